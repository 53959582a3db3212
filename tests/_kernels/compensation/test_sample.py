"""Intervals of an angle log, and codes of coefficients."""

from __future__ import annotations

import numba
import numpy as np
import pytest

import piga
from piga.units import G0
from tests.compensation.twin_data import (
    K_G,
    TAN_BETA,
    calibration_of,
    mean_force,
    run_of,
)

pytestmark = pytest.mark.interpreted

CAL = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.4})
SECONDS = 4.0 if numba.config.DISABLE_JIT else 20.0


def smooth(t: np.ndarray) -> np.ndarray:
    """A force that sways along X0 and goes linearly across, where smooth samples mean a smooth force [m/s^2]."""
    a = 1.0 + 0.3 * np.sin(np.pi * t)
    return G0 * np.stack([a, 5.0 + 0.05 * t, 0.4 - 0.03 * t], axis=1)


@pytest.mark.parametrize("rate", [50.0, 100.0, 400.0])
def test_smooth_force_comes_back_to_1e12_g(rate):
    """From the fourth interval on, plus the rounding of the angle; 3e-11 g at 50 Hz."""
    t = np.arange(0.0, SECONDS, 1.0 / rate)
    run = run_of(t, smooth(t), phi=0.4)
    rounding = 2 * np.finfo(float).eps * np.abs(run.output).max() * rate / run.scale_factor
    left = np.abs(piga.compensate(run, CAL).ax[1:] - mean_force(smooth(t)))[3:]
    assert left.max() < (4e-11 if rate < 100.0 else 2e-12) * G0 + 2.0 * rounding


def test_uneven_intervals_cost_the_higher_differences_only():
    rng = np.random.default_rng(3)
    t = np.cumsum(0.01 * (1.0 + 0.2 * rng.random(500)))
    left = np.abs(piga.compensate(run_of(t, smooth(t), phi=0.4), CAL).ax[1:] - mean_force(smooth(t)))[3:]
    assert left.max() < 1e-8 * G0
