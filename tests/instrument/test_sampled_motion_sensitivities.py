"""Derivatives of the motion against the complex step through an independent plain evaluation, in every regime."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest

import piga
from piga.instrument import SENSITIVITY_NAMES, Instrument, closed_form, propagate, sensitivities

pytestmark = pytest.mark.interpreted

INST = Instrument(0.0906, 0.02, -2.5)


def plain_motion(K, beta, alpha0, t, f, omega):
    """Equation (4) of docs/theory/motion with Magnus increments, for complex arguments."""
    alpha, out = alpha0, [alpha0]
    u = K * f - omega
    r = np.stack([u[:, 0], cmath.tan(beta) * u[:, 1], cmath.tan(beta) * u[:, 2]], axis=1)
    for k in range(t.size - 1):
        h, (a0, y0, z0), (a1, y1, z1) = t[k + 1] - t[k], r[k], r[k + 1]
        A = h * (a0 + a1) / 2 + h**2 / 12 * (y0 * z1 - z0 * y1)
        Y = h * (y0 + y1) / 2 + h**2 / 12 * (a0 * z1 - z0 * a1)
        Z = h * (z0 + z1) / 2 - h**2 / 12 * (a0 * y1 - y0 * a1)
        x = cmath.sqrt((Y * Y + Z * Z - A * A) / 4)
        C, S = cmath.cosh(x), cmath.sinh(x) / x
        sine, cosine = cmath.sin(alpha), cmath.cos(alpha)
        top, bottom = S * (A + Y * sine - Z * cosine) / 2, C - S * (Y * cosine + Z * sine) / 2
        branch = math.pi if bottom.real < 0 else 0.0
        step = 2 * (cmath.atan(top / bottom) + (branch if top.real > 0 else -branch))
        alpha = alpha + step
        out.append(alpha)
    out = np.array(out)
    return out, r[:, 0] + r[:, 1] * np.sin(out) - r[:, 2] * np.cos(out)


def compare(inst, t, f, omega, column):
    """The derivative by one parameter or component against the complex step."""
    arguments, shifted = [inst.scale_factor, inst.beta, inst.alpha0], f.astype(complex)
    if column < 3:
        arguments[column] += 1e-40j
    else:
        shifted[:, column - 3] += 1e-40j
    alpha, rate = plain_motion(*arguments, t, shifted, omega)
    result, name = sensitivities(inst, t, f, omega), SENSITIVITY_NAMES[column]
    assert result.alpha == pytest.approx(alpha.real, abs=1e-11)
    for mine, theirs in ((result.of_alpha(name), alpha.imag), (result.of_rate(name), rate.imag)):
        assert mine == pytest.approx(theirs * 1e40, abs=1e-10 * np.abs(theirs * 1e40).max())


@pytest.mark.parametrize(("h", "size"), [(0.02, 15.0), (0.6, 15.0), (0.6, 60.0)])
@pytest.mark.parametrize("column", range(6))
def test_against_the_complex_step(h, size, column):
    rng = np.random.default_rng(4)
    t = np.cumsum(rng.uniform(0.5, 1.5, 40) * h)
    compare(INST, t, rng.normal(0.0, size, (40, 3)), rng.normal(0.0, 0.05, (40, 3)), column)


def test_motion_is_that_of_propagate():
    rng = np.random.default_rng(5)
    t, f = np.arange(50) * 0.05, rng.normal(0.0, 20.0, (50, 3))
    result = sensitivities(INST, t, f)
    alpha, rate = propagate(INST, t, f, with_rate=True, between="linear")
    assert result.alpha == pytest.approx(alpha, abs=1e-13)
    assert result.rate == pytest.approx(rate, abs=1e-13)


def test_locked_gimbal_forgets_its_start():
    """d(alpha)/d(alpha0) decays with twice the locking rate of the half angle."""
    t = np.linspace(0.0, 400.0, 41)
    force = (0.02, 50.0, 0.0)
    forgotten = sensitivities(INST, t, np.tile(force, (41, 1))).of_alpha("alpha0")
    _, rate = closed_form(INST, t, *force)
    assert forgotten == pytest.approx(rate / rate[0], rel=1e-9)


def test_bad_input_is_named():
    with pytest.raises(piga.ArgumentError, match=r"f: nan at index \(1, 0\)"):
        sensitivities(INST, [0.0, 1.0], [[0, 0, 0], [math.nan, 0, 0]])
    with pytest.raises(piga.ArgumentError, match="too large"):
        sensitivities(INST, [0.0, 1e9], np.ones((2, 3)))


BETA = 0.6


@pytest.mark.parametrize("square", [-4.0, -0.9, -0.51, -0.49, -0.05, 0.05, 0.49, 0.51, 0.9, 1.5, 4.0])
@pytest.mark.parametrize("column", range(6))
def test_single_steps_against_the_complex_step(square: float, column: int) -> None:
    """``square`` is (Y^2 + Z^2 - A^2)/4 of the steps: negative where the output turns, positive where it is locked."""
    inst, h, n = Instrument(0.0906, BETA, 0.3), 0.25, 6
    long, short = 2.0 * math.sqrt(abs(square) + 0.01), 0.2
    a, across = (long, short) if square < 0.0 else (short, long)
    rates = np.tile(np.array([a, 0.8 * across, -0.6 * across]) / h, (n, 1))
    rates *= 1.0 + 0.01 * np.sin(np.arange(n))[:, None]
    f = rates / (0.0906 * np.array([1.0, math.tan(BETA), math.tan(BETA)]))
    t, omega = h * np.arange(n), np.zeros((n, 3))
    outcome = ((rates[:, 1:] ** 2).sum(axis=1) - rates[:, 0] ** 2) * h**2 / 4.0
    assert np.abs(outcome / square - 1.0).max() < 0.1
    compare(inst, t, f, omega, column)
