"""There is no first guess: each of ten thousand problems has one optimum (slow). A coupling has one sign."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

import piga
from piga.calibration.model.solution import Estimate, Layout, name_parameters
from piga.records.run_file import EstimationTable
from piga.units import G0

PROBLEMS = 10_000


REACHED = 6.0
"""Errors below this many standard uncertainties are noise; one in 10^8 coefficients exceeds it."""


def problem(seed: int) -> tuple[piga.Run, dict[str, float]]:
    """Random coefficients, random plan of moving forces; 400 samples, noise levels known."""
    rng = np.random.default_rng([seed, 71])
    truth = {
        "tan_beta": 10.0 ** rng.uniform(-3.5, -2.0),
        "phi": rng.uniform(-np.pi, np.pi),
        "k0": rng.normal(0.0, 1e-3),
    }
    t = np.arange(400) * 0.04
    a = rng.uniform(0.3, 2.0, 3) * rng.choice([-1.0, 1.0], 3)
    w, p = rng.uniform(0.05, 0.8, 3), rng.uniform(0.0, 2.0 * np.pi, 3)
    f = np.column_stack(
        [a[0] + 0.5 * np.sin(w[0] * t + p[0]), *(3.0 * a[i] * np.sin(w[i] * t + p[i]) for i in (1, 2))]
    )
    f *= G0
    inst = piga.Instrument(
        scale_factor="0.8884 rad/s/g", beta=float(np.arctan(truth["tan_beta"])), alpha0=truth["phi"]
    )
    alpha = piga.propagate(inst, t, f + np.array([truth["k0"] * G0, 0.0, 0.0]))
    output = alpha - truth["phi"] + 2e-5 * rng.standard_normal(t.size)
    run = piga.Run.from_arrays(t, output, f, scale_factor="0.8884 rad/s/g")
    known = EstimationTable(angle_rms="2e-5 rad", angle_random_walk="1e-8 rad/sqrt(s)")
    return replace(run, estimation=known), truth


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
