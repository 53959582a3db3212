"""There is no first guess: ten thousand random problems, each solved to its one optimum (slow)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

import piga
from piga.calibration.classical.recursive import run_published
from piga.calibration.model.request import make_request
from piga.records.run_file import EstimationTable
from piga.units import G0

PROBLEMS = 10_000
REACHED = 6.0
"""Errors below this many standard uncertainties are noise; one in 10^8 coefficients exceeds it."""
PUBLISHED_X0 = ((1e-4, 1e-2), (-np.pi, np.pi))
"""Starts of the published recursion: tan_beta and phi, in the range of its documented examples."""


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


@pytest.mark.slow
def test_published_recursion_depends_on_its_start() -> None:
    """The published recursion from random starts reaches 5 % of tan_beta and 0.1 rad in a part of the problems."""
    reached = 0
    for seed in range(1000):
        run, truth = problem(seed)
        rng = np.random.default_rng([seed, 72])
        start = (rng.uniform(*PUBLISHED_X0[0]), rng.uniform(*PUBLISHED_X0[1]))
        request = make_request(run, ["tan_beta", "k0", "k1", "k2"], "published", None, None)
        state = run_published(run, _with_start(request, start)).state
        size, phase = abs(state[0]), state[1] + (np.pi if state[0] < 0.0 else 0.0)
        near = abs(size / truth["tan_beta"] - 1.0) < 0.05
        reached += near and abs(np.angle(np.exp(1j * (phase - truth["phi"])))) < 0.1
    assert 0 < reached < 500


def _with_start(request, start: tuple[float, float]):
    return replace(request, x0=(*start, 0.0, 0.0, 0.0), P0=1e10)
