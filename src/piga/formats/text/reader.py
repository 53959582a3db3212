"""Read CSV and other separated text with PyArrow's tokenizer. Errors name row and column."""

from __future__ import annotations

import re
from collections.abc import Iterator
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.errors import DataError, Fix, Where
from piga.formats.columns import FileChunk, LabelCodes, MissingCount, numbers_of
from piga.formats.text.convention import (
    INFINITE,
    LINE_END,
    MISSING,
    SEPARATORS,
    HeadRows,
    TextFormat,
    duplicate_name,
    find_format,
    split_line,
    units_in_names,
)
from piga.formats.text.faults import MAX_LISTED, Faults, find_faults, split_cells
from piga.formats.text.source import FIRST_ROWS, TextSource
from piga.formats.text.time_stamp import StampClock, time_stamp
from piga.records.calibration import Event

_BLANKS = re.compile(rb"[ \t]+")
_EDGES = re.compile(rb"^ | (?=\r?$)", re.MULTILINE)
_ODD_QUOTES = re.compile(rb'^[^"\n]*"(?:[^"\n]*"[^"\n]*")*[^"\n]*$', re.MULTILINE)
_ROW = re.compile(r"^(?:In CSV column #\d+: )?(?:CSV parse error: )?(?:Row #(\d+): )?")
"""Beginning of a message of PyArrow. Its row counts within the piece."""
EXAMINED_BYTES = 1 << 16
"""Size of a part with damage that is examined line by line [bytes]."""
BLOCK_BYTES = 1 << 20
"""Bytes per block that PyArrow tokenizes on one thread."""


