"""A rate of its own in every segment, found beside white noise and random walk and told from a bias drift."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import piga
from piga.calibration.fit.one_run import Fit, fit_run, refine_counted
from piga.calibration.intervals import slow_noise
from piga.calibration.intervals.degrees_of_freedom import type_a_degrees
from piga.calibration.intervals.slow_noise import include_slow_noise, likely_level, quick_looks, slow_factor
from piga.calibration.model.request import make_request
from piga.calibration.model.solution import name_coefficients
from piga.calibration.noise.levels import Noise
from piga.calibration.noise.settings import NOISE
from piga.calibration.noise.weighting import SegmentBasis, slow_bases
from tests.calibration.made.dense import increments_covariance, moved_by_turning
from tests.calibration.made.scenarios import SCENARIOS, Scenario, tumble
from tests.chance import assert_variance

pytestmark = pytest.mark.only_compiled

SCATTER = SCENARIOS["scatter"]
assert isinstance(SCATTER, Scenario)
COUNTED = replace(SCENARIOS["coarse"], scatter=5e-5)
assert isinstance(COUNTED, Scenario)


def fitted(scenario: Scenario, seed: int, phase: str | None = None) -> Fit:
    run = scenario.record(np.random.default_rng([seed, 78]))
    request = make_request(run, scenario.terms, None, phase)
    return fit_run(run, request)


@pytest.mark.parametrize("phase", ["shared", "per-segment"])
def test_known_scatter_is_found_on_average_and_not_taken_for_a_drift(phase: str) -> None:
    """Twelve records of ten degrees of freedom (16 positions, six coefficients) bound the mean of the variances."""
    collected = []
    for seed in range(12):
        fit = fitted(SCATTER, seed, phase)
        noise = include_slow_noise(fit).noise
        collected.append([noise.scatter / SCATTER.scatter**2, noise.walk / SCATTER.walk**2])
    scatter, walk = np.mean(collected, axis=0)
    assert_variance(scatter, 12 * 10, "scatter")
    assert_variance(walk, 12 * SCATTER._times().size / 10, "walk")
    assert sum(row[0] > 0.0 for row in collected) >= 10


def test_covariance_is_the_dense_one_of_these_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    """Weights of white noise and random walk: the dense covariance of that estimate with the scatter, levels as found."""
    monkeypatch.setattr(slow_noise, "NOISE", replace(NOISE, slow_in_weights=math.inf))
    fit = fitted(SCATTER, 3)
    result = include_slow_noise(fit)
    noise, steps, h = result.noise, round(SCATTER.seconds * SCATTER.rate), 1.0 / SCATTER.rate
    V = increments_covariance(noise, steps, h)
    run, count = result.design.run, len(SCATTER.forces)
    columns = [
        SCATTER._derivatives(run.output[run.segment_index == s] + SCATTER.phi, s, h) for s in range(count)
    ]
    white = [np.linalg.solve(V, part) for part in columns]
    inverse = np.linalg.inv(sum(a.T @ b for a, b in zip(columns, white, strict=True)))
    meat = sum(part.T @ (V + noise.scatter * h**2) @ part for part in white)
    dense = inverse @ meat @ inverse
    std = np.sqrt(np.diag(name_coefficients(result.design, result.solution, result.covariance)[1]))
    assert noise.scatter > 0.0
    assert result.weights == noise.without_slow()
    assert std == pytest.approx(np.sqrt(np.diag(dense)), rel=0.06)
    assert 5.0 < type_a_degrees(result)[0] < 25.0
    assert type_a_degrees(replace(result, slow_deviation=0.0))[0] > 25.0


def test_a_clear_scatter_is_weighted_by() -> None:
    """The estimate and covariance of generalised least squares with the dense covariance, levels as found."""
    fit = fitted(replace(SCATTER, scatter=3e-5), 3)
    result = include_slow_noise(fit)
    noise = result.noise
    exact = replace(
        SCATTER, scatter=noise.segment_scatter, white=noise.angle_rms, walk=noise.angle_random_walk
    ).bound(fit.design.run)
    coefficients, covariance = name_coefficients(result.design, result.solution, result.covariance)
    plain = name_coefficients(fit.design, fit.solution, fit.covariance)[0]
    assert result.slow_part is None
    assert result.weights == noise
    assert np.sqrt(np.diag(covariance)) == pytest.approx(np.sqrt(np.diag(exact)), rel=0.03)
    assert abs(coefficients[1].value - SCATTER.tan_beta) < 0.5 * abs(plain[1].value - SCATTER.tan_beta)


def test_what_it_adds_beside_coarse_counts_is_that_of_records_whose_segments_turn() -> None:
    """With the weights as they are: the changes of the estimate by the rate of every segment, one record each."""
    plain = fitted(COUNTED, 1)
    fit = include_slow_noise(refine_counted(plain))
    assert fit.noise.scatter > 0.0
    run = fit.design.run
    since = SegmentBasis.of(run).angle(run.t)[0]
    moved = moved_by_turning(fit, [(run.segment_index == s) * since for s in range(len(run.labels))])
    assert fit.slow_part == pytest.approx(moved @ moved.T, rel=0.02, abs=1e-4 * fit.slow_part.max())


@pytest.mark.parametrize("scenario", [SCATTER, COUNTED], ids=["fine", "counted"])
def test_intervals_hold(scenario: Scenario) -> None:
    """Twenty-four records: about 95 of 100; with the noise of the angle alone hardly more than half."""
    inside, narrow = [], []
    for seed in range(24):
        calibration = scenario.calibrate(scenario.record(np.random.default_rng([seed, 101])))
        errors, half = scenario.errors(calibration), np.array([c.expanded for c in calibration.coefficients])
        inside.append(np.abs(errors) <= half)
        narrow.append(np.abs(errors[0]) <= 0.3 * half[0])
    assert np.mean(inside) > 0.9
    assert np.mean(narrow) < 0.75, "a third of the intervals would do"


def test_the_result_says_so_and_keeps_it(tmp_path: Path) -> None:
    scenario = replace(SCATTER, scatter=3e-5)
    results = [scenario.calibrate(scenario.record(np.random.default_rng([seed, 4]))) for seed in range(8)]
    levels = [result.segment_scatter for result in results]
    assert_variance(np.mean(np.square(levels)) / 3e-5**2, 8 * 10, "scatter")
    outcome = results[0]
    assert outcome.bias_drift == 0.0
    assert any("times more than the noise of the angle explains" in note for note in outcome.notes)
    assert outcome.diagnostics.segment_scatter_ratio < 1.5
    outcome.to_json(tmp_path / "c.json")
    assert piga.Calibration.from_json(tmp_path / "c.json").segment_scatter == outcome.segment_scatter


def test_none_is_seen_where_there_is_none() -> None:
    """Of 60 records at most 9."""
    still = replace(SCATTER, scatter=0.0)
    assert sum(include_slow_noise(fitted(still, seed)).noise.scatter > 0.0 for seed in range(60)) <= 9


def test_quick_look_sees_what_a_long_record_shows() -> None:
    def gain(scatter: float, seed: int) -> float:
        fit = fitted(replace(SCATTER, scatter=scatter), seed)
        return quick_looks(fit, [SegmentBasis.of(fit.design.run)])[0].gain

    assert gain(3e-5, 1) > 10.0
    assert np.median([gain(0.0, seed) for seed in range(6)]) < 0.3


def test_few_and_very_many_segments_have_none() -> None:
    """Three segments leave nothing to see a scatter by."""
    for count, kinds in ((3, 1), (4, 2), (NOISE.most_segments, 2), (NOISE.most_segments + 1, 1)):
        scenario = Scenario("few", tumble(count), seconds=1.0, white=1e-5)
        assert len(slow_bases(scenario.record(np.random.default_rng(1)))) == kinds


def test_none_is_looked_for_where_coefficients_take_it_up() -> None:
    """Five positions and as many coefficients of mean rates: whatever they scatter, nothing shows it."""
    scenario = replace(SCATTER, forces=tumble(5), scatter=1e-4, terms=("scale_factor", "k0", "k2", "m_Y", "k3"))
    fit = fitted(scenario, 1)
    assert include_slow_noise(fit).noise.scatter == 0.0
    assert (
        likely_level(
            slow_factor(fit, fit.noise, SegmentBasis.of(fit.design.run)),
            SegmentBasis.of(fit.design.run),
        ).gain
        == 0.0
    )


def test_levels_of_one_kind_replace_the_other() -> None:
    basis = SegmentBasis(np.array([0.0, 10.0]))
    noise = Noise(1.0, 2.0, drift=3.0)
    assert basis.noise(noise, 5.0) == Noise(1.0, 2.0, scatter=5.0)
    assert Noise(1.0, 2.0, scatter=5.0).slower(2.0) == Noise(1.0, 2.0, scatter=10.0)
    assert basis.angle(np.array([1.0, 12.0])).tolist() == [[1.0, 2.0]]
    placed = basis.placed(np.array([[1.0, 7.0], [0.0, 8.0]]), 1)
    assert placed.tolist() == [[0.0, 1.0, 7.0], [0.0, 0.0, 8.0]]


def test_columns_that_are_all_one_rate_in_a_segment_do_not_spoil_the_weights() -> None:
    """Constant force: without the segment's own rate nothing is left of some columns but rounding errors."""
    calibration = SCATTER.calibrate(SCATTER.record(np.random.default_rng([193, 2026])))
    errors = SCATTER.errors(calibration)
    assert calibration.segment_scatter > 0.0
    assert (np.abs(errors) < 4.0 * np.array([c.std for c in calibration.coefficients])).all()
