"""Derivatives of single steps in every regime: slowly and fast turning, pulled and locked, near the borders between them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from piga.instrument import SENSITIVITY_NAMES, Instrument, sensitivities
from tests.instrument.motion.test_sensitivity import plain_motion

pytestmark = pytest.mark.compiled

BETA = 0.6


@pytest.mark.parametrize("square", [-4.0, -0.9, -0.51, -0.49, -0.05, 0.05, 0.49, 0.51, 0.9, 1.5, 4.0])
@pytest.mark.parametrize("column", range(6))
def test_against_the_complex_step(square: float, column: int) -> None:
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
    arguments, shifted = [inst.scale_factor, inst.beta, inst.alpha0], f.astype(complex)
    if column < 3:
        arguments[column] += 1e-40j
    else:
        shifted[:, column - 3] += 1e-40j
    alpha, rate = plain_motion(*arguments, t, shifted, omega)
    result = sensitivities(inst, t, f, omega)
    name = SENSITIVITY_NAMES[column]
    assert result.alpha == pytest.approx(alpha.real, abs=1e-12)
    for mine, theirs in ((result.of_alpha(name), alpha.imag), (result.of_rate(name), rate.imag)):
        assert mine == pytest.approx(theirs * 1e40, abs=1e-11 * np.abs(theirs * 1e40).max())