class TextStream:
    """The named columns of a text file, chunk by chunk; see :class:`piga.formats.columns.RecordStream`.

    Parameters
    ----------
    path:
        ``.csv`` (``.txt``, ``.tsv``), plain or ``.gz``.
    numeric, label:
        Names of the number columns and of the segment column.
    separator, decimal, encoding, rows:
        From the run file; None: detected from the file.
    stamp:
        Name and form of a number column that holds time stamps. It is given in seconds since the first midnight.
    missing:
        Further words that mean a missing value.
    mask_damaged:
        Leave damaged rows out and count them by kind, instead of refusing the file.
    piece:
        Bytes read at a time (None: ``source.PIECE_BYTES``). The result does not depend on it.

    Raises
    ------
    DataError
        If the file cannot be read. The message names file, row, column, the faulty text and the remedy.
    """

    def __init__(
        self,
        path: Path,
        numeric: tuple[str, ...],
        label: str | None,
        *,
        separator: str | None = None,
        decimal: str | None = None,
        encoding: str | None = None,
        rows: HeadRows | None = None,
        stamp: tuple[str, str] | None = None,
        missing: tuple[str, ...] = (),
        mask_damaged: bool = False,
        piece: int | None = None,
    ) -> None:
        self._path, self._numeric, self._label = path, tuple(dict.fromkeys(numeric)), label
        self._missing = missing
        rows = rows or HeadRows()
        wanted = [*numeric, *([label] if label else [])]
        self._source = TextSource(path, encoding, piece, wanted=wanted, first_rows=FIRST_ROWS + rows.last)
        head = self._source.head.decode("utf-8", errors="replace")
        self._form = find_format(head, path, self._source.encoding, separator, decimal, rows)
        self._clock = None if stamp is None else StampClock(time_stamp(stamp[1]))
        if stamp is not None:
            self._form = replace(self._form, stamps={stamp[0]: time_stamp(stamp[1])})
        _check_columns(self._form, wanted, head, path)
        self.units = {name: unit for name, unit in self._form.units.items() if name in numeric}
        self.label_names: list[str] = []
        self._codes = LabelCodes(self.label_names)
        self._mask, self._faults, self._missed = mask_damaged, Faults(), MissingCount()
        self._row = self._form.skip + 1
        self._read, self._last_filled = 0, self._form.skip
        self._truncated: int | None = None

    def chunks(self) -> Iterator[FileChunk]:
        """The rows in order. A damaged file gives the rows before the first damage, then the error that lists the faults."""
        for raw, ends in self._lines():
            for part, table in self._tables(raw, ends):
                lines = part.count(b"\n")
                if self._mask or not self._faults.total:
                    yield from self._convert(table, self._file_rows(part, table.num_rows, lines))
                elif self._faults.total > MAX_LISTED:
                    raise self._faults.error(self._path)
                self._row += lines
        if self._faults.total and not self._mask:
            raise self._faults.error(self._path)
        self._truncated = self._row if self._source.cut else None
        if self._read == 0:
            raise DataError(
                f"{self._path}: a header but no complete data row",
                remedy="check that the logger wrote data",
                where=Where(self._path),
            )

    def _lines(self) -> Iterator[tuple[bytes, int]]:
        """Pieces of complete lines and their number. Where blanks separate the columns, one blank is left of many."""
        pieces = self._source.pieces(self._form.skip)
        if self._form.separator != " ":
            return pieces
        return ((_EDGES.sub(b"", _BLANKS.sub(b" ", raw)), ends) for raw, ends in pieces)

    def events(self) -> list[Event]:
        """Faults and omissions; complete after the last chunk."""
        events = []
        if self._source.encoding != "utf-8":
            events.append(Event("encoding", 1, 1, f"read as {self._source.encoding}"))
        if self._truncated is not None:
            row = self._truncated
            events.append(Event("truncated-last-line", 1, row, f"row {row} has no line end: it is not used"))
        events += self._faults.events()
        blank = self._last_filled - self._form.skip - self._read - self._faults.rows
        if blank > 0:
            events.append(Event("blank-line", blank, None, "skipped"))
        return [*events, *self._missed.events(self._numeric)]

    def _file_rows(self, raw: bytes, read: int, ends: int) -> NDArray[np.int64]:
        """File rows of the data rows of a piece (blank lines are counted, as an editor does)."""
        if read == ends:
            rows = np.arange(self._row, self._row + read, dtype=np.int64)
        else:
            filled = (row for row, line in enumerate(raw.split(b"\n"), start=self._row) if line.strip())
            rows = np.fromiter(filled, dtype=np.int64)
        self._last_filled = int(rows[-1]) if rows.size else self._last_filled
        self._read += read
        return rows

    def _convert(self, table: Any, rows: NDArray[np.int64]) -> Iterator[FileChunk]:
        start = 0
        for batch in table.to_batches():
            part = rows[start : start + batch.num_rows]
            start += batch.num_rows
            numbers = {}
            for name in self._numeric:
                column = batch.column(name)
                numbers[name] = numbers_of(column)
                self._missed.see(name, column, part)
            codes = self._codes.of(batch.column(self._label)) if self._label is not None else None
            yield FileChunk(numbers, codes, part)

    def _tables(self, raw: bytes, ends: int) -> Iterator[tuple[bytes, Any]]:
        """A piece and its table. A piece that cannot be read is halved, until damage lies in a small part: that is examined."""
        whole = self._without_blank_lines(raw) if len(self._form.names) == 1 else raw
        table, _ = self._parse(whole, ends)
        if table is None:
            whole = self._without_blank_lines(raw)
            whole = re.sub(rb"\r+\n", b"\r\n", whole) if b"\r\r\n" in whole else whole
            table, _ = self._parse(whole)
        middle = raw.find(b"\n", len(raw) // 2) + 1
        if table is not None:
            yield whole, table
        elif len(raw) > EXAMINED_BYTES and 0 < middle < len(raw):
            for part in (raw[:middle], raw[middle:]):
                yield from self._tables(part, part.count(b"\n"))
        else:
            yield self._examined(whole)

    def _examined(self, raw: bytes) -> tuple[bytes, Any]:
        """The text without damaged rows, which are listed, and its table."""
        most = None if self._mask else MAX_LISTED
        damaged = find_faults(self._faults, raw, self._row, self._form, self._numeric, self._missing, most)
        raw = self._without_padding(_blanked(raw, damaged))
        table, complaint = self._parse(raw)
        if table is None and not (self._faults.total and not self._mask):
            match = _ROW.match(complaint)
            within = int(match.group(1) or 1) if match else 1
            filled = [at for at, line in enumerate(raw.split(b"\n")) if line.strip()]
            row = self._row + filled[min(within, len(filled)) - 1]
            raise DataError(
                f"{self._path}: row {row}: {_ROW.sub('', complaint)}",
                remedy="check this row's cells and separators",
                where=Where(self._path, row),
            )
        return raw, table

    def _without_blank_lines(self, raw: bytes) -> bytes:
        """The text with empty lines in place of lines of blanks. A line of tabs holds empty cells, where tabs separate."""
        blank = rb"^ +\r?\n" if self._form.separator == "\t" else rb"^[ \t]+\r?\n"
        return re.sub(blank, b"\n", raw, flags=re.MULTILINE)

    def _without_padding(self, raw: bytes) -> bytes:
        """The text without blanks beside separators: PyArrow recognises words for missing values only without them."""
        separator = self._form.separator.encode()
        return b"\n".join(
            separator.join(cell.strip(b" ") for cell in line.split(separator)) if b" " in line else line
            for line in raw.split(b"\n")
        )

    def _parse(self, raw: bytes, ends: int | None = None) -> tuple[Any, str]:
        """Tokenize with PyArrow. Returns the table, or None and the error message, which without ``ends`` names a row."""
        import pyarrow as pa
        from pyarrow import csv

        if b"\0" in raw:
            return None, "NUL bytes"
        if raw.isspace():
            return _no_rows(self._numeric, self._label), ""
        if b"\r" in raw and raw.count(b"\r") != raw.count(b"\r\n"):
            return None, "a carriage return inside a line"
        form = self._form
        types = {name: pa.string() if name in form.stamps else pa.float64() for name in self._numeric}
        if self._label is not None:
            types[self._label] = pa.string()
        bad: list[Any] = []

        def stop(row: Any) -> str:
            bad.append(row)
            return "error"

        try:
            table = csv.read_csv(
                pa.BufferReader(pa.py_buffer(raw)),
                read_options=csv.ReadOptions(
                    column_names=list(form.names),
                    block_size=BLOCK_BYTES,
                    use_threads=ends is not None and len(raw) > BLOCK_BYTES,
                ),
                parse_options=csv.ParseOptions(delimiter=form.separator, invalid_row_handler=stop),
                convert_options=csv.ConvertOptions(
                    include_columns=list(types),
                    column_types=types,
                    null_values=[*MISSING, *INFINITE, *self._missing],
                    decimal_point=form.decimal,
                    strings_can_be_null=False,
                ),
            )
        except pa.ArrowInvalid as error:
            if bad:
                return None, f"Row #{bad[0].number or 1}: the row does not have {len(form.names)} cells"
            return None, str(error).splitlines()[0]
        counted = table.num_rows == ends or table.num_rows == _filled(raw)
        if not counted or _open_quote(raw, form.separator):
            return None, "a quotation mark is not closed"
        return self._with_times(table)

    def _with_times(self, table: Any) -> tuple[Any, str]:
        """The table with seconds in place of time stamps."""
        if self._clock is None:
            return table, ""
        name = next(iter(self._form.stamps))
        clock = copy(self._clock)
        seconds = clock.convert(table.column(name), {*MISSING, *self._missing})
        if seconds is None:
            return None, f"column '{name}' holds a cell that is not a time stamp"
        self._clock = clock
        return table.set_column(table.schema.get_field_index(name), name, seconds), ""


def _filled(raw: bytes) -> int:
    return sum(1 for line in raw.split(b"\n") if line.strip())


def _open_quote(raw: bytes, separator: str) -> bool:
    """True if a cell begins with a quotation mark that its line does not close."""
    if b'"' not in raw:
        return False
    odd = (match.group().decode("utf-8", errors="replace") for match in _ODD_QUOTES.finditer(raw))
    return any(split_cells(line, separator) is None for line in odd)


def _blanked(raw: bytes, damaged: list[int]) -> bytes:
    """The text with damaged lines made empty. The other lines keep their numbers."""
    if not damaged:
        return raw
    lines = raw.split(b"\n")
    for index in damaged:
        lines[index] = b""
    return b"\n".join(lines)


def _no_rows(numeric: tuple[str, ...], label: str | None) -> Any:
    import pyarrow as pa

    types = dict.fromkeys(numeric, pa.float64()) | ({label: pa.string()} if label is not None else {})
    return pa.schema(list(types.items())).empty_table()


def _check_columns(form: TextFormat, wanted: list[str], head: str, path: Path) -> None:
    """Refuse a file that lacks a wanted column. A later row that holds all of them is named."""
    missing = list(dict.fromkeys(name for name in wanted if name not in form.names))
    if not missing:
        return
    twice = duplicate_name(path, form.header, missing, form.names)
    if twice is not None:
        raise twice
    listed = ", ".join(f"'{name}'" for name in missing)
    guessed = "" if form.encoding.startswith("utf") else f" (read as {form.encoding})"
    row = _row_of(wanted, head, form.header)
    remedy, fixes = "correct the column name in [data], or [data] delimiter if the columns are not split", []
    if row is not None:
        remedy, fixes = (
            f"row {row} has these names: add [data] header_row = {row}",
            [Fix("data", "header_row", row)],
        )
    elif guessed:
        remedy += "; or add [data] encoding = '...', if the names are misread"
        fixes = [Fix("data", "encoding")]
    raise DataError(
        f"{path}: row {form.header}{guessed}: no column {listed}; the columns are: {', '.join(form.names)}",
        remedy=remedy,
        where=Where(path, form.header, tuple(missing)),
        columns=form.names,
        fixes=fixes,
    )


def _row_of(wanted: list[str], head: str, after: int) -> int | None:
    """The first row after ``after`` whose cells hold all wanted names, whatever its separator."""
    for number, line in enumerate(LINE_END.split(head), start=1):
        for separator in f"{SEPARATORS} " if number > after else "":
            names = tuple(cell.strip().strip('"').strip() for cell in split_line(line, separator))
            if set(wanted) <= {*names, *units_in_names(names)[0]}:
                return number
    return None
