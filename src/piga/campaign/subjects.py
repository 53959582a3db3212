"""Computation of one record: simulate and calibrate a test on a stand, or run a platform."""

from __future__ import annotations

import math
import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from piga.campaign.campaign_file import CampaignPlan, RecordName
from piga.errors import PigaWarning
from piga.records.calibration.coefficient import changes
from piga.records.calibration.diagnostics import SCATTER
from piga.results import Array
from piga.stand.scenario import Scenario, run_scenario
from piga.text_files import toml_text

if TYPE_CHECKING:
    from piga.platform.scenario import PlatformScenario
    from piga.records import Calibration
    from piga.stand.simulate import SimulatedTest


@dataclass(frozen=True)
class Outcome:
    """Numbers of one record: ``columns`` with an entry per coefficient or quantity, in the units of calibration.json.

    ``low`` and ``high`` are the ends of the 95 % interval. ``deviation`` is value minus ``truth``; for a phase it is taken to
    the nearest turn. ``z`` is that over ``u``. Unknown values are nan; a quantity without truth has ``name``, ``unit`` and
    ``value`` alone. ``nees`` is the mean square of all errors in their covariance, ``nees_expected`` its expected value for
    Student's t. ``seen`` names what the calibration reports: kinds of noise, terms it suggests, and a doubt about the noise.
    """

    columns: dict[str, Sequence[str] | Array]
    nees: float = math.nan
    nees_expected: float = math.nan
    seen: tuple[str, ...] = ()

    def rows(self) -> list[dict[str, Any]]:
        """The columns as one row per coefficient."""
        return [dict(zip(self.columns, row, strict=True)) for row in zip(*self.columns.values(), strict=True)]


def compute(plan: CampaignPlan, record: RecordName) -> Outcome:
    """Compute a record."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PigaWarning)
        scenario, seed = plan.scenario(record), plan.seed_of(record)
        return _simulated(scenario, seed) if isinstance(scenario, Scenario) else _platform_run(scenario, seed)


def scenario_text(plan: CampaignPlan, record: RecordName) -> str:
    """The scenario file of a record: that of the campaign with the values and the seed of the record."""
    document = plan.document(record)
    return toml_text(document | {"run": document.get("run", {}) | {"seed": plan.seed_of(record)}})


# --- tests with known truth --------------------------------------------------------------------------


def of_calibration(calibration: Calibration, truth: Array) -> Outcome:
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
        }  # fmt: skip
    return Outcome(columns, nees, expected, _seen(calibration))


def _seen(calibration: Calibration) -> tuple[str, ...]:
    """Kinds of noise that a calibration reports, terms that it suggests, and a doubt about the noise."""
    scatters = calibration.diagnostics.worst > SCATTER
    noise = {
        "random walk": calibration.angle_random_walk > 0.0,
        "scatter of the segments": calibration.segment_scatter > 0.0,
        "doubt about the noise": scatters or any(doubt.noise for doubt in calibration.verdict.doubts),
    }
    missing = calibration.diagnostics.missing_terms
    suggested = dict.fromkeys(f"suggested: {' '.join(entry.terms)}" for entry in missing)
    return (*(name for name, there in noise.items() if there), *suggested)


def _simulated(scenario: Scenario, seed: int) -> Outcome:
    """Simulate, write the files of a lab, read them and calibrate, as a user does."""
    from piga.calibration.calibrate import calibrate
    from piga.stand import read_run
    from piga.stand.write_run import run_file_text, write_data

    test = run_scenario(scenario, seed=seed)
    with tempfile.TemporaryDirectory(prefix="piga-campaign-") as folder:
        run, data = Path(folder, "run.toml"), f"run.{scenario.table.run.format}"
        write_data(test, Path(folder, data))
        run.write_text(run_file_text(scenario, test, data), encoding="utf-8", newline="\n")
        calibration = calibrate(read_run(run))
    return of_calibration(calibration, _truth(test, calibration))


def _truth(test: SimulatedTest, calibration: Calibration) -> Array:
    """True values by coefficient. A term that the simulation lacks has the truth 0."""
    from piga.stand.write_run import coefficients

    truth = {(value.name, value.segment): value.value for value in coefficients(test)}

    def one(name: str, segment: str | None) -> float:
        return truth.get((name, segment), truth.get((name, None), math.nan if name == "phi" else 0.0))

    return np.array([one(c.name, c.segment) for c in calibration.coefficients])


# --- platform ----------------------------------------------------------------------------------------


def _platform_run(scenario: PlatformScenario, seed: int) -> Outcome:
    from piga.platform.chain import compare, last_east_lines

    labels = ("east_velocity_line", "east_velocity_equatorial_line")
    rows: list[tuple[str, str, float]] = []
    for model, run in compare(replace(scenario, seed=seed)).models.items():
        rows.append((f"position_error[{model}]", "m", float(run.lines.position.max())))
        values = zip(labels, last_east_lines(run.lines), strict=False)
        rows += [(f"{label}[{model}]", "m/s", value) for label, value in values]
    return Outcome(dict(zip(("name", "unit", "value"), zip(*rows, strict=True), strict=True)))
