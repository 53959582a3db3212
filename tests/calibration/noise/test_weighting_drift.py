"""Bias drift: found in simulated records of known drift, used in the covariance, shown; none where there is none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import piga
from piga.calibration.allan import allan_deviation, drift_line
from piga.calibration.fit.one_run import Fit, fit_run, refine_counted
from piga.calibration.intervals import added_noise
from piga.calibration.intervals.degrees_of_freedom import type_a_degrees
from piga.calibration.intervals.slow_noise import include_slow_noise, quick_looks
from piga.calibration.joint.summary import RunSummary
from piga.calibration.model.request import make_request
from piga.calibration.model.solution import name_coefficients, solve
from piga.calibration.noise.levels import Noise
from piga.calibration.noise.weighting import DriftBasis, reduce_segments
from piga.units import G0, to_si
from tests.calibration.made.dense import dense_sums, moved_by_turning
from tests.calibration.made.scenarios import SCALE, SCENARIOS, Scenario
from tests.chance import assert_variance

pytestmark = pytest.mark.only_compiled

DRIFT = SCENARIOS["drift"]
assert isinstance(DRIFT, Scenario)
COUNTED = replace(SCENARIOS["coarse"], drift=3e-6)
assert isinstance(COUNTED, Scenario)


def fitted(scenario: Scenario, seed: int, phase: str | None = None) -> Fit:
    run = scenario.record(np.random.default_rng([seed, 77]))
    request = make_request(run, scenario.terms, None, phase)
    return fit_run(run, request)


def looked(scenario: Scenario, seed: int) -> float:
    """Gain of a drift at the quick look."""
    fit = fitted(scenario, seed)
    return quick_looks(fit, [DriftBasis.of(fit.design.run)])[0].gain


@pytest.mark.parametrize("phase", ["shared", "per-segment"])
def test_known_drift_is_found_on_average(phase: str) -> None:
    """Twelve records of ten degrees of freedom (16 positions, six coefficients) bound the mean of the variances of the drift.

    The walk is seen in every sample interval; a tenth of them is taken. One record may pass for a scatter of the segments.
    """
    collected = []
    for seed in range(12):
        fit = fitted(DRIFT, seed, phase)
        noise = include_slow_noise(fit).noise
        collected.append([noise.drift / DRIFT.drift**2, noise.walk / DRIFT.walk**2])
    drift, walk = np.mean(collected, axis=0)
    assert_variance(drift, 12 * 10, "drift")
    assert_variance(walk, 12 * DRIFT._times().size / 10, "walk")
    assert sum(row[0] > 0.0 for row in collected) >= 11


def test_covariance_is_that_of_the_dense_matrix() -> None:
    """With the true levels: variances of the whole, dense covariance of all increments (Cramer-Rao bound)."""
    fit = fitted(DRIFT, 3)
    noise = Noise(DRIFT.white**2, DRIFT.walk**2, DRIFT.drift**2)
    solution = solve(fit.design, reduce_segments(fit.design, fit.mode, noise))
    without = solve(fit.design, reduce_segments(fit.design, fit.mode, replace(noise, drift=0.0)))
    bound = DRIFT.bound(fit.design.run)
    at = fit.design.names.index("scale_factor")
    unit = to_si("1 rad/s/g", "rad/s/g")
    amplitude = 1 + at - 2  # tan_beta is one amplitude where p and q were two columns
    std = np.sqrt(solution.covariance[amplitude, amplitude]) / unit
    assert std == pytest.approx(np.sqrt(bound[0, 0]), rel=0.03)
    assert np.sqrt(without.covariance[amplitude, amplitude]) / unit < 0.8 * std


def test_phases_of_segments_cost_little_beside_a_drift() -> None:
    """Levels given: a phase for each segment instead of one takes 16 coefficients more, and little of the rest.

    The shared phase is the constraint of the same estimate: its variances are no larger, its values within them.
    """
    noise = Noise(DRIFT.white**2, DRIFT.walk**2, DRIFT.drift**2)
    values = {}
    for phase in ("shared", "per-segment"):
        fit = fitted(DRIFT, 3, phase)
        values[phase] = solve(fit.design, reduce_segments(fit.design, fit.mode, noise))
    count = values["shared"].amplitudes.size
    std = [np.sqrt(np.diag(values[phase].covariance)[:count]) for phase in ("shared", "per-segment")]
    assert (std[1] >= 0.999 * std[0]).all()
    assert (std[1] < 1.2 * std[0]).all()
    shift = values["per-segment"].amplitudes - values["shared"].amplitudes
    assert (np.abs(shift) < 3.0 * np.sqrt(np.maximum(std[1] ** 2 - std[0] ** 2, (0.05 * std[0]) ** 2))).all()


def test_a_drift_that_is_not_weighted_by_is_in_the_covariance() -> None:
    """Weights of the other noise: the dense covariance of that estimate with the drift, for the levels found."""
    fit = fitted(DRIFT, 3)
    result = include_slow_noise(fit, clear=np.inf)
    noise = result.noise
    information, scattered = dense_sums(DRIFT, result.design.run, noise)
    inverse = np.linalg.inv(information)
    dense = inverse @ scattered @ inverse
    std = np.sqrt(np.diag(name_coefficients(result.design, result.solution, result.covariance)[1]))
    assert noise.drift > 0.0
    assert result.weights == replace(noise, drift=0.0)
    assert std == pytest.approx(np.sqrt(np.diag(dense)), rel=0.06)
    plain = np.sqrt(np.diag(name_coefficients(result.design, result.solution, result.solution.covariance)[1]))
    assert std[0] > 1.2 * plain[0]
    assert type_a_degrees(result)[0] < 40.0
    assert type_a_degrees(replace(result, slow_deviation=0.0))[0] > 40.0


@pytest.fixture
def no_colour(monkeypatch: pytest.MonkeyPatch) -> None:
    """Coloured noise is not looked for: a short record hardly tells it from a drift."""
    monkeypatch.setattr(added_noise, "include_coloured_noise", lambda fit: fit)


@pytest.mark.usefixtures("no_colour")
def test_a_drift_beside_coarse_counts_is_in_the_covariance() -> None:
    """Twelve records: intervals hold; with the covariance of the counts alone hardly more than half of them do."""
    inside, drift, degrees = [], [], []
    for seed in range(12):
        calibration = COUNTED.calibrate(COUNTED.record(np.random.default_rng([seed, 99])))
        half = np.array([c.expanded for c in calibration.coefficients])
        inside.append(np.abs(COUNTED.errors(calibration)) <= half)
        drift.append(calibration.bias_drift)
        degrees.append(calibration.coefficients[0].degrees_of_freedom)
    assert np.mean(inside) > 0.9
    assert_variance(np.mean(np.square(drift)) / COUNTED.drift**2, 12 * 10, "drift")
    assert np.median(degrees) < 12.0


def test_what_a_drift_adds_beside_coarse_counts_is_that_of_records_moved_by_its_steps() -> None:
    """With the weights as they are: the changes of the estimate by every step, one record each."""
    plain = fitted(COUNTED, 1)
    fit = include_slow_noise(refine_counted(plain))
    assert fit.slow_part is not None
    basis = DriftBasis.of(fit.design.run)
    moved = moved_by_turning(fit, basis.angle(fit.design.run.t))
    assert fit.slow_part == pytest.approx(
        basis.spacing * moved @ moved.T, rel=0.02, abs=1e-4 * fit.slow_part.max()
    )


def test_intervals_are_wider_and_the_result_says_so(tmp_path: Path) -> None:
    run = DRIFT.record(np.random.default_rng(4))
    calibration = DRIFT.calibrate(run)
    fit = fitted(DRIFT, 4)
    levels = [DRIFT.calibrate(DRIFT.record(np.random.default_rng([s, 5]))).bias_drift for s in range(8)]
    assert_variance(np.mean(np.square(levels)) / DRIFT.drift**2, 8 * 10, "drift")
    assert calibration.bias_drift > 0.0
    assert (np.abs(DRIFT.errors(calibration)) < 4.0 * np.array([c.std for c in calibration.coefficients])).all()
    assert calibration["scale_factor"].degrees_of_freedom < 60.0
    assert fit.noise.drift == 0.0
    calibration.to_json(tmp_path / "c.json")
    assert piga.Calibration.from_json(tmp_path / "c.json").bias_drift == calibration.bias_drift
    RunSummary.of(run, DRIFT.terms).to_json(tmp_path / "s.json")
    merged = piga.calibrate([RunSummary.from_json(tmp_path / "s.json")], DRIFT.terms)
    for one, other in zip(calibration.coefficients, merged.coefficients, strict=True):
        assert other.value == pytest.approx(one.value, rel=1e-6)
        assert other.std == pytest.approx(one.std, rel=1e-3)


def test_no_drift_is_seen_where_there_is_none() -> None:
    """Of 60 records at most 9 (5 in 100 are expected); taken from any gain on, 11 would be."""
    still = replace(DRIFT, drift=0.0)
    seen = 0
    for seed in range(60):
        fit = fitted(still, seed)
        seen += include_slow_noise(fit).noise.drift > 0.0
    assert seen <= 9


def test_quick_look_sees_what_a_long_record_shows() -> None:
    """The means over bins are enough to suspect a plain drift, and see nothing without."""
    assert looked(replace(DRIFT, drift=5e-6), 1) > 10.0
    gains = [looked(replace(DRIFT, drift=0.0), seed) for seed in range(6)]
    assert np.median(gains) < 0.3


@pytest.mark.usefixtures("no_colour")
def test_allan_deviation_rises_along_the_drift_found() -> None:
    """Four records of one long position: at long averaging times the Allan deviation is that of the drift that is found.

    The drift has 32 steps a record. Averaging times of 100 to 500 s are some 18 slices of 4000 s.
    """
    one = Scenario(
        "one", np.array([[0.8, 0.1, 0.6]]), seconds=4000.0, rate=2.0, white=1e-5, walk=1e-5, drift=2e-6,
        tan_beta=0.0, truth={"k0": 1e-3}, terms=("k0",),
    )  # fmt: skip
    levels, ratios = [], []
    for seed in range(4):
        run = replace(one.record(np.random.default_rng([seed, 2])), scale_factor=SCALE / G0)
        calibration = piga.calibrate(run, ["k0"])
        assert calibration.residuals is not None
        begins = np.zeros(calibration.residuals.t.size, dtype=bool)
        begins[0] = True
        allan = allan_deviation(
            calibration.residuals.after,
            calibration.residuals.t,
            begins,
            white=calibration.angle_rms**2,
            walk=calibration.angle_random_walk**2,
        )
        far = (allan.tau > 100.0) & (allan.tau < 500.0)
        levels.append(calibration.bias_drift / one.drift)
        ratios.append(np.median(allan.deviation[far] / drift_line(allan.tau[far], calibration.bias_drift)))
    assert_variance(np.mean(np.square(levels)), 4 * 32, "drift")
    assert_variance(np.mean(np.square(ratios)), 4 * 18, "Allan variance")
