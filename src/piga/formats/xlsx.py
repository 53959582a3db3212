"""Read XLSX data: one sheet, cached values, every cell checked. The container is examined before it is opened."""

from __future__ import annotations

import re
import zipfile
from contextlib import suppress
from datetime import datetime, time, timedelta
from itertools import pairwise
from typing import Any

import numpy as np

from piga.errors import Fix
from piga.formats.columns import Container, column_letter
from piga.formats.text.convention import (
    INFINITE,
    MISSING,
    NO_UNIT,
    check_present,
    is_units_row,
    joined_names,
    single_names,
    unit_text,
    units_in_names,
)
from piga.formats.text.reader import Fault, Faults, missing_hint
from piga.records.calibration import Event
from piga.records.limits import check_unpacked, open_regular

_MOST_HEAD = 100
"""Rows of a sheet within which the column names must stand."""
_NOTED = {
    "formula": (re.compile(rb"<f[ />]"), "the value last computed is used"),
    "hidden-row": (re.compile(rb"<row\b[^>]*\bhidden=\"(?:1|true)\""), "used like the others"),
}
"""What is counted in all sheets, and what is done with it."""
_Row = tuple[int, tuple[Any, ...]]
"""Number and cells of a row."""


class Xlsx(Container):
    """The named columns of a sheet. The names stand in the first row that holds all of them. Dates become seconds."""

    name, remedy = "XLSX", "save it again as .xlsx, without a password"

    def read(self) -> None:
        """Read the sheet."""
        if self.path.with_name(f"~${self.path.name}").exists():
            raise self.refusal("is open in a spreadsheet program", "close it there, then try again")
        import openpyxl

        with open_regular(self.path) as stream:
            noted = self._noted(stream)
            book = openpyxl.load_workbook(stream, read_only=True, data_only=True, keep_links=False)
            rows = enumerate(self._sheet(book).iter_rows(values_only=True), 1)
            self._read_rows([(at, row) for at, row in rows if any(cell is not None for cell in row)])
        self.noted = noted

    def _noted(self, stream: Any) -> list[Event]:
        """Formulas and hidden rows. The size that a part declares is never exceeded by :mod:`zipfile`."""
        with zipfile.ZipFile(stream) as container:
            parts = container.infolist()
            check_unpacked(self.path, sum(part.file_size for part in parts))
            sheets = [container.read(one) for one in parts if one.filename.startswith("xl/worksheets/")]
        stream.seek(0)
        counts = {kind: sum(len(mark.findall(one)) for one in sheets) for kind, (mark, _) in _NOTED.items()}
        return [Event(kind, count, None, _NOTED[kind][1]) for kind, count in counts.items() if count]

    def _sheet(self, book: Any) -> Any:
        """The requested sheet, or the only one."""
        sheets, name = {sheet.title: sheet for sheet in book.worksheets}, self.sheet
        listed = ", ".join(f"'{title}'" for title in list(sheets)[:20])
        fixes = [Fix("data", "sheet", title) for title in sheets]
        if name is None and len(sheets) > 1:
            remedy = "add [data] sheet = '...' with one of them"
            raise self.refusal(f"there are {len(sheets)} sheets: {listed}", remedy, fixes=fixes)
        if not sheets or (name is not None and name not in sheets):
            words = f"no sheet '{name}'; the sheets are: {listed}"
            raise self.refusal(words, "correct [data] sheet", fixes=fixes)
        sheet = sheets[name] if name is not None else next(iter(sheets.values()))
        sheet.reset_dimensions()
        return sheet

    def _read_rows(self, rows: list[_Row]) -> None:
        """The columns of the rows of a sheet. Bad cells are collected and reported together."""
        if not rows:
            raise self.refusal("the sheet is empty", "check [data] sheet")
        place, header = self._header(rows[:_MOST_HEAD])
        at, row = rows[place]
        if all(not isinstance(cell, str) for cell in row if cell is not None):
            remedy = "add a row with the column names above the numbers"
            raise self.refusal("the first row holds numbers, not column names", remedy, row=at)
        names, units = units_in_names(single_names(header))
        check_present(self.path, at, self.wanted, names)
        following = [[*_texts(row)] for _, row in rows[place + 1 : place + 3]]
        body = rows[place + 1 :]
        if following and is_units_row(following[0], *following[1:]):
            body, written = body[1:], zip(names, map(unit_text, following[0]), strict=False)
            units |= {name: unit for name, unit in written if name and unit not in NO_UNIT}
        columns = self._cells(body, {name: names.index(name) for name in self.wanted})
        if not body:
            raise self.refusal("a header but no data", "check that the logger wrote data")
        self.take(columns.__getitem__, units)
        self.rows = np.array([number for number, _ in body])
        for name in self.numeric:  # an empty cell is a missing value
            empty = np.flatnonzero(np.isnan(columns[name]))
            if empty.size:
                self._missing[name] = empty.size, int(self.rows[empty[0]])

    def _cells(self, body: list[_Row], places: dict[str, int]) -> dict[str, Any]:
        """The cells of the columns at these places; numbers of the number columns."""
        cells, faults = _Cells({*MISSING, *INFINITE, *self.missing}), Faults()
        columns: dict[str, list[Any]] = {name: [] for name in places}
        for number, row in body:
            for name, place in places.items():
                value = row[place] if place < len(row) else None
                value = cells.number(value) if name in self.numeric else value
                if isinstance(value, Fault):
                    where = f"row {number}, column '{name}' ({column_letter(place)}): "
                    faults.add(number, value._replace(words=where + value.words, column=name))
                columns[name].append(value)
        if faults.total:
            remedy = "set the format of these cells to number and enter them again; dates: export seconds"
            raise faults.error(self.path, remedy)
        return {
            name: np.array(cells, float if name in self.numeric else object) for name, cells in columns.items()
        }

    def _header(self, head: list[_Row]) -> tuple[int, tuple[str, ...]]:
        """Index of the row of the column names, and the names: the first row, or two rows, that hold all wanted names.

        Else the row that looks most like it.
        """
        single = [_texts(row) for _, row in head]
        double = [joined_names(above, names) for above, names in pairwise(single)]
        for place, names in (*enumerate(single), *enumerate(double, 1)):
            if set(self.wanted) <= {*names, *units_in_names(names)[0]}:
                return place, names
        words = [sum(isinstance(cell, str) for cell in row) for _, row in head]
        numbers = [sum(isinstance(cell, (int, float)) for cell in row) for _, row in head]
        begin = next((k for k, count in enumerate(numbers) if count > 1), 0)
        wide = [k for k in range(begin) if words[k] > 1 and 2 * words[k] >= max(words[:begin])]
        if len(wide) > 1 and is_units_row([*single[wide[-1]]], [*single[begin]]):
            wide.pop()
        place = wide[-1] if wide else 0
        names = single[place]
        each = words[place - 1] == len(single[place - 1]) == len(names)
        if place - 1 in wide and (len(set(names)) < len(names) or "" in names or each):  # names over two rows
            return place, double[place - 1]
        return place, names


