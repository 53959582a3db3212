"""Intervals that hold and estimates that are efficient, over many simulated tests.

Two hundred in the default suite, a thousand of every scenario in the slow one, ten thousand by
``python -m benchmarks.intervals coverage --repeats 10000``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from scipy.stats import binom

from piga.campaign import collect, document, plan_campaign, run_campaign
from tests.calibration.made.scenarios import SCENARIOS
from tests.campaign.small import computed, one_case, written

FEW = 10 if numba.config.DISABLE_JIT else 200
REPEATS = 1000
EXACT = ("static", "centrifuge", "near-critical", "walk")
"""Scenarios whose output is not coarsely counted."""


def figures(name: str, tests: int, folder: Path, workers: int = 0) -> dict[str, Any]:
    """What a campaign of one scenario says; without workers it is computed in this process."""
    path = written(folder, one_case(name, tests, bounds=200))
    if workers:
        campaign = plan_campaign(path, folder / "out")
        run_campaign(campaign, workers=workers)
    else:
        campaign = computed(path, folder / "out")
    content = document(collect(campaign))
    assert (content["computed"], content["failed"]) == (tests, 0)
    group: dict[str, Any] = content["groups"][0]
    return group


def column(group: dict[str, Any], name: str) -> Any:
    """A figure of all coefficients."""
    return np.array([c[name] for c in group["coefficients"]])


@pytest.mark.only_compiled
def test_intervals_hold_in_two_hundred_tests(tmp_path: Path) -> None:
    """Coverage inside its 99.9 % band, with few degrees of freedom."""
    result = figures("static", FEW, tmp_path)
    low, high = binom.ppf([0.0005, 0.9995], FEW, 0.95) / FEW
    assert (column(result, "coverage") >= low).all()
    assert (column(result, "coverage") <= high).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", list(SCENARIOS))
def test_coverage_bias_and_efficiency(name: str, tmp_path: Path) -> None:
    """Coverage inside its 99.9 % band (coarse counts may hold more).

    Bias below 0.05 sigma, variance within 5 % of the bound for the mixes of counts and random walk, beyond chance.
    """
    result = figures(name, REPEATS, tmp_path, workers=2)
    low, high = binom.ppf([0.0005, 0.9995], REPEATS, 0.95) / REPEATS
    assert column(result, "coverage").min() >= low - (0.0 if name in EXACT else 0.015)
    assert column(result, "coverage").max() <= high + (0.05 if name.startswith("coarse") else 0.015)
    assert np.abs(column(result, "bias_over_sigma")).max() < 0.05 + 4.0 / np.sqrt(REPEATS)
    if name.startswith("mix"):
        ratio = column(result, "variance_over_bound")
        assert np.abs(ratio - 1.0).max() < 0.05 + 4.0 * np.sqrt(2.0 / REPEATS)
