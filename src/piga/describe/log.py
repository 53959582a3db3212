"""Describe a log: its layout and the content of every column. Only the log is needed."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.describe.columns import (
    TOLD,
    ColumnGuess,
    as_told,
    guess_columns,
    kind_of_name,
    known_names,
    without_fills,
    without_spikes,
)
from piga.describe.layout import Guess, TextLayout, text_layout
from piga.errors import DataError, PigaError
from piga.formats.columns import RecordStream
from piga.formats.text.convention import HeadRows, units_in_names
from piga.formats.text.reader import TextStream, is_number
from piga.formats.text.time_stamp import forms_of
from piga.reading.columns import TEXT_SUFFIXES, columns_stream, file_kind, open_stream
from piga.records.run_file import DataTable, OutputColumn
from piga.results import Array

_MOST_LOG_ROWS = 2_000_000
"""Rows of a log whose values are examined."""


_NO_COLUMN = "\N{REPLACEMENT CHARACTER}"
"""A column that no file has: the refusal lists the columns that there are."""


@dataclass(frozen=True)
class LogDescription:
    """What a log holds, as guessed.

    Attributes
    ----------
    path:
        The log.
    layout:
        Layout of a text file; None for other formats.
    columns:
        The columns in order, each with kind, unit, reason and alternatives.
    facts:
        Keys of the run file that the preamble gives, such as ``instrument.serial``.
    numbers:
        Values of the number columns, at most :data:`_MOST_LOG_ROWS` of each.
    labels:
        Segment label of each of these rows, as an index into ``label_names``; None without a segment column.
    fills:
        Number that marks missing values, by column. It is nan in ``numbers``.
    spikes:
        The same where good values of the column pass this number: the number, and the first and last row of each spike.
    rows:
        Row of the file of each of these values (text files).
    """

    path: Path
    layout: TextLayout | None
    columns: tuple[ColumnGuess, ...]
    facts: dict[str, Guess] = field(default_factory=dict)
    numbers: dict[str, Array] = field(default_factory=dict)
    labels: NDArray[np.int32] | None = None
    label_names: tuple[str, ...] = ()
    fills: dict[str, float] = field(default_factory=dict)
    spikes: dict[str, tuple[float, tuple[tuple[int, int], ...]]] = field(default_factory=dict)
    rows: NDArray[np.int64] | None = None

    def of(self, kind: str) -> list[ColumnGuess]:
        """Columns of a kind, by axis; those that the user named come first."""
        return sorted(
            (c for c in self.columns if c.kind == kind),
            key=lambda c: (-1 if c.axis is None else c.axis, not c.reason.startswith(TOLD)),
        )


def describe_log(path: str | Path, told: Mapping[str, str] | None = None) -> LogDescription:
    """Describe a log: encoding, preamble, header, units, separator, decimal mark, time stamps, and every column.

    Parameters
    ----------
    path:
        The log, in any format that :func:`piga.reading.columns.open_stream` reads.
    told:
        What some columns hold, by name: ``{"CH3": "angle [deg]"}``. The others are guessed.
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(
            f"{path}: no such file, or it is a folder, a pipe or a device", remedy="name the log of the test"
        )
    if file_kind(path) in TEXT_SUFFIXES:
        return _describe_text(path, told or {})
    return _describe_container(path, told or {})


