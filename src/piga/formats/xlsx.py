"""Read XLSX data: one sheet, cached values, every cell checked. The container is examined before it is opened."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from datetime import datetime, time, timedelta
from itertools import chain, islice, pairwise
from typing import Any

import numpy as np

from piga.errors import Fix
from piga.formats.columns import TableStream, Wanted, column_letter
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
from piga.records.limits import open_regular

_MOST_HEAD = 100
"""Rows of a sheet within which the column names must stand."""
_FORMULA = re.compile(rb"<f[ />]")
_HIDDEN = re.compile(rb"<row\b[^>]*\bhidden=\"(?:1|true)\"")


def read_xlsx(wanted: Wanted) -> TableStream:
    """Read the named columns of a sheet. The names stand in the first row that holds all of them. Dates become seconds.

    Raises
    ------
    DataError
        If its unpacked size is too large, the sheet is ambiguous, or cells are not numbers. The message names row and
        column letter of up to 100 cells.
    """
    import openpyxl

    with open_regular(wanted.path) as stream:
        events = _formulas_and_hidden_rows(wanted, stream)
        book = openpyxl.load_workbook(stream, read_only=True, data_only=True, keep_links=False)
        rows = enumerate(_sheet(wanted, book).iter_rows(values_only=True), 1)
        return _read_rows(
            wanted, ((at, row) for at, row in rows if any(cell is not None for cell in row)), events
        )


def _formulas_and_hidden_rows(wanted: Wanted, stream: Any) -> list[Event]:
    """Count the formulas and hidden rows of all sheets. The size that a part declares is never exceeded by :mod:`zipfile`."""
    formulas, hidden = 0, 0
    with zipfile.ZipFile(stream) as container:
        parts = container.infolist()
        wanted.check_unpacked(sum(part.file_size for part in parts))
        for part in (one for one in parts if one.filename.startswith("xl/worksheets/")):
            text = container.read(part)
            formulas += len(_FORMULA.findall(text))
            hidden += len(_HIDDEN.findall(text))
    stream.seek(0)
    events = []
    if formulas:
        events.append(Event("formula", formulas, None, "the value last computed is used"))
    if hidden:
        events.append(Event("hidden-row", hidden, None, "used like the others"))
    return events


def _sheet(wanted: Wanted, book: Any) -> Any:
    """The requested sheet, or the only one."""
    sheets, name = {sheet.title: sheet for sheet in book.worksheets}, wanted.sheet
    listed = ", ".join(f"'{title}'" for title in list(sheets)[:20])
    fixes = [Fix("data", "sheet", title) for title in sheets]
    if name is None and len(sheets) > 1:
        remedy = "add [data] sheet = '...' with one of them"
        raise wanted.refusal(f"there are {len(sheets)} sheets: {listed}", remedy, fixes=fixes)
    if not sheets or (name is not None and name not in sheets):
        words = f"no sheet '{name}'; the sheets are: {listed}"
        raise wanted.refusal(words, "correct [data] sheet", fixes=fixes)
    sheet = sheets[name] if name is not None else next(iter(sheets.values()))
    sheet.reset_dimensions()
    return sheet


def _texts(row: tuple[Any, ...]) -> tuple[str, ...]:
    """The cells of a row as text."""
    return tuple("" if cell is None else str(cell).strip() for cell in row)


_Row = tuple[int, tuple[Any, ...]]
"""Number and cells of a row."""


def _read_rows(wanted: Wanted, filled: Iterator[_Row], events: list[Event]) -> TableStream:
    """The columns of the rows of a sheet. Bad cells are collected and reported together."""
    head = list(islice(filled, _MOST_HEAD))
    if not head:
        raise wanted.refusal("the sheet is empty", "check [data] sheet")
    at, header = _header(wanted, head)
    if all(not isinstance(cell, str) for cell in dict(head)[at] if cell is not None):
        remedy = "add a row with the column names above the numbers"
        raise wanted.refusal("the first row holds numbers, not column names", remedy, row=at)
    names, units = units_in_names(single_names(header))
    check_present(wanted.path, at, wanted.names, names)
    body = [entry for entry in head if entry[0] > at]
    if body and is_units_row([*_texts(body[0][1])], [*_texts(body[1][1])] if len(body) > 1 else None):
        written = zip(names, _texts(body.pop(0)[1]), strict=False)
        units |= {name: unit_text(cell) for name, cell in written if name and unit_text(cell) not in NO_UNIT}
    cells, faults = _Cells({*MISSING, *INFINITE, *wanted.missing}), Faults()
    numbers: list[int] = []
    places = {name: names.index(name) for name in wanted.names}
    columns: dict[str, list[Any]] = {name: [] for name in places}
    for number, row in chain(body, filled):
        numbers.append(number)
        for name, values in columns.items():
            place = places[name]
            value = row[place] if place < len(row) else None
            if name in wanted.numeric:
                value = cells.number(value)
                if isinstance(value, Fault):
                    where = f"row {number}, column '{name}' ({column_letter(place)}): "
                    faults.add(number, value._replace(words=where + value.words, column=name))
            values.append(value)
    if faults.total:
        remedy = "set the format of these cells to number and enter them again; dates: export seconds"
        raise faults.error(wanted.path, remedy)
    if not numbers:
        raise wanted.refusal("a header but no data", "check that the logger wrote data")
    kinds = {name: float if name in wanted.numeric else object for name in columns}
    return wanted.table(
        lambda name: np.array(columns[name], kinds[name]), units, np.array(numbers), events, empty_cells=True
    )


def _header(wanted: Wanted, head: list[_Row]) -> tuple[int, tuple[str, ...]]:
    """Row of the column names, and the names: the first row, or two rows, that hold all wanted names.

    Else the row that looks most like it.
    """
    single = [(at, _texts(row)) for at, row in head]
    double = [(at, joined_names(above, names)) for (_, above), (at, names) in pairwise(single)]
    for at, names in (*single, *double):
        if set(wanted.names) <= {*names, *units_in_names(names)[0]}:
            return at, names
    words = [sum(isinstance(cell, str) for cell in row) for _, row in head]
    numbers = [sum(isinstance(cell, (int, float)) for cell in row) for _, row in head]
    begin = next((k for k, count in enumerate(numbers) if count > 1), 0)
    wide = [k for k in range(begin) if words[k] > 1 and 2 * words[k] >= max(words[:begin])]
    if wide and len(wide) > 1 and is_units_row([*_texts(head[wide[-1]][1])], [*_texts(head[begin][1])]):
        wide.pop()
    place = wide[-1] if wide else 0
    names = single[place][1]
    each = words[place - 1] == len(single[place - 1][1]) == len(names)
    if place - 1 in wide and (len(set(names)) < len(names) or "" in names or each):  # names over two rows
        return double[place - 1]
    return single[place]


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
