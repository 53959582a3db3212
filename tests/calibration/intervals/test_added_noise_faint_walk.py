"""A random walk that is not clear: unbiased, with either sign, in the covariance and the degrees of freedom alone."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from piga.calibration.fit.one_run import Fit, fit_run
from piga.calibration.intervals import added_noise
from piga.calibration.intervals.added_noise import include_faint_walk, slowest
from piga.calibration.intervals.degrees_of_freedom import type_a_degrees
from piga.calibration.model.request import make_request
from piga.calibration.model.solution import name_coefficients, solve
from piga.calibration.noise.levels import Noise
from piga.calibration.noise.weighting import reduce_segments, residual_increments
from tests.calibration.made.dense import increments_covariance
from tests.calibration.made.scenarios import SCENARIOS, Scenario, tumble

WHITE = SCENARIOS["white"]
assert isinstance(WHITE, Scenario)
SMALL = replace(WHITE, forces=tumble(6, (0.5, 1.0)), seconds=8.0, rate=5.0)


def fitted(scenario: Scenario, seed: int) -> Fit:
    """A fit with the weights of white noise; a walk that was taken as real is none."""
    run = scenario.record(np.random.default_rng([seed, 78]))
    request = make_request(run, scenario.terms)
    fit = fit_run(run, request)
    noise = replace(fit.noise, walk=0.0)
    solution = solve(fit.design, reduce_segments(fit.design, fit.mode, noise))
    d, h = residual_increments(fit.design, solution.values)
    return replace(fit, noise=noise, solution=solution, covariance=solution.covariance, d=d, h=h)


@pytest.mark.only_compiled
@pytest.mark.compiled
def test_slowest_value_bounds_the_walks_that_are_covariances() -> None:
    """Dense: just above minus the bound the covariance of the increments is positive definite, just below not."""
    fit = fitted(SMALL, 1)
    steps, h = round(SMALL.seconds * SMALL.rate), 1.0 / SMALL.rate
    least = [
        np.linalg.eigvalsh(increments_covariance(Noise(1.0, -slowest(fit) * share), steps, h))[0]
        for share in (0.999, 1.001)
    ]
    assert least[0] > 0.0 > least[1]


@pytest.mark.only_compiled
@pytest.mark.compiled
@pytest.mark.parametrize(("share", "weighted"), [(-0.6, 0.0), (0.8, 0.015)])
def test_covariance_is_that_of_the_dense_matrix_with_the_weights_of_white_noise(
    share: float, weighted: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """White weights, a walk of either sign in the covariance: the sandwich of dense matrices.

    Weights of a walk that hardly shows change nothing.
    """
    fit = fitted(SMALL, 2)
    fit = replace(fit, noise=replace(fit.noise, walk=weighted * slowest(fit) * fit.noise.white))
    monkeypatch.setattr(added_noise, "_likely_share", lambda *_: share)
    result = include_faint_walk(fit)
    assert result.levels.walk / (slowest(fit) * fit.noise.white) == pytest.approx(share, rel=1e-12)
    assert result.weights == fit.noise
    steps, h, run = round(SMALL.seconds * SMALL.rate), 1.0 / SMALL.rate, fit.design.run
    inverse = np.linalg.inv(increments_covariance(Noise(1.0, 0.0), steps, h))
    V = increments_covariance(result.levels, steps, h)
    parts = [
        SMALL._derivatives(run.output[run.segment_index == s] + SMALL.phi, s, h)
        for s in range(len(SMALL.forces))
    ]
    bread = np.linalg.inv(sum(X.T @ inverse @ X for X in parts))
    meat = sum(X.T @ inverse @ V @ inverse @ X for X in parts)
    dense = np.sqrt(np.diag(bread @ meat @ bread))
    std = np.sqrt(np.diag(name_coefficients(result.design, result.solution, result.covariance)[1]))
    plain = np.sqrt(np.diag(name_coefficients(fit.design, fit.solution, fit.covariance)[1]))
    assert std == pytest.approx(dense, rel=0.02)
    assert abs(std[0] / plain[0] - 1.0) > 0.2


@pytest.mark.only_compiled
@pytest.mark.parametrize("walk", [0.0, 1e-6])
def test_walk_found_is_right_on_average(walk: float) -> None:
    """Sixty records: the mean within four of its standard deviations; found negative in many, if there is none."""
    collected = []
    for seed in range(60):
        fit = fitted(replace(WHITE, walk=walk), seed)
        collected.append(include_faint_walk(fit).levels.walk / (slowest(fit) * fit.noise.white))
    spread = float(np.std(collected)) / math.sqrt(len(collected))
    unit = 4.0 * math.sin(0.5 * math.pi / 201.0) ** 2 * WHITE.rate * WHITE.white**2
    assert np.mean(collected) == pytest.approx(walk**2 / unit, abs=4.0 * spread)
    assert 0.25 < spread * math.sqrt(len(collected)) / (1.0 + walk**2 / unit) < 0.65
    if walk == 0.0:
        assert 15 <= sum(share < 0.0 for share in collected) <= 45


@pytest.mark.only_compiled
def test_degrees_of_freedom_are_those_of_the_variances() -> None:
    """``2 m^2/var`` of the variances found over sixty records, against their degrees of freedom; ripple knows more.

    The variances are taken over those with white noise alone, for they depend on where the gimbal starts.
    """
    ratios, degrees = [], []
    for seed in range(60):
        fit = fitted(WHITE, seed)
        result = include_faint_walk(fit)
        both = (name_coefficients(fit.design, fit.solution, f.covariance)[1] for f in (result, fit))
        ratios.append(np.divide(*(np.diag(covariance) for covariance in both)))
        degrees.append(type_a_degrees(result))
    seen = 2.0 * np.mean(ratios, axis=0) ** 2 / np.var(ratios, axis=0)
    said = np.median(degrees, axis=0)
    assert (np.abs(np.log(seen / said)) < math.log(2.0)).all()
    assert 8.0 < said[0] < 18.0
    assert np.min(degrees) > 7.0
    assert said[1] > 1.5 * said[0]


@pytest.mark.only_compiled
def test_a_calibration_has_it() -> None:
    """Standard uncertainties and degrees of freedom of the whole calibration are those of the fit with it."""
    run = SMALL.record(np.random.default_rng([3, 78]))
    calibration = SMALL.calibrate(run)
    request = make_request(run, SMALL.terms)
    plain = fit_run(run, request)
    assert plain.noise.walk == 0.0
    fit = include_faint_walk(plain)
    std = np.sqrt(np.diag(name_coefficients(fit.design, fit.solution, fit.covariance)[1]))
    assert [c.std for c in calibration.coefficients] == pytest.approx(std, rel=1e-9)
    assert calibration["scale_factor"].degrees_of_freedom < 60.0
    assert abs(fit.levels.walk) > 0.02 * slowest(fit) * fit.noise.white


@pytest.mark.only_compiled
@pytest.mark.compiled
def test_information_is_that_of_the_dense_restricted_likelihood() -> None:
    """``tr(P V_i P V_j)/2`` with dense matrices, at a negative walk."""
    fit = fitted(SMALL, 2)
    steps, h, run = round(SMALL.seconds * SMALL.rate), 1.0 / SMALL.rate, fit.design.run
    count, share = len(SMALL.forces), -0.4
    units = [
        np.kron(np.eye(count), increments_covariance(noise, steps, h))
        for noise in (Noise(1.0, 0.0), Noise(0.0, 1.0))
    ]
    V = units[0] + share * slowest(fit) * units[1]
    X = np.concatenate(
        [SMALL._derivatives(run.output[run.segment_index == s] + SMALL.phi, s, h) for s in range(count)]
    )
    inverse = np.linalg.inv(V)
    P = inverse - inverse @ X @ np.linalg.solve(X.T @ inverse @ X, X.T @ inverse)
    moved = [P @ unit for unit in units]
    expected = [[0.5 * np.trace(a @ b) for b in moved] for a in moved]
    result = added_noise._walk_information(fit, share)
    assert result.ravel() == pytest.approx(np.ravel(expected), rel=0.03, abs=0.0)


@pytest.mark.compiled
def test_too_few_positions_say_nothing_of_a_faint_walk() -> None:
    few = replace(SMALL, forces=tumble(4), terms=("scale_factor", "tan_beta", "k0"), truth={"k0": 1.6e-3})
    fit = fitted(few, 1)
    assert include_faint_walk(fit) is fit


@pytest.mark.only_compiled
@pytest.mark.compiled
def test_a_clear_walk_and_given_levels_stay_as_they_are() -> None:
    fit = fitted(SMALL, 3)
    clear = replace(fit, noise=replace(fit.noise, walk=5.0 * slowest(fit) * fit.noise.white))
    assert include_faint_walk(clear) is clear
    given = replace(fit, noise=replace(fit.noise, drift=1e-12))
    assert include_faint_walk(given) is given
