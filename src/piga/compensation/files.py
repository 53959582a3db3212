"""Compensate a record, or the records of a set of three or more instruments on one base, from file to file in bounded memory.

A set is also compensated whole in memory (:func:`compensate_set`). The set file is TOML.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from piga.compensation.compensator import Chunk, check_phase_kept, check_serial, pieces_of, stream_of
from piga.compensation.model import FLAGS, Limits, Phase
from piga.compensation.result import (
    Compensated,
    CompensatedSet,
    Inputs,
    Resampler,
    TableWriter,
    inputs_listed,
    notes_on,
)
from piga.compensation.set_compensator import Mounted, SetCompensator
from piga.errors import ArgumentError, DataError, RunFileError
from piga.progress import Progress, report
from piga.reading.checks import integrated_rate
from piga.records import read_toml
from piga.records.calibration import Calibration
from piga.records.calibration.document import read_with_digest
from piga.records.run import Run
from piga.records.run_file import Quantity
from piga.records.text_files import toml_bytes, toml_document
from piga.results import Array
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
    check_together(records)
    if len(records) != len(instruments):
        raise ArgumentError(
            f"{len(records)} records for {len(instruments)} instruments",
            remedy="give one record for each instrument",
        )
    for record, item in zip(records, instruments, strict=True):
        check_member(record, item, force)
    stream = set_stream(
        records,
        instruments,
        uncertainty=uncertainty,
        limits=limits,
        max_age_days=max_age_days,
        details=details,
    )
    parts: list[CompensatedSet] = []
    size, solved = records[0].size, 0
    report(progress, 0, size, "compensating")
    for _, part in _solved(records, stream):
        parts.append(part)
        solved += part.size
        report(progress, solved, size, "compensating")
    return replace(joined_set(parts), notes=stream.notes + stream.remarks(), u_velocity=stream.u_velocity())


def joined_set(parts: Sequence[CompensatedSet]) -> CompensatedSet:
    """Compensated rows that follow one another, as one result."""
    if len(parts) == 1:
        return parts[0]
    lengths = {"misfit": 1, "each": 1}
    arrays = [field.name for field in fields(CompensatedSet) if field.name not in ("notes", "u_velocity")]
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts], axis=lengths.get(name, 0))
        for name in arrays
    }
    return CompensatedSet(**columns)


def set_stream(
    records: Sequence[Run], instruments: Sequence[Mounted], *, uncertainty: bool,
    limits: Limits | None = None, max_age_days: float | None = None, details: bool = False,
) -> SetCompensator:  # fmt: skip
    """The compensator of a set.

    The first segment of each record gives the phase of its instrument, unless another one is named.
    """
    sampled = records[0].kind == "rate"
    mounted = [
        replace(item, segment=item.segment or record.labels[0])
        for record, item in zip(records, instruments, strict=True)
    ]
    return SetCompensator(
        mounted, sampled=sampled, uncertainty=uncertainty, limits=limits, max_age_days=max_age_days,
        details=details,
    )  # fmt: skip


def check_member(record: Run, item: Mounted, force: bool) -> None:
    """Refuse a record for which the calibration of its instrument is not valid.

    Raises
    ------
    CalibrationError
        If the record is of another instrument (unless ``force``), or lost the zero of its angle. In a set one phase must
        be valid for the whole record.
    """
    check_serial(record, item.calibration, force)
    check_phase_kept(record, item.calibration, item.phase, alone=False)


def check_together(records: Sequence[Run]) -> None:
    """Refuse records that were not sampled at the same times.

    Raises
    ------
    DataError
        If the records differ in their times or in the kind of output.
    """
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

    Raises
    ------
    RunFileError
        If the file is not valid.
    CalibrationError
        If a calibration it names cannot be read.
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


@dataclass(frozen=True)
class SetReading:
    """Rows common to all files: ``t`` (n,), ``output`` (N, n), ``begins`` (n,), base rates and temperatures or None."""

    t: Array
    output: Array
    begins: NDArray[np.bool_]
    base_rate: list[Array] | None
    temperature: list[Array] | None


SetWatch = Callable[[str, SetReading, CompensatedSet], None]
"""Called with the label of the first instrument's segment, the rows read, and their compensated rows."""


