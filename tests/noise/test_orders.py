import dataclasses
import math

import numpy as np
import pytest

from piga.calibration.weights import count_size
from piga.noise.orders import order_spectrum, ripple
from piga.records.calibration.diagnostics import Residuals
from piga.units import ARCSEC, G0
from tests.reports.example import TAN_BETA, K, residuals, ripple_integral

MICRO_G = 1e-6 * G0


def ramp(order_2, seed=3, rows=30_000):
    """One segment with the input ramping from 0.5 to 2 g, unevenly sampled, with a hole of five turns."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.004, 0.016, rows))
    keep = (t < 150.0) | (t > 190.0)
    a_x = G0 * (0.5 + 1.5 * t / t[-1])
    psi = 0.7 + np.concatenate(([0.0], np.cumsum(K * 0.5 * (a_x[1:] + a_x[:-1]) * np.diff(t))))
    after = K * order_2 * ripple_integral(psi, t, 2, 1.1) + 3e-8 * t
    columns = (np.arange(1, rows + 1), t, psi, a_x, 3.0 * after, after, after * 0.0)
    return Residuals(*(column[keep] for column in columns), np.zeros(int(keep.sum()), dtype=np.int32))


def at(spectrum, order):
    return int(np.argmin(np.abs(spectrum.order - order)))


def test_planted_second_order_is_found_to_one_percent():
    planted = 50.0 * MICRO_G
    spectrum = order_spectrum(residuals(order_2=planted, uneven=True, white=0.5 * ARCSEC, walk=0.2 * ARCSEC), K)
    assert spectrum.after[at(spectrum, 2)] == pytest.approx(planted, rel=0.004)
    assert spectrum.before[at(spectrum, 2)] == pytest.approx(planted, rel=0.01)
    assert spectrum.after[at(spectrum, 4)] < 0.05 * planted


def test_changing_rate_uneven_samples_and_a_hole_do_no_harm():
    planted = 20.0 * MICRO_G
    spectrum = order_spectrum(ramp(planted), K)
    assert spectrum.segments == 1
    # The hole is bridged as if the rate were constant there: 0.1 % is what that costs here.
    assert spectrum.after[at(spectrum, 2)] == pytest.approx(planted, rel=0.01)
    assert spectrum.before[at(spectrum, 2)] == pytest.approx(3 * planted, rel=0.01)


def test_noise_alone_lies_on_the_expected_noise():
    white, walk = 2.2 * ARCSEC, 1.2 * ARCSEC
    ratios = []
    for seed in range(6):
        spectrum = order_spectrum(residuals(seed=seed, white=white, walk=walk), K, (white, walk))
        shown = spectrum.order >= 1.0
        ratios.append(np.mean((spectrum.after / spectrum.noise)[shown] ** 2))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.15)


def test_segments_that_hardly_turn_are_left_out():
    result = residuals()
    still = dataclasses.replace(result, psi=result.psi * 1e-3)
    assert order_spectrum(still, K).segments == 0
    assert np.isnan(order_spectrum(still, K).after).all()
    assert ripple(still, K).segments == 0


def test_standing_samples_of_a_coarse_encoder_keep_their_time():
    rows, planted = 60_000, 80.0 * MICRO_G
    t = 0.002 * np.arange(rows)
    psi = K * 0.2 * G0 * t + 0.3
    after = K * planted * ripple_integral(psi, t, 2, 0.0)
    coarse = np.round(psi / 1e-3) * 1e-3
    zeros = np.zeros(rows)
    result = Residuals(np.arange(rows), t, coarse, zeros, after, after, zeros, zeros.astype(np.int32))
    spectrum = order_spectrum(result, K)
    assert spectrum.after[at(spectrum, 2)] == pytest.approx(planted, rel=0.01)


def test_ripple_shows_the_cross_coupling_and_its_removal():
    turned = ripple(residuals(), K)
    mean = math.fsum(turned.before) / turned.before.size
    first = 2.0 * np.mean((turned.before - mean) * np.exp(1j * turned.psi))
    # 22 of the 24 positions turn; their mean transverse force is the mean of |sin| over them.
    used = [abs(math.sin(math.radians(15 * s))) for s in range(24) if s not in {6, 18}]
    assert abs(first) == pytest.approx(TAN_BETA * G0 * float(np.mean(used)), rel=0.05)
    assert np.max(np.abs(turned.after)) < 0.15 * abs(first)
    assert np.all(np.abs(turned.after) < 6.0 * turned.scatter)


def test_a_ripple_of_one_segment_is_in_its_own_spectrum_only():
    """Ripple planted in segment 3; segments 2 and 4 turn as far and have none."""
    planted = 50.0 * MICRO_G
    plain = residuals(white=0.5 * ARCSEC, walk=0.2 * ARCSEC)
    at_three = plain.segment == 3
    extra = np.zeros(plain.t.size)
    extra[at_three] = K * planted * ripple_integral(plain.psi[at_three], plain.t[at_three], 2, 0.3)
    spectrum = order_spectrum(dataclasses.replace(plain, after=plain.after + extra), K)
    single = dict(spectrum.single)
    line = at(spectrum, 2)
    assert len(single) == spectrum.segments
    assert single[3][line] == pytest.approx(planted, rel=0.02)
    assert max(single[2][line], single[4][line]) < 0.1 * planted


COUNT = 2.0 * math.pi / 72_000


def counted(per_sample, rows=6000, white=0.0, planted=0.0, seed=5):
    """A segment read in whole counts, so many of them per sample; ``planted`` [m/s^2] is a ripple at order 2."""
    noise = white * np.random.default_rng(seed).standard_normal(rows)
    path = COUNT * per_sample * np.arange(rows) + 0.1
    t, zeros = path / (K * G0), np.zeros(rows)
    angle = path + K * planted * ripple_integral(path, t, 2, 0.3)
    psi = COUNT * np.round((angle + noise) / COUNT)
    after = psi - path
    return Residuals(np.arange(rows), t, psi, zeros, after, after, zeros, zeros.astype(np.int32))


def test_the_beat_of_counts_with_the_sampling_is_a_line_that_counts_explain():
    """Where 508 counts per sample less a little make the rounding error turn 3.375 times in a revolution: q/pi in amplitude."""
    per_sample, beat = 508.0 / (1.0 + 3.375 / 72_000), 3.375
    spectrum = order_spectrum(counted(per_sample), K, (COUNT / math.sqrt(12.0), 0.0))
    height = COUNT / math.pi * beat * G0
    line = at(spectrum, beat)
    assert spectrum.counts[line] == pytest.approx(height, rel=0.1)
    assert spectrum.after[line] == pytest.approx(spectrum.counts[line], rel=0.01)
    assert [(order, explained) for order, _, explained in spectrum.lines()] == [(spectrum.order[line], True)]


def test_a_ripple_that_is_no_beat_is_a_line_without_explanation():
    spectrum = order_spectrum(counted(507.3713, planted=30 * MICRO_G), K, (COUNT / math.sqrt(12.0), 0.0))
    assert [(order, explained) for order, _, explained in spectrum.lines()] == [(2.0, False)]


def test_the_size_of_a_count_is_read_from_the_angles():
    psi = COUNT * np.round(np.cumsum(np.random.default_rng(2).uniform(0, 9, 4000)))
    assert count_size(psi) == pytest.approx(COUNT, rel=1e-9)
    assert count_size(psi + 1e-7 * np.random.default_rng(3).standard_normal(4000)) == 0.0
