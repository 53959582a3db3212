"""Compensate the records of a set of three or more instruments on one base; the files of a set, and a summary."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from piga.compensation.compensator import check_phase_kept, check_serial
from piga.compensation.model import Limits, Phase
from piga.compensation.result import Compensated, CompensatedSet, Inputs, inputs_listed
from piga.compensation.set_compensator import Mounted, SetCompensator
from piga.errors import ArgumentError, DataError, RunFileError
from piga.progress import Progress, report
from piga.records import read_toml
from piga.records.arrays import integrated_rate
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.document import read_with_digest
from piga.records.run import Run
from piga.records.run_file import Quantity
from piga.records.text_files import toml_bytes, toml_document
from piga.stand.run_reference import read_run
from piga.units import to_si

APART = 1e-6
"""Largest difference between the times of one row in the records of a set, as a share of the first interval."""


def compensate_set(
    records: Sequence[Run],
    instruments: Sequence[Mounted],
    *,
    uncertainty: bool = True,
    limits: Limits | None = None,
    max_age_days: float | None = None,
    force: bool = False,
    details: bool = False,
    progress: Progress | None = None,
) -> CompensatedSet:
    """Specific force of whole records of three or more instruments, sampled at the same times.

    Records of angles give the mean over each interval. Records of rates give the force at the samples; their angles
    are integrated from the rates. ``details`` keeps misfits and flags of each instrument. ``progress`` is called as
    ``progress(done, total, what)`` with the rows done; it returns False to stop (:mod:`piga.progress`).

    Raises
    ------
    DataError
        If the records differ in their times or in the kind of output.
    CalibrationError, ArgumentError
        As :class:`SetCompensator`, and for calibrations of other instruments unless ``force``.
    """
    _check_together(records)
    if len(records) != len(instruments):
        raise ArgumentError(
            f"{len(records)} records for {len(instruments)} instruments",
            remedy="give one record for each instrument",
        )
    for record, item in zip(records, instruments, strict=True):
        check_serial(record, item.calibration, force)
        check_phase_kept(record, item.calibration, item.phase, alone=False)
    first, rates = records[0], records[0].kind == "rate"
    stream = SetCompensator(
        [replace(item, segment=item.segment or r.labels[0]) for r, item in zip(records, instruments, strict=True)],
        sampled=rates, uncertainty=uncertainty, limits=limits, max_age_days=max_age_days, details=details,
        step=(first.median_step or 1.0) if rates else None,
    )  # fmt: skip
    begins = np.logical_or.reduce([record.begins for record in records])
    angles = [integrated_rate(r.t, r.output, begins) if rates else r.output for r in records]
    base = any(record.base_rate is not None for record in records)
    warm = [record.temperature for record in records if record.temperature is not None]
    whole = stream.empty_rows(first.t)
    report(progress, 0, first.size, "compensating")
    step = max(READINGS // len(records), 1)
    for start in range(0, first.size, step):
        part = slice(start, min(start + step, first.size))
        still = np.zeros((part.stop - start, 3))
        stream.push(
            np.ascontiguousarray(first.t[part]),
            np.array([angle[part] for angle in angles]),
            rate=np.array([r.output[part] for r in records]) if rates else None,
            base_rate=np.array([still if r.base_rate is None else r.base_rate[part] for r in records])
            if base
            else None,
            temperature=np.array([kelvin[part] for kelvin in warm]) if len(warm) == len(records) else None,
            begins=begins[part],
            into=whole.rows(part),
        )
        report(progress, part.stop, first.size, "compensating")
    return replace(whole, notes=stream.notes + stream.remarks(), u_velocity=stream.u_velocity())


def _check_together(records: Sequence[Run]) -> None:
    """Refuse records that were not sampled at the same times."""
    if not records:
        raise DataError("a set without a record", remedy="give the records of three or more instruments")
    first = records[0]
    apart = APART * (first.t[1] - first.t[0])
    for index, record in enumerate(records[1:], start=1):
        name, other = record.source or f"record {index}", first.source or "record 0"
        if record.kind != first.kind:
            raise DataError(
                f"{name}: the output is of kind '{record.kind}', that of {other} is '{first.kind}'",
                remedy="log the same kind with all instruments",
            )
        both = slice(min(record.size, first.size))
        differs = np.abs(record.t[both] - first.t[both]) > apart
        if differs.any():
            at = int(np.argmax(differs))
            raise DataError(
                f"{name}: row {record.row[at]}, t = {record.t[at]:.9g} s: the times are not those of {other}",
                remedy="sample all instruments together, or interpolate them to common times first",
            )
        if record.size != first.size:
            raise DataError(
                f"{name}: has {record.size} rows that can be used, {other} has {first.size}",
                remedy="sample all instruments together, and cut the records to the time they share",
            )


Row = tuple[float, float, float]


class TriadInstrument(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """``[[triad.instrument]]``: run, calibration and axes (rows X0, Y0, Z0 in the common frame)."""

    run: str
    calibration: str
    axes: tuple[Row, Row, Row]
    phase: Quantity | None = None


class TriadTable(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """``[triad]``."""

    instrument: tuple[TriadInstrument, ...]


class TriadFile(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """A whole triad file."""

    triad: TriadTable


def is_triad_file(path: Path) -> bool:
    """True if a TOML file has a table ``[triad]``. Errors of an unreadable file are left to its reader."""
    try:
        return "triad" in toml_document(path)
    except RunFileError:
        return False


def read_triad(path: str | Path) -> tuple[list[Path], list[Mounted], list[tuple[str, str]]]:
    """Run files and mounted instruments of a triad file; file names are relative to it.

    The last result lists the triad file and the calibrations, each with its name and the SHA-256 of what was read.
    """
    path = Path(path)
    raw = toml_bytes(path)
    file = read_toml(path, TriadFile, raw)
    items = file.triad.instrument
    if len(items) < 3:
        raise RunFileError(
            f"{path}: [[triad.instrument]] occurs {len(items)} times", remedy="write it three times or more"
        )
    read = [read_with_digest(path.parent / item.calibration) for item in items]
    mounted = [
        Mounted(
            calibration,
            np.array(item.axes),
            None if item.phase is None else Phase(to_si(item.phase, "rad", what=f"{path}: phase")),
        )
        for item, (calibration, _) in zip(items, read, strict=True)
    ]
    named = [Path(item.calibration).name for item in items]
    inputs = [(path.name, hashlib.sha256(raw).hexdigest()), *zip(named, (d for _, d in read), strict=True)]
    return [path.parent / item.run for item in items], mounted, inputs


def orthogonal_triad(calibrations: list[Calibration]) -> list[Mounted]:
    """Three instruments whose input axes are x, y and z of the common frame, in this order.

    The transverse axes follow in cyclic order: the second has ``X0 = y, Y0 = z, Z0 = x``.
    """
    return [Mounted(c, np.roll(np.eye(3), -i, axis=0)) for i, c in enumerate(calibrations)]


READINGS = 1 << 15
"""Number of instruments times rows processed at once."""


def read_member(path: Path, item: Mounted, force: bool) -> Run:
    """The record of an instrument, without the columns that a set does not need."""
    record = read_run(path, need_reference=False)
    check_serial(record, item.calibration, force)
    check_phase_kept(record, item.calibration, item.phase, alone=False)
    return replace(record, f=np.zeros((0, 3)), segment_index=record.segment_index[:0])


def summary_of(
    result: Compensated | CompensatedSet,
    records: Sequence[Run],
    written: tuple[int, dict[str, int]],
    inputs: Inputs,
) -> dict[str, Any]:
    """What the command says of a compensation, for JSON: rows and flags ``written``, velocity, findings while reading."""
    repairs: dict[str, int] = {}
    for record in records:
        for event in record.quality.events:
            repairs[event.kind] = repairs.get(event.kind, 0) + event.count
    u = np.asarray(result.u_velocity)
    return {
        "rows": written[0],
        "velocity_m_s": result.dv.sum(axis=0).tolist(),
        "u_velocity_m_s": None if np.isnan(u).any() else u.tolist(),
        "flags": written[1],
        "repairs": repairs,
        "notes": result.notes,
        "inputs": inputs_listed(inputs),
    }
