"""Pictures of a record: least and largest values per pixel, for any zoom.

A record is read once, by the reader of the calibration. Each of its columns is written to a cache folder, with the
extremes of each 256 samples. A short span is drawn from the samples, a long one from these blocks. A gap of the record is
a gap of the line: no block and no pixel holds samples of two stretches. Of a long record some samples are written as a
record of their own, for a first answer.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError
from piga.formats.columns import data_table
from piga.records.calibration.diagnostics import Event
from piga.records.run import Run
from piga.records.run_file import RunFile
from piga.results import Array
from piga.tables import arrow_table
from piga.text_files import toml_document, toml_text
from piga.units import G0, offset_to_si, parse_unit

BLOCK, DRAWN = 256, 1 << 18
"""Samples per block of the envelope; samples of a span that is drawn from the samples themselves."""
_MOST_WIDTH = 4096
"""Largest width of a picture [pixels]."""
MOVING = 0.01 * G0
"""Specific force [m/s^2] by which a sample of a moving stand differs from its position, at least."""
LONG, THINNED = 1_000_000, 50_000
"""Samples of a record of which a thinned copy is made, and about the samples of the copy."""
FORM = 11
"""Version of the cache's files."""


class Signal(msgspec.Struct, frozen=True):
    """One column of a record: key, title, shown unit, number of its figure."""

    key: str
    title: str
    unit: str
    figure: int


class Span(msgspec.Struct, frozen=True):
    """A named span of time [s]: a position, or rows that are left out; ``rows``: first and last row of the file."""

    name: str
    first: float
    last: float
    rows: tuple[int, int]


class Outline(msgspec.Struct, frozen=True):
    """What a page needs to know before it draws.

    ``moves`` are rows at the ends of positions in which the stand still moves. ``findings`` are those of the check, with the
    time [s] of their first row. ``phase_kept`` is False if the counter may have folded unseen between positions.
    """

    signals: tuple[Signal, ...]
    duration: float
    samples: int
    rows: int
    rate: float
    positions: tuple[Span, ...]
    left_out: tuple[Span, ...]
    moves: tuple[Span, ...]
    findings: tuple[tuple[Event, float | None], ...]
    phase_kept: bool

    @property
    def every(self) -> int:
        """Each how many samples the thinned copy has one; 1 if there is none."""
        return self.samples // THINNED if self.samples > LONG else 1


_OUTLINE = msgspec.json.Decoder(Outline)
"""Made once: msgspec may crash if two threads meet a type for the first time."""


def cache_key(paths: list[Path]) -> str:
    """Name of the cache of a record. It changes if any file of the record changes."""
    states = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in paths if path.is_file()]
    return hashlib.sha256(json.dumps([FORM, states]).encode()).hexdigest()[:24]


def read_outline(folder: Path) -> Outline | None:
    """The outline of a complete cache; None if there is none."""
    try:
        return _OUTLINE.decode((folder / "outline.json").read_bytes())
    except (OSError, msgspec.MsgspecError):
        return None


