"""Computation of one record: simulate and calibrate a test on a stand, or run a platform; and its files."""

from __future__ import annotations

import math
import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from piga.campaign.campaign_file import CampaignPlan, RecordName
from piga.errors import ArgumentError, PigaWarning, RunFileError, UnitError
from piga.records.calibration.coefficient import changes
from piga.records.run_file import ASSUMED_SOURCES, EstimationTable, ModelTable, UncertaintyTable
from piga.records.text_files import convert_table, convert_toml, toml_text
from piga.results import Array, finite
from piga.stand.scenario import Scenario, ScenarioTable, run_scenario, scenario_of

if TYPE_CHECKING:
    from piga.platform.scenario import PlatformScenario
    from piga.records import Calibration, Run
    from piga.stand.simulate import SimulatedTest


@dataclass(frozen=True)
class Outcome:
    """Numbers of one record: ``columns`` with an entry per coefficient or quantity, in the units of calibration.json.

    ``low`` and ``high`` are the ends of the 95 % interval. ``deviation`` is value minus ``truth``; for a phase it is taken to
    the nearest turn. ``z`` is that over ``u``. ``bound`` is the standard deviation of Cramer and Rao. Unknown values are nan;
    a quantity without truth has ``name``, ``unit`` and ``value`` alone. ``nees`` is the mean square of all errors in their
    covariance, ``nees_expected`` its expected value for Student's t.
    ``seen`` names what the calibration reports: kinds of noise, terms it suggests, and a doubt about the noise.
    """

    columns: dict[str, Sequence[str] | Array]
    nees: float = math.nan
    nees_expected: float = math.nan
    notes: tuple[str, ...] = ()
    seen: tuple[str, ...] = ()

    def rows(self) -> list[dict[str, Any]]:
        """The columns as one row per coefficient."""
        return [dict(zip(self.columns, row, strict=True)) for row in zip(*self.columns.values(), strict=True)]


def built(plan: CampaignPlan, record: RecordName, document: dict[str, Any]) -> Scenario | PlatformScenario:
    """The scenario of a record, ready to run."""
    path = plan.path.parent / record.group.scenario
    try:
        if record.group.subject == "stand":
            return _stand(path, document)
        from piga.platform.scenario import scenario_of_document

        return scenario_of_document(path, document)
    except (ArgumentError, UnitError) as error:
        raise RunFileError(error.message, remedy=error.remedy) from None


def _stand(path: Path, document: dict[str, Any]) -> Scenario:
    table = convert_toml(path, document, ScenarioTable)
    kinds = {"model": ModelTable, "estimation": EstimationTable, "uncertainty": UncertaintyTable}
    for part, kind in kinds.items():
        try:
            convert_table(part, getattr(table, part), kind)
        except ArgumentError as error:
            raise RunFileError(f"{path}: {error.message}", remedy=error.remedy) from None
    if table.truth.get("k1"):
        raise RunFileError(
            f"{path}: [truth] k1: a calibration cannot separate it from the scale factor",
            remedy="leave it out, or change scale_factor",
        )
    return scenario_of(path, table)


