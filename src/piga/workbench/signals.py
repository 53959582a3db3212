"""Pictures of a record: least and largest values per pixel, for any zoom.

A record is read once, by the reader of the calibration. Each of its columns is written to a cache folder, with the
extremes of each 256 samples. A short span is drawn from the samples, a long one from these blocks. No block crosses the
begin of a stretch, so a gap is drawn as a gap. Of a long record a thinned copy is written, too, for a first answer.
"""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError
from piga.records.run import Run
from piga.records.run_file import RunFile
from piga.records.text_files import toml_text
from piga.results import Array
from piga.units import G0, offset_to_si, parse_unit

BLOCK = 256
"""Samples per block of the envelope."""
DRAWN = 1 << 18
"""Samples of a span that is drawn from the samples themselves."""
_MOST_STRETCHES = 20_000
"""Longest breaks that are drawn as gaps. More of them would not be seen."""
_MOST_WIDTH = 4096
"""Largest width of a picture [pixels]."""
LONG, THINNED = 1_000_000, 50_000
"""Samples of a record of which a thinned copy is made, and about the samples of the copy."""
MOVING = 0.01 * G0
"""Specific force [m/s^2] by which a sample of a moving stand differs from its position, at least."""
CHUNK = 1 << 20
FORM = 5
"""Version of the cache's files."""


@dataclass(frozen=True)
class Signal:
    """One column of a record: key, title, shown unit, factor from SI to it, picture it belongs to, offset of the unit."""

    key: str
    title: str
    unit: str
    factor: float
    group: str
    offset: float = 0.0


@dataclass(frozen=True)
class Finding:
    """A finding of the check, and the time [s] of its first row; None if it has no row."""

    kind: str
    count: int
    detail: str
    time: float | None


@dataclass(frozen=True)
class Span:
    """A named span of time [s]: a position, or rows that are left out; ``rows``: first and last row of the file."""

    name: str
    first: float
    last: float
    rows: tuple[int, int]


@dataclass(frozen=True)
class Outline:
    """What a page needs to know before it draws.

    ``moves`` are rows at the ends of positions in which the stand still moves. ``phase_kept`` is False if the counter may
    have folded unseen between positions. ``thinned``: every so many samples are in the thinned copy; 1 if there is none.
    """

    signals: tuple[Signal, ...]
    duration: float
    samples: int
    rows: int
    rate: float
    positions: tuple[Span, ...]
    left_out: tuple[Span, ...]
    moves: tuple[Span, ...]
    findings: tuple[Finding, ...]
    phase_kept: bool
    thinned: int = 1


def cache_key(paths: list[Path]) -> str:
    """Name of the cache of a record. It changes if any file of the record changes."""
    states = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in paths if path.is_file()]
    return hashlib.sha256(json.dumps([FORM, states]).encode()).hexdigest()[:24]


