"""The columns of a data file of any format as read, in the units of the file. All chunks are joined.

Text and Parquet are read piece by piece. Containers (HDF5, MATLAB, TDMS, XLSX) cannot unpack to
more than 2 GiB and are read whole. Results, events and errors do not depend on the size of the pieces.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.errors import DataError, Fix, Where
from piga.formats.columns import FileChunk, ParquetStream, RecordStream, refusal
from piga.formats.text.reader import is_number
from piga.records.arrays import ColumnWriter, largest_size, scaled, stored
from piga.records.calibration.diagnostics import Event, counted
from piga.records.run import segments_of_visits
from piga.records.run_file import DataTable
from piga.results import Array
from piga.text_files import LARGEST_SAMPLE, MAX_SEGMENTS, MOST_NAME_LETTERS, open_regular
from piga.units import conversion_factor, parse_unit, to_si

TEXT_SUFFIXES = (".csv", ".txt", ".tsv", ".lvm", ".asc", ".dat", ".log", ".prn")
"""Endings of separated text. ``.lvm`` is written by LabVIEW."""


def open_stream(folder: Path, data: DataTable) -> RecordStream:
    """Open the data file of a run file. ``folder`` is that of the run file; ``data`` is its ``[data]`` table."""
    path, columns = folder / data.file, (tuple(data.number_columns()), data.label_column)
    kind, stamp = file_kind(path), data.time.stamp if data.time else None
    if data.sheet is not None and kind != ".xlsx":
        raise refusal(path, "[data] sheet is for .xlsx files", "leave it out")
    if kind in TEXT_SUFFIXES:
        from piga.formats.text.convention import HeadRows

        return columns_stream(
            path,
            *columns,
            separator=data.delimiter,
            decimal=data.decimal,
            encoding=data.encoding,
            rows=HeadRows(data.skip_rows, data.header_row, data.units_row),
            stamp=(data.time.column, stamp) if data.time and stamp else None,
            missing=data.missing,
            mask_damaged=data.damaged_rows == "mask",
        )
    units = data.units_row is not None
    for key, given in (("skip_rows", data.skip_rows), ("header_row", data.header_row), ("units_row", units)):
        if given:
            raise refusal(path, f"[data] {key} is for text files", "leave it out")
    if stamp is not None:
        remedy = "give unit = 's': dates and time stamps of Parquet and XLSX are read as seconds; text in a cell is not"
        raise refusal(path, "[data] time: stamp is for text files", remedy)
    return columns_stream(path, *columns, data.sheet, data.missing)


def columns_stream(
    path: Path,
    numeric: tuple[str, ...],
    segment: str | None = None,
    sheet: str | None = None,
    missing: tuple[str, ...] = (),
    **text: Any,
) -> RecordStream:
    """Open the number columns ``numeric`` and the segment column of a data file.

    ``sheet`` names the sheet of a spreadsheet, ``missing`` further words that mean a missing value. ``text`` holds options of
    :class:`piga.formats.text.reader.TextStream`.
    """
    kind = file_kind(path)
    if kind in TEXT_SUFFIXES:
        from piga.formats.text.reader import TextStream

        return TextStream(path, numeric, segment, missing=missing, **text)
    if kind in (".parquet", ".pq"):
        return ParquetStream(path, numeric, segment)
    from piga.formats.container import CONTAINERS

    if kind in CONTAINERS:
        return CONTAINERS[kind](path, numeric, segment, sheet, missing)
    remedy = f"give .csv, .csv.gz, .parquet or one of {', '.join(CONTAINERS)}"
    if kind in (".xls", ".xlsm", ".xlsb", ".ods"):
        remedy = "open it in the spreadsheet program and save it as .xlsx or .csv"
    raise DataError(f"{path}: piga does not read files of kind '{kind}'", remedy=remedy)


def file_kind(path: Path) -> str:
    """The ending that identifies the format of a file; ``.gz`` is skipped."""
    suffixes = ["", *(suffix.lower() for suffix in path.suffixes)]
    return suffixes[-2] if suffixes[-1] == ".gz" and len(suffixes) > 2 else suffixes[-1]


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
    with steady(path, "[data] file is relative to the run file"):
        raw = collect(path, data, open_stream(folder, data))
        raw.inputs[path.name] = file_digest(path)
    return raw


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
        _check_labels(path, str(data.label_column), stream.label_names)
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


def _check_labels(path: Path, column: str, labels: Sequence[str]) -> None:
    if len(labels) > MAX_SEGMENTS:
        words = f"column '{column}' has more than {MAX_SEGMENTS} different segments"
        raise refusal(path, words, "name the column that numbers the positions", column)
    longest = max(labels, key=len, default="")
    if len(longest) > MOST_NAME_LETTERS:
        words = f"column '{column}': the label '{longest[:40]}...' has {len(longest)} characters"
        raise refusal(path, words, f"use {MOST_NAME_LETTERS} or fewer", column)


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


@contextmanager
def steady(path: Path, remedy: str) -> Iterator[None]:
    """Refuse a file that changes or is replaced while the block runs."""

    def state() -> tuple[int, int, int, int]:
        with open_regular(path, f"the file; {remedy}") as stream:
            status = os.fstat(stream.fileno())
        return status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino

    before = state()
    yield
    if state() != before:
        raise refusal(path, "the file changed while it was read", "stop what writes it, then try again")


def stand_files(table: Any) -> list[str]:
    """Names of all files in a ``[stand]`` table and its inner tables, as written."""
    inner = table.values() if isinstance(table, dict) else table if isinstance(table, list) else ()
    named = [table["file"]] if isinstance(table, dict) and isinstance(table.get("file"), str) else []
    return list(dict.fromkeys(named + [name for value in inner for name in stand_files(value)]))


def file_digest(path: Path) -> str:
    """SHA-256 of a file, as hexadecimal digits."""
    with open_regular(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