def compensate_set_files(
    runs: Sequence[Path],
    instruments: Sequence[Mounted],
    out: Path,
    kind: str,
    *,
    uncertainty: bool = True,
    max_age_days: float | None = None,
    force: bool = False,
    period: float | None = None,
    progress: Progress | None = None,
    watch: SetWatch | None = None,
    inputs: Inputs = (),
) -> dict[str, Any]:
    """Compensate the run files of a set into ``out`` (``kind``: parquet or csv); returns a summary.

    The files are read one after another, with the checks of :func:`piga.read_run`. The columns of long files are kept on
    disk. The rows are solved piece by piece. With a ``period`` [s] the increments are resampled to that interval.
    ``progress`` is called as ``progress(done, total, what)`` with the rows done; it returns False to stop
    (:mod:`piga.progress`), and ``out`` is then not complete. ``watch`` is called with every piece before resampling.
    ``inputs`` are files read earlier; the files of the records are appended.

    Raises
    ------
    DataError
        If the files differ in their times or in the kind of output.
    CalibrationError, ArgumentError
        As :func:`piga.compensation.compensate_set`.
    """
    resampler = None if period is None else Resampler(period)
    records = [_read(run, item, force) for run, item in zip(runs, instruments, strict=True)]
    check_together(records)
    inputs = [*inputs, *(file for record in records for file in record.input_sha256.items())]
    stream = set_stream(
        records,
        instruments,
        uncertainty=uncertainty,
        max_age_days=max_age_days,
        details=watch is not None,
    )
    counts, velocity, rows, solved = dict.fromkeys(FLAGS, 0), np.zeros(3), 0, 0
    report(progress, 0, records[0].size, "compensating")
    with TableWriter(out, kind, stream.notes, inputs) as writer:
        for read, part in _solved(records, stream):
            solved += part.size
            report(progress, solved, records[0].size, "compensating")
            if watch is not None and part.size:
                watch(records[0].labels[0], read, part)
            for name in FLAGS:
                counts[name] += int(part.flagged(name).sum())
            velocity += part.dv.sum(axis=0)
            columns = part.columns() if resampler is None else resampler.push_set(part)
            rows += columns["t"].size
            writer.write(columns)
        writer.close(stream.remarks())
    return {
        "rows": rows,
        "velocity_m_s": velocity.tolist(),
        "u_velocity_m_s": stream.u_velocity().tolist(),
        "flags": {k: v for k, v in counts.items() if v},
        "repairs": found_while_reading(*records),
        "notes": stream.remarks(),
        "inputs": inputs_listed(inputs),
    }


def _read(path: Path, item: Mounted, force: bool) -> Run:
    """The record of an instrument without the columns that a set does not need."""
    record = read_run(path, need_reference=False)
    check_member(record, item, force)
    nothing = np.zeros((0, 3))
    return replace(record, f=nothing, segment_index=record.segment_index[:0])


