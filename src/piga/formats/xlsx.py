"""Read XLSX data: one sheet, cached values, every cell checked. The container is examined before it is opened."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from datetime import datetime, time, timedelta
from itertools import chain, islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from piga.errors import DataError, Fix, Where
from piga.formats.columns import (
    TableStream,
    column_letter,
    label_text,
    table_of,
)
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
from piga.results import number_column, text_column

_MOST_HEAD = 100
"""Rows of a sheet within which the column names must stand."""
_FORMULA = re.compile(rb"<f[ />]")
_HIDDEN = re.compile(rb"<row\b[^>]*\bhidden=\"(?:1|true)\"")


def read_xlsx(
    path: Path,
    numeric: tuple[str, ...],
    label: str | None,
    sheet: str | None = None,
    missing: tuple[str, ...] = (),
) -> TableStream:
    """Read the named columns of a sheet. The names stand in the first row that holds all of them. Dates become seconds.

    Parameters
    ----------
    path:
        The file.
    numeric, label:
        Names of the number columns and of the segment column.
    sheet:
        Name of the sheet; may be None if there is only one.
    missing:
        Further words that mean a missing value.

    Raises
    ------
    DataError
        If its unpacked size is too large, the sheet is ambiguous, or cells are not numbers. The message names row and
        column letter of up to 100 cells.
    """
    import openpyxl

    with open_regular(path) as stream:
        events = _formulas_and_hidden_rows(path, stream)
        book = openpyxl.load_workbook(stream, read_only=True, data_only=True, keep_links=False)
        rows = _sheet(path, book, sheet).iter_rows(values_only=True)
        return _Sheet(path, numeric, label, events, missing).read(rows)


def _formulas_and_hidden_rows(path: Path, stream: Any) -> list[Event]:
    """Count the formulas and hidden rows of all sheets. The size that a part declares is never exceeded by :mod:`zipfile`."""
    formulas, hidden = 0, 0
    with zipfile.ZipFile(stream) as container:
        parts = container.infolist()
        check_unpacked(path, sum(part.file_size for part in parts), path.stat().st_size)
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


def _sheet(path: Path, book: Any, name: str | None) -> Any:
    """The requested sheet, or the only one."""
    sheets = {sheet.title: sheet for sheet in book.worksheets}
    listed = ", ".join(f"'{title}'" for title in list(sheets)[:20])
    fixes = [Fix("data", "sheet", title) for title in sheets]
    if name is None and len(sheets) > 1:
        raise DataError(
            f"{path}: there are {len(sheets)} sheets: {listed}",
            remedy="add [data] sheet = '...' with one of them",
            fixes=fixes,
        )
    if not sheets or (name is not None and name not in sheets):
        raise DataError(
            f"{path}: no sheet '{name}'; the sheets are: {listed}", remedy="correct [data] sheet", fixes=fixes
        )
    sheet = sheets[name] if name is not None else next(iter(sheets.values()))
    sheet.reset_dimensions()
    return sheet


def _texts(row: tuple[Any, ...]) -> tuple[str, ...]:
    """The cells of a row as text."""
    return tuple("" if cell is None else str(cell).strip() for cell in row)


class _Sheet:
    """Converts rows of a sheet to columns. Bad cells are collected and reported together."""

    def __init__(
        self,
        path: Path,
        numeric: tuple[str, ...],
        label: str | None,
        events: list[Event],
        missing: tuple[str, ...],
    ) -> None:
        self.empty = {*MISSING, *INFINITE, *missing}
        self.path, self.numeric, self.label, self.events = path, tuple(dict.fromkeys(numeric)), label, events
        self.faults = Faults()
        self.values: dict[str, list[float]] = {name: [] for name in self.numeric}
        self.labels: list[object] = []
        self.numbers: list[int] = []
        self.first_day: datetime | None = None

    def read(self, rows: Iterator[tuple[Any, ...]]) -> TableStream:
        filled = ((at, row) for at, row in enumerate(rows, 1) if any(cell is not None for cell in row))
        head = list(islice(filled, _MOST_HEAD))
        if not head:
            raise DataError(f"{self.path}: the sheet is empty", remedy="check [data] sheet")
        at, header = self._header(head)
        names = header
        if all(not isinstance(cell, str) for cell in dict(head)[at] if cell is not None):
            raise DataError(
                f"{self.path}: row {at}: the first row holds numbers, not column names",
                remedy="add a row with the column names above the numbers",
            )
        names, units = units_in_names(single_names(names))
        wanted = [*self.numeric, *([] if self.label is None else [self.label])]
        check_present(self.path, at, wanted, names)
        where = {name: names.index(name) for name in wanted}
        body = [entry for entry in head if entry[0] > at]
        if body and is_units_row([*_texts(body[0][1])], [*_texts(body[1][1])] if len(body) > 1 else None):
            written = zip(names, _texts(body.pop(0)[1]), strict=False)
            units |= {
                name: unit_text(cell) for name, cell in written if name and unit_text(cell) not in NO_UNIT
            }
        for number, row in chain(body, filled):
            self.numbers.append(number)
            for name in self.numeric:
                self.values[name].append(self._number(row, where[name], name, number))
            if self.label is not None:
                self.labels.append(row[where[self.label]] if where[self.label] < len(row) else None)
        return self._table(units)

    def _header(self, head: list[tuple[int, tuple[Any, ...]]]) -> tuple[int, tuple[str, ...]]:
        """Row of the column names, and the names: the first row, or two rows, that hold all wanted names.

        Else the row that looks most like it.
        """
        wanted = {*self.numeric, *([self.label] if self.label else [])}
        single = [(at, _texts(row)) for at, row in head]
        double = [(at, joined_names(above, names)) for (_, above), (at, names) in pairwise(single)]
        for at, names in (*single, *double):
            if wanted <= {*names, *units_in_names(names)[0]}:
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

    def _number(self, row: tuple[Any, ...], place: int, name: str, number: int) -> float:
        cell = row[place] if place < len(row) else None
        if isinstance(cell, (int, float)) and not isinstance(cell, bool):
            return float(cell)
        if isinstance(cell, (datetime, time, timedelta)):
            return self._seconds(cell)
        text = "" if cell is None else str(cell).strip()
        if cell is None or (isinstance(cell, str) and text in self.empty):
            return float("nan")
        with suppress(ValueError):  # a date and a time as text
            return self._seconds(datetime.fromisoformat(text if ":" in text else ""))
        kind = "text" if isinstance(cell, str) else type(cell).__name__
        where = f"row {number}, column '{name}' ({column_letter(place)})"
        words = f"{where}: '{text[:40]}' is {kind}, not a number"
        words_only = isinstance(cell, str) and not text[0].isdigit()
        hint, fixes = missing_hint(text) if words_only else ("", ())
        self.faults.add(number, Fault("not-a-number", words, hint, fixes, column=name))
        return float("nan")

    def _seconds(self, cell: datetime | time | timedelta) -> float:
        """Seconds since the midnight before the first date, or of a time of day or duration."""
        if isinstance(cell, timedelta):
            return cell.total_seconds()
        if isinstance(cell, time):
            return cell.hour * 3600.0 + cell.minute * 60.0 + cell.second + cell.microsecond * 1e-6
        if self.first_day is None:
            self.first_day = cell.replace(hour=0, minute=0, second=0, microsecond=0)
        return (cell - self.first_day).total_seconds()

    def _table(self, units: dict[str, str]) -> TableStream:
        if self.faults.total:
            raise DataError(
                f"{self.path}: {self.faults.words}",
                remedy=f"set the format of these cells to number and enter them again; dates: export seconds{self.faults.hint}",
                where=Where(self.path, self.faults.first_row, tuple(self.faults.columns)),
                fixes=self.faults.fixes,
            )
        if not self.numbers:
            raise DataError(f"{self.path}: a header but no data", remedy="check that the logger wrote data")
        arrays = {name: number_column(np.array(cells), empty_cells=True) for name, cells in self.values.items()}
        if self.label is not None and self.label not in arrays:
            arrays[self.label] = text_column([label_text(cell) for cell in self.labels])
        return TableStream(
            self.path,
            table_of(arrays, units),
            self.numeric,
            self.label,
            rows=np.array(self.numbers),
            noted=self.events,
        )
