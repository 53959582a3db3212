"""Noise that a run is not weighted by, carried by its summary into joint calibrations."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

import piga
from piga.calibration.intervals import added_noise, slow_noise
from piga.calibration.intervals.added_noise import AddedNoise
from piga.calibration.intervals.slow_noise import include_slow_noise
from piga.calibration.joint.joint_fit import evident_together
from piga.calibration.joint.summary import RunSummary
from piga.calibration.noise.settings import NOISE
from piga.errors import CalibrationError
from tests.calibration.made.dense import dense_sums
from tests.calibration.made.scenarios import SCENARIOS, Scenario, tumble

DRIFT = replace(SCENARIOS["drift"], drift=2e-7)
WHITE, SCATTER = SCENARIOS["white"], SCENARIOS["scatter"]
COUNTED = replace(SCENARIOS["coarse"], drift=3e-6)
assert isinstance(DRIFT, Scenario)
assert isinstance(COUNTED, Scenario)
assert isinstance(WHITE, Scenario)
assert isinstance(SCATTER, Scenario)


def never_clear(monkeypatch: pytest.MonkeyPatch) -> None:
    """A slow noise that is seen is never weighted by."""
    monkeypatch.setattr(slow_noise, "NOISE", replace(NOISE, slow_in_weights=math.inf))
    monkeypatch.setattr(added_noise, "include_slow_noise", lambda fit, **_: include_slow_noise(fit, math.inf))


def lacking(calibration: piga.Calibration) -> set[str]:
    """Sources of terms that the model lacks."""
    return {
        entry.source for entry in calibration.budget if "lacks" in entry.source or "meaning" in entry.source
    }


def by_hand() -> AddedNoise:
    first, second = np.array([[1.0, 2.0], [0.0, 1.0]]), np.array([[3.0, 0.0], [1.0, 1.0]])
    return AddedNoise("drift", 1.0, 1.0, True, (first, second))


@pytest.mark.only_compiled
@pytest.mark.parametrize(
    ("gains", "coloured"),
    [
        ((4.2,), True),
        ((5.0, 0.0), False),
        ((5.0, 1.0), True),
        ((3.9, 0.0, 3.0), True),
        ((6.0, 0.0, 0.0), False),
    ],
)
def test_runs_show_coloured_noise_together_or_not(gains: tuple[float, ...], coloured: bool) -> None:
    """The limit of n runs is that of one, 4, and 2 log n. Without the colour its walk comes in."""
    plain = RunSummary.of(replace(WHITE, rate=2.0).record(np.random.default_rng(1)), WHITE.terms)
    drift = by_hand()
    summaries = [
        replace(
            plain,
            added=(
                drift,
                replace(drift, name="flicker", gain=gain),
                replace(drift, name="walk", gain=gain),
                replace(drift, name="walk", otherwise=True),
            ),
        )
        for gain in gains
    ]
    left = [("flicker", False), ("walk", False)] if coloured else [("walk", True)]
    kept = [(noise.name, noise.otherwise) for noise in evident_together(summaries)[0].added]
    assert kept == [("drift", False), *left]


def test_one_noise_for_all_groups_or_one_for_each() -> None:
    """By hand: scores add before they are squared where one noise moves all groups, after it else."""
    noise = by_hand()
    jacobians = [np.eye(2), np.array([[1.0, 0.0], [1.0, 1.0]])]
    moved = noise.scores[0] + jacobians[1].T @ noise.scores[1]
    assert noise.per_unit(jacobians) == pytest.approx(moved @ moved.T)
    each = (
        noise.scores[0] @ noise.scores[0].T
        + jacobians[1].T @ noise.scores[1] @ noise.scores[1].T @ jacobians[1]
    )
    assert replace(noise, together=False).per_unit(jacobians) == pytest.approx(each)


def test_columns_are_found_by_name() -> None:
    chosen = by_hand().select(("k0", "k2"), ("k2", "k0"))
    assert np.array_equal(chosen.scores[0], [[0.0, 1.0], [1.0, 2.0]])
    assert np.array_equal(chosen.scaled(2.0).scores[1], [[2.0, 2.0], [6.0, 0.0]])


@pytest.mark.only_compiled
@pytest.mark.parametrize("phase", ["shared", "per-segment"])
@pytest.mark.parametrize("kind", ["drift", "walk", "scatter", "drift beside counts"])
def test_a_summary_alone_says_what_the_run_says(
    kind: str, phase: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Written, read and solved: values, uncertainties and degrees of freedom of the record itself."""
    never_clear(monkeypatch)
    scenario = {"drift": DRIFT, "walk": WHITE, "scatter": SCATTER, "drift beside counts": COUNTED}[kind]
    close, needed = (1e-2, 2) if scenario is COUNTED else (0.0, 3)
    kind, compared, at_border = kind.partition(" ")[0], 0, 0
    for seed in range(24):
        run = scenario.record(np.random.default_rng([seed, 9]))
        run = replace(run, model=msgspec.structs.replace(run.model, phases=phase))
        RunSummary.of(run, scenario.terms).to_json(tmp_path / "s.json")
        read = RunSummary.from_json(tmp_path / "s.json")
        if [noise.name for noise in read.added] != [kind]:
            continue
        alone = piga.calibrate(run, scenario.terms, phases=phase)
        merged = piga.calibrate([read], scenario.terms)
        if lacking(alone) != lacking(merged):  # a chance signature at the border of being clear
            at_border += 1
            continue
        for one, other in zip(alone.coefficients, merged.coefficients, strict=True):
            assert other.value == pytest.approx(one.value, rel=1e-9, abs=close * one.std)
            assert other.std == pytest.approx(one.std, rel=2e-3 if one.name != "phi" else 1e-2, abs=0.0)
        first = (alone.coefficients[0], merged.coefficients[0])
        assert first[1].degrees_of_freedom == pytest.approx(first[0].degrees_of_freedom, rel=0.06)
        compared += 1
        if compared == needed:
            break
    assert compared == needed
    assert at_border <= 1


