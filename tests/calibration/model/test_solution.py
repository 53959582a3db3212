"""There is no first guess: each of ten thousand problems has one optimum (slow). A coupling has one sign."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import chi2

import piga
from piga.calibration.model.solution import Estimate, Layout, name_parameters
from piga.units import G0
from tests.calibration.made.random_plans import problem

PROBLEMS = 10_000


REACHED = 6.0
"""Errors below this many standard uncertainties are noise; one in 10^8 coefficients exceeds it."""


def solved(run: piga.Run, truth: dict[str, float]) -> tuple[bool, float]:
    """Whether every coefficient is the truth within noise, and the normalised squared error."""
    calibration = piga.calibrate(run, ["tan_beta", "k0"])
    error = np.array([c.value - truth[c.name] for c in calibration.coefficients])
    at = [c.name for c in calibration.coefficients].index("phi")
    error[at] = np.angle(np.exp(1j * error[at]))
    return bool((np.abs(error) < REACHED * calibration_std(calibration)).all()), float(
        error @ np.linalg.solve(calibration.covariance, error)
    )


def calibration_std(calibration: piga.Calibration) -> np.ndarray:
    return np.array([c.std for c in calibration.coefficients])


@pytest.mark.slow
def test_truth_in_ten_thousand_of_ten_thousand() -> None:
    reached, squares = zip(*(solved(*problem(seed)) for seed in range(PROBLEMS)), strict=True)
    assert sum(reached) == PROBLEMS
    low, high = chi2.ppf([0.0005, 0.9995], 3 * PROBLEMS) / PROBLEMS
    assert low < np.mean(squares) < high


def test_a_negative_coupling_is_a_positive_one_half_a_turn_away() -> None:
    """The columns behind the coefficients, hence all that was measured, stay as they were; odd harmonics turn, too."""
    layout = Layout(True, (1, 2), (("scale_factor", None), ("k0", None)), (np.array([0, 1]),))
    amplitudes = np.array([-0.3e-3, 2e-5, -3e-5, 1e-5, 4e-5, 0.0906, 1.4e-4])
    phases = np.array([2.9])
    spread = np.random.default_rng(7).standard_normal((8, 8))
    estimate = Estimate(amplitudes, phases, 1e-12 * spread @ spread.T, 0.0, ())
    coefficients, covariance = name_parameters(
        layout, estimate, estimate.covariance, 0.0906, ("scale_factor", "tan_beta", "s1", "c1", "s2", "c2", "k0"),
        [(None, None)],
    )  # fmt: skip
    result = {c.name: c.value for c in coefficients}
    assert result["tan_beta"] > 0.0
    assert -math.pi < result["phi"] <= math.pi
    K = amplitudes[5]
    unit = {c.name: c.unit for c in coefficients}
    assert unit["k0"] == "g"
    same = np.array([K * result["tan_beta"], *amplitudes[1:5], *amplitudes[5:]])
    same[1:5] = [K * result[name] * (G0 if unit[name] == "g" else 1.0) for name in ("s1", "c1", "s2", "c2")]
    before = layout.linear(amplitudes, phases[0], 0)
    np.testing.assert_allclose(layout.linear(same, result["phi"], 0), before, rtol=1e-12, atol=1e-18)
    names = [c.name for c in coefficients]
    plain = estimate.covariance
    at = names.index("tan_beta"), names.index("phi")
    # d tan_beta = -(d A - tan dK)/K: the sign of its covariance with the phase turns with its own
    tangent = amplitudes[0] / K
    assert covariance[at] == pytest.approx(-(plain[0, 7] - tangent * plain[5, 7]) / K, rel=1e-9)