def _texts(row: tuple[Any, ...]) -> tuple[str, ...]:
    """The cells of a row as text."""
    return tuple("" if cell is None else str(cell).strip() for cell in row)


class _Cells:
    """Converts cells to numbers. Times are seconds since the midnight before the first date, or of a time of day or duration."""

    def __init__(self, empty: set[str]) -> None:
        self._empty = empty
        self._first_day: datetime | None = None

    def number(self, cell: Any) -> float | Fault:
        """The number, nan for an empty cell, or the fault of the cell."""
        if isinstance(cell, (int, float)) and not isinstance(cell, bool):
            return float(cell)
        if isinstance(cell, (datetime, time, timedelta)):
            return self._seconds(cell)
        text = "" if cell is None else str(cell).strip()
        if cell is None or (isinstance(cell, str) and text in self._empty):
            return float("nan")
        with suppress(ValueError):  # a date and a time as text
            return self._seconds(datetime.fromisoformat(text if ":" in text else ""))
        word = isinstance(cell, str)
        words = f"'{text[:40]}' is {'text' if word else type(cell).__name__}, not a number"
        hint, fixes = missing_hint(text) if word and not text[0].isdigit() else ("", ())
        return Fault("not-a-number", words, hint, fixes)

    def _seconds(self, cell: datetime | time | timedelta) -> float:
        if isinstance(cell, timedelta):
            return cell.total_seconds()
        if isinstance(cell, time):
            return cell.hour * 3600.0 + cell.minute * 60.0 + cell.second + cell.microsecond * 1e-6
        if self._first_day is None:
            self._first_day = cell.replace(hour=0, minute=0, second=0, microsecond=0)
        return (cell - self._first_day).total_seconds()
