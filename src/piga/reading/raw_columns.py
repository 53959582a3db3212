"""The columns of a data file of any format as read, in the units of the file. All chunks are joined.

:func:`open_stream` returns a :class:`~piga.formats.columns.RecordStream`. Its ``chunks()`` are the rows in order, in
the units of the file. Text and Parquet are read piece by piece. Containers (HDF5, MATLAB, TDMS, XLSX) cannot unpack to
more than 2 GiB and are read whole. Results, events and errors do not depend on the size of the pieces.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from piga.errors import DataError
from piga.formats.columns import FileChunk, RecordStream
from piga.records.calibration import Event, Tally
from piga.records.limits import LARGEST_SAMPLE, MAX_SEGMENTS, MOST_NAME_LETTERS, open_regular, read_whole
from piga.records.run_file import DataTable
from piga.records.spool import Arrays, arrays_like, spans
from piga.results import Array

TEXT_SUFFIXES = (".csv", ".txt", ".tsv", ".lvm", ".asc", ".dat", ".log", ".prn")
"""Endings of separated text. ``.lvm`` is written by LabVIEW."""


def open_stream(
    folder: Path,
    data: DataTable,
    see: Callable[[bytes | bytearray], object] | None = None,
) -> RecordStream:
    """Open the data file of a run file.

    Parameters
    ----------
    folder:
        Folder of the run file. The data file is relative to it.
    data:
        The run file's ``[data]`` table: ``read_run_file(path).data``.
    see:
        Function that gets the bytes of a text file as they are read (for a digest). Not called for other formats.

    Raises
    ------
    DataError
        If the file cannot be read as requested: at once, or while its chunks are taken. Names file, row and column.
    """
    path = folder / data.file
    numeric = tuple(data.number_columns())
    kind = file_kind(path)
    if data.sheet is not None and kind != ".xlsx":
        raise DataError(f"{path}: [data] sheet is for .xlsx files", remedy="leave it out")
    if kind in TEXT_SUFFIXES:
        from piga.formats.text.convention import HeadRows
        from piga.formats.text.reader import TextStream

        stamp = (data.time.column, data.time.stamp) if data.time and data.time.stamp else None
        return TextStream(
            path, numeric, data.segment, separator=data.delimiter, decimal=data.decimal, encoding=data.encoding,
            rows=HeadRows(data.skip_rows, data.header_row, data.units_row), stamp=stamp, missing=data.missing,
            mask_damaged=data.damaged_rows == "mask", see=see or len,
        )  # fmt: skip
    _only_text(path, data)
    return columns_stream(path, numeric, data.sheet, data.segment)


def columns_stream(
    path: Path, numeric: tuple[str, ...], sheet: str | None = None, segment: str | None = None
) -> RecordStream:
    """Open a data file that is not text.

    Parameters
    ----------
    path:
        The file.
    numeric, segment:
        Names of the number columns and of the segment column.
    sheet:
        Name of the sheet of a spreadsheet.

    Raises
    ------
    DataError
        If the file cannot be read as requested: at once, or while its chunks are taken.
    """
    kind = file_kind(path)
    if kind in (".parquet", ".pq"):
        from piga.formats.parquet import ParquetStream

        return ParquetStream(path, numeric, segment)
    from piga.formats.container import CONTAINERS, read_container

    if kind in CONTAINERS:
        return read_container(path, kind, numeric, segment, sheet)
    spreadsheet = kind in (".xls", ".xlsm", ".xlsb", ".ods")
    raise DataError(
        f"{path}: piga does not read files of kind '{kind}'",
        remedy="open it in the spreadsheet program and save it as .xlsx or .csv"
        if spreadsheet
        else f"give .csv, .csv.gz, .parquet or one of {', '.join(CONTAINERS)}",
    )


def _only_text(path: Path, data: DataTable) -> None:
    """Refuse options of text files for other files."""
    named = {
        "skip_rows": data.skip_rows,
        "header_row": data.header_row,
        "units_row": data.units_row is not None,
    }
    for key, given in named.items():
        if given:
            raise DataError(f"{path}: [data] {key} is for text files", remedy="leave it out")
    if data.time is not None and data.time.stamp is not None:
        raise DataError(
            f"{path}: [data] time: stamp is for text files",
            remedy="give unit = 's': dates and time stamps of Parquet and XLSX are read as seconds; text in a cell is not",
        )


def file_kind(path: Path) -> str:
    """The ending that identifies the format of a file; ``.gz`` is skipped."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    if suffixes[-1:] == [".gz"] and len(suffixes) > 1:
        return suffixes[-2]
    return (suffixes[-1:] or [""])[0]


