"""Find every damaged row and cell of a text file, in one pass.

This is slow and thorough. It is used only if the fast reader fails, or the file has bytes that no log holds.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

from piga.errors import DataError, Fix, Where
from piga.formats.columns import column_letter
from piga.formats.text.convention import INFINITE, MISSING, TextFormat
from piga.formats.text.time_stamp import forms_of
from piga.records.calibration import Event

MAX_LISTED = 100
"""Most faults that one message lists all. A file that has more is refused there; only a masked one is examined to its end."""
FIRST_LISTED = 20
"""Faults listed of a file that has more: most often one cause, such as the decimal mark."""
Hint = tuple[str, tuple[Fix, ...]]
"""More of the remedy in words, and as keys of the run file."""
_NUMBER = re.compile(r"[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|inf|infinity|nan)", re.IGNORECASE | re.ASCII)


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

    def add(self, row: int, kind: str, words: str, hint: Hint = ("", ()), column: str = "") -> None:
        """Add a fault."""
        if row != self.last_row:
            self.kinds.setdefault(kind, [0, row])[0] += 1
            self.last_row = row
        self.total += 1
        self.first_row = self.first_row or row
        self.columns |= {column: None} if column else {}
        if len(self.listed) <= MAX_LISTED:
            self.listed.append(words)
        if not self.hint:
            self.hint, self.fixes = hint

    @property
    def words(self) -> str:
        """All faults in words, or the first of many."""
        if self.total <= MAX_LISTED:
            return "; ".join(self.listed)
        return f"{'; '.join(self.listed[:FIRST_LISTED])}; and more"

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


def find_faults(
    faults: Faults,
    raw: bytes,
    first: int,
    form: TextFormat,
    numeric: tuple[str, ...],
    missing: tuple[str, ...],
    most: int | None,
) -> list[int]:
    """Check every needed cell of some lines, the first of which is row ``first``. Stops after more than ``most`` faults.

    Adds to ``faults`` and returns the lines (0-based) with faults.
    """
    tokens = {*MISSING, *INFINITE, *missing}
    places = [(name, form.names.index(name)) for name in dict.fromkeys(numeric)]
    damaged = []
    for index, line in enumerate(raw.split(b"\n")):
        before = faults.total
        if line.strip():
            _look_at_line(faults, first + index, line, form, places, tokens)
        if faults.total > before:
            damaged.append(index)
            if most is not None and faults.total > most:
                break
    return damaged


def _look_at_line(
    faults: Faults, row: int, line: bytes, form: TextFormat, places: list[tuple[str, int]], tokens: set[str]
) -> None:
    if b"\0" in line:
        words = (
            f"row {row}: {line.count(0)} NUL bytes from byte {line.find(0)} of the row (the logger lost power?)"
        )
        faults.add(row, "nul-bytes", words)
        return
    try:
        text = line.decode("utf-8").rstrip("\r")
    except UnicodeDecodeError as error:
        words = f"row {row}: byte {error.start} of the row is not UTF-8 text"
        faults.add(row, "bad-encoding", words, ("; or add [data] encoding = '...'", (Fix("data", "encoding"),)))
        return
    if "\r" in text:
        faults.add(row, "carriage-return", f"row {row}: a carriage return inside the line")
        return
    _look_at(faults, row, text, form, places, tokens)


def _look_at(
    faults: Faults, row: int, line: str, form: TextFormat, places: list[tuple[str, int]], tokens: set[str]
) -> None:
    cells = split_cells(line, form.separator)
    if cells is None:
        faults.add(row, "open-quote", f"row {row}: a quotation mark is not closed")
        return
    if len(cells) != len(form.names):
        many = form.separator == "," and len(cells) > len(form.names)
        faults.add(
            row,
            "long-row" if len(cells) > len(form.names) else "short-row",
            f"row {row} has {len(cells)} cell{'s' if len(cells) != 1 else ''}, the header has {len(form.names)}",
            ("; commas as decimal marks need another separator" if many else "", ()),
        )
        return
    for name, column in places:
        cell = cells[column].strip().strip('"').strip()
        stamp = form.stamps.get(name)
        if cell in tokens or (
            is_number(cell, form.decimal) if stamp is None else stamp.seconds(cell) is not None
        ):
            continue
        where = f"row {row}, column '{name}' ({column_letter(column)}): '{cell[:40]}' is"
        if stamp is None:
            faults.add(row, "not-a-number", f"{where} not a number", _cell_hint(cell, form, name), name)
        else:
            words = f"{where} not a time stamp of the form {stamp.form}"
            faults.add(row, "not-a-time", words, _stamp_hint(cell, name), name)


def split_cells(line: str, separator: str) -> list[str] | None:
    """Cells of a line. A quoted cell is not split. None if a quotation mark is not closed."""
    if '"' not in line:
        return line.split(separator)
    cells, at = [], 0
    while at <= len(line):
        if line[at : at + 1] == '"':
            closing = re.compile(r'(?:[^"]|"")*"').match(line, at + 1)
            if closing is None:
                return None
            end = line.find(separator, closing.end())
        else:
            end = line.find(separator, at)
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


def _stamp_hint(cell: str, name: str) -> Hint:
    """How to read a cell that is a time stamp."""
    forms = forms_of([cell])[:1]
    words = "".join(f"; or read it with time = {{ column = '{name}', stamp = '{form}' }}" for form in forms)
    return words, tuple(Fix("data", "time", {"column": name, "stamp": form}) for form in forms)


def _cell_hint(cell: str, form: TextFormat, name: str) -> Hint:
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
    if cell and not cell[0].isdigit():
        words = f"; if '{cell[:20]}' marks a missing value, add [data] missing = ['{cell[:20]}']"
        return words, (Fix("data", "missing", [cell[:20]]),)
    return "", ()