def write_envelopes(run: Run, run_file: RunFile, folder: Path) -> Outline:
    """Write the columns and envelopes of a record to a new folder, ``RECORD-KEY``.

    It appears when it is complete; others of the same record are removed.
    """
    breaks = np.flatnonzero(run.begins[1:]) + 1
    edges = [0, *breaks.tolist(), run.size]
    blocks = np.concatenate([np.arange(first, last, BLOCK) for first, last in pairwise(edges)])
    t, signals = _time(run), list[Signal]()
    part = Path(tempfile.mkdtemp(prefix="part-", dir=folder.parent))
    try:
        for number, (signal, values) in enumerate(_signals(run, run_file, t)):
            signals.append(signal)
            np.save(part / f"{number}.npy", values)
            np.save(part / f"{number}-blocks.npy", _extremes(values, values, blocks))
        for name, array in {"t": t, "breaks": breaks, "blocks": blocks, "row": run.row}.items():
            np.save(part / f"{name}.npy", array)
        outline = _outline(run, run_file, t, tuple(signals))
        if outline.every > 1:
            _write_thinned(run, outline.every, part)
        (part / "outline.json").write_bytes(msgspec.json.encode(outline))
        for place in folder.parent.glob(f"{folder.name.partition('-')[0]}-*"):
            shutil.rmtree(place, ignore_errors=True)
        part.rename(folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return outline


def _write_thinned(run: Run, every: int, folder: Path) -> None:
    """Write each so many samples of a record as Parquet with a run file: that of the record, with other data."""
    from pyarrow.parquet import write_table

    write_table(arrow_table(run.table_columns(slice(None, None, every))), folder / "thinned.parquet")
    tables = {name: table for name, table in toml_document(Path(run.source)).items() if name != "data"}
    text = toml_text(tables) + "\n" + data_table(run, "thinned.parquet") + "\n"
    (folder / "thinned.toml").write_text(text, encoding="utf-8")


def _extremes(least: Array, largest: Array, starts: NDArray[np.int64]) -> Array:
    """Least and largest value of a column from each start to the next."""
    return np.stack((np.fmin.reduceat(least, starts), np.fmax.reduceat(largest, starts)))


def _time(run: Run) -> Array:
    """Time since the first sample (n,) [s].

    Where the time of a record goes back (at the begin of a segment with a clock of its own), the segment is shown
    after the one before.
    """
    t, back = run.t - run.t[0], 1 + np.flatnonzero(run.t[1:] < run.t[:-1])
    if back.size:
        jumps = np.zeros(run.size)
        jumps[back] = run.t[back - 1] + run.median_step - run.t[back]
        t += np.cumsum(jumps)
    return t


def _difference(run: Run, t: Array) -> Array:
    """The output angle minus what the nominal scale factor makes of a_x; it begins at zero in each stretch."""
    force = run.scale_factor * 0.5 * (run.f[1:, 0] + run.f[:-1, 0])
    total = np.append(0.0, np.cumsum(np.diff(run.output) - force * np.diff(t)))
    begin = np.maximum.accumulate(np.where(run.begins, np.arange(run.size), 0))
    return total - total[begin]


def _signals(run: Run, run_file: RunFile, t: Array) -> Iterator[tuple[Signal, Array]]:
    degree = 180.0 / np.pi
    name, unit, factor = "output rate", "deg/s", degree
    if run.direct:
        name, unit, factor = "output", run.output_unit, 1.0
    elif run.kind == "angle":
        name, unit, factor = "output angle", "rev", 0.5 / np.pi
    yield Signal("output", name, unit, 0), factor * run.output
    if run.kind == "angle":
        unit, factor = ("count", 1.0) if run.direct else ("deg", degree)
        yield Signal("difference", f"{run.quantity} minus K ∫aₓdt", unit, 1), factor * _difference(run, t)
    vectors = [("f", "a_", "g", 1.0 / G0, 2, run.f)]
    if run.base_rate is not None:
        vectors.append(("rate", "Ω_", "deg/s", degree, 3, run.base_rate))
    for key, title, unit, factor, figure, values in vectors:
        for index, axis in enumerate("XYZ"):
            yield Signal(f"{key}{axis}", f"{title}{axis}", unit, figure), factor * values[:, index]
    if run.temperature is not None:
        unit = run_file.data.temperature.unit if run_file.data.temperature else "K"
        values = (run.temperature - offset_to_si(unit)) / parse_unit(unit).factor
        yield Signal("temperature", "temperature", unit.replace("deg", "°"), 4), values


def _outline(run: Run, run_file: RunFile, t: Array, signals: tuple[Signal, ...]) -> Outline:
    def at(row: int) -> float:
        return float(t[min(int(np.searchsorted(run.row, row)), run.size - 1)])

    def span(name: str, first: int, last: int) -> Span:
        return Span(name, float(t[first]), float(t[last - 1]), (int(run.row[first]), int(run.row[last - 1])))

    edges = run.segment_edges().tolist()
    pieces = [(run.labels[int(run.segment_index[first])], first, last) for first, last in pairwise(edges)]
    left_out = run_file.data.leave_out
    findings = [one for one in run.quality.events if one.kind != "left-out"]  # those are drawn as spans
    return Outline(
        signals=signals,
        duration=float(t[-1]),
        samples=run.size,
        rows=run.quality.rows,
        rate=1.0 / run.median_step if run.median_step else 0.0,
        positions=tuple(span(*piece) for piece in pieces),
        left_out=tuple(Span(one.reason, at(one.rows[0]), at(one.rows[1] + 1), one.rows) for one in left_out),
        moves=tuple(span(piece[0], *ends) for piece in pieces for ends in _moves(run, *piece[1:])),
        findings=tuple((one, None if one.first_row is None else at(one.first_row)) for one in findings),
        phase_kept=len(set(run.phase_group)) == 1 or run_file.model.phases == "per-segment",
    )


def _moves(run: Run, first: int, last: int) -> Iterator[tuple[int, int]]:
    """Samples at the ends of a position in which the stand still moves.

    There the specific force differs from its median of the position. A position that turns all the time has no such rows.
    """
    force = np.asarray(run.f[first:last])
    far = np.abs(force - np.median(force, axis=0)).max(axis=1) > MOVING
    if far.any() and far.mean() <= 0.5:
        still = first + np.flatnonzero(~far)
        ends = ((first, int(still[0])), (int(still[-1]) + 1, last))
        yield from (one for one in ends if one[0] < one[1])


def picture(folder: Path, keys: Sequence[str], first: float, last: float, width: int) -> Array:
    """Least and largest values of signals in a span of time [s], about two rows per pixel of ``width``.

    ``folder`` is the cache of the record. The rows are time, then least and largest value of each signal in its shown unit. A
    row of NaN separates stretches.
    """
    outline = read_outline(folder)
    names = [] if outline is None else [one.key for one in outline.signals]
    if not set(keys) <= set(names):
        raise ArgumentError(f"{keys!r}: there is no such signal", remedy="choose a signal of the page")
    if not (np.isfinite(first) and np.isfinite(last) and first < last and 0 < width <= _MOST_WIDTH):
        raise ArgumentError("the span of the picture is not valid", remedy="reload the page")

    def stored(name: str) -> Array:
        array: Array = np.load(folder / f"{name}.npy", mmap_mode="r")
        return array

    t, breaks, blocks = (stored(name) for name in ("t", "breaks", "blocks"))
    low = max(int(np.searchsorted(t, first)) - 1, 0)
    high = min(int(np.searchsorted(t, last, side="right")) + 1, t.size)
    is_short = high - low <= DRAWN
    part = slice(int(np.searchsorted(blocks, low, side="right")) - 1, int(np.searchsorted(blocks, high)))
    at = np.arange(low, high) if is_short else np.asarray(blocks[part])
    gaps = breaks[(breaks > at[0]) & (breaks < high)]
    after = np.searchsorted(at, gaps[:: gaps.size // (4 * width) + 1])  # more of them would not be seen
    starts = np.union1d(np.arange(0, at.size, max(at.size // (2 * width), 1)), after)
    columns = [t[at[starts]]]
    for number in map(names.index, keys):
        name = f"{number}" if is_short else f"{number}-blocks"
        least, largest = [stored(name)[low:high]] * 2 if is_short else stored(name)[:, part]
        columns += list(_extremes(least, largest, starts))
    rows, gap = np.column_stack(columns), np.searchsorted(starts, after)
    between = np.full((gap.size, rows.shape[1]), np.nan)
    between[:, 0] = 0.5 * (rows[gap - 1, 0] + rows[gap, 0])
    return np.insert(rows, gap, between, axis=0)


def rows_between(folder: Path, first: float, last: float) -> tuple[int, int]:
    """First and last row of the data file whose samples lie in a span of time [s]."""
    t = np.load(folder / "t.npy", mmap_mode="r")
    low, high = int(np.searchsorted(t, first)), int(np.searchsorted(t, last, side="right"))
    if not low < high:
        raise ArgumentError("no sample lies in this span", remedy="mark a wider span")
    rows = np.load(folder / "row.npy", mmap_mode="r")[low:high]
    return int(rows.min()), int(rows.max())