def _solved(records: Sequence[Run], stream: SetCompensator) -> Iterator[tuple[SetReading, CompensatedSet]]:
    """Pieces of the records and their compensated rows; more records mean fewer rows at a time."""
    size, step, rates = records[0].size, max(READINGS // len(records), 1), records[0].kind == "rate"
    begins = _begins(records, slice(0, size))
    angles = [integrated_rate(r.t, r.output, begins) if rates else r.output for r in records]
    for start in range(0, size, step):
        part = slice(start, min(start + step, size))
        rows = _reading(records, part)
        solved = stream.push(
            rows.t,
            np.array([angle[part] for angle in angles]),
            rate=rows.output if rates else None,
            base_rate=rows.base_rate,
            temperature=rows.temperature,
            begins=rows.begins,
        )
        yield rows, solved


def _reading(records: Sequence[Run], part: slice) -> SetReading:
    """Rows of all records together."""
    base = any(record.base_rate is not None for record in records)
    warm = all(record.temperature is not None for record in records)
    still = np.zeros((part.stop - part.start, 3))
    return SetReading(
        np.ascontiguousarray(records[0].t[part]),
        np.array([record.output[part] for record in records]),
        _begins(records, part),
        [still if r.base_rate is None else np.ascontiguousarray(r.base_rate[part]) for r in records]
        if base else None,
        [np.ascontiguousarray(r.temperature[part]) for r in records if r.temperature is not None]
        if warm else None,
    )  # fmt: skip


def _begins(records: Sequence[Run], part: slice) -> NDArray[np.bool_]:
    """Rows at which a stretch begins in any record."""
    return np.logical_or.reduce([record.begins[part] for record in records])


HELD_ROWS = 1 << 18
"""Rows of all records together above which their columns are kept on disk, to bound the memory."""
Watch = Callable[[str, Chunk, Compensated], object]
"""Called with the label of a segment, its samples, and their compensated rows."""


@dataclass(eq=False)
class FileSummary:
    """Totals of a written file: rows, velocity and its standard uncertainty [m/s], rows per flag, and notes."""

    rows: int = 0
    velocity: float = 0.0
    u_velocity: float = math.nan
    flags: dict[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def add(self, part: Compensated) -> None:
        """Add a compensated part."""
        self.rows += part.size
        self.velocity += float(part.dv.sum())
        any_flags = int(np.bitwise_or.reduce(part.flags))
        for name, bit in FLAGS.items():
            if any_flags & bit:
                count = int(np.count_nonzero(part.flags & bit))
                self.flags[name] = self.flags.get(name, 0) + count


def found_while_reading(*records: Run) -> dict[str, int]:
    """Number of findings of each kind in the records, as ``piga check`` counts them."""
    counts: dict[str, int] = {}
    for record in records:
        for event in record.quality.events:
            counts[event.kind] = counts.get(event.kind, 0) + event.count
    return counts


def compensate_to_file(
    record: Run,
    calibration: Calibration,
    out: Path,
    kind: str,
    *,
    resampler: Resampler | None = None,
    progress: Progress | None = None,
    watch: Watch | None = None,
    inputs: Inputs = (),
    **options: Any,
) -> FileSummary:
    """Compensate a record piece by piece into the file ``out``.

    Parameters
    ----------
    record, calibration, **options:
        As for :func:`piga.compensate`.
    out, kind:
        The file, and its format: ``"parquet"`` or ``"csv"``.
    resampler:
        Resamples the rows to its rate.
    progress:
        Called as ``progress(done, total, what)`` with the rows of the record that are done; it returns False to stop
        (:mod:`piga.progress`). ``out`` is then not complete.
    watch:
        Called with every piece before resampling.
    inputs:
        Input files of the result, for the metadata of a Parquet file.

    Raises
    ------
    CalibrationError
        As :func:`piga.compensate`.
    """
    summary, rows = FileSummary(), 0
    report(progress, 0, record.size, "compensating")
    with TableWriter(out, kind, notes_on(calibration), inputs) as writer:
        stream = stream_of(record, calibration, **options)
        for _, label, chunk in pieces_of(record, stream):
            piece = stream.push(chunk)
            rows += piece.size
            report(progress, rows, record.size, "compensating")
            if watch is not None:
                watch(label, chunk, piece)
            part = resampler.push_rows(piece) if resampler else piece
            summary.add(part)
            if part.size:
                writer.write(part.columns())
        summary.notes, summary.u_velocity = stream.remarks(), stream.u_velocity()
        writer.close(summary.notes)
    return summary