LARGE_ROWS = 1 << 22
"""The columns of records with more rows are kept on disk. This takes 1.5 times as long and a third of the memory."""
MAX_SIDECAR = 1 << 16
"""Largest ``.sha256`` file [bytes]. It holds one line: 64 digits and a file name."""


@dataclass
class RawColumns:
    """``numbers`` in the units of the file (n,), ``segment`` (n,) with ``labels``, 1-based file ``rows`` (n,).

    ``inputs`` holds the SHA-256 of the data file and of its ``.sha256`` file, by name, as they were read.
    """

    path: Path
    numbers: dict[str, Array]
    segment: NDArray[np.int32]
    labels: tuple[str, ...]
    rows: NDArray[np.int64]
    units: dict[str, str]
    events: list[Event]
    arrays: Arrays
    inputs: dict[str, str] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """Rows read."""
        return int(self.rows.size)


def read_columns(folder: Path, data: DataTable, held: int | None = None) -> RawColumns:
    """Read the whole data file of a run file.

    If it has more than ``held`` rows (default :data:`LARGE_ROWS`), the columns lie on disk beside it.

    Raises
    ------
    DataError
        If the file cannot be read as the run file says, does not match its ``.sha256``, or changes while it is read.
    """
    path = folder / data.file
    steady = SteadyFile(path, "[data] file is relative to the run file")
    sidecar = _check_sidecar(path)
    text = file_kind(path) in TEXT_SUFFIXES
    seen = hashlib.sha256()
    with ThreadPoolExecutor(1) as pool:
        digest = None if text else pool.submit(file_digest, path)
        stream = open_stream(folder, data, seen.update)
        raw = collect(path, data, stream, LARGE_ROWS if held is None else held)
    steady.check()
    raw.inputs.update({path.name: digest.result() if digest else seen.hexdigest()} | sidecar)
    return raw


def collect(path: Path, data: DataTable, stream: RecordStream, held: int) -> RawColumns:
    """All chunks of a stream, joined. Above ``held`` rows the columns lie on disk beside ``path``."""
    names, arrays = data.number_columns(), Arrays(path.parent)
    numbers = {name: arrays.growing(most=held) for name in names}
    segment, rows = arrays.growing(np.int32, held), arrays.growing(np.int64, held)
    visits = Visits(stream.label_names)
    for chunk in stream.chunks():
        room = stream.expected_rows
        for name in names:
            _check_size(path, name, chunk)
            numbers[name].append(chunk.numbers[name], room)
        rows.append(chunk.rows, room)
        if chunk.codes is None:
            segment.append(np.zeros(chunk.rows.size, np.int32), room)
            continue
        if len(stream.label_names) > MAX_SEGMENTS:
            raise DataError(
                f"{path}: column '{data.segment}' has more than {MAX_SEGMENTS} different segments",
                remedy="name the column that numbers the positions",
            )
        segment.append(visits.segment(chunk.codes, chunk.rows), room)
    visits.finish()
    long = next((name for name in stream.label_names if len(name) > MOST_NAME_LETTERS), None)
    if long is not None:
        raise DataError(
            f"{path}: column '{data.segment}': the label '{long[:40]}...' has {len(long)} characters",
            remedy=f"use {MOST_NAME_LETTERS} or fewer",
        )
    file_rows = rows.finish()
    return RawColumns(
        path,
        {name: column.finish() for name, column in numbers.items()},
        segment.finish(),
        ("all",) if data.segment is None else tuple(visits.names),
        file_rows,
        stream.units,
        [*stream.events(), *visits.events],
        arrays_like(file_rows),
    )


def _check_size(path: Path, name: str, chunk: FileChunk) -> None:
    """Refuse numbers that no instrument gives and whose squares overflow. Non-finite values are counted elsewhere."""
    size = np.abs(chunk.numbers[name])
    bad = (size > LARGEST_SAMPLE) & (size < np.inf)
    if bad.any():
        at = int(np.argmax(bad))
        raise DataError(
            f"{path}: row {chunk.rows[at]}, column '{name}': {chunk.numbers[name][at]:g} is too large to compute with",
            remedy="correct it in the file",
        )


class SteadyFile:
    """A file that must not change while it is read. Its state is noted now and compared by :meth:`check`.

    Raises
    ------
    DataError
        If it does not exist or is not a regular file.
    """

    def __init__(self, path: Path, remedy: str) -> None:
        self.path, self._remedy = path, remedy
        self._before = self._state()

    def check(self) -> None:
        """Refuse the file if it was changed or replaced since.

        Raises
        ------
        DataError
            If it was. The message names the file.
        """
        if self._state() != self._before:
            raise DataError(
                f"{self.path}: the file changed while it was read", remedy="stop what writes it, then try again"
            )

    def _state(self) -> tuple[int, int, int, int]:
        """State of a file that every change alters: size, times and identity."""
        if self.path.exists() and not self.path.is_file():
            raise DataError(f"{self.path}: is not a regular file", remedy=f"name the file: {self._remedy}")
        try:
            status = os.stat(self.path)  # noqa: PTH116 - one call for all four
        except OSError as error:
            raise DataError(f"{self.path}: cannot be read ({error.strerror})", remedy=self._remedy) from None
        return status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino


