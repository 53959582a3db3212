"""Long-run behaviour under constant input, against the exact motion and 50-digit arithmetic."""

import math

import mpmath as mp
import numpy as np
import pytest

import piga
from piga.instrument import (
    Instrument,
    closed_form,
    dead_zone,
    fixed_points,
    locking_time,
    mean_rate,
    regime,
    revolution_period,
    separatrix_distance,
)
from piga.units import G0

PUBLISHED = Instrument("0.8884 rad/s/g", "1000 arcsec", math.pi / 4)
TRANSVERSE = (3 * G0, -4 * G0)


def test_published_mean_rate_and_period():
    assert np.degrees(mean_rate(PUBLISHED, G0, 5 * G0, 0.0)) == pytest.approx(50.8866129320529, abs=1e-12)
    assert revolution_period(PUBLISHED, G0, 5 * G0, 0.0) == pytest.approx(7.0745522104349, abs=1e-13)


@pytest.mark.parametrize("beta", [0.01, -0.01])
def test_fixed_points_are_at_rest_and_rightly_stable(beta):
    inst = Instrument(0.09, beta)
    for a_x in (-0.4, 0.0, 0.3):
        for kind, angle in zip(("stable", "unstable"), fixed_points(inst, a_x, *TRANSVERSE), strict=True):
            near = Instrument(0.09, beta, float(angle) + 1e-4)
            _, at_rest = closed_form(Instrument(0.09, beta, float(angle)), 0.0, a_x, *TRANSVERSE)
            alpha, _ = closed_form(near, [0.0, 5.0], a_x, *TRANSVERSE)
            assert at_rest == pytest.approx(0.0, abs=1e-16)
            assert (abs(alpha[1] - angle) < abs(alpha[0] - angle)) == (kind == "stable")


def test_locking_time_is_the_decay_of_the_motion():
    a_x = 0.01 * G0
    _, rate = closed_form(PUBLISHED, [1500.0, 1600.0], a_x, 5 * G0, 0.0)
    tau = locking_time(PUBLISHED, a_x, 5 * G0, 0.0)
    assert 100.0 / math.log(rate[0] / rate[1]) == pytest.approx(tau, rel=1e-6)


def test_borders():
    b = 5 * G0 * PUBLISHED.tan_beta
    low, high = dead_zone(PUBLISHED, 5 * G0, 0.0)
    assert (low, high) == pytest.approx((-b, b), rel=1e-15)
    assert regime(PUBLISHED, float(high) * 0.999, 5 * G0, 0.0) == "locked"
    assert mean_rate(PUBLISHED, b * 0.99, 5 * G0, 0.0) == 0.0
    assert revolution_period(PUBLISHED, 0.0, 5 * G0, 0.0) == math.inf
    assert locking_time(PUBLISHED, 2 * b, 5 * G0, 0.0) != locking_time(PUBLISHED, 2 * b, 5 * G0, 0.0)
    assert np.isnan(fixed_points(PUBLISHED, 2 * b, 5 * G0, 0.0)).all()
    assert np.isnan(fixed_points(Instrument(0.09), 0.0, 5 * G0, 0.0)).all()
    assert separatrix_distance(PUBLISHED, [-2 * b, 0.5 * b], 5 * G0, 0.0) == pytest.approx(
        [b, -b / 2], rel=1e-14
    )


@pytest.mark.parametrize("distance", [1e-3, 1e-9, 1e-14])
def test_mean_rate_near_the_separatrix_keeps_half_the_digits_that_are_there(distance):
    b = PUBLISHED.tan_beta * math.hypot(*TRANSVERSE)
    a_x = b * (1 + distance)
    with mp.workdps(50):
        K, a = mp.mpf(PUBLISHED.scale_factor), mp.mpf(a_x)
        square = mp.mpf(PUBLISHED.tan_beta) ** 2 * sum(mp.mpf(v) ** 2 for v in TRANSVERSE)
        reference = float(K * mp.sqrt(a * a - square))
    kappa = 0.5 / distance
    assert mean_rate(PUBLISHED, a_x, *TRANSVERSE) == pytest.approx(reference, rel=5e-16 * kappa + 1e-15)


def test_base_rate_shifts_everything():
    omega = np.array([1e-3, 2e-3, -1e-3])
    shifted = np.array([0.2, *TRANSVERSE]) - omega / PUBLISHED.scale_factor
    for function in (mean_rate, separatrix_distance, revolution_period):
        with_rate = function(PUBLISHED, 0.2, *TRANSVERSE, base_rate=omega)
        assert with_rate == pytest.approx(function(PUBLISHED, *shifted), rel=1e-12)
    low, high = dead_zone(PUBLISHED, *TRANSVERSE, base_rate=omega)
    assert (low + high) / 2 == pytest.approx(omega[0] / PUBLISHED.scale_factor, rel=1e-12)


def test_bad_input():
    with pytest.raises(piga.ArgumentError, match="a_x"):
        mean_rate(PUBLISHED, math.nan, 0.0, 0.0)
    with pytest.raises(piga.ArgumentError, match="do not fit"):
        mean_rate(PUBLISHED, [1, 2], [1, 2, 3], 0.0)
    with pytest.raises(piga.ArgumentError, match="base_rate"):
        mean_rate(PUBLISHED, 1.0, 0.0, 0.0, base_rate=[1.0])
