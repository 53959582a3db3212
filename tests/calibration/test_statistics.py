"""Intervals that hold and estimates that are efficient, over many simulated tests.

Two hundred in the default suite, a thousand of every scenario in the slow one, ten thousand by
``python -m tests.calibration.coverage``.
"""

from __future__ import annotations

import numba
import numpy as np
import pytest
from scipy.stats import binom, chi2

from tests.calibration.coverage import figures, run_tests
from tests.calibration.scenarios import SCENARIOS

FEW = 10 if numba.config.DISABLE_JIT else 200
REPEATS = 1000
EXACT = ("static", "centrifuge", "near-critical", "walk")
"""Scenarios whose noise levels are known so well that NEES is that of the normal distribution."""


@pytest.mark.only_compiled
def test_intervals_hold_in_two_hundred_tests() -> None:
    """Coverage and NEES inside their 99.9 % bands; a covariance 1.2 times too large falls out of its band."""
    errors, half, nees, _ = run_tests("static", FEW)
    low, high = binom.ppf([0.0005, 0.9995], FEW, 0.95) / FEW
    inside = (np.abs(errors) <= half).mean(axis=0)
    assert (inside >= low).all()
    assert (inside <= high).all()
    size = errors.shape[1]
    band = chi2.ppf([0.0005, 0.9995], FEW * size) / (FEW * size)
    assert band[0] < nees.mean() / size < band[1]
    if FEW > 100:
        assert nees.mean() / size / 1.2 < band[0], "a covariance too large by 1.2 would go unnoticed"


@pytest.mark.slow
@pytest.mark.parametrize("name", list(SCENARIOS))
def test_coverage_bias_and_efficiency(name: str) -> None:
    """Coverage inside its 99.9 % band (one per cent more for the few degrees of freedom of coarse counts).

    Bias below 0.05 sigma, variance within 5 % of the bound for the mixes of counts and random walk, beyond
    chance; NEES in its band, and out of it for a covariance 1.2 times too large.
    """
    found = figures(name, *run_tests(name, REPEATS, 2))
    low, high = found["coverage_band"]
    slack = 0.0 if name in EXACT else 0.015 if name != "coarse-slow" else 0.04
    assert min(found["coverage"]) >= low - slack
    assert max(found["coverage"]) <= high + slack
    assert np.abs(found["bias_over_sigma"]).max() < 0.05 + 4.0 / np.sqrt(REPEATS)
    if name.startswith("mix"):
        assert np.abs(np.array(found["variance_over_bound"]) - 1.0).max() < 0.05 + 4.0 * np.sqrt(2.0 / REPEATS)
    if name in EXACT:
        band = found["nees_band"]
        assert band[0] < found["nees"] < band[1]
        assert not band[0] < found["nees"] / 1.2 < band[1], "a covariance too large by 1.2 would go unnoticed"