def write_envelopes(run: Run, run_file: RunFile, folder: Path, began: float = math.inf) -> Outline:
    """Write the columns and envelopes of a record.

    Parameters
    ----------
    run, run_file:
        The record as read, and its run file.
    folder:
        New folder, ``RECORD-KEY``. It appears when it is complete; older ones of the same record are removed.
    began:
        When the reading began [s since 1970]. What another reading completed since is of a newer record, and stays.
    """
    part = Path(tempfile.mkdtemp(prefix="part-", dir=folder.parent))
    try:
        outline = _write_all(run, run_file, part)
        if read_outline(folder) is None:  # else another reading has completed it, and pages use it
            shutil.rmtree(folder, ignore_errors=True)
            part.rename(folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    for place in folder.parent.glob(f"{folder.name.partition('-')[0]}-*"):
        if place != folder and _completed(place) < began:
            shutil.rmtree(place, ignore_errors=True)
    return outline


def _completed(folder: Path) -> float:
    """When a cache was completed [s since 1970]; long ago if it is not complete."""
    try:
        return (folder / "outline.json").stat().st_mtime
    except OSError:
        return -math.inf


def _write_all(run: Run, run_file: RunFile, folder: Path) -> Outline:
    begins = _breaks(run)
    t = _shown_time(run, folder / "t.npy")
    np.save(folder / "breaks.npy", begins[1:])
    rows = np.lib.format.open_memmap(folder / "row.npy", mode="w+", dtype=np.int64, shape=(run.size,))
    for part in _chunks(run.size):
        rows[part] = run.row[part]
    blocks = _blocks(run.size, begins)
    np.save(folder / "blocks.npy", blocks)
    temperature = run_file.data.temperature
    columns = _columns(run, "K" if temperature is None else temperature.unit)
    for signal, values in columns:
        _write_column(folder, signal.key, values, blocks)
    signals = [signal for signal, _ in columns]
    if run.kind == "angle":
        _write_difference(run, t, folder, blocks)
        shown = ("count", 1.0) if run.direct else ("deg", 180.0 / np.pi)
        words = f"{run.quantity} minus K ∫aₓdt"
        signals.insert(1, Signal("difference", words, *shown, "difference"))
    thinned = _write_thinned(run, run_file, folder) if run.size > LONG else 1
    outline = _outline(run, run_file, t, rows, tuple(signals), thinned)
    (folder / "outline.json").write_text(json.dumps(asdict(outline)), encoding="utf-8")
    return outline


def _chunks(size: int) -> Iterator[slice]:
    for first in range(0, size, CHUNK):
        yield slice(first, min(first + CHUNK, size))


def _write_difference(run: Run, t: Array, folder: Path, blocks: NDArray[np.int64]) -> None:
    """The output angle minus what the nominal scale factor makes of a_x; it begins at zero in each stretch."""
    whole = np.lib.format.open_memmap(folder / "difference.npy", mode="w+", dtype=np.float64, shape=(run.size,))
    carried = 0.0
    for part in _chunks(run.size):
        with_last = slice(max(part.start - 1, 0), part.stop)
        time, angle, force = (np.asarray(column[with_last]) for column in (t, run.output, run.f[:, 0]))
        step = np.diff(angle) - run.scale_factor * 0.5 * (force[1:] + force[:-1]) * np.diff(time)
        step = step if part.start else np.concatenate(([0.0], step))
        begins = np.asarray(run.begins[part])
        step[begins] = 0.0
        total = carried + np.cumsum(step)
        first = np.flatnonzero(begins)
        if first.size:
            total[first[0] :] -= np.repeat(total[first], np.diff(np.append(first, total.size)))
        whole[part] = total
        carried = float(total[-1])
    _write_envelope(folder, "difference", whole, blocks)


def _write_thinned(run: Run, run_file: RunFile, folder: Path) -> int:
    """A thinned copy of a long record, in SI, with a run file of its own: for a first answer."""
    import pyarrow as pa
    import pyarrow.parquet

    every = max(run.size // THINNED, 1)
    part = slice(None, None, every)
    columns: dict[str, Any] = {"t": run.t[part], "output": run.output[part]}
    columns |= {f"f{axis}": run.f[part, index] for index, axis in enumerate("xyz")}
    columns["segment"] = pa.array([run.labels[index] for index in run.segment_index[part]])
    data: dict[str, Any] = {
        "file": "thinned.parquet", "segment": "segment", "time": {"column": "t", "unit": "s"},
        "output": {"column": "output", "kind": run.kind, "unit": run.output_unit},
        "reference": {"columns": ["fx", "fy", "fz"], "unit": "m/s^2"},
    }  # fmt: skip
    if run.base_rate is not None:
        columns |= {f"w{axis}": run.base_rate[part, index] for index, axis in enumerate("xyz")}
        data["base_rate"] = {"columns": ["wx", "wy", "wz"], "unit": "rad/s"}
    if run.temperature is not None:
        columns["temperature"] = run.temperature[part]
        data["temperature"] = {"column": "temperature", "unit": "K"}
    pyarrow.parquet.write_table(pa.table(columns), folder / "thinned.parquet")
    instrument = {"serial": run.serial, "scale_factor": f"{run.scale_factor * G0!r} {run.unit}/g"}
    if run.direct:
        instrument["kind"] = "direct"
    if run.quantity == "count":
        data["output"] = {"column": "output", "kind": "counts"}
    model = {"terms": list(run_file.model.terms), "phases": run_file.model.phases}
    document = {"instrument": instrument, "data": data, "model": model}
    (folder / "thinned.toml").write_text(toml_text(document), encoding="utf-8")
    return every


def read_outline(folder: Path) -> Outline | None:
    """The outline of a complete cache; None if there is none."""
    try:
        return msgspec.convert(json.loads((folder / "outline.json").read_text(encoding="utf-8")), Outline)
    except (OSError, ValueError):
        return None


def picture(folder: Path, key: str, first: float, last: float, width: int) -> Array:
    """Least and largest values of a signal in a span of time.

    Parameters
    ----------
    folder:
        The cache of the record.
    key:
        The signal's key.
    first, last:
        The span [s].
    width:
        Width of the picture [pixels]. About one block per pixel is returned.

    Returns
    -------
    Array
        Rows of time, least and largest value in SI, shape (n, 3). A row of NaN separates stretches.
    """
    outline = read_outline(folder)
    if outline is None or key not in {signal.key for signal in outline.signals}:
        raise ArgumentError(f"{key!r}: there is no such signal", remedy="choose a signal of the page")
    if not (np.isfinite(first) and np.isfinite(last) and first < last and 0 < width <= _MOST_WIDTH):
        raise ArgumentError("the span of the picture is not valid", remedy="reload the page")
    t = np.load(folder / "t.npy", mmap_mode="r")
    low = max(int(np.searchsorted(t, first)) - 1, 0)
    high = min(int(np.searchsorted(t, last, side="right")) + 1, t.size)
    if high - low <= DRAWN:
        at = np.arange(low, high)
        least = largest = np.load(folder / f"{key}.npy", mmap_mode="r")[low:high]
    else:
        blocks = np.load(folder / "blocks.npy", mmap_mode="r")
        part = slice(int(np.searchsorted(blocks, low, side="right")) - 1, int(np.searchsorted(blocks, high)))
        at = np.asarray(blocks[part])
        least, largest = np.load(folder / f"{key}-extremes.npy", mmap_mode="r")[:, part]
    breaks = np.load(folder / "breaks.npy", mmap_mode="r")
    new = np.searchsorted(
        at, breaks[np.searchsorted(breaks, at[0], side="right") : np.searchsorted(breaks, high)]
    )
    starts = np.union1d(np.arange(0, at.size, max(at.size // (2 * width), 1)), new).astype(np.int64)
    rows = np.column_stack((t[at[starts]], np.fmin.reduceat(least, starts), np.fmax.reduceat(largest, starts)))
    return _with_gaps(rows, np.searchsorted(starts, new))


def rows_between(folder: Path, first: float, last: float) -> tuple[int, int]:
    """First and last row of the data file whose samples lie in a span of time [s]."""
    t = np.load(folder / "t.npy", mmap_mode="r")
    low, high = int(np.searchsorted(t, first)), int(np.searchsorted(t, last, side="right"))
    if not low < high:
        raise ArgumentError("no sample lies in this span", remedy="mark a wider span")
    rows = np.load(folder / "row.npy", mmap_mode="r")[low:high]
    return int(rows.min()), int(rows.max())


def _with_gaps(rows: Array, at: NDArray[np.int64]) -> Array:
    """The rows with a row of NaN before each index ``at``; its time is in the middle."""
    gaps = np.full((at.size, 3), np.nan)
    gaps[:, 0] = 0.5 * (rows[at - 1, 0] + rows[at, 0])
    return np.insert(rows, at, gaps, axis=0)


def _breaks(run: Run) -> NDArray[np.int64]:
    """First samples of the stretches that follow the longest breaks, and sample 0."""
    rows = np.flatnonzero(run.begins)
    rows = rows[rows > 0]
    if rows.size > _MOST_STRETCHES:
        size = np.abs(run.t[rows] - run.t[rows - 1])
        rows = np.sort(rows[np.argsort(size)[-_MOST_STRETCHES:]])
    return np.concatenate(([0], rows)).astype(np.int64)


def _shown_time(run: Run, path: Path) -> Array:
    """Write the time axis of the page: seconds since the first sample.

    Where the time of a record goes back (at the begin of a segment with a clock of its own), the segment is shown
    after the one before.
    """
    t = np.lib.format.open_memmap(path, mode="w+", dtype=np.float64, shape=(run.size,))
    shift, last = -float(run.t[0]), 0.0
    for part in _chunks(run.size):
        values = np.asarray(run.t[part])
        cuts = np.flatnonzero(np.diff(values, prepend=values[:1]) < 0.0)
        if part.start and values[0] + shift < last:
            cuts = np.concatenate(([0], cuts[cuts > 0]))
        begin = 0
        for cut in [*cuts.tolist(), values.size]:
            t[part.start + begin : part.start + cut] = values[begin:cut] + shift
            if cut > begin:
                last = float(values[cut - 1] + shift)
            if cut < values.size:
                shift = last + run.median_step - float(values[cut])
            begin = cut
    return t


def _blocks(size: int, breaks: NDArray[np.int64]) -> NDArray[np.int64]:
    """First samples of the blocks of the envelope."""
    ends = np.append(breaks[1:], size)
    return np.concatenate([np.arange(*span, BLOCK) for span in zip(breaks, ends, strict=True)])


def _columns(run: Run, temperature_unit: str) -> list[tuple[Signal, Any]]:
    turn = 2.0 * np.pi
    output = (
        Signal("output", "output angle", "rev", 1.0 / turn, "output")
        if run.kind == "angle"
        else Signal("output", "output rate", "deg/s", 360.0 / turn, "output")
    )
    if run.direct:
        output = Signal("output", "output", run.output_unit, 1.0, "output")
    columns: list[tuple[Signal, Any]] = [(output, run.output)]
    for index, axis in enumerate("XYZ"):
        columns.append((Signal(f"f{axis}", f"a_{axis}", "g", 1.0 / G0, "specific force"), run.f[:, index]))
    if run.base_rate is not None:
        for index, axis in enumerate("XYZ"):
            signal = Signal(f"rate{axis}", f"Ω_{axis}", "deg/s", 360.0 / turn, "base rate")
            columns.append((signal, run.base_rate[:, index]))
    if run.temperature is not None:
        factor = 1.0 / parse_unit(temperature_unit).factor
        offset = -offset_to_si(temperature_unit) * factor
        unit = temperature_unit.replace("deg", "°")
        signal = Signal("temperature", "temperature", unit, factor, "temperature", offset)
        columns.append((signal, run.temperature))
    return columns


def _write_column(folder: Path, key: str, values: Any, blocks: NDArray[np.int64]) -> None:
    """Write a column and its envelope."""
    whole = np.lib.format.open_memmap(folder / f"{key}.npy", mode="w+", dtype=np.float64, shape=(len(values),))
    for part in _chunks(len(values)):
        whole[part] = values[part]
    _write_envelope(folder, key, whole, blocks)


def _write_envelope(folder: Path, key: str, whole: Array, blocks: NDArray[np.int64]) -> None:
    """Write the least and largest value of each block."""
    np.save(
        folder / f"{key}-extremes.npy",
        np.stack((np.fmin.reduceat(whole, blocks), np.fmax.reduceat(whole, blocks))),
    )


def _outline(
    run: Run, run_file: RunFile, t: Array, rows: NDArray[np.int64], signals: tuple[Signal, ...], thinned: int
) -> Outline:
    def at(row: int) -> float:
        return float(t[min(int(np.searchsorted(rows, row)), run.size - 1)])

    edges = run.segment_edges()
    positions = tuple(
        Span(
            run.labels[int(run.segment_index[first])], float(t[first]), float(t[last - 1]),
            (int(rows[first]), int(rows[last - 1])),
        )
        for first, last in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
    )  # fmt: skip
    left_out = tuple(
        Span(entry.reason, at(entry.rows[0]), at(entry.rows[1] + 1), entry.rows)
        for entry in run_file.data.leave_out
    )
    findings = tuple(
        Finding(event.kind, event.count, event.detail, None if event.first_row is None else at(event.first_row))
        for event in run.quality.events
        if event.kind != "left-out"  # those are drawn as spans
    )
    kept = len(set(run.phase_group)) == 1 or run_file.model.phases == "per-segment"
    rate = 1.0 / run.median_step if run.median_step else 0.0
    return Outline(
        signals, float(t[-1]), run.size, run.quality.rows, rate, positions, left_out,
        tuple(_moves(run, t, rows, edges)), findings, kept, thinned,
    )  # fmt: skip


def _moves(run: Run, t: Array, rows: NDArray[np.int64], edges: NDArray[np.int64]) -> Iterator[Span]:
    """Rows at the ends of each position in which the stand still moves.

    There the specific force differs from its median of the position. A position that turns all the time has no such rows.
    """
    for first, last in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        force = np.asarray(run.f[first:last])
        far = np.abs(force - np.median(force, axis=0)).max(axis=1) > MOVING
        if not far.any() or far.mean() > 0.5:
            continue
        still = np.flatnonzero(~far)
        for begin, end in ((first, first + still[0]), (first + still[-1] + 1, last)):
            if end > begin:
                name = run.labels[int(run.segment_index[first])]
                yield Span(name, float(t[begin]), float(t[end - 1]), (int(rows[begin]), int(rows[end - 1])))
