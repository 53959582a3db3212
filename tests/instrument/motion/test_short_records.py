"""Records of one, two and three intervals: slopes at both ends come from the few intervals that there are."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from piga.instrument import Instrument, propagate, propagate_increments

pytestmark = pytest.mark.compiled

INST = Instrument(0.0906, 0.3, 0.4)
START, SLOPE = np.array([4.0, 20.0, -9.0]), np.array([3.0, -40.0, 70.0])


def reference(t: np.ndarray) -> np.ndarray:
    """Angle under the force ``START + SLOPE t`` by tight DOP853."""

    def rate(time: float, alpha: np.ndarray) -> list[float]:
        u = INST.scale_factor * (START + SLOPE * time)
        return [u[0] + INST.tan_beta * (u[1] * np.sin(alpha[0]) - u[2] * np.cos(alpha[0]))]

    return solve_ivp(rate, (t[0], t[-1]), [0.4], "DOP853", t, rtol=1e-13, atol=1e-14).y[0]


@pytest.mark.parametrize("count", [2, 3, 4, 5])
@pytest.mark.parametrize("even", [True, False])
def test_increments_of_a_linear_force_lose_the_fifth_order_only(count: int, even: bool) -> None:
    """Half the interval: a thirty-second of the error of a step, at the ends as inside."""
    errors = []
    for h in (0.08, 0.04, 0.02):
        t = h * (np.arange(count + 1) + (0.0 if even else 0.2 * np.sin(np.arange(count + 1))))
        dv = np.diff(START * t[:, None] + 0.5 * SLOPE * t[:, None] ** 2, axis=0)
        errors.append(np.abs(propagate_increments(INST, t, dv) - reference(t)).max())
    assert np.log2(errors[0] / errors[2]) / 2.0 > 4.5
    assert errors[2] < 1e-8


def test_one_increment_is_a_constant_rate() -> None:
    t, f = np.array([0.0, 0.05]), np.tile(START, (2, 1))
    assert propagate_increments(INST, t, 0.05 * START[None, :]) == pytest.approx(
        propagate(INST, t, f), abs=1e-15
    )


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_samples_of_a_linear_force_lose_the_fifth_order_only(count: int) -> None:
    errors = []
    for h in (0.08, 0.04, 0.02):
        t = h * np.arange(count + 1)
        errors.append(np.abs(propagate(INST, t, START + SLOPE * t[:, None]) - reference(t)).max())
    assert np.log2(errors[0] / errors[2]) / 2.0 > 4.5


@pytest.mark.parametrize("h", [0.05, 0.7, 3.0, 20.0])
def test_the_rate_is_that_of_the_angle_whatever_the_step(h: float) -> None:
    """Steps of many turns are taken one by one: the rate at a sample must still be the one of its own angle."""
    t = h * np.arange(12)
    f = np.array([-30.0, 40.0, 3.0]) + np.sin(np.arange(12))[:, None]
    alpha, rate = propagate(INST, t, f, with_rate=True)
    u = INST.scale_factor * f
    expected = u[:, 0] + INST.tan_beta * (u[:, 1] * np.sin(alpha) - u[:, 2] * np.cos(alpha))
    assert rate == pytest.approx(expected, abs=1e-12 + 4.0 * np.spacing(np.abs(alpha).max()))