@pytest.mark.only_compiled
def test_joint_covariance_is_that_of_dense_matrices(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two runs, the second with a drift that is not weighted by: the sandwich of all increments of both."""
    never_clear(monkeypatch)
    runs = (
        replace(SCENARIOS["static"], forces=tumble(6), white=6e-5, walk=4e-5, phi=-1.9),
        replace(SCENARIOS["drift"], forces=tumble(8, (0.5, 1.0)), drift=2e-6, walk=2e-5),
    )
    records = [scenario.record(np.random.default_rng([3, 1 - index])) for index, scenario in enumerate(runs)]
    own = [RunSummary.of(record, scenario.terms) for record, scenario in zip(records, runs, strict=True)]
    assert own[1].noise.drift > 0.0
    assert [noise.name for noise in own[1].added] == ["drift"]
    calibration = piga.calibrate(records, runs[0].terms)
    keys = [c.key for c in calibration.coefficients]
    bread, meat = np.zeros((2, len(keys), len(keys)))
    for index, (scenario, record, part) in enumerate(zip(runs, records, own, strict=True)):
        at = [keys.index(f"phi[run {index + 1}]" if name == "phi" else name) for name in scenario.names]
        A, M = dense_sums(scenario, record, part.noise)
        bread[np.ix_(at, at)] += A
        meat[np.ix_(at, at)] += M
    inverse = np.linalg.inv(bread)
    expected = np.sqrt(np.diag(inverse @ meat @ inverse))
    std = np.array([c.std for c in calibration.coefficients])
    assert std == pytest.approx(expected, rel=0.06, abs=0.0)
    assert (std / np.sqrt(np.diag(inverse))).max() > 1.3


@pytest.mark.only_compiled
def test_a_drift_with_a_phase_per_segment_is_in_joint_calibrations() -> None:
    """However clear it is, it is added and not weighted by; intervals hold the truth."""
    scenario = SCENARIOS["drift"]
    run = scenario.record(np.random.default_rng([2, 9]))
    run = replace(run, model=msgspec.structs.replace(run.model, phases="per-segment"))
    calibration = piga.calibrate([RunSummary.of(run, scenario.terms)], scenario.terms)
    still = piga.calibrate([replace(RunSummary.of(run, scenario.terms), added=())], scenario.terms)
    assert calibration["scale_factor"].value == still["scale_factor"].value
    assert calibration["scale_factor"].std > 1.5 * still["scale_factor"].std
    assert calibration["scale_factor"].degrees_of_freedom < 0.7 * still["scale_factor"].degrees_of_freedom


@pytest.mark.only_compiled
def test_summaries_without_it_are_read_and_damaged_ones_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.json"
    small = replace(WHITE, forces=tumble(6, (0.5, 1.0)), seconds=8.0, rate=5.0)
    made = RunSummary.of(small.record(np.random.default_rng([3, 78])), small.terms)
    made.to_json(path)
    written = json.loads(path.read_text())
    assert [noise["name"] for noise in written["added"]] == ["walk"]
    assert RunSummary.from_json(path).added[0].variance == made.added[0].variance
    path.write_text(json.dumps({key: value for key, value in written.items() if key != "added"}))
    assert RunSummary.from_json(path).added == ()
    for damage in ([], [[[1.0]]], [[[1.0], [1.0, 2.0]]]):
        written["added"][0]["scores"] = damage
        path.write_text(json.dumps(written))
        with pytest.raises(CalibrationError, match="added noise"):
            RunSummary.from_json(path)