def _describe_text(path: Path, told: Mapping[str, str]) -> LogDescription:
    layout = text_layout(path)
    numeric = tuple(
        name for name, cells in layout.sample.items() if _mostly_numbers(cells, layout.decimal.value)
    )
    label = _label_column(layout.names, layout.sample, told)
    stamp = next(
        (
            (name, forms_of(cells[:50])[0])
            for name, cells in layout.sample.items()
            if name not in numeric and forms_of(cells[:50])
        ),
        None,
    )
    read = tuple(name for name in (*numeric, *(stamp or ())[:1]) if name != label)
    stream = TextStream(
        path,
        read,
        label,
        separator=layout.separator.value,
        decimal=layout.decimal.value,
        encoding=layout.encoding.value,
        rows=HeadRows(layout.skip_rows, layout.header_row.value, layout.units_row.value),
        mask_damaged=True,
        stamp=stamp,
    )
    numbers, codes, rows = _collected(stream, read)
    if label in numeric and codes is not None:
        numbers[label] = _label_numbers(stream.label_names, layout.decimal.value)[codes]
    fills = without_fills(numbers, numeric)
    spikes = without_spikes(numbers, numeric, rows)
    valued = {name: numbers[name] for name in numeric}
    columns = as_told(guess_columns(layout.names, layout.units, layout.sample, valued), told, valued)
    return LogDescription(
        path,
        layout,
        tuple(columns),
        layout.facts,
        numbers,
        codes if label else None,
        tuple(stream.label_names),
        fills,
        spikes,
        rows,
    )


_MOST_WORDS = 0.2
"""Largest share of cells with words in a column of numbers."""


def _mostly_numbers(cells: list[str], decimal: str) -> bool:
    """True for a column of numbers, in which some cells may hold a word for a missing value."""
    words = sum(not is_number(cell, decimal) for cell in cells[:-1] or cells)
    return bool(cells) and words <= _MOST_WORDS * len(cells) and len(cells) > words


def _label_numbers(names: list[str], decimal: str) -> Array:
    """The number of each label, nan of a word; then nan for the rows without a label, whose code is -1."""
    numbers = (float(name.replace(decimal, ".")) if is_number(name, decimal) else np.nan for name in names)
    return np.array([*numbers, np.nan])


def _label_column(names: tuple[str, ...], sample: dict[str, list[str]], told: Mapping[str, str]) -> str | None:
    """The column that may number the segments: as told, else by its name."""
    segments = [name for name, kind in told.items() if kind == "segment" and name in names]
    if segments:
        return segments[0]
    named = [name for name in names if sample.get(name) and kind_of_name(name)[0] == "segment"]
    return named[0] if named else None


def _collected(stream: RecordStream, names: tuple[str, ...]) -> tuple[dict[str, Array], Any, Any]:
    """The first rows of a stream: numbers by column, the codes of the labels, and the rows of the file."""
    parts: dict[str, list[Array]] = {name: [] for name in names}
    codes: list[Any] = []
    places: list[Any] = []
    rows = 0
    for chunk in stream.chunks():
        places.append(chunk.rows)
        for name in names:
            parts[name].append(chunk.numbers[name])
        if chunk.codes is not None:
            codes.append(chunk.codes)
        rows += chunk.rows.size
        if rows >= _MOST_LOG_ROWS:
            break
    joined = {name: np.concatenate(part) if part else np.empty(0) for name, part in parts.items()}
    file_rows = np.concatenate(places) if places else np.empty(0, np.int64)
    return joined, np.concatenate(codes) if codes else None, file_rows


