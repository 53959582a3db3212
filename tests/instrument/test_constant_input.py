"""Motion under constant input against 50-digit references and the published values."""

import math

import numpy as np
import pytest

import piga
from piga.instrument import Instrument, closed_form, closed_form_turns
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
    turns, rest, rate = closed_form_turns(case.inst, case.t, *case.force)
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
    turns, rest, _ = closed_form_turns(inst, seconds, G0, 0.0, 0.0)
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
