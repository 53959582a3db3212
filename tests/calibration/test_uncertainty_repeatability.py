"""What is set anew at each position, level or run: its draws, budget, joint runs, and that it is not counted twice.

The instrument feels the forces as they were set, the reference tells what was asked for. The product's stands and kernels take
no part in the truth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import piga
from piga.calibration.summary import RunSummary
from piga.errors import RunFileError
from piga.records.calibration.coefficient import Amount
from piga.records.run_file import ASSUMED_SOURCES, EstimationTable
from piga.units import ARCSEC, G0
from tests.calibration.made.scenarios import SCENARIOS, Array, Scenario
from tests.calibration.made.synthetic import at_rest
from tests.chance import assert_variance

pytestmark = pytest.mark.interpreted
ROW = "angle_repeatability"
TRUTH = {"k0": 1.6e-3, "k2": 2.0e-4, "m_Y": 2.4e-4}
TERMS = ("scale_factor", "tan_beta", "k0", "k2", "m_Y")
CENTRIFUGE = SCENARIOS["centrifuge"]


def in_plane(angle: Array) -> Array:
    """Forces [g] of a dividing head at its positions [rad]."""
    return np.stack([np.cos(angle), -np.sin(angle), np.zeros(angle.size)], axis=1)


@dataclass(frozen=True)
class Repeated:
    """A test: its forces as asked for, the forces as set, what is stated of it, and its stand."""

    scenario: Scenario
    set_forces: Callable[[np.random.Generator], Array]
    stated: dict[str, Any]
    stand: dict[str, Any] | None = None

    def record(self, rng: np.random.Generator) -> piga.Run:
        """One simulated test; the lab states what repeats."""
        run = replace(self.scenario, forces=self.set_forces(rng)).record(rng)
        asked = (self.scenario.forces * G0)[run.segment_index]
        return replace(run, f=asked, uncertainty=at_rest(**self.stated), stand=self.stand)


def head(arcsec: float, positions: int = 24, told: str = "", **noise: float) -> Repeated:
    """A dividing head that sets each position with a normal error [arcsec], stated as ``told``."""
    angle = 2.0 * np.pi * np.arange(positions) / positions
    levels = {"white": 2.5e-5, "walk": 2e-5} | noise
    scenario = Scenario("head", in_plane(angle), truth=TRUTH, terms=TERMS, **levels)  # type: ignore[arg-type]

    def forces(rng: np.random.Generator) -> Array:
        return in_plane(angle + ARCSEC * arcsec * rng.standard_normal(positions))

    written = tuple(f"{value!r} rad" for value in angle.tolist())
    stand = {"kind": "dividing-head", "latitude": "40 deg", "gravity": f"{G0} m/s^2", "positions": written}
    return Repeated(scenario, forces, {ROW: told or f"{arcsec} arcsec"}, stand)


def centrifuge(ppm: float) -> Repeated:
    """A centrifuge whose reference is off by another share at each level."""
    asked = CENTRIFUGE.forces

    def forces(rng: np.random.Generator) -> Array:
        return asked * (1.0 + 1e-6 * ppm * rng.standard_normal((len(asked), 1)))

    return Repeated(CENTRIFUGE, forces, {"reference_repeatability": f"{ppm} ppm"})


def small(case: Repeated, **changes: Any) -> Repeated:
    return replace(case, scenario=replace(case.scenario, seconds=6.0, rate=5.0, **changes))


LINEAR = ("scale_factor", "k0", "k2")
SETTING = small(head(2.0, positions=10), terms=LINEAR, tan_beta=1e-8, truth={"k0": 1.6e-3, "k2": 2.0e-4})


@pytest.fixture(scope="module")
def record() -> piga.Run:
    return SETTING.record(np.random.default_rng(5))


def rows(result: piga.Calibration) -> dict[str, dict[str, Any]]:
    return {row.source: row for row in result.budget}


def known_noise(run: piga.Run, uncertainty: str = "gum") -> piga.Run:
    """The record with its noise levels given, so that weights are those of the noise alone."""
    table = EstimationTable(
        angle_rms="2.5e-5 rad", angle_random_walk="2e-5 rad/sqrt(s)", uncertainty=uncertainty
    )
    stated = msgspec.structs.replace(
        run.uncertainty, waived=dict.fromkeys(ASSUMED_SOURCES, "not of interest here")
    )
    return replace(run, estimation=table, uncertainty=stated)


def least_squares(scenario: Scenario, angle: Array) -> Array:
    """Estimates (scale factor, k0, k2) from mean rates of equal weight, the reference off by ``angle`` (positions,) [rad]."""
    x = np.arctan2(-scenario.forces[:, 1], scenario.forces[:, 0])
    asked = np.cos(x + angle)
    rate = 0.8884 * (np.cos(x) + 1.6e-3 + 2.0e-4 * np.cos(x) ** 2)
    scale, *rest = np.linalg.lstsq(np.stack([asked, asked**0, asked**2], axis=1), rate, rcond=None)[0]
    return np.array([scale, *(value / scale for value in rest)])


def test_one_draw_for_each_position(record: piga.Run) -> None:
    """The row is the root of the sum of squares of what each position does when it alone is moved."""
    calibration = piga.calibrate(known_noise(record), SETTING.scenario.terms)
    count = len(record.labels)
    base = least_squares(SETTING.scenario, np.zeros(count))
    moved = [least_squares(SETTING.scenario, 2.0 * ARCSEC * own) - base for own in np.eye(count)]
    row = rows(calibration)[ROW]
    share = np.array(list(row.contributions.values())) / np.linalg.norm(moved, axis=0)
    assert (share > 0.5).all()
    assert (share < 1.001).all(), "the weights know of it"
    assert row.standard_uncertainty == Amount(2.0, "arcsec")
    type_a = rows(calibration)["fit residuals (repeatability)"].contributions
    for c in calibration.coefficients:
        assert c.std**2 == pytest.approx(type_a[c.key] ** 2 + row.contributions[c.key] ** 2, rel=1e-9)


def test_monte_carlo_draws_each_position(record: piga.Run) -> None:
    calibration = piga.calibrate(known_noise(record, "monte-carlo"), SETTING.scenario.terms)
    for c in calibration.coefficients:
        drawn = calibration.diagnostics.monte_carlo.coefficients[c.key]
        assert drawn.symmetric[1] - drawn.symmetric[0] == pytest.approx(2.0 * c.expanded, rel=0.1)


def dense(case: Repeated, run: piga.Run) -> np.ndarray:
    """Standard uncertainties of least squares with the whole covariance: noise, and a rate of each segment."""
    s = case.scenario
    steps, h = round(s.seconds * s.rate), 1.0 / s.rate
    V = np.diag(np.full(steps, s.walk**2 * h + 2.0 * s.white**2))
    V -= s.white**2 * (np.eye(steps, k=1) + np.eye(steps, k=-1))
    whole = np.zeros((len(s.names),) * 2)
    for k, force in enumerate(s.forces):
        rate = 0.8884 * force[1] * 2.0 * ARCSEC
        columns = s._derivatives(run.output[run.segment_index == k] + s.phi, k, h)
        whole += columns.T @ np.linalg.solve(V + (rate * h) ** 2, columns)
    return np.sqrt(np.diag(np.linalg.inv(whole)))


@pytest.mark.long
def test_what_is_stated_is_not_found_again() -> None:
    """Quiet records, errors of setting far above the noise: nothing is found, and the total is that of least squares."""
    case = small(
        head(2.0, walk=5e-7, white=2e-6, positions=12), terms=LINEAR, tan_beta=1e-8, truth={"k0": 1.6e-3}
    )
    ratio = []
    for seed in range(3):
        run = case.record(np.random.default_rng(seed))
        told = case.scenario.calibrate(run)
        silent = case.scenario.calibrate(replace(run, uncertainty=at_rest()))
        assert told.segment_scatter < 0.7 * silent.segment_scatter
        ratio.append([c.std for c in told.coefficients] / dense(case, run))
    assert np.array(ratio)[:, 1:].min() > 0.95, "the larger of model and scatter is reported"
    assert np.mean(ratio, axis=0).max() < 2.0


@pytest.mark.long
def test_more_than_is_stated_is_found_beside_it() -> None:
    case = small(
        head(10.0, walk=5e-7, white=2e-6, positions=16, told="2 arcsec"),
        terms=("scale_factor", "k0"),
        tan_beta=1e-8,
        truth={"k0": 1.6e-3},
    )
    levels = [
        case.scenario.calibrate(case.record(np.random.default_rng(seed))).segment_scatter for seed in range(8)
    ]
    expected = 0.8884 * 10.0 * ARCSEC / np.sqrt(2.0)  # the error of the angle times the mean size of sin
    assert_variance(np.mean(np.square(levels)) / expected**2, 8 * (16 - 2), "scatter")


# --- several runs


@pytest.fixture(scope="module")
def pair() -> list[piga.Run]:
    """Two tests on one head with one reference: repeated settings and mountings, a shared turn of the axis."""
    stated = at_rest(
        reference_id="head 2",
        angle_repeatability="2 arcsec",
        reference_misalignment="1 arcsec",
        mounting_repeatability="1 arcsec",
    )
    records = [SETTING.record(np.random.default_rng(seed)) for seed in (1, 2)]
    return [replace(known_noise(run), uncertainty=stated) for run in records]


MISALIGNED = ["scale_factor", "k0", "m_Y"]


@pytest.mark.long
def test_each_run_is_mounted_anew_and_shares_its_reference(pair: list[piga.Run]) -> None:
    """A turn about Z0 goes into m_Y: shared in full, of two mountings over the square root of two."""
    result = rows(piga.calibrate(pair, MISALIGNED))
    shared = result["reference_misalignment Z0 (run 1, run 2)"].contributions["m_Y"]
    each = [result[f"mounting_repeatability Z0 (run {k})"].contributions["m_Y"] for k in (1, 2)]
    assert abs(shared) == pytest.approx(ARCSEC, rel=0.01)
    assert np.hypot(*each) == pytest.approx(ARCSEC / np.sqrt(2.0), rel=0.05)


@pytest.mark.long
def test_a_summary_keeps_its_draws(pair: list[piga.Run], tmp_path: Path) -> None:
    RunSummary.of(pair[1], MISALIGNED, name="run 2").to_json(tmp_path / "second.json")
    live = piga.calibrate(pair, MISALIGNED)
    read = piga.calibrate([pair[0], RunSummary.from_json(tmp_path / "second.json")], MISALIGNED)
    for mine, other in zip(live.budget, read.budget, strict=True):
        assert mine.source == other.source
        assert list(mine.contributions.values()) == pytest.approx(
            list(other.contributions.values()), rel=1e-6, abs=1e-10
        )


# --- other stands, refusals


@pytest.mark.parametrize("key", ["levelling", "angle_error", "angle_repeatability"])
def test_a_negative_uncertainty_of_a_stand_is_refused(record: piga.Run, key: str) -> None:
    wrong = replace(record, source="a.toml", uncertainty=at_rest(**{key: "-0.3 arcsec"}))
    with pytest.raises(RunFileError, match=rf"\[uncertainty\] {key}: '-0.3 arcsec' is negative"):
        piga.calibrate(wrong, TERMS)


def test_a_stand_refuses_what_it_does_not_repeat(record: piga.Run) -> None:
    wrong = replace(record, source="a.toml", uncertainty=at_rest(rate_repeatability="1 ppm"))
    with pytest.raises(RunFileError, match=r"rate_repeatability does not exist on a dividing-head") as refused:
        piga.calibrate(wrong, TERMS)
    assert "angle_repeatability" in str(refused.value.remedy)


CASES = {
    "head": head(1.0),
    "head-8": head(1.0, positions=8),
    "head-quiet": head(1.0, walk=0.0),
    "head-unclear-walk": head(1.0, walk=1e-6),
    "head-coarse-setting": head(10.0),
    "head-fine-setting": head(0.2),
    "centrifuge": centrifuge(20.0),
}


def test_a_stated_scatter_is_no_slow_change() -> None:
    """Positions in order widen the interval of a bias where they scatter; not by what is set anew at each position."""
    case = CASES["head-coarse-setting"]
    runs = [case.record(np.random.default_rng([seed, 1906])) for seed in range(4)]
    stated = [piga.calibrate(run, TERMS)["k0"].std for run in runs]
    alone = [piga.calibrate(replace(run, uncertainty=at_rest()), TERMS)["k0"].std for run in runs]
    assert np.mean(stated) < 0.7 * np.mean(alone)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("name", CASES)
def test_intervals_of_records_with_stated_repeatability_hold(name: str) -> None:
    """300 records: 93 to 98 % of all coefficients together, no coefficient below 91 %."""
    case, held = CASES[name], []
    for seed in range(300):
        calibration = case.scenario.calibrate(case.record(np.random.default_rng([seed, 1906])))
        half = np.array([c.expanded for c in calibration.coefficients])
        held.append(np.abs(case.scenario.errors(calibration)) <= half)
    assert 0.93 <= np.mean(held) <= 0.98
    assert np.mean(held, axis=0).min() >= 0.91
