"""Draws of every distribution; limits of a size that cannot be negative hold the truth, zero included."""

from __future__ import annotations

import math

import numpy as np
import pytest

import piga
from piga.calibration import monte_carlo
from piga.calibration.monte_carlo import size_limits, standard_draws
from tests.calibration.made.independent import Bench


@pytest.mark.parametrize(
    ("distribution", "fourth", "largest"),
    [
        ("normal", 3.0, math.inf),
        ("rectangular", 1.8, math.sqrt(3.0)),
        ("triangular", 2.4, math.sqrt(6.0)),
        ("arcsine", 1.5, math.sqrt(2.0)),
    ],
)
def test_draws_have_unit_variance_and_the_kurtosis_of_their_distribution(
    distribution: str, fourth: float, largest: float
) -> None:
    x = standard_draws(distribution, math.inf, 40_000, np.random.default_rng(3))
    assert abs(x.mean()) < 0.025
    assert np.mean(x**2) == pytest.approx(1.0, abs=0.035)
    assert np.mean(x**4) == pytest.approx(fourth, rel=0.08)
    assert np.abs(x).max() <= largest


def test_draws_of_students_t_have_its_wider_spread() -> None:
    x = standard_draws("t", 10.0, 40_000, np.random.default_rng(4))
    assert np.mean(x**2) == pytest.approx(10.0 / 8.0, rel=0.04)


TERMS = ("scale_factor", "tan_beta", "k0")
U = 4.9e-7
"""Standard uncertainty of tan_beta in the records below."""


def bench(multiple: float) -> Bench:
    """White noise alone, and tan_beta this many of its standard uncertainties."""
    return Bench(seconds=20.0, rate=10.0, walk=0.0, tan_beta=multiple * U)


@pytest.mark.parametrize("degrees", [np.inf, 8.0])
@pytest.mark.parametrize("size", [0.0, 1.0, 3.0, 6.0])
def test_limits_of_a_size_hold_it(size, degrees):
    """2000 draws of two normal components each."""
    rng = np.random.default_rng([19, int(size)])
    drawn = np.hypot(*(rng.standard_normal((2, 2000)) + np.array([[size], [0.0]])))
    std = np.ones(2000) if np.isinf(degrees) else np.sqrt(rng.chisquare(degrees, 2000) / degrees)
    limits = np.array([size_limits(float(r), float(s), degrees) for r, s in zip(drawn, std, strict=True)])
    held = np.mean((limits[:, 0] <= size) & (size <= limits[:, 1]))
    assert 0.93 < held < 0.99


def test_limits_far_above_the_noise_are_the_normal_ones():
    low, high = size_limits(50.0, 1.0, np.inf)
    assert low == pytest.approx(50.0 - 1.96, abs=0.02)
    assert high == pytest.approx(50.0 + 1.96, abs=0.02)
    assert size_limits(2.70, 1.0, np.inf)[0] == 0.0 < size_limits(2.75, 1.0, np.inf)[0]
    assert size_limits(1e-9, 1.0, np.inf)[1] == pytest.approx(2.4477, abs=1e-3)


@pytest.mark.long
def test_an_instrument_without_coupling_may_have_none(monkeypatch):
    monkeypatch.setattr(monte_carlo, "_TRIALS", 20_000)
    calibration = piga.calibrate(bench(0.0).record(3), TERMS)
    assert calibration["tan_beta"].limits[0] == 0.0
    assert calibration["tan_beta"].limits[1] < 6.0 * calibration["tan_beta"].std
    low, high = calibration["phi"].limits
    assert high - low == pytest.approx(2.0 * np.pi)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("multiple", [0.0, 1.0, 3.0, 6.0])
def test_intervals_of_a_weak_coupling_hold(multiple, monkeypatch):
    """200 records each, integrated by SciPy."""
    monkeypatch.setattr(monte_carlo, "_TRIALS", 20_000)
    test, held, turned = bench(multiple), 0, 0
    for seed in range(200):
        calibration = piga.calibrate(test.record(seed), TERMS)
        low, high = calibration["tan_beta"].limits
        held += low <= test.tan_beta <= high
        low, high = calibration["phi"].limits
        turned += any(low <= test.phi + turn <= high for turn in (-2.0 * np.pi, 0.0, 2.0 * np.pi))
    assert held >= 184
    assert turned >= 182