def file_digest(path: Path) -> str:
    """SHA-256 of a file, as hexadecimal digits."""
    with open_regular(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _check_sidecar(path: Path) -> dict[str, str]:
    """Compare with ``FILE.sha256``, if there is one. Returns the SHA-256 of that file, by name."""
    sidecar = path.with_name(path.name + ".sha256")
    try:
        sidecar.lstat()
    except OSError:
        return {}
    raw = read_whole(sidecar, MAX_SIDECAR, "a line with the SHA-256")
    words = raw.decode("ascii", errors="replace").split()
    if not words or words[0].lower() != file_digest(path):
        raise DataError(
            f"{path}: its SHA-256 is not the one in {sidecar.name}",
            remedy="the file was damaged or changed: copy it again",
        )
    return {sidecar.name: hashlib.sha256(raw).hexdigest()}


@dataclass
class Visits:
    """Gives each visit of a label a segment number. A label that returns later is a new segment ``label#2``.

    ``names`` are the segments so far. ``events`` report rows without a label.
    """

    labels: list[str]
    names: list[str] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    _seen: dict[int, int] = field(default_factory=dict)
    _code: int | None = None
    _bare: list[int] = field(default_factory=list)

    def segment(self, codes: NDArray[np.int32], rows: NDArray[np.int64]) -> NDArray[np.int32]:
        """Segment index of each row; -1 without a label."""
        starts = np.flatnonzero(np.diff(codes, prepend=codes[:1]) != 0)
        starts = np.concatenate(([0], starts))
        index = np.empty(starts.size, dtype=np.int32)
        counts = np.diff(np.append(starts, codes.size))
        for at, (start, count) in enumerate(zip(starts.tolist(), counts.tolist(), strict=True)):
            index[at] = self._visit(int(codes[start]), count, int(rows[start]))
        return np.repeat(index, counts)

    def _visit(self, code: int, count: int, row: int) -> int:
        if code != self._code:
            self.finish()
            self._code = code
            if code >= 0:
                self._seen[code] = self._seen.get(code, 0) + 1
                again = self._seen[code]
                self.names.append(self.labels[code] if again == 1 else f"{self.labels[code]}#{again}")
        if code >= 0:
            return len(self.names) - 1
        self._bare = [self._bare[0] + count, self._bare[1]] if self._bare else [count, row]
        return -1

    def finish(self) -> None:
        """Report the rows without a label so far; called after the last row."""
        if self._bare:
            count, row = self._bare
            self.events.append(Event("no-segment", count, row, "rows without a segment are not used"))
            self._bare = []


def split_lost(
    segment: NDArray[np.int32],
    labels: tuple[str, ...],
    lost: NDArray[np.bool_],
    rows: NDArray[np.int64],
    arrays: Arrays,
) -> tuple[NDArray[np.int32], tuple[str, ...], tuple[int, ...], list[Event]]:
    """Give every part after a lost phase its own segment and phase group.

    Returns the segment of each row, the labels, the phase group of each segment, and the events.
    """
    order = arrays.empty(segment.size, np.int32)
    names, groups = [labels[int(segment[0])]], [0]
    parts = {int(segment[0]): 1}
    inside, last, new_phase = 0, 0, Tally()
    for part in spans(segment.size):
        gone = lost[part]
        new = gone.copy()
        new[int(part.start == 0) :] |= np.diff(segment[max(part.start - 1, 0) : part.stop]) != 0
        if part.start == 0:
            new[0] = False
        begins = np.flatnonzero(new)
        if begins.size == 0:
            order[part] = last
            continue
        order[part] = last + np.cumsum(new)
        last = int(order[part.stop - 1])
        for at in begins.tolist():
            row = part.start + at
            old = int(segment[row])
            parts[old] = parts.get(old, 0) + 1
            names.append(labels[old] + ("" if parts[old] == 1 else f"/{parts[old]}"))
            groups.append(groups[-1] + int(gone[at]))
            if gone[at]:
                new_phase.see(np.array([row]))
                inside += int(old == segment[row - 1])
    detail = "the counter may have rolled over unseen; the zero of the output angle is new there"
    events = new_phase.events("phase-lost", rows, detail)
    if inside:
        events.append(Event("segment-split", inside, None, "a gap inside a segment, phase lost"))
    return order, tuple(names), tuple(groups), events
