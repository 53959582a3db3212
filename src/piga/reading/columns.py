"""The columns of a data file of any format as read, in the units of the file. All chunks are joined.

The column of a stand tells the positions where nothing numbers them (:func:`positions`).

Text and Parquet are read piece by piece. Containers (HDF5, MATLAB, TDMS, XLSX) cannot unpack to
more than 2 GiB and are read whole. Results, events and errors do not depend on the size of the pieces.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.errors import DataError, Fix, Where
from piga.formats.columns import FileChunk, RecordStream, refusal
from piga.formats.container import TEXT_SUFFIXES, columns_stream, file_kind
from piga.formats.text.convention import TextOptions
from piga.formats.text.reader import is_number
from piga.records.arrays import ColumnWriter, largest_size, scaled, stored
from piga.records.calibration.diagnostics import Event, counted
from piga.records.run import segments_of_visits
from piga.records.run_file import DataTable
from piga.results import Array
from piga.text_files import LARGEST_SAMPLE, MAX_SEGMENTS, open_regular
from piga.units import conversion_factor, parse_unit, to_si


def _open_stream(folder: Path, data: DataTable) -> RecordStream:
    """Open the data file of a run file. ``folder`` is that of the run file; ``data`` is its ``[data]`` table."""
    path, columns = folder / data.file, (tuple(data.number_columns()), data.label_column)
    kind, stamp = file_kind(path), data.time.stamp if data.time else None
    if data.sheet is not None and kind != ".xlsx":
        raise refusal(path, "[data] sheet is for .xlsx files", "leave it out")
    options = TextOptions(
        data.skip_rows,
        data.header_row,
        data.units_row,
        data.delimiter,
        data.decimal,
        data.encoding,
        (data.time.column, stamp) if data.time and stamp else None,
        data.missing,
        data.damaged_rows == "mask",
        data.sheet,
    )
    rows = options.skip, options.header, options.units, options.stamp
    if kind not in TEXT_SUFFIXES and rows != (0, None, None, None):
        words = "[data] skip_rows, header_row, units_row and a stamp of the time are for text files"
        remedy = "leave them out; dates and time stamps of Parquet are read as seconds: unit = 's'"
        raise refusal(path, words, remedy)
    return columns_stream(path, *columns, options)


@dataclass
class RawColumns:
    """The columns of a file, and what was noticed while reading.

    ``numbers`` holds values (n,) in the units of the file by column; ``units`` those that the file states. ``segment`` (n,) is
    the index into ``labels``, -1 without one. ``rows`` (n,) are 1-based file rows; ``usable`` (n,) is False for a row that is
    not used. ``inputs``: SHA-256 of the data file by its name.
    """

    path: Path
    numbers: dict[str, Array]
    segment: NDArray[np.int32]
    labels: tuple[str, ...]
    rows: NDArray[np.int64]
    units: dict[str, str] = field(default_factory=dict)
    events: list[Event] = field(default_factory=list)
    inputs: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.usable = self.segment >= 0

    @property
    def count(self) -> int:
        """Number of rows."""
        return int(self.rows.size)

    def note(self, kind: str, where: NDArray[Any], detail: str) -> None:
        """Add an event of some rows: their indices in rising order, or True (n,) for each. None if there is no row."""
        at = np.flatnonzero(where) if where.dtype == np.bool_ else where
        self.events += counted(kind, at, self.rows, detail)

    def leave_out(self, kind: str, where: NDArray[np.bool_], detail: str) -> None:
        """Do not use the rows for which ``where`` (n,) is true."""
        self.usable &= ~where
        self.note(kind, where, detail)

    def keep_usable(self, t: Array) -> Array:
        """Drop the rows that are not used. Returns ``t`` (n,) of the others."""
        if self.usable.all():
            return t
        for name, values in self.numbers.items():
            self.numbers[name] = stored(values[self.usable])
        self.rows, self.segment = stored(self.rows[self.usable]), stored(self.segment[self.usable])
        return stored(t[self.usable])

    def refusal(
        self, words: str, remedy: str, *columns: str, at: int | None = None, key: str = ""
    ) -> DataError:
        """The error of the file, of columns or of the row with index ``at``; ``key`` of ``[instrument]`` may resolve it."""
        row = None if at is None else int(self.rows[at])
        place = "" if row is None else f"row {row}, "
        fixes = [Fix("instrument", key)] if key else []
        return DataError(
            f"{self.path}: {place}{words}", remedy=remedy, where=Where(self.path, row, columns), fixes=fixes
        )

    def unit(self, column: str, declared: str) -> str:
        """The declared unit, checked against the unit in the data file, if that has one."""
        in_file, wanted = parse_unit(self.units.get(column, declared)), parse_unit(declared)
        if (in_file.dimension, in_file.factor) != (wanted.dimension, wanted.factor):
            words = f"column '{column}' has the unit '{self.units[column]}' in the file, but '{declared}' in the run file"
            raise self.refusal(words, "correct the one that is wrong", column)
        return declared

    def si(self, column: str, factor: float, offset: float = 0.0) -> Array:
        """A column times a factor, plus an offset."""
        values = self.numbers[column]
        return values if (factor, offset) == (1.0, 0.0) else scaled(values, factor, offset)

    def time(self, data: DataTable) -> Array:
        """Time of each row (n,) [s]. Time stamps are in seconds already."""
        if data.time is None:
            rate = to_si(data.sample_rate or 1.0, "Hz", what="[data] sample_rate")
            return stored(np.arange(self.count) / rate)
        column, unit = data.time.column, data.time.unit
        factor = 1.0 if unit is None else conversion_factor(self.unit(column, unit), "s")
        return self.si(column, factor)


def read_columns(folder: Path, data: DataTable) -> RawColumns:
    """Read the whole data file of a run file. It must not change while it is read."""
    path = folder / data.file
    before = _state(path)
    raw = collect(path, data, _open_stream(folder, data))
    raw.inputs[path.name] = file_digest(path)
    if _state(path) != before:
        raise refusal(path, "the file changed while it was read", "stop what writes it, then try again")
    return raw


def _state(path: Path) -> tuple[int, ...]:
    """What shows that a file was changed or replaced: its size, times and number."""
    with open_regular(path, "the file; [data] file is relative to the run file") as stream:
        status = os.fstat(stream.fileno())
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino


def read_series(folder: Path, data: DataTable, names: Sequence[str]) -> tuple[Array, Array, dict[str, str]]:
    """Values (n, k) of named columns and time (n,) [s] of the rows that have all of them, and the digests of the files."""
    raw = read_columns(folder, data)
    values, t = np.column_stack([raw.numbers[name] for name in names]), raw.time(data)
    used = np.isfinite(values).all(axis=1) & np.isfinite(t)
    return values[used], t[used], raw.inputs


def collect(path: Path, data: DataTable, stream: RecordStream) -> RawColumns:
    """All chunks of a stream, joined. ``path`` names it in messages."""
    numbers = {name: ColumnWriter() for name in data.number_columns()}
    rows, codes = ColumnWriter(np.int64), ColumnWriter(np.int32)
    for chunk in stream.chunks():
        for name, column in numbers.items():
            _check_size(path, name, chunk)
            column.append(chunk.numbers[name])
        rows.append(chunk.rows)
        codes.append(np.zeros(chunk.rows.size, np.int32) if chunk.codes is None else chunk.codes)
        if len(stream.label_names) > MAX_SEGMENTS:
            words = f"column '{data.label_column}' has more than {MAX_SEGMENTS} different segments"
            raise refusal(path, words, "name the column that numbers the positions", str(data.label_column))
    labels = stream.label_names if data.label_column else ["all"]
    segment, names = segments_of_visits(codes.finish(), labels)
    columns = {name: column.finish() for name, column in numbers.items()}
    raw = RawColumns(path, columns, stored(segment), names, rows.finish(), stream.units, stream.events())
    raw.note("no-segment", segment < 0, "rows without a segment are not used")
    fills = [float(word) for word in data.missing if is_number(word, ".")]
    for name, values in columns.items() if fills else ():
        filled = np.isin(values, fills)
        values[filled] = np.nan
        raw.note("missing-value", filled, f"column '{name}'")
    import pyarrow as pa

    pa.default_memory_pool().release_unused()
    return raw


def _check_size(path: Path, name: str, chunk: FileChunk) -> None:
    """Refuse numbers that no instrument gives and whose squares overflow. Non-finite values are counted elsewhere."""
    values = chunk.numbers[name]
    if values.size == 0 or largest_size(values) <= LARGEST_SAMPLE:
        return
    bad = np.flatnonzero((np.abs(values) > LARGEST_SAMPLE) & (np.abs(values) < np.inf))
    if bad.size:
        row = int(chunk.rows[bad[0]])
        words = f"row {row}, column '{name}': {values[bad[0]]:g} is too large to compute with"
        raise DataError(f"{path}: {words}", remedy="correct it in the file", where=Where(path, row, (name,)))


def stand_files(table: Any) -> list[str]:
    """Names of all files in a ``[stand]`` table and its inner tables, as written."""
    inner = table.values() if isinstance(table, dict) else table if isinstance(table, list) else ()
    named = [table["file"]] if isinstance(table, dict) and isinstance(table.get("file"), str) else []
    return list(dict.fromkeys(named + [name for value in inner for name in stand_files(value)]))


def file_digest(path: Path) -> str:
    """SHA-256 of a file, as hexadecimal digits."""
    with open_regular(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


# -- positions told by the column of a stand ---------------------------------------------------------------

_BLOCKS = 4000
"""Blocks into which a column is divided, at most; an edge of a position is known to one block."""
_NOISE = 6.0
"""A block farther than this many standard deviations of a block mean from its position is outside."""
_SAME = 1e-4
"""Share of the range of the column within which it stands still, whatever its noise."""
_SHORT = 0.05
"""Positions shorter than this share of the longest one are parts of a move."""
_LEAST_STILL = 0.2
"""Least share of the rows in positions; below it the stand is taken to move all the time."""
_LEAST_ROWS = 16
"""Fewest rows of a position."""
_QUARTILE = 0.3186 * 6.0**0.5
"""Lower quartile of the second difference of three values of a normal distribution, in its standard deviations."""


def positions(x: Array) -> list[tuple[int, int]]:
    """First row and row after the last of each position of a column (n,). Rows without a number belong to none.

    The column is averaged over short blocks of rows. A position is a run of blocks whose mean stays within a tolerance of the
    mean of the position so far: the noise of the column, or 1e-4 of its range. So a jump and a move end a position. A run that
    drifts through its tolerance is a ramp. Runs much shorter than the longest one belong to moves.
    The list is empty if the column nowhere stands still.
    """
    rows = np.flatnonzero(np.isfinite(x))
    if rows.size < 2 * _LEAST_ROWS:
        return []
    width = max(rows.size // _BLOCKS, 1)
    count = rows.size // width
    means = x[rows[: count * width]].reshape(count, width).mean(axis=1)
    tolerance = _tolerance(means, x[rows])
    still, start, total = [], 0, float(means[0])
    for k in range(1, count + 1):
        if k == count or abs(means[k] - total / (k - start)) > tolerance:
            third = max((k - start) // 3, 1)
            drift = abs(float(means[k - third : k].mean() - means[start : start + third].mean()))
            if (k - start) * width >= _LEAST_ROWS and drift <= 0.5 * tolerance:
                still.append((start, k))
            start, total = k, 0.0
        total += float(means[min(k, count - 1)])
    longest = max((b - a for a, b in still), default=0)
    kept = [_trimmed(means, a, b) for a, b in still if b - a >= _SHORT * longest]
    if sum(b - a for a, b in kept) < _LEAST_STILL * count:
        return []
    return [(int(rows[a * width]), int(rows[b * width - 1]) + 1) for a, b in kept if b > a]


def _trimmed(means: Array, start: int, stop: int) -> tuple[int, int]:
    """A run without the blocks at its ends that belong to a move, by the scatter of the run itself."""
    run = means[start:stop]
    middle = float(np.median(run))
    limit = _NOISE * 1.4826 * float(np.median(np.abs(run - middle))) + 1e-12 * abs(middle)
    inside = np.flatnonzero(np.abs(run - middle) <= limit)
    first, last = start + int(inside[0]), start + int(inside[-1]) + 1
    return first + (first > 0), last - (last < means.size)


def _tolerance(means: Array, x: Array) -> float:
    """Largest distance of the mean of a block from that of its position."""
    steps = np.abs(np.diff(x))
    resolution = float(np.min(steps, where=steps > 0.0, initial=np.inf))
    noise = float(np.quantile(np.abs(np.diff(means, 2)), 0.25)) / _QUARTILE  # a straight move has none
    quantum = 1.5 * resolution if noise > 0.0 and np.isfinite(resolution) else 0.0
    return max(_NOISE * noise, _SAME * float(np.ptp(means)), min(quantum, 0.01 * float(np.ptp(means))))


def find_positions(raw: RawColumns, name: str) -> None:
    """Segments of a record without a column that numbers them: where the stand, whose column is ``name``, stands still."""
    spans = positions(raw.numbers[name])
    if not spans:
        words = f"column '{name}' nowhere stands still, so it tells no position"
        remedy = (
            "name the column that logs the angle or the speed of the stand, or one that numbers the positions"
        )
        raise raw.refusal(words, remedy, name)
    raw.segment = np.full(raw.count, -1, np.int32)
    for k, (start, stop) in enumerate(spans):
        raw.segment[start:stop] = k
    raw.labels = tuple(str(k + 1) for k in range(len(spans)))
    detail = f"'{name}' does not stand still: rows between the {len(spans)} positions are not used"
    raw.leave_out("moving", raw.segment < 0, detail)
