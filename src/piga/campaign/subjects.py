"""Computation of one record: simulate and calibrate a test on a stand, or run a platform; and its files."""

from __future__ import annotations

import datetime as dt
import math
import tempfile
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from piga.campaign.campaign_file import CampaignPlan, RecordName
from piga.errors import ArgumentError, PigaError, PigaWarning, RunFileError, UnitError
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
    """Numbers of one record, one entry per coefficient or quantity, in the units of calibration.json.

    ``low`` and ``high`` are the ends of the 95 % interval. ``truth`` is the true value. ``error`` is value minus truth;
    for a phase it is taken to the nearest turn. ``bound`` is the standard
    deviation of Cramer and Rao. Unknown values are nan. ``nees`` is the mean square of all errors in their
    covariance, ``nees_expected`` its expected value for Student's t.
    ``seen`` names what the calibration reports: kinds of noise, terms it suggests, and a doubt about the noise.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    value: Array
    u: Array
    low: Array
    high: Array
    degrees_of_freedom: Array
    truth: Array
    error: Array
    bound: Array
    nees: float = math.nan
    nees_expected: float = math.nan
    notes: tuple[str, ...] = ()
    seen: tuple[str, ...] = ()


def built(plan: CampaignPlan, record: RecordName, document: dict[str, Any]) -> Any:
    """The scenario of a record, ready to run."""
    try:
        return (_stand if record.group.subject == "stand" else _platform)(plan, record, document)
    except (ArgumentError, UnitError) as error:
        raise RunFileError(error.message, remedy=error.remedy) from None


def _stand(plan: CampaignPlan, record: RecordName, document: dict[str, Any]) -> Scenario:
    path = plan.path.parent / record.group.scenario
    table = convert_toml(path, document, ScenarioTable)
    for part, kind in (
        ("model", ModelTable),
        ("estimation", EstimationTable),
        ("uncertainty", UncertaintyTable),
    ):
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


def _platform(plan: CampaignPlan, record: RecordName, document: dict[str, Any]) -> PlatformScenario:
    from piga.platform.scenario import scenario_of_document

    return scenario_of_document(plan.path.parent / record.group.scenario, document)


def compute(plan: CampaignPlan, record: RecordName) -> Outcome:
    """Compute a record."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PigaWarning)
        made = built(plan, record, plan.document(record))
        if isinstance(made, Scenario):
            return _simulated(plan, record, made, with_bound=record.repeat < record.group.bounds)
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
        with np.errstate(all="ignore"):
            try:
                nees = float(error @ np.linalg.solve(calibration.covariance, error)) / error.size
            except np.linalg.LinAlgError:
                nees = math.nan
        expected = float(np.mean(1.0 / (1.0 - 2.0 / np.maximum(degrees, 3.0))))
    none = np.full(value.size, math.nan)
    return Outcome(
        names=tuple(c.key for c in coefficients),
        units=tuple(c.unit for c in coefficients),
        value=value,
        u=u,
        low=low,
        high=high,
        degrees_of_freedom=degrees,
        truth=truth,
        error=error,
        bound=none if bound is None else bound,
        nees=nees,
        nees_expected=expected,
        notes=tuple(calibration.notes),
        seen=_seen(calibration),
    )


NOISE_DOUBTED = "doubt about the noise"
"""Entry of ``seen`` of a calibration whose verdict doubts the noise."""


def _seen(calibration: Calibration) -> tuple[str, ...]:
    """Kinds of noise that a calibration reports, terms that it suggests, and a doubt about the noise."""
    levels = {
        "random walk": calibration.angle_random_walk,
        "scatter of the segments": calibration.segment_scatter,
    }
    noise = [name for name, level in levels.items() if level > 0.0]
    missing = calibration.diagnostics.missing_terms
    if calibration.verdict.warns_of_noise:
        noise.append(NOISE_DOUBTED)
    return (*noise, *dict.fromkeys(f"suggested: {' '.join(entry.terms)}" for entry in missing))


