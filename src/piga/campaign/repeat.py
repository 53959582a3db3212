"""Repeat one record of a campaign, and write the files that a lab would have."""

from __future__ import annotations

import datetime as dt
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from piga.campaign.campaign_file import CampaignPlan, RecordName
from piga.campaign.constant_force import ConstantForce, Joint
from piga.campaign.subjects import Outcome, built, seed_of, write_lab_files
from piga.records.text_files import toml_text
from piga.stand.scenario import Scenario, run_scenario
from piga.units import from_si

if TYPE_CHECKING:
    from piga.records import Run

FILES = ("scenario.toml", "run*.toml", "run*.parquet", "run.csv", "truth.json")
"""Names of the files of a record."""


def write_record(plan: CampaignPlan, record: RecordName, folder: Path) -> list[str]:
    """Write the files of a record into ``folder``. Returns their names.

    A scenario of a stand or a platform is written as it was used, with the seed of the record. A test of constant forces has no
    scenario file; its log and its run file are written.
    """
    document = plan.document(record)
    made = built(plan, record, document)
    if isinstance(made, Joint):
        rng = np.random.default_rng(plan.sequence(record))
        runs = zip(made.runs, made.record(rng), strict=True)
        return [
            name for k, (test, run) in enumerate(runs, 1) for name in _write_run(test, run, folder, f"run-{k}")
        ]
    if isinstance(made, ConstantForce):
        run = made.record(np.random.default_rng(plan.sequence(record)))
        return _write_run(made, run, folder, "run")
    seeded = _plain(document | {"run": document.get("run", {}) | {"seed": seed_of(plan, record)}})
    (folder / "scenario.toml").write_text(toml_text(seeded), encoding="utf-8", newline="\n")
    if isinstance(made, Scenario):
        write_lab_files(made, run_scenario(made, seed=seed_of(plan, record)), folder)
    return sorted(path.name for path in folder.iterdir())


def _plain(value: Any) -> Any:
    """Tables that can be written again: dates become text."""
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_plain(part) for part in value]
    return value.isoformat() if isinstance(value, dt.date | dt.time) else value


def _write_run(test: ConstantForce, run: Run, folder: Path, name: str) -> list[str]:
    """Log (Parquet) and run file of a test of constant forces."""
    import pyarrow as pa
    from pyarrow import parquet

    columns = {"t": run.t, "psi": run.output, "segment": run.segment_index}
    columns |= {f"f{axis}": run.f[:, k] for k, axis in enumerate("xyz")}
    if run.base_rate is not None:
        columns |= {f"w{axis}": run.base_rate[:, k] for k, axis in enumerate("xyz")}
    parquet.write_table(pa.table(columns), folder / f"{name}.parquet", compression="zstd")
    output: dict[str, Any] = {"column": "psi", "kind": "angle", "unit": "rad"}
    data: dict[str, Any] = {
        "file": f"{name}.parquet",
        "time": {"column": "t", "unit": "s"},
        "output": output,
        "reference": {"columns": ["fx", "fy", "fz"], "unit": "m/s^2"},
        "segment": "segment",
    }
    if run.base_rate is not None:
        data["base_rate"] = {"columns": ["wx", "wy", "wz"], "unit": "rad/s"}
    instrument = {"serial": run.serial, "scale_factor": f"{from_si(run.scale_factor, 'rad/s/g')!r} rad/s/g"}
    tables = {"instrument": instrument, "data": data, "model": {"terms": list(test.terms)}}
    (folder / f"{name}.toml").write_text(toml_text(tables), encoding="utf-8", newline="\n")
    return [f"{name}.toml", f"{name}.parquet"]


def outcome_document(record: RecordName, outcome: Outcome) -> dict[str, Any]:
    """One record as plain data."""
    names = ("value", "u", "low", "high", "truth")
    return {
        "record": record.number,
        "case": record.case,
        "repeat": record.repeat,
        "group": record.group.label,
        "nees": _finite(outcome.nees),
        "coefficients": [
            {"name": name, "unit": unit}
            | {key: _finite(float(getattr(outcome, key)[k])) for key in names}
            | {"z": _finite(float(outcome.error[k] / outcome.u[k]))}
            for k, (name, unit) in enumerate(zip(outcome.names, outcome.units, strict=True))
        ],
        "notes": list(outcome.notes),
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def outcome_lines(record: RecordName, outcome: Outcome) -> list[str]:
    """One record in words."""
    lines = [f"record {record.number}: {record.group.label}, case {record.case}, repeat {record.repeat}"]
    for k, (name, unit) in enumerate(zip(outcome.names, outcome.units, strict=True)):
        text = f"  {name:<24}{outcome.value[k]:>18.9g} {unit}"
        if math.isfinite(float(outcome.error[k])):
            text += f"   u {outcome.u[k]:.2g}   error {outcome.error[k]:.2g} ({outcome.error[k] / outcome.u[k]:+.1f} u)"
        lines.append(text)
    return lines
