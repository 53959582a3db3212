"""Several run files of instruments that are solved together, from file to file in bounded memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.compensation.compensate import check_serial_names
from piga.compensation.file_length import holds_more
from piga.compensation.file_to_file import GIVEN_BACK_AFTER, GIVEN_BACK_SOONER, HELD_BYTES
from piga.compensation.flags import FLAGS
from piga.compensation.large_file import LargeFile
from piga.compensation.mounting import Mounted
from piga.compensation.published_set import PublishedSet
from piga.compensation.rate_angle import RateAngle
from piga.compensation.resample import Resampler
from piga.compensation.result import CompensatedSet
from piga.compensation.set_compensator import SetCompensator
from piga.compensation.triad import compensate_triad, set_stream
from piga.compensation.writers import TableWriter
from piga.errors import DataError
from piga.records.run_file import read_run_file
from piga.records.spool import Arrays, give_back, trim

Array = NDArray[np.float64]

APART = 1e-6
"""Part of the interval by which times of one row may differ between the files."""
READINGS = 1 << 15
"""Rows worked on at a time, times the instruments."""
ROW = ("t", "output", "begins", "base_rate", "temperature")
"""What is kept of a file."""


@dataclass(frozen=True)
class Rows:
    """Rows that all files have: ``t`` (n,), ``output`` (N, n), ``begins`` (n,), base rates and temperatures or None."""

    t: Array
    output: Array
    begins: NDArray[np.bool_]
    base_rate: list[Array] | None
    temperature: list[Array] | None


Watch = Callable[[str, Rows, CompensatedSet], None]
"""Sees the label of the first instrument's segment, what was read, and what became of it."""


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
    method: str = "exact",
    large: int = 0,
    advance: Callable[[int], None] = lambda _rows: None,
    watch: Watch | None = None,
) -> dict[str, Any]:
    """Compensate the run files of a set into ``out`` (``kind``: parquet or csv); a summary comes back.

    When the data files together have no more than ``large`` rows they are read whole, with all repairs; longer ones
    are brought to disk beside ``out``, one after another, and solved chunk by chunk. With a ``period`` [s] the
    increments are brought to that interval. ``watch`` is shown every piece before that.

    Raises
    ------
    DataError
        If the files have not the same times, or hold different kinds of output.
    CalibrationError, ArgumentError
        As :func:`piga.compensation.compensate_triad`.
    """
    resampler = None if period is None else Resampler(period)
    if any(holds_more(run.parent, read_run_file(run).data, large // len(runs)) for run in runs):
        details = watch is not None
        parts = _streamed(
            runs, instruments, uncertainty, max_age_days, force, method, details, out.parent, advance
        )
    else:
        parts = _whole(runs, instruments, uncertainty, max_age_days, force, method, watch is not None)
    counts, velocity, rows = dict.fromkeys(FLAGS, 0), np.zeros(3), 0
    with TableWriter(out, kind) as writer:
        for number, (label, read, part) in enumerate(parts, 1):
            advance(part.size)
            if number % (GIVEN_BACK_AFTER if watch is None else GIVEN_BACK_SOONER) == 0:
                give_back(HELD_BYTES)
            if watch is not None and part.size:
                watch(label, read, part)
            for name in FLAGS:
                counts[name] += int(part.flagged(name).sum())
            velocity += part.dv.sum(axis=0)
            columns = part.columns() if resampler is None else resampler.push_set(part)
            rows += columns["t"].size
            writer.write(columns)
    if rows == 0:
        raise DataError(f"{runs[0]}: no usable row", remedy="check the columns in [data]")
    return {"rows": rows, "velocity_m_s": velocity.tolist(), "flags": {k: v for k, v in counts.items() if v}}


def _whole(
    runs: Sequence[Path],
    instruments: Sequence[Mounted],
    uncertainty: bool,
    max_age: float | None,
    force: bool,
    method: str,
    details: bool,
) -> Iterator[tuple[str, Rows, CompensatedSet]]:
    from piga.stand import read_run

    records = [read_run(run, need_reference=False) for run in runs]
    found = compensate_triad(
        records, instruments, uncertainty=uncertainty, max_age_days=max_age, force=force, method=method,
        details=details,
    )  # fmt: skip
    first, outputs = records[0], np.array([record.output for record in records])
    base = [np.zeros((first.size, 3)) if r.base_rate is None else r.base_rate for r in records]
    begins = np.logical_or.reduce([record.begins for record in records])
    yield first.labels[0], Rows(first.t, outputs, begins, base, None), found


def _streamed(
    runs: Sequence[Path],
    instruments: Sequence[Mounted],
    uncertainty: bool,
    max_age: float | None,
    force: bool,
    method: str,
    details: bool,
    folder: Path,
    advance: Callable[[int], None],
) -> Iterator[tuple[str, Rows, CompensatedSet]]:
    files = [LargeFile(run, read_run_file(run)) for run in runs]
    for file, item in zip(files, instruments, strict=True):
        check_serial_names(file.run_file.instrument.serial, item.calibration.serial, force)
        if file.kind != files[0].kind:
            raise DataError(
                f"{file.path}: holds {file.kind}, {files[0].path}: {files[0].kind}", remedy="log one kind"
            )
    sampled = files[0].kind == "rate"
    followers = [RateAngle() for _ in files]
    stream: SetCompensator | PublishedSet | None = None
    waiting: Rows | None = None
    labels: list[str] = []
    for labels, rows in _aligned(files, folder, advance):
        if stream is None:
            mounted = [
                replace(item, segment=item.segment or label)
                for item, label in zip(instruments, labels, strict=True)
            ]
            stream = set_stream(
                mounted, method, sampled=sampled, uncertainty=uncertainty, max_age_days=max_age, details=details
            )  # fmt: skip
        if not sampled:
            part = stream.push(
                rows.t, rows.output, base_rate=rows.base_rate, temperature=rows.temperature, begins=rows.begins
            )
            yield labels[0], rows, part
            continue
        psi = [f.push(rows.t, rate, rows.begins) for f, rate in zip(followers, rows.output, strict=True)]
        known = rows if waiting is None else _joined(waiting, rows)
        ready, waiting = _split(known, known.t.size - 1)
        yield labels[0], ready, _push_sampled(stream, ready, psi)
    if stream is not None and waiting is not None:
        yield labels[0], waiting, _push_sampled(stream, waiting, [f.finish() for f in followers])


def _push_sampled(stream: SetCompensator | PublishedSet, rows: Rows, psi: list[Array]) -> CompensatedSet:
    return stream.push(
        rows.t, np.array(psi), rate=rows.output, base_rate=rows.base_rate, temperature=rows.temperature,
        begins=rows.begins,
    )  # fmt: skip


def _aligned(
    files: Sequence[LargeFile], folder: Path, advance: Callable[[int], None]
) -> Iterator[tuple[list[str], Rows]]:
    """Rows of all files together, and the labels of their first segments; the shorter, the more files there are."""
    labels, columns = zip(*(_read(file, folder, advance) for file in files), strict=True)
    give_back()
    sizes = [some.size for some in columns]
    count, step, tolerance = min(sizes), max(READINGS // len(files), 1), 0.0
    for start in range(0, count, step):
        parts = [_rows(some[start : min(start + step, count)]) for some in columns]
        tolerance = tolerance or APART * _interval(parts[0].t)
        yield list(labels), _together(files, parts, tolerance)
    if max(sizes) > count:
        raise DataError(
            f"{files[sizes.index(count)].path}: ends before the other files",
            remedy="sample all instruments together",
        )


def _read(file: LargeFile, folder: Path, advance: Callable[[int], None]) -> tuple[str, NDArray[Any]]:
    """Label of the first segment and all rows of a file, on disk: every open file would hold a part in memory."""
    label, found = "", Arrays(folder).growing()
    for piece in file.pieces():
        columns = {name: getattr(piece.chunk, name) for name in ROW if getattr(piece.chunk, name).shape[0]}
        rows = np.empty(
            piece.chunk.t.size, [(name, values.dtype, values.shape[1:]) for name, values in columns.items()]
        )
        for name, values in columns.items():
            rows[name] = values
        if not label:
            label, found = piece.label, Arrays(folder).growing(rows.dtype)
        found.append(rows)
        advance(0)
    return label, found.finish()


def _rows(some: NDArray[Any]) -> Rows:
    """Rows of one file in memory."""
    held = {name: np.ascontiguousarray(some[name]) for name in some.dtype.names or ()}
    trim()
    base, warm = held.get("base_rate"), held.get("temperature")
    return Rows(
        held["t"], held["output"][None, :], held["begins"], None if base is None else [base],
        None if warm is None else [warm],
    )  # fmt: skip


def _interval(t: Array) -> float:
    return float(t[1] - t[0]) if t.size > 1 else 1.0


def _together(files: Sequence[LargeFile], parts: list[Rows], tolerance: float) -> Rows:
    first = parts[0]
    for file, part in zip(files, parts, strict=True):
        apart = np.abs(part.t - first.t) > tolerance
        if apart.any():
            time = part.t[int(np.argmax(apart))]
            raise DataError(
                f"{file.path}: at t = {time:.9g} s: the times are not those of {files[0].path}",
                remedy="sample all instruments together, or bring them to common times first",
            )
    size = first.t.size
    base = [part.base_rate[0] if part.base_rate else np.zeros((size, 3)) for part in parts]
    warm = [part.temperature[0] for part in parts if part.temperature]
    return Rows(
        first.t,
        np.concatenate([part.output for part in parts]),
        np.logical_or.reduce([part.begins for part in parts]),
        base if any(part.base_rate for part in parts) else None,
        warm if len(warm) == len(parts) else None,
    )


def _split(rows: Rows, count: int) -> tuple[Rows, Rows | None]:
    """The first ``count`` rows, and what is left (None: nothing)."""
    head, tail = (
        Rows(
            rows.t[cut], np.ascontiguousarray(rows.output[:, cut]), rows.begins[cut],
            None if rows.base_rate is None else [values[cut] for values in rows.base_rate],
            None if rows.temperature is None else [values[cut] for values in rows.temperature],
        )
        for cut in (slice(0, count), slice(count, None))
    )  # fmt: skip
    return head, tail if tail.t.size else None


def _joined(a: Rows, b: Rows) -> Rows:
    def both(x: list[Array] | None, y: list[Array] | None) -> list[Array] | None:
        return None if x is None or y is None else [np.concatenate(pair) for pair in zip(x, y, strict=True)]

    return Rows(
        np.concatenate((a.t, b.t)), np.concatenate((a.output, b.output), axis=1),
        np.concatenate((a.begins, b.begins)), both(a.base_rate, b.base_rate), both(a.temperature, b.temperature),
    )  # fmt: skip