def _simulated(plan: CampaignPlan, record: RecordName, scenario: Scenario, *, with_bound: bool) -> Outcome:
    """Simulate, write the files of a lab, read them and calibrate, as a user does."""
    from piga.calibration.calibrate import calibrate
    from piga.stand import read_run

    with tempfile.TemporaryDirectory(prefix="piga-campaign-") as folder:
        test = run_scenario(scenario, seed=seed_of(plan, record))
        run = read_run(_write_lab_files(scenario, test, Path(folder)))
        calibration = calibrate(run)
        bound = _bound(test, run) if with_bound else None
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
    if (
        e.bias_random_walk
        or e.clock_jitter
        or e.clock_offset
        or test.model == "twin"
        or stated
        or e.kind == "rate"
    ):
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

    models = compare(replace(scenario, seed=seed_of(plan, record))).models
    rows: list[tuple[str, str, float]] = []
    for model, run in models.items():
        rows.append((f"position_error[{model}]", "m", float(run.lines.position.max())))
        labels = ("east_velocity_line", "east_velocity_equatorial_line")
        rows += [
            (f"{label}[{model}]", "m/s", value)
            for label, value in zip(labels, last_east_lines(run.lines), strict=False)
        ]
    none = np.full(len(rows), math.nan)
    values = np.array([value for _, _, value in rows])
    names, units = tuple(row[0] for row in rows), tuple(row[1] for row in rows)
    return Outcome(names, units, values, none, none, none, none, none, none, none)


def reason(error: Exception) -> tuple[str, str]:
    """Class and message of an error, for the row of a record that failed."""
    text = str(error) if isinstance(error, PigaError) else f"{error}" or repr(error)
    return type(error).__name__, text[:2000]


# --- files of a record -------------------------------------------------------------------------------


FILES = ("scenario.toml", "run.toml", "run.parquet", "run.csv", "truth.json")
"""Names of the files of a record."""


def write_record(plan: CampaignPlan, record: RecordName, folder: Path) -> list[str]:
    """Write the files of a record into ``folder``. Returns their names.

    The scenario is written as it was used, with the seed of the record.
    """
    document = plan.document(record)
    made = built(plan, record, document)
    seeded = _plain(document | {"run": document.get("run", {}) | {"seed": seed_of(plan, record)}})
    (folder / "scenario.toml").write_text(toml_text(seeded), encoding="utf-8", newline="\n")
    if isinstance(made, Scenario):
        _write_lab_files(made, run_scenario(made, seed=seed_of(plan, record)), folder)
    return sorted(path.name for path in folder.iterdir())


def _plain(value: Any) -> Any:
    """Tables that can be written again: dates become text."""
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_plain(part) for part in value]
    return value.isoformat() if isinstance(value, dt.date | dt.time) else value


def outcome_document(record: RecordName, outcome: Outcome) -> dict[str, Any]:
    """One record as plain data."""
    names = ("value", "u", "low", "high", "truth")
    return {
        "record": record.number,
        "case": record.case,
        "repeat": record.repeat,
        "group": record.group.label,
        "nees": finite(outcome.nees),
        "coefficients": [
            {"name": name, "unit": unit}
            | {key: finite(float(getattr(outcome, key)[k])) for key in names}
            | {"z": finite(float(outcome.error[k] / outcome.u[k]))}
            for k, (name, unit) in enumerate(zip(outcome.names, outcome.units, strict=True))
        ],
        "notes": list(outcome.notes),
    }


def outcome_lines(record: RecordName, outcome: Outcome) -> list[str]:
    """One record in words."""
    lines = [f"record {record.number}: {record.group.label}, case {record.case}, repeat {record.repeat}"]
    for k, (name, unit) in enumerate(zip(outcome.names, outcome.units, strict=True)):
        text = f"  {name:<24}{outcome.value[k]:>18.9g} {unit}"
        if math.isfinite(float(outcome.error[k])):
            text += f"   u {outcome.u[k]:.2g}   error {outcome.error[k]:.2g} ({outcome.error[k] / outcome.u[k]:+.1f} u)"
        lines.append(text)
    return lines
