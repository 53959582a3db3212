"""Motion under constant input against 50-digit references and the published values."""

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
)
from piga.instrument.motion import constant_motion
from piga.units import G0
from tests.instrument.references import EPS, constant_cases

pytestmark = pytest.mark.interpreted

PUBLISHED = Instrument("0.8884 rad/s/g", "1000 arcsec", math.pi / 4)
TABLE = [  # a_x [g], t [s], alpha [rad], rate [rad/s]: the published case, 50-digit arithmetic
    (0.0, 10, 0.9491746985354608, 0.01750704037230992),
    (0.0, 100, 2.595170058228499, 0.01119062745661036),
    (5 * PUBLISHED.tan_beta, 10, 1.178202539030557, 0.04143275317062007),
    (5 * PUBLISHED.tan_beta, 100, 3.668827377185051, 0.01070005577036106),
    (0.01, 10, 1.044035858736815, 0.02750023252002772),
    (0.01, 100, 3.084120483267742, 0.01012101598663986),
    (1.0, 1, 1.693465728913634, 0.9097737640725562),
    (1.0, 10, 9.707147027250887, 0.882399501802617),
    (1.0, 100, 89.61827271643399, 0.9098616660388023),
]


@pytest.mark.parametrize(("a_x", "t", "alpha", "rate"), TABLE)
def test_published_case_to_the_digits_given(a_x, t, alpha, rate):
    computed = closed_form(PUBLISHED, t, a_x * G0, 5 * G0, 0.0)
    assert computed[0] == pytest.approx(alpha, rel=0, abs=1e-15 * max(1.0, alpha) * 2)
    assert computed[1] == pytest.approx(rate, rel=0, abs=2e-16)


@pytest.mark.parametrize("case", constant_cases(), ids=lambda c: c.case)
def test_against_high_precision(case):
    turns, rest, rate = constant_motion(case.inst, [case.t], [case.force], np.zeros((1, 3)), onward=False)[:, 0]
    tolerance = 1e-12
    difference = (turns - case.turns) * 2 * math.pi + (rest - case.rest)
    assert abs(difference) < tolerance
    if abs(case.rest) < math.pi - tolerance:
        assert turns == case.turns
    speed = case.inst.scale_factor * (abs(case.force[0]) + case.inst.tan_beta * np.hypot(*case.force[1:]))
    assert abs(rate - case.rate) < tolerance * max(speed, 1e-3)
    alpha, _ = closed_form(case.inst, case.t, *case.force)
    assert abs(alpha - (2 * math.pi * case.turns + case.rest)) < tolerance + 2 * EPS * abs(alpha)


def test_a_thousand_million_revolutions_keep_their_fraction():
    inst = Instrument("0.8884 rad/s/g", 0.0, 0.25)
    seconds = 2.0**33
    turns, rest, _ = constant_motion(inst, [seconds], [[G0, 0.0, 0.0]], np.zeros((1, 3)), onward=False)[:, 0]
    phase = inst.scale_factor * G0  # the exact product, revolution by revolution, in integers
    exact = (int(inst.scale_factor * 2**60) * int(G0 * 2**50) << 33) + (int(0.25 * 2**60) << 50)
    two_pi = int("6283185307179586476925286766559005768394338798750211641949889184615") * 2**110 // 10**66
    assert turns == pytest.approx(phase * seconds / (2 * math.pi), abs=1)
    assert turns > 1.2e9
    assert (exact - int(turns) * two_pi) / 2**110 == pytest.approx(rest, abs=1e-14)


def test_rate_that_decays_keeps_its_digits():
    """The locked rate falls as exp(-t/tau); a + b sin(theta) would leave noise of 1e-18."""
    a_x = 0.01 * G0
    _, rate = closed_form(PUBLISHED, [2000.0, 2100.0], a_x, 5 * G0, 0.0)
    b = 5 * G0 * PUBLISHED.tan_beta
    decay = PUBLISHED.scale_factor * math.sqrt((b - a_x) * (b + a_x))
    assert rate[0] < 1e-15
    assert rate[1] / rate[0] == pytest.approx(math.exp(-100 * decay), rel=1e-10)
    assert locking_time(PUBLISHED, a_x, 5 * G0, 0.0) == pytest.approx(1.0 / decay, rel=1e-12)


def test_shape_follows_time_and_scalars_stay_scalars():
    alpha, rate = closed_form(PUBLISHED, np.zeros((2, 3)), G0, G0, 0.0)
    assert alpha.shape == rate.shape == (2, 3)
    assert np.all(alpha == math.pi / 4)
    assert closed_form(PUBLISHED, 0.0, G0, G0, 0.0)[0].shape == ()


def test_base_rate_enters_as_u():
    omega = np.array([3e-5, -2e-5, 6e-5])
    f = (0.3 * G0, 5 * G0, -G0)
    with_rate = closed_form(PUBLISHED, 50.0, *f, base_rate=omega)
    moved = np.array(f) - omega / PUBLISHED.scale_factor
    assert np.array(with_rate) == pytest.approx(np.array(closed_form(PUBLISHED, 50.0, *moved)), abs=1e-12)


@pytest.mark.parametrize(
    ("t", "a_x", "message"),
    [
        ([0.0, math.nan], 1.0, "t: nan at index 1"),
        ([], 1.0, "t: empty"),
        (1.0, math.inf, "a_x: holds a value that is not a finite number"),
    ],
)
def test_bad_input_is_named(t, a_x, message):
    with pytest.raises(piga.ArgumentError, match=message):
        closed_form(PUBLISHED, t, a_x, 0.0, 0.0)
    with pytest.raises(piga.ArgumentError, match="base_rate: shape"):
        closed_form(PUBLISHED, 1.0, 1.0, 0.0, 0.0, base_rate=[1.0])


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


def test_borders():
    b = 5 * G0 * PUBLISHED.tan_beta
    low, high = dead_zone(PUBLISHED, 5 * G0, 0.0)
    assert (low, high) == pytest.approx((-b, b), rel=1e-15)
    assert regime(PUBLISHED, float(high) * 0.999, 5 * G0, 0.0) == "locked"
    assert mean_rate(PUBLISHED, b * 0.99, 5 * G0, 0.0) == 0.0
    assert revolution_period(PUBLISHED, 0.0, 5 * G0, 0.0) == math.inf
    assert np.isnan(locking_time(PUBLISHED, 2 * b, 5 * G0, 0.0))
    assert np.isnan(fixed_points(PUBLISHED, 2 * b, 5 * G0, 0.0)).all()
    assert np.isnan(fixed_points(Instrument(0.09), 0.0, 5 * G0, 0.0)).all()


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
    for function in (mean_rate, revolution_period):
        with_rate = function(PUBLISHED, 0.2, *TRANSVERSE, base_rate=omega)
        assert with_rate == pytest.approx(function(PUBLISHED, *shifted), rel=1e-12)
    low, high = dead_zone(PUBLISHED, *TRANSVERSE, base_rate=omega)
    assert (low + high) / 2 == pytest.approx(omega[0] / PUBLISHED.scale_factor, rel=1e-12)


def test_bad_forces():
    with pytest.raises(piga.ArgumentError, match="a_x"):
        mean_rate(PUBLISHED, math.nan, 0.0, 0.0)
    with pytest.raises(piga.ArgumentError, match="do not fit"):
        mean_rate(PUBLISHED, [1, 2], [1, 2, 3], 0.0)
    with pytest.raises(piga.ArgumentError, match="base_rate"):
        mean_rate(PUBLISHED, 1.0, 0.0, 0.0, base_rate=[1.0])
