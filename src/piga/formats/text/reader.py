"""Read CSV and other separated text with PyArrow's tokenizer. Errors name row and column.

A part of a file that PyArrow does not read is read line by line. Every damaged row and cell is then named.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from piga.errors import DataError, Fix, Where
from piga.formats.columns import RecordStream, column_letter, refusal, with_rows
from piga.formats.text.convention import (
    INFINITE,
    MISSING,
    TextFormat,
    TextOptions,
    TextSource,
    check_present,
    find_format,
)
from piga.formats.text.time_stamp import StampClock, forms_of
from piga.records.calibration.diagnostics import Event

_BLANKS = re.compile(rb"[ \t]+")
_EDGES = re.compile(rb"^ | (?=\r?$)", re.MULTILINE)
_ODD_QUOTES = re.compile(rb'^[^"\n]*"(?:[^"\n]*"[^"\n]*")*[^"\n]*$', re.MULTILINE)
_PART_BYTES = 1 << 16
"""Size of the parts in which a piece with damage is read again [bytes]. A part with damage is read line by line."""
_BLOCK_BYTES = 1 << 20
"""Bytes per block that PyArrow tokenizes on one thread."""


class TextStream(RecordStream):
    """The named columns of a text file, plain or ``.gz``, chunk by chunk.

    Time stamps are given in seconds since the first midnight. ``source``: the lines, in place of those of the file, as
    :class:`TextSource` gives them.
    """

    def __init__(
        self,
        path: Path,
        numeric: tuple[str, ...],
        label: str | None,
        options: TextOptions | None = None,
        source: Any = None,
    ) -> None:
        super().__init__(path, numeric, label)
        options = options or TextOptions()
        self._empty = {*MISSING, *INFINITE, *options.missing}
        self._source = source or TextSource(path, options.encoding, wanted=self.wanted)
        head = self._source.head.decode("utf-8", errors="replace")
        self._form = form = find_format(head, path, self._source.encoding, options, self.wanted)
        self._clock = StampClock(*form.stamps.values()) if form.stamps else None
        remedy, fixes = (
            "correct the column name in [data], or [data] delimiter if the columns are not split",
            [],
        )
        if not form.encoding.startswith("utf"):
            remedy += (
                f"; the file was read as {form.encoding}: add [data] encoding = '...' if the names are misread"
            )
            fixes = [Fix("data", "encoding")]
        check_present(path, form.header, self.wanted, form.names, remedy, fixes)
        self.units = {name: unit for name, unit in form.units.items() if name in numeric}
        self._mask, self._faults = options.mask_damaged, Faults()
        self._row = form.skip + 1
        self._read, self._last_filled = 0, form.skip

    def batches(self) -> Iterator[tuple[Any, NDArray[np.int64]]]:
        """Record batches, and the file rows of each.

        A damaged file gives the rows before the first damage, then the error that lists the faults.
        """
        for raw in self._pieces():
            for table, rows in self._tables(raw):
                if self._mask or not self._faults.total:
                    if rows.size:
                        self._read, self._last_filled = self._read + rows.size, int(rows[-1])
                    yield from with_rows(table.to_batches(), rows)
                elif self._faults.total > _MAX_LISTED:
                    raise self._refused()
        if self._faults.total and not self._mask:
            raise self._refused()
        if self._read == 0:
            raise refusal(self.path, "a header but no complete data row", "check that the logger wrote data")

    def events(self) -> list[Event]:
        """Faults and omissions; complete after the last chunk."""
        events = []
        if self._source.encoding != "utf-8":
            events.append(Event("encoding", 1, 1, f"read as {self._source.encoding}"))
        if self._source.cut:
            words = f"row {self._row} has no line end: it is not used"
            events.append(Event("truncated-last-line", 1, self._row, words))
        events += self._faults.events()
        lines = self._last_filled - self._form.skip
        blank = lines - self._read - sum(event.count for event in self._faults.events())
        if blank > 0:
            events.append(Event("blank-line", blank, None, "skipped"))
        return events + super().events()

    def _pieces(self) -> Iterator[bytes]:
        """Pieces of complete lines. Where blanks separate the columns, one blank is left of many."""
        pieces = self._source.pieces(self._form.skip)
        if self._form.separator != " ":
            return pieces
        return (_EDGES.sub(b"", _BLANKS.sub(b" ", raw)) for raw in pieces)

    def _tables(self, raw: bytes) -> Iterator[tuple[Any, NDArray[np.int64]]]:
        """Tables of the lines of a piece, and their file rows: all at once, else part by part, else line by line."""
        whole = self._parsed(raw)
        for part in [raw] if whole is not None else _parts(raw):
            yield whole or self._parsed(part) or self._examined(part)
            self._row += part.count(b"\n")

    def _parsed(self, raw: bytes) -> tuple[Any, NDArray[np.int64]] | None:
        """The table of some lines as PyArrow reads them. None if a line is damaged or odd."""
        import pyarrow as pa
        from pyarrow import csv

        if b"\0" in raw or raw.count(b"\r") != raw.count(b"\r\n") or (b'"' in raw and _ODD_QUOTES.search(raw)):
            return None
        form = self._form
        types = {
            name: pa.string() if name in {*form.stamps, self.label} else pa.float64() for name in self.wanted
        }
        try:
            table = csv.read_csv(
                pa.BufferReader(pa.py_buffer(raw)),
                read_options=csv.ReadOptions(
                    column_names=list(form.names), block_size=_BLOCK_BYTES, use_threads=len(raw) > _BLOCK_BYTES
                ),
                parse_options=csv.ParseOptions(delimiter=form.separator),
                convert_options=csv.ConvertOptions(
                    include_columns=list(types),
                    column_types=types,
                    null_values=list(self._empty),
                    decimal_point=form.decimal,
                    strings_can_be_null=False,
                ),
            )
        except pa.ArrowInvalid:
            return None
        lines, rows = raw.count(b"\n"), np.arange(self._row, self._row + table.num_rows, dtype=np.int64)
        if table.num_rows != lines or len(form.names) == 1:  # blank lines are counted, as an editor does
            filled = (row for row, line in enumerate(raw.split(b"\n"), self._row) if line.strip(form.blanks))
            rows = np.fromiter(filled, dtype=np.int64)
        return self._with_times(table, rows) if rows.size == table.num_rows else None

    def _with_times(self, table: Any, rows: NDArray[np.int64]) -> tuple[Any, NDArray[np.int64]] | None:
        """The table with seconds in place of time stamps; None if a cell is not a time stamp."""
        if self._clock is None:
            return table, rows
        name = next(iter(self._form.stamps))
        seconds = self._clock.convert(table.column(name), {None, *self._empty})
        if seconds is None:
            return None
        return table.set_column(table.schema.get_field_index(name), name, seconds), rows

    def _examined(self, raw: bytes) -> tuple[Any, NDArray[np.int64]]:
        """The table of the lines without damage. The others are listed as faults.

        A cell is a number, None for a missing value, text for a time stamp or a label.
        """
        import pyarrow as pa

        form, faults = self._form, self._faults
        places = {name: form.names.index(name) for name in self.wanted}
        values: dict[str, list[Any]] = {name: [] for name in places}
        rows = []
        for row, line in enumerate(raw.split(b"\n"), self._row):
            if faults.total > _MAX_LISTED and not self._mask:
                break
            if not line.strip(form.blanks):
                continue
            cells = _cells(row, line, form)
            if isinstance(cells, Fault):
                faults.add(row, cells)
                continue
            read = {
                name: _unquoted(cells[at])
                if name == self.label
                else _value(row, cells[at], form, name, self._empty)
                for name, at in places.items()
            }
            bad = [value for value in read.values() if isinstance(value, Fault)]
            for fault in bad:
                faults.add(row, fault)
            if not bad:
                rows.append(row)
                for name, value in read.items():
                    values[name].append(value)
        kinds = {name: pa.string() if name in {*form.stamps, self.label} else pa.float64() for name in places}
        table = pa.table({name: pa.array(cells, kinds[name]) for name, cells in values.items()})
        made = self._with_times(table, np.array(rows, dtype=np.int64))
        assert made is not None  # noqa: S101 - each time stamp was checked
        return made

    def _refused(self) -> DataError:
        remedy = "repair or delete these rows, or leave them out with [data] damaged_rows = 'mask'"
        return self._faults.error(self.path, remedy, [Fix("data", "damaged_rows", "mask")])


def _parts(raw: bytes) -> Iterator[bytes]:
    start = 0
    while start < len(raw):
        end = raw.find(b"\n", min(start + _PART_BYTES, len(raw)) - 1) + 1 or len(raw)
        yield raw[start:end]
        start = end


# -- line by line: slow and thorough -------------------------------------------------------------------

_MAX_LISTED = 100
"""Most faults that one message lists all. A file that has more is refused there; only a masked one is examined to its end."""
_FIRST_LISTED = 20
"""Faults listed of a file that has more: most often one cause, such as the decimal mark."""
_NUMBER = re.compile(r"[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|inf|infinity|nan)", re.IGNORECASE | re.ASCII)


class Fault(NamedTuple):
    """A fault of a row or cell: its kind, words, and more of the remedy in words and as keys of the run file."""

    kind: str
    words: str
    hint: str = ""
    fixes: tuple[Fix, ...] = ()
    column: str = ""


@dataclass
class Faults:
    """Faults of a file, added in the order of its rows: the first ones, and the number of all.

    ``kinds``: number of rows with a fault and the first row, by kind. A row counts once, by its first fault.
    """

    listed: list[Fault] = field(default_factory=list)
    total: int = 0
    kinds: dict[str, list[int]] = field(default_factory=dict)
    last_row: int = 0

    def add(self, row: int, fault: Fault) -> None:
        """Add a fault of a row."""
        if row != self.last_row:
            self.kinds.setdefault(fault.kind, [0, row])[0] += 1
            self.last_row = row
        self.total += 1
        if len(self.listed) < _MAX_LISTED:
            self.listed.append(fault)

    def error(self, path: Path, remedy: str, fixes: Sequence[Fix] = ()) -> DataError:
        """All faults, or the first of many, as one error. ``remedy`` and ``fixes`` are those of any fault."""
        many = self.total > _MAX_LISTED
        words = [fault.words for fault in self.listed[: _FIRST_LISTED if many else None]]
        first = next((fault for fault in self.listed if fault.hint), self.listed[0])
        columns = dict.fromkeys(fault.column for fault in self.listed if fault.column)
        return DataError(
            f"{path}: {'; '.join([*words, 'and more'] if many else words)}",
            remedy=f"{remedy}{first.hint}",
            where=Where(path, min(row for _, row in self.kinds.values()), tuple(columns)),
            fixes=[*first.fixes, *fixes],
        )

    def events(self) -> list[Event]:
        """Events for the rows left out, by kind."""
        return [Event(kind, count, first, "the row is not used") for kind, (count, first) in self.kinds.items()]


def _cells(row: int, line: bytes, form: TextFormat) -> list[str] | Fault:
    """The cells of a line, or the fault of its form."""
    if b"\0" in line:
        words = f"{line.count(0)} NUL bytes from byte {line.find(0)} of the row (the logger lost power?)"
        return Fault("nul-bytes", f"row {row}: {words}")
    try:
        text = line.decode("utf-8").rstrip("\r")
    except UnicodeDecodeError as error:
        words = f"row {row}: byte {error.start} of the row is not UTF-8 text"
        return Fault("bad-encoding", words, "; or add [data] encoding = '...'", (Fix("data", "encoding"),))
    if "\r" in text:
        return Fault("carriage-return", f"row {row}: a carriage return inside the line")
    cells = split_cells(text, form.separator)
    if cells is None:
        return Fault("open-quote", f"row {row}: a quotation mark is not closed")
    if len(cells) == len(form.names):
        return cells
    words = f"row {row} has {len(cells)} cell{'s' if len(cells) != 1 else ''}, the header has {len(form.names)}"
    if len(cells) < len(form.names):
        return Fault("short-row", words)
    hint = "; commas as decimal marks need another separator" if form.separator == "," else ""
    return Fault("long-row", words, hint)


def _value(row: int, cell: str, form: TextFormat, name: str, tokens: set[str]) -> float | str | Fault | None:
    """A number, the text of a time stamp, None for a missing value, or the fault of the cell."""
    cell = _unquoted(cell).strip(" \t")
    if cell in tokens:
        return None
    stamp = form.stamps.get(name)
    if stamp is None and is_number(cell, form.decimal):
        return float(cell.replace(form.decimal, "."))
    if stamp is not None and stamp.seconds(cell) is not None:
        return cell
    where = f"row {row}, column '{name}' ({column_letter(form.names.index(name))}): '{cell[:40]}' is"
    if stamp is None:
        return Fault("not-a-number", f"{where} not a number", *_cell_hint(cell, form, name), name)
    words = f"{where} not a time stamp of the form {stamp.form}"
    return Fault("not-a-time", words, *_stamp_hint(cell, name), name)


def _unquoted(cell: str) -> str:
    """A cell without blanks around it and without its quotation marks. Other control characters are damage."""
    cell = cell.strip(" \t")
    return cell[1:-1].replace('""', '"') if len(cell) > 1 and cell[0] == cell[-1] == '"' else cell


def split_cells(line: str, separator: str) -> list[str] | None:
    """Cells of a line. A quoted cell is not split. None if a quotation mark is not closed."""
    if '"' not in line:
        return line.split(separator)
    try:
        return next(csv.reader([line], delimiter=separator, strict=True))
    except csv.Error:
        return None


def is_number(cell: str, decimal: str) -> bool:
    """True if a cell holds a number in plain digits with this decimal mark."""
    if decimal != ".":
        if "." in cell:
            return False
        cell = cell.replace(decimal, ".")
    return _NUMBER.fullmatch(cell) is not None


def _stamp_hint(cell: str, name: str) -> tuple[str, tuple[Fix, ...]]:
    forms = forms_of([cell])[:1]
    words = "".join(f"; or read it with time = {{ column = '{name}', stamp = '{form}' }}" for form in forms)
    return words, tuple(Fix("data", "time", {"column": name, "stamp": form}) for form in forms)


def _cell_hint(cell: str, form: TextFormat, name: str) -> tuple[str, tuple[Fix, ...]]:
    words, fixes = _stamp_hint(cell, name)
    if words:
        return f"{words} in [data]", fixes
    if not cell.isascii() and cell.replace(".", "").replace("．", "").strip("-－+").isdecimal():
        return "; write the digits as plain 0-9 (these are full-width)", ()
    if "," in cell and "," not in (form.separator, form.decimal):
        words = "; is ',' a decimal mark ([data] decimal = ',') or a thousands separator (remove it)?"
        return words, (Fix("data", "decimal", ","),)
    if cell.replace("'", "").replace(" ", "").replace("\u00a0", "").isdecimal():
        return "; remove the thousands separators", ()
    if not cell or cell[0].isdigit():
        return "", ()
    words = f"; if '{cell[:20]}' marks a missing value, add [data] missing = ['{cell[:20]}']"
    return words, (Fix("data", "missing", [cell[:20]]),)
