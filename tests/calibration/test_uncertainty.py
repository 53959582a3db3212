"""Propagation, budget and degrees of freedom against published examples and an independent program."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import piga
from piga.calibration import uncertainty
from piga.calibration.uncertainty import propagate_distributions, size_limits, source_draws
from piga.records.calibration.coefficient import coverage_factor, welch_satterthwaite
from piga.records.run_file import Spread, standard_uncertainty
from tests.calibration.made.independent import Bench
from tests.calibration.made.scenarios import COUPLED, SCENARIOS


def test_gum_annex_h1_end_gauge() -> None:
    """JCGM 100, annex H.1: u_c = 32 nm (first order), 34 nm with the second-order terms; nu = 16, U99 = 93 nm."""
    sensitivities = [1.0, 1.0, -50e6 * -0.1 * -1.0, -50e6 * 11.5e-6]
    uncertainties = [25.0, 9.7, 0.58e-6, 0.029]
    contributions = np.abs(np.array(sensitivities) * np.array(uncertainties))
    assert contributions[2:] == pytest.approx([2.9, 16.6], abs=0.08)
    assert np.linalg.norm(contributions) == pytest.approx(31.7, abs=0.1)
    degrees = welch_satterthwaite(contributions, [18.0, 25.6, 50.0, 2.0])
    assert int(degrees) == 16
    assert coverage_factor(16.0, 0.99) == pytest.approx(2.92, abs=0.005)
    assert coverage_factor(16.0, 0.99) * 31.7 == pytest.approx(93.0, abs=0.5)


H2 = np.array(
    [
        [5.007, 4.994, 5.005, 4.990, 4.999],
        [19.663e-3, 19.639e-3, 19.640e-3, 19.685e-3, 19.678e-3],
        [1.0456, 1.0438, 1.0468, 1.0428, 1.0433],
    ]
)
"""JCGM 100, table H.2: potential difference [V], current [A], phase [rad], five simultaneous observations."""


def test_gum_annex_h2_resistance_and_reactance() -> None:
    """JCGM 100, table H.4: resistance, reactance, impedance [ohm] and their standard uncertainties as printed."""

    def results(draws: np.ndarray) -> np.ndarray:
        v, i, phase = draws.T
        return np.stack([v / i * np.cos(phase), v / i * np.sin(phase), v / i], axis=1)

    means, covariance = H2.mean(axis=1), np.cov(H2) / 5.0
    values, std = np.array([127.732, 219.847, 254.260]), np.array([0.071, 0.2956, 0.236])
    assert results(means[None])[0] == pytest.approx(values, abs=5e-4)
    limits = values + np.outer([-1.96, 1.96], std)
    for check, u in zip(
        propagate_distributions(means, covariance, math.inf, [], results, limits), std, strict=True
    ):
        assert check.std == pytest.approx(u, rel=0.01)
        assert check.validated


def test_degrees_of_freedom_agree_with_gtc() -> None:
    gtc = pytest.importorskip("GTC")
    a, b, c = gtc.ureal(0.0, 3.0, 4), gtc.ureal(0.0, 2.0, 9), gtc.ureal(0.0, 1.0)
    assert welch_satterthwaite([3.0, 2.0, 1.0], [4.0, 9.0, math.inf]) == pytest.approx(
        gtc.dof(a + b + c), rel=1e-12
    )


def test_distributions_of_type_b() -> None:
    """Half-widths become standard uncertainties."""
    width = Spread(half_width="10 ppm", distribution="rectangular", degrees_of_freedom=8)
    size, *shape = standard_uncertainty(width, "ppm", "x")
    assert size == pytest.approx(1e-5 / math.sqrt(3.0))
    assert shape == ["rectangular", 8.0]
    assert standard_uncertainty("2 arcsec", "arcsec", "x") == standard_uncertainty(
        Spread(value="2 arcsec"), "arcsec", "x"
    )


def test_monte_carlo_of_a_linear_model_agrees_with_the_first_order() -> None:
    """JCGM 101, 9.2: four normal or rectangular inputs summed; published intervals +-3.92 and +-3.88."""

    def total(draws: np.ndarray) -> np.ndarray:
        return draws.sum(axis=1, keepdims=True)

    for distribution, half in (("normal", 3.92), ("rectangular", 3.88)):
        sources = [(np.eye(4)[i : i + 1], distribution, math.inf) for i in range(4)]
        (propagated,) = propagate_distributions(
            np.zeros(4), np.zeros((4, 4)), math.inf, sources, total, np.array([[-3.92], [3.92]])
        )
        assert propagated.std == pytest.approx(2.0, abs=0.01)
        assert np.ptp(propagated.shortest) == pytest.approx(2 * half, abs=0.06)
        assert propagated.symmetric[1] == pytest.approx(half, abs=0.03)
        assert propagated.validated or distribution == "rectangular"


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
    x = source_draws(1, distribution, math.inf, 40_000, np.random.default_rng(3))[:, 0]
    assert abs(x.mean()) < 0.025
    assert np.mean(x**2) == pytest.approx(1.0, abs=0.035)
    assert np.mean(x**4) == pytest.approx(fourth, rel=0.08)
    assert np.abs(x).max() <= largest


def test_draws_of_a_t_distribution_share_their_scale() -> None:
    drawn = source_draws(2, "t", 5.0, 40_000, np.random.default_rng(1))
    assert drawn.var(axis=0) == pytest.approx([5.0 / 3.0] * 2, rel=0.1)
    assert abs(np.corrcoef(drawn.T)[0, 1]) < 0.03
    assert np.corrcoef(drawn.T**2)[0, 1] > 0.1


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
    monkeypatch.setattr(uncertainty, "_TRIALS", 20_000)
    calibration = piga.calibrate(bench(0.0).record(3), COUPLED)
    assert calibration["tan_beta"].limits[0] == 0.0
    assert calibration["tan_beta"].limits[1] < 6.0 * calibration["tan_beta"].std
    low, high = calibration["phi"].limits
    assert high - low == pytest.approx(2.0 * np.pi)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("multiple", [0.0, 1.0, 3.0, 6.0])
def test_intervals_of_a_weak_coupling_hold(multiple, monkeypatch):
    """200 records each, integrated by SciPy."""
    monkeypatch.setattr(uncertainty, "_TRIALS", 20_000)
    test, held, turned = bench(multiple), 0, 0
    for seed in range(200):
        calibration = piga.calibrate(test.record(seed), COUPLED)
        low, high = calibration["tan_beta"].limits
        held += low <= test.tan_beta <= high
        low, high = calibration["phi"].limits
        turned += any(low <= test.phi + turn <= high for turn in (-2.0 * np.pi, 0.0, 2.0 * np.pi))
    assert held >= 184
    assert turned >= 182


@pytest.mark.long
def test_weak_coupling_gets_a_monte_carlo_interval() -> None:
    """tan_beta at twice its noise: the first order is refuted, the shortest interval stays above zero."""
    scenario = replace(SCENARIOS["static"], tan_beta=4e-7, seconds=10.0)
    calibration = scenario.calibrate(scenario.record(np.random.default_rng(8)))
    coupling = calibration["tan_beta"]
    assert coupling.value < 6.0 * coupling.std
    table = calibration.diagnostics.monte_carlo.coefficients
    assert not table["tan_beta"].validated
    assert coupling.interval is not None
    assert coupling.interval[0] >= 0.0
    low, high = table["scale_factor"].symmetric
    assert high - low == pytest.approx(2.0 * calibration["scale_factor"].expanded, rel=0.05)
