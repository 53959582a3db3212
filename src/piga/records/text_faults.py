"""Where a text file is damaged: every row and cell that cannot be read, found in one pass.

Slow and thorough; used only when the fast reader has complained, or bytes are there that no log holds.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from piga.errors import DataError
from piga.records.calibration import Event
from piga.records.table import column_letter
from piga.records.text_format import INFINITE, MISSING, TextFormat

MAX_LISTED = 100
"""Faults listed in one message; the rest is counted."""


@dataclass
class Faults:
    """``rows``: file rows that cannot be used, with the kind of fault; ``listed``: in words."""

    rows: dict[int, str] = field(default_factory=dict)
    listed: list[str] = field(default_factory=list)
    total: int = 0
    hint: str = ""

    def add(self, row: int, kind: str, words: str, hint: str = "") -> None:
        """One more fault."""
        self.rows.setdefault(row, kind)
        self.total += 1
        if len(self.listed) < MAX_LISTED:
            self.listed.append(words)
        self.hint = self.hint or hint

    def error(self, path: Path) -> DataError:
        """All of it as one error."""
        more = f"; and {self.total - len(self.listed)} more" if self.total > len(self.listed) else ""
        return DataError(
            f"{path}: {'; '.join(self.listed)}{more}",
            remedy=f"repair or delete these rows, or leave them out with [data] damaged_rows = 'mask'{self.hint}",
        )

    def events(self) -> list[Event]:
        """Rows left out, counted by kind."""
        counts = Counter(self.rows.values())
        first = {kind: min(row for row, k in self.rows.items() if k == kind) for kind in counts}
        return [Event(kind, count, first[kind], "the row is not used") for kind, count in counts.items()]


def find_faults(
    raw: bytes, form: TextFormat, numeric: tuple[str, ...], missing: tuple[str, ...] = ()
) -> Faults:
    """Look at every cell that is needed."""
    found = Faults()
    tokens = {*MISSING, *INFINITE, *missing}
    places = [(name, form.names.index(name)) for name in dict.fromkeys(numeric)]
    for row, line in enumerate(raw.split(b"\n"), start=1):
        if row <= form.skip or not line.strip():
            continue
        if b"\0" in line:
            offset = sum(len(part) + 1 for part in raw.split(b"\n", row - 1)[: row - 1]) + line.find(b"\0")
            words = f"row {row}: {line.count(0)} NUL bytes from byte {offset} (the logger lost power?)"
            found.add(row, "nul-bytes", words)
            continue
        try:
            text = line.decode("utf-8")
        except UnicodeDecodeError as error:
            words = f"row {row}: byte {error.start} of the row is no UTF-8 text"
            found.add(row, "bad-encoding", words, "; or add [data] encoding = '...'")
            continue
        _look_at(found, row, text.rstrip("\r"), form, places, tokens)
    return found


def _look_at(
    found: Faults, row: int, line: str, form: TextFormat, places: list[tuple[str, int]], tokens: set[str]
) -> None:
    cells = line.split(form.separator)
    if len(cells) != len(form.names):
        many = form.separator == "," and len(cells) > len(form.names)
        found.add(
            row,
            "long-row" if len(cells) > len(form.names) else "short-row",
            f"row {row} has {len(cells)} cells, the header has {len(form.names)}",
            "; commas as decimal marks need another separator" if many else "",
        )
        return
    for name, column in places:
        cell = cells[column].strip().strip('"').strip()
        if cell in tokens or is_number(cell, form.decimal):
            continue
        words = f"row {row}, column '{name}' ({column_letter(column)}): '{cell[:40]}' is not a number"
        found.add(row, "not-a-number", words, _cell_hint(cell, form))


def is_number(cell: str, decimal: str) -> bool:
    """Whether a cell holds a number in plain digits with this decimal mark."""
    if not cell.isascii() or "_" in cell or (decimal == "," and "." in cell):
        return False
    try:
        float(cell.replace(decimal, ".") if decimal != "." else cell)
    except ValueError:
        return False
    return True


def _cell_hint(cell: str, form: TextFormat) -> str:
    if not cell.isascii() and cell.replace(".", "").replace("．", "").strip("-－+").isdecimal():
        return "; write the digits as plain 0-9 (these are full-width)"
    if "," in cell and "," not in (form.separator, form.decimal):
        return "; is ',' a decimal mark ([data] decimal = ',') or a thousands separator (remove it)?"
    if cell.replace("'", "").replace(" ", "").replace("\u00a0", "").isdecimal():
        return "; remove the thousands separators"
    if cell and not cell[0].isdigit():
        return f"; if '{cell[:20]}' marks a missing value, add [data] missing = ['{cell[:20]}']"
    return ""
