"""Read lines of a text file one by one, and name every damaged row and cell.

This is slow and thorough. It is used for a part of a file that PyArrow does not read.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from piga.errors import DataError, Fix, Where
from piga.formats.columns import column_letter
from piga.formats.text.convention import INFINITE, MISSING, TextFormat
from piga.formats.text.time_stamp import forms_of
from piga.records.calibration import Event

MAX_LISTED = 100
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
    """Faults of a file, added piece by piece.

    Attributes
    ----------
    listed, total:
        The first faults in words, and the number of all.
    kinds:
        Number of rows with a fault and the first row, by kind. A row counts once, by its first fault.
    hint, fixes:
        What else can be done: in words, and as keys of the run file.
    first_row, columns:
        Row of the first fault, and the columns with a faulty cell.
    """

    listed: list[str] = field(default_factory=list)
    total: int = 0
    kinds: dict[str, list[int]] = field(default_factory=dict)
    hint: str = ""
    fixes: tuple[Fix, ...] = ()
    first_row: int | None = None
    columns: dict[str, None] = field(default_factory=dict)
    last_row: int = 0

    def add(self, row: int, fault: Fault) -> None:
        """Add a fault of a row."""
        if row != self.last_row:
            self.kinds.setdefault(fault.kind, [0, row])[0] += 1
            self.last_row = row
        self.total += 1
        self.first_row = self.first_row or row
        self.columns |= {fault.column: None} if fault.column else {}
        if len(self.listed) <= MAX_LISTED:
            self.listed.append(fault.words)
        if not self.hint:
            self.hint, self.fixes = fault.hint, fault.fixes

    @property
    def words(self) -> str:
        """All faults in words, or the first of many."""
        if self.total <= MAX_LISTED:
            return "; ".join(self.listed)
        return f"{'; '.join(self.listed[:_FIRST_LISTED])}; and more"

    def error(self, path: Path) -> DataError:
        """All faults as one error."""
        return DataError(
            f"{path}: {self.words}",
            remedy=f"repair or delete these rows, or leave them out with [data] damaged_rows = 'mask'{self.hint}",
            where=Where(path, self.first_row, tuple(self.columns)),
            fixes=[*self.fixes, Fix("data", "damaged_rows", "mask")],
        )

    def events(self) -> list[Event]:
        """Events for the rows left out, by kind."""
        return [Event(kind, count, first, "the row is not used") for kind, (count, first) in self.kinds.items()]

    @property
    def rows(self) -> int:
        """Rows with a fault."""
        return sum(count for count, _ in self.kinds.values())


def read_lines(
    faults: Faults,
    raw: bytes,
    first: int,
    form: TextFormat,
    numeric: tuple[str, ...],
    label: str | None,
    missing: tuple[str, ...],
    most: int | None,
) -> tuple[dict[str, list[Any]], list[int]]:
    """Read the needed cells of some lines, the first of which is row ``first``. Stops after more than ``most`` faults.

    Adds to ``faults``. Returns the cells of the good lines by column, and the rows of these lines. A cell is a number, None
    for a missing value, text for a time stamp or a label.
    """
    tokens = {*MISSING, *INFINITE, *missing}
    places = {name: form.names.index(name) for name in numeric if name != label}
    values: dict[str, list[Any]] = {name: [] for name in [*places, *([] if label is None else [label])]}
    rows = []
    for row, line in enumerate(raw.split(b"\n"), start=first):
        if most is not None and faults.total > most:
            break
        if not line.strip(form.blanks):
            continue
        cells = _cells(row, line, form)
        if isinstance(cells, Fault):
            faults.add(row, cells)
            continue
        read: dict[str, Any] = {name: _value(row, cells[at], form, name, tokens) for name, at in places.items()}
        bad = [value for value in read.values() if isinstance(value, Fault)]
        for fault in bad:
            faults.add(row, fault)
        if bad:
            continue
        if label is not None:
            read[label] = _unquoted(cells[form.names.index(label)])
        rows.append(row)
        for name, value in read.items():
            values[name].append(value)
    return values, rows


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
    return Fault(
        "long-row", words, "; commas as decimal marks need another separator" if form.separator == "," else ""
    )


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
    cells, at = [], 0
    while at <= len(line):
        end = at
        if line[at : at + 1] == '"':
            closing = re.compile(r'(?:[^"]|"")*"').match(line, at + 1)
            if closing is None:
                return None
            end = closing.end()
        end = line.find(separator, end)
        end = len(line) if end < 0 else end
        cells.append(line[at:end])
        at = end + 1
    return cells


def is_number(cell: str, decimal: str) -> bool:
    """True if a cell holds a number in plain digits with this decimal mark."""
    if decimal != ".":
        if "." in cell:
            return False
        cell = cell.replace(decimal, ".")
    return _NUMBER.fullmatch(cell) is not None


def _stamp_hint(cell: str, name: str) -> tuple[str, tuple[Fix, ...]]:
    """How to read a cell that is a time stamp."""
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
    return missing_hint(cell) if cell and not cell[0].isdigit() else ("", ())


def missing_hint(word: str) -> tuple[str, tuple[Fix, ...]]:
    """What to do with a word among numbers, in words and as a key of the run file."""
    words = f"; if '{word[:20]}' marks a missing value, add [data] missing = ['{word[:20]}']"
    return words, (Fix("data", "missing", [word[:20]]),)
