"""Intervals of an angle log, and codes of coefficients."""

from __future__ import annotations

import numba
import numpy as np
import pytest

import piga
from piga._kernels.compensation import data as at
from piga.compensation.model import make_model
from piga.units import G0
from tests.compensation.twin_data import (
    K_G,
    TAN_BETA,
    calibration_of,
    mean_force,
    run_of,
)

CAL = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.4})
SECONDS = 4.0 if numba.config.DISABLE_JIT else 20.0


def smooth(t: np.ndarray) -> np.ndarray:
    """A force that sways along X0 and goes linearly across, where smooth samples mean a smooth force [m/s^2]."""
    a = 1.0 + 0.3 * np.sin(np.pi * t)
    return G0 * np.stack([a, 5.0 + 0.05 * t, 0.4 - 0.03 * t], axis=1)


@pytest.mark.interpreted
@pytest.mark.parametrize("rate", [50.0, 100.0, 400.0])
def test_smooth_force_comes_back_to_1e12_g(rate):
    """From the fourth interval on, plus the rounding of the angle; 3e-11 g at 50 Hz."""
    t = np.arange(0.0, SECONDS, 1.0 / rate)
    run = run_of(t, smooth(t), phi=0.4)
    rounding = 2 * np.finfo(float).eps * np.abs(run.output).max() * rate / run.scale_factor
    left = np.abs(piga.compensate(run, CAL).ax[1:] - mean_force(smooth(t)))[3:]
    assert left.max() < (4e-11 if rate < 100.0 else 2e-12) * G0 + 2.0 * rounding


@pytest.mark.interpreted
def test_uneven_intervals_cost_the_higher_differences_only():
    rng = np.random.default_rng(3)
    t = np.cumsum(0.01 * (1.0 + 0.2 * rng.random(500)))
    left = np.abs(piga.compensate(run_of(t, smooth(t), phi=0.4), CAL).ax[1:] - mean_force(smooth(t)))[3:]
    assert left.max() < 1e-8 * G0


def test_coefficients_have_codes_of_their_own():
    """The code of the scale factor was that of k_ZZ: its uncertainty went in as another one."""
    special = {at.SCALE_FACTOR, at.TAN_BETA, at.PHI}
    assert not special & set(range(len(at.TERMS)))
    assert max(special) < at.HARMONIC


def test_uncertainty_is_that_of_the_covariance():
    """Five coefficients, correlated: against numerical derivatives of the force itself."""
    t = np.arange(0.0, 1.0, 0.01)
    values = {"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.4, "k0": 1e-3, "k_ZZ": 1e-4, "k0_t": 1e-5}
    std = {"tan_beta": 1e-6, "phi": 1e-4, "k0": 1e-5, "k_ZZ": 1e-6, "k0_t": 1e-6}
    run = run_of(t, smooth(t), phi=0.4)
    uncertainty = piga.compensate(run, calibration_of(values, std)).u_ax[1:]
    base = piga.compensate(run, calibration_of(values)).ax[1:]
    total = np.zeros(base.size)
    for name, u in std.items():
        total += (piga.compensate(run, calibration_of({**values, name: values[name] + u})).ax[1:] - base) ** 2
    assert np.abs(uncertainty[1:] / np.sqrt(total[1:]) - 1.0).max() < 2e-3
    assert 1.0 < uncertainty[0] / np.sqrt(total[0]) < 3.0  # the first interval has its bend as well


def test_factor_is_triangular_and_gives_the_covariance():
    cal = calibration_of({"tan_beta": 1e-3, "phi": 0.1, "k0": 1e-3}, {"tan_beta": 1e-6, "k0": 2e-6})
    model = make_model(cal).more
    assert model.codes.size == 2
    assert np.allclose(np.tril(model.factor, -1), 0.0)
    assert np.allclose(np.sqrt(np.diag(model.factor.T @ model.factor)), [1e-6, 2e-6 * G0])
