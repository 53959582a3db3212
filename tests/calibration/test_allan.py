"""Allan deviation: against allantools, against the noise put in, over stretches that are not joined."""

from __future__ import annotations

import numpy as np
import pytest

from piga.calibration.allan import allan_deviation, drift_line, equivalent_degrees, model_deviation
from piga.errors import ArgumentError

allantools = pytest.importorskip("allantools")

STEP = 0.05


def angle(rng: np.random.Generator, samples: int, white: float, walk: float):
    path = np.cumsum(np.sqrt(walk * STEP) * rng.standard_normal(samples))
    return path + np.sqrt(white) * rng.standard_normal(samples)


def one_stretch(samples: int):
    begins = np.zeros(samples, dtype=bool)
    begins[0] = True
    return np.arange(samples) * STEP, begins


def test_one_stretch_as_allantools():
    x = angle(np.random.default_rng(1), 4000, 1e-10, 1e-11)
    t, begins = one_stretch(4000)
    deviation = allan_deviation(x, t, begins, white=1e-10, walk=1e-11)
    tau, reference, _, _ = allantools.oadev(x, rate=1.0 / STEP, data_type="phase", taus=deviation.tau)
    assert tau == pytest.approx(deviation.tau, rel=1e-12)
    assert deviation.deviation == pytest.approx(reference, rel=1e-9)


@pytest.mark.parametrize(("walking", "kind"), [(False, 2), (True, 0)])
@pytest.mark.parametrize("m", [1, 3, 30, 300])
def test_degrees_of_freedom_as_allantools(m: int, walking: bool, kind: int):
    assert equivalent_degrees(1001, m, walking=walking) == pytest.approx(allantools.edf_simple(1001, m, kind))


def test_band_as_allantools():
    """68 % band of chi-square with these degrees of freedom."""
    x = angle(np.random.default_rng(2), 1001, 1e-10, 0.0)
    t, begins = one_stretch(1001)
    deviation = allan_deviation(x, t, begins, white=1e-10, walk=0.0)
    for index in (0, deviation.tau.size - 1):
        low, high = allantools.confidence_interval(
            deviation.deviation[index], deviation.degrees_of_freedom[index], ci=0.682689492137
        )
        assert (deviation.lower[index], deviation.upper[index]) == pytest.approx((low, high), rel=1e-6)


def test_bands_hold_the_model():
    """In 68 % of many records the band holds the deviation of the noise put in, at short and at long times."""
    rng, white, walk = np.random.default_rng(3), 4e-10, 1e-10
    inside = []
    for _ in range(150):
        x = np.concatenate([angle(rng, 400, white, walk) for _ in range(6)])
        t, begins = one_stretch(x.size)
        begins[::400] = True
        deviation = allan_deviation(x, t, begins, white=white, walk=walk)
        true = np.hypot(*model_deviation(deviation.tau, white, walk))
        inside.append((deviation.lower < true) & (true < deviation.upper))
    share = np.mean(inside, axis=0)
    assert share.min() > 0.55
    assert share.max() < 0.82


def test_stretches_are_not_joined():
    """A step between stretches leaves no trace, and each counts by its differences."""
    rng = np.random.default_rng(4)
    parts = [angle(rng, samples, 1e-10, 1e-11) for samples in (500, 1500)]
    x = np.concatenate([parts[0], parts[1] + 1.0])
    t, begins = one_stretch(x.size)
    begins[500] = True
    t[500:] += 100.0
    deviation = allan_deviation(x, t, begins, white=1e-10, walk=1e-11)
    alone = [allan_deviation(p, *one_stretch(p.size), white=1e-10, walk=1e-11) for p in parts]
    pooled = np.sqrt((498 * alone[0].deviation[0] ** 2 + 1498 * alone[1].deviation[0] ** 2) / 1996)
    assert deviation.deviation[0] == pytest.approx(pooled, rel=1e-12)
    assert deviation.stretches[0] == 2
    assert deviation.stretches[-1] == 1
    assert deviation.deviation.max() < 1e-3


def test_uneven_sampling_is_read_on_an_even_grid():
    t = np.sort(np.random.default_rng(5).uniform(0.0, 200.0, 4000))
    begins = np.zeros(t.size, dtype=bool)
    deviation = allan_deviation(0.3 * t + 1e-4 * t**2, t, begins, white=1e-10, walk=0.0)
    assert deviation.deviation[-1] == pytest.approx(np.sqrt(2.0) * 1e-4 * deviation.tau[-1], rel=1e-2)


def test_random_walk_of_the_rate_has_the_slope_of_the_drift_line():
    rng, level = np.random.default_rng(6), 1e-6
    rate = np.cumsum(level * np.sqrt(STEP) * rng.standard_normal(60_000))
    t, begins = one_stretch(rate.size)
    deviation = allan_deviation(np.cumsum(rate) * STEP, t, begins, white=1e-20, walk=1e-20)
    middle = (deviation.tau > 1.0) & (deviation.tau < 30.0)
    assert deviation.deviation[middle] == pytest.approx(drift_line(deviation.tau[middle], level), rel=0.25)


def test_long_records_are_thinned_to_the_same_figure():
    x = angle(np.random.default_rng(7), 300_000, 1e-10, 1e-11)
    t, begins = one_stretch(x.size)
    deviation = allan_deviation(x, t, begins, white=1e-10, walk=1e-11)
    _, reference, _, _ = allantools.oadev(x, rate=1.0 / STEP, data_type="phase", taus=deviation.tau[:20])
    assert deviation.deviation[:20] == pytest.approx(reference, rel=0.01)


def test_too_short_and_unequal():
    t, begins = one_stretch(3)
    assert allan_deviation(np.zeros(3), t, begins, white=1.0, walk=0.0).tau.size == 0
    with pytest.raises(ArgumentError, match="3, 3 and 2"):
        allan_deviation(np.zeros(3), t, begins[:2], white=1.0, walk=0.0)