def _describe_container(path: Path, told: Mapping[str, str]) -> LogDescription:
    """A log in another format than text: every column of numbers is read."""
    sheets = _sheets(path)
    listed = {sheet: _names_in(path, sheet) for sheet in sheets}
    sheet = max(sheets, key=lambda one: known_names(listed[one]))
    known = _short_names(listed[sheet], file_kind(path))
    plain, units = units_in_names(tuple(known))
    known = dict(zip(plain, known.values(), strict=True))
    read = _numbers_of(path, sheet, list(known.values()))
    numbers = {short: read[0][name] for short, name in known.items() if name in read[0]}
    units |= {short: read[1][name] for short, name in known.items() if name in read[1]}
    told = {short: told[one] for short, name in known.items() for one in (short, name) if one in told} | {
        name: kind for name, kind in told.items() if name not in (*known, *known.values())
    }
    label = _label_column(tuple(known), {name: ["x"] for name in known}, told)
    codes = None
    labels: tuple[str, ...] = ()
    if label is not None and numbers:
        whole = (short for short, column in numbers.items() if np.isfinite(column).all())
        other = known[next(whole, next(iter(numbers)))]
        with_label = DataTable(path.name, OutputColumn(other, "counts"), segment=known[label], sheet=sheet)
        stream = open_stream(path.parent, with_label)
        codes, labels = _collected(stream, (other,))[1], tuple(stream.label_names)
    fills = without_fills(numbers, tuple(numbers))
    guesses = as_told(guess_columns(tuple(known), units, {}, numbers), told, numbers)
    columns = [replace(guess, name=known[guess.name]) for guess in guesses]
    others = [name for name in listed[sheet] if name not in known.values()]
    columns += [ColumnGuess(name, "other", "it is in another group") for name in others]
    facts = (
        {}
        if len(sheets) < 2
        else {
            "data.sheet": Guess(
                sheet,
                f"the sheet with the most known names of {len(sheets)}",
                tuple(one for one in sheets if one != sheet),
            )
        }
    )
    return LogDescription(
        path,
        None,
        tuple(columns),
        facts,
        {known[short]: column for short, column in numbers.items()},
        codes,
        labels,
        {known[short]: value for short, value in fills.items()},
    )


def _short_names(names: tuple[str, ...], kind: str) -> dict[str, str]:
    """Full name of each column by its name without groups. Of groups with equal names, that with the most known names."""
    split = {".mat": "[./]", ".tdms": "/", ".h5": "/", ".hdf5": "/", ".hdf": "/"}.get(kind)
    short = {name: re.split(split, name)[-1] if split else name for name in names if name}
    if len(set(short.values())) == len(short):
        return {one: name for name, one in short.items()}
    groups: dict[str, dict[str, str]] = {}
    for name, one in short.items():
        groups.setdefault(name.removesuffix(one), {})[one] = name
    return max(groups.values(), key=known_names)


def _numbers_of(
    path: Path, sheet: str | None, names: list[str], missing: tuple[str, ...] = ()
) -> tuple[dict[str, Array], dict[str, str]]:
    """Values and units of the columns that hold numbers: all at once, or one by one where one of them does not.

    One word in some cells of a sheet marks a missing value.
    """
    if not names:
        return {}, {}
    try:
        stream = columns_stream(path, tuple(names), sheet=sheet, missing=missing)
        return _collected(stream, tuple(names))[0], dict(stream.units)
    except PigaError as error:
        if len(names) == 1:
            word = next((fix.value for fix in error.fixes if fix.key == "missing"), None)
            if word is None or missing:
                return {}, {}
            numbers, units = _numbers_of(path, sheet, names, tuple(word))
            empty = [np.mean(np.isnan(column)) for column in numbers.values()]
            return (numbers, units) if empty and empty[0] <= _MOST_WORDS else ({}, {})
    numbers, units = {}, {}
    for name in names:
        one, unit = _numbers_of(path, sheet, [name])
        numbers |= one
        units |= unit
    return numbers, units


def _sheets(path: Path) -> list[str | None]:
    """The sheets of a spreadsheet with several; else one without a name."""
    error = _refusal(path, None)
    sheets = [fix.value for fix in error.fixes if fix.key == "sheet"] if error else []
    return [*sheets] or [None]


def _names_in(path: Path, sheet: str | None) -> tuple[str, ...]:
    """Names of all columns of a container."""
    error = _refusal(path, sheet)
    if error is not None and not error.columns and sheet is None:
        raise error
    return () if error is None else error.columns


def _refusal(path: Path, sheet: str | None) -> DataError | None:
    """The answer to a request for no column: it lists the columns, or the sheets, of the file."""
    try:
        open_stream(path.parent, DataTable(path.name, OutputColumn(_NO_COLUMN, "counts"), sheet=sheet))
    except DataError as error:
        return error
    return None