def compute(plan: CampaignPlan, record: RecordName) -> Outcome:
    """Compute a record."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PigaWarning)
        made = built(plan, record, plan.document(record))
        if isinstance(made, Scenario):
            return _simulated(plan, record, made)
        return _platform_run(plan, record, made)


def seed_of(plan: CampaignPlan, record: RecordName) -> int:
    """Seed of a simulated scenario, as ``piga simulate --seed`` takes it."""
    return int(plan.sequence(record).generate_state(1, np.uint64)[0] >> np.uint64(1))


# --- tests with known truth --------------------------------------------------------------------------


def of_calibration(calibration: Calibration, truth: Array, bound: Array | None = None) -> Outcome:
    """The outcome of a calibration with its truth (nan where it is not known)."""
    coefficients = calibration.coefficients
    value, u = np.array([(c.value, c.std) for c in coefficients]).reshape(-1, 2).T
    low, high = np.array([c.limits for c in coefficients]).reshape(-1, 2).T
    degrees = np.array([c.degrees_of_freedom or math.inf for c in coefficients])
    error = changes(coefficients, truth, value)
    nees = expected = math.nan
    if np.isfinite(error).all() and error.size:
        nees = float(error @ np.linalg.solve(calibration.covariance, error)) / error.size
        expected = float(np.mean(1.0 / (1.0 - 2.0 / np.maximum(degrees, 3.0))))
    with np.errstate(all="ignore"):
        columns: dict[str, Sequence[str] | Array] = {
            "name": [c.key for c in coefficients],
            "unit": [c.unit for c in coefficients],
            "value": value, "u": u, "low": low, "high": high, "degrees_of_freedom": degrees,
            "truth": truth, "deviation": error, "z": error / u,
            "bound": np.full(value.size, math.nan) if bound is None else bound,
        }  # fmt: skip
    return Outcome(columns, nees, expected, tuple(calibration.notes), _seen(calibration))


NOISE_DOUBTED = "doubt about the noise"
"""Entry of ``seen`` of a calibration whose verdict doubts the noise."""


def _seen(calibration: Calibration) -> tuple[str, ...]:
    """Kinds of noise that a calibration reports, terms that it suggests, and a doubt about the noise."""
    noise = {
        "random walk": calibration.angle_random_walk > 0.0,
        "scatter of the segments": calibration.segment_scatter > 0.0,
        NOISE_DOUBTED: calibration.verdict.warns_of_noise,
    }
    missing = calibration.diagnostics.missing_terms
    suggested = dict.fromkeys(f"suggested: {' '.join(entry.terms)}" for entry in missing)
    return (*(name for name, there in noise.items() if there), *suggested)


def _simulated(plan: CampaignPlan, record: RecordName, scenario: Scenario) -> Outcome:
    """Simulate, write the files of a lab, read them and calibrate, as a user does."""
    from piga.calibration.calibrate import calibrate
    from piga.stand import read_run

    with tempfile.TemporaryDirectory(prefix="piga-campaign-") as folder:
        test = run_scenario(scenario, seed=seed_of(plan, record))
        run = read_run(_write_lab_files(scenario, test, Path(folder)))
        calibration = calibrate(run)
        bound = _bound(test, run) if record.repeat < record.group.bounds else None
    return of_calibration(calibration, _truth(test, calibration), bound)


def _write_lab_files(scenario: Scenario, test: SimulatedTest, folder: Path) -> Path:
    """Write the log, the run file and the truth of a simulated test into ``folder``. Returns the run file."""
    from piga.stand.write_run import run_file_text, truth_text, write_data

    data = f"run.{scenario.table.run.format}"
    write_data(test, folder / data)
    run = folder / "run.toml"
    run.write_text(run_file_text(scenario, test, data), encoding="utf-8", newline="\n")
    (folder / "truth.json").write_text(truth_text(scenario, test), encoding="utf-8", newline="\n")
    return run


def _truth(test: SimulatedTest, calibration: Calibration) -> Array:
    """True values by coefficient. A term that the simulation lacks has the truth 0."""
    from piga.stand.write_run import coefficients

    truth = {(value.name, value.segment): value.value for value in coefficients(test)}

    def one(name: str, segment: str | None) -> float:
        return truth.get((name, segment), truth.get((name, None), math.nan if name == "phi" else 0.0))

    return np.array([one(c.name, c.segment) for c in calibration.coefficients])


def _bound(test: SimulatedTest, run: Run) -> Array | None:
    """Cramer-Rao standard deviations, for known noise levels.

    None where the noise is more than white noise, counting and a random walk of the angle, or where Type B is stated.
    """
    from piga.calibration.calibrate import calibrate

    e = test.electronics
    entries = msgspec.structs.asdict(run.uncertainty)
    stated = any(value is not None for name, value in entries.items() if name != "waived")
    other_noise = e.bias_random_walk or e.clock_jitter or e.clock_offset
    if other_noise or stated or test.model == "twin" or e.kind == "rate":
        return None
    step = 2.0 * math.pi / e.counts_per_revolution if e.kind == "counts" else 0.0
    white = math.sqrt(e.angle_noise**2 + step**2 / 12.0)
    true_noise = EstimationTable(
        method="information",
        angle_rms=f"{white!r} rad",
        angle_random_walk=f"{e.angle_random_walk!r} rad/sqrt(s)",
        uncertainty="gum",
    )
    noise_alone = UncertaintyTable(waived=dict.fromkeys(ASSUMED_SOURCES, "the bound is that of the noise"))
    best = calibrate(replace(run, estimation=true_noise, uncertainty=noise_alone))
    return np.array([c.std for c in best.coefficients])


# --- platform ----------------------------------------------------------------------------------------


def _platform_run(plan: CampaignPlan, record: RecordName, scenario: PlatformScenario) -> Outcome:
    from piga.platform.chain import compare, last_east_lines

    labels = ("east_velocity_line", "east_velocity_equatorial_line")
    rows: list[tuple[str, str, float]] = []
    for model, run in compare(replace(scenario, seed=seed_of(plan, record))).models.items():
        rows.append((f"position_error[{model}]", "m", float(run.lines.position.max())))
        values = zip(labels, last_east_lines(run.lines), strict=False)
        rows += [(f"{label}[{model}]", "m/s", value) for label, value in values]
    return Outcome(dict(zip(("name", "unit", "value"), zip(*rows, strict=True), strict=True)))


# --- files of a record -------------------------------------------------------------------------------


FILES = ("scenario.toml", "run.toml", "run.parquet", "run.csv", "truth.json")
"""Names of the files of a record."""


def write_record(plan: CampaignPlan, record: RecordName, folder: Path) -> None:
    """Write the files of a record into ``folder``: the scenario as it was used, with the seed of the record."""
    document = plan.document(record)
    made = built(plan, record, document)
    seeded = document | {"run": document.get("run", {}) | {"seed": seed_of(plan, record)}}
    (folder / "scenario.toml").write_text(toml_text(seeded), encoding="utf-8", newline="\n")
    if isinstance(made, Scenario):
        _write_lab_files(made, run_scenario(made, seed=seed_of(plan, record)), folder)


def outcome_document(record: RecordName, outcome: Outcome) -> dict[str, Any]:
    """One record as plain data."""
    numbers = ("value", "u", "low", "high", "truth", "z")
    return {
        "record": record.number,
        "case": record.case,
        "repeat": record.repeat,
        "group": record.group.label,
        "nees": finite(outcome.nees),
        "coefficients": [
            {"name": row["name"], "unit": row["unit"]}
            | {key: finite(float(row.get(key, math.nan))) for key in numbers}
            for row in outcome.rows()
        ],
        "notes": list(outcome.notes),
    }


def outcome_lines(record: RecordName, outcome: Outcome) -> list[str]:
    """One record in words."""
    lines = [f"record {record.number}: {record.group.label}, case {record.case}, repeat {record.repeat}"]
    for row in outcome.rows():
        text = f"  {row['name']:<24}{row['value']:>18.9g} {row['unit']}"
        if math.isfinite(row.get("deviation", math.nan)):
            text += "   u {u:.2g}   error {deviation:.2g} ({z:+.1f} u)".format(**row)
        lines.append(text)
    return lines
