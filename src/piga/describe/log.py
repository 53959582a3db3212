"""Describe a log: its layout and the content of every column. Only the log is needed."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

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
)
from piga.describe.layout import Guess, TextLayout, text_layout
from piga.errors import DataError, PigaError
from piga.formats.columns import RecordStream
from piga.formats.text.convention import HeadRows, units_in_names
from piga.formats.text.reader import TextStream, is_number
from piga.formats.text.time_stamp import forms_of
from piga.reading.columns import TEXT_SUFFIXES, columns_stream, file_kind
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
    """

    path: Path
    layout: TextLayout | None
    columns: tuple[ColumnGuess, ...]
    facts: dict[str, Guess] = field(default_factory=dict)
    numbers: dict[str, Array] = field(default_factory=dict)
    labels: NDArray[np.int32] | None = None
    label_names: tuple[str, ...] = ()
    fills: dict[str, float] = field(default_factory=dict)

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
    decimal, cells = layout.decimal.value, layout.sample.items()
    numeric = tuple(name for name, some in cells if _mostly_numbers(some, decimal))
    label = _label_column(layout.names, layout.sample, told)
    stamps = ((name, form) for name, some in cells if name not in numeric for form in forms_of(some[:50])[:1])
    stamp = next(stamps, None)
    read = tuple(name for name in (*numeric, *(stamp or ())[:1]) if name != label)
    stream = TextStream(
        path,
        read,
        label,
        separator=layout.separator.value,
        decimal=decimal,
        encoding=layout.encoding.value,
        rows=HeadRows(layout.skip_rows, layout.header_row.value, layout.units_row.value),
        mask_damaged=True,
        stamp=stamp,
    )
    numbers, codes = _collected(stream, read)
    if label in numeric and codes is not None:
        numbers[label] = _label_numbers(stream.label_names, decimal)[codes]
    fills = without_fills(numbers, numeric)
    valued = {name: numbers[name] for name in numeric}
    columns = as_told(guess_columns(layout.names, layout.units, layout.sample, valued), told, valued)
    labels = tuple(stream.label_names)
    return LogDescription(path, layout, tuple(columns), layout.facts, numbers, codes, labels, fills)


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


def _collected(
    stream: RecordStream, names: tuple[str, ...]
) -> tuple[dict[str, Array], NDArray[np.int32] | None]:
    """The first rows of a stream: numbers by column, and the codes of the labels."""
    chunks, rows = [], 0
    for chunk in stream.chunks():
        chunks.append(chunk)
        rows += chunk.rows.size
        if rows >= _MOST_LOG_ROWS:
            break
    codes = [chunk.codes for chunk in chunks if chunk.codes is not None]
    numbers = {name: np.concatenate([np.empty(0), *(one.numbers[name] for one in chunks)]) for name in names}
    return numbers, np.concatenate(codes) if codes else None


def _describe_container(path: Path, told: Mapping[str, str]) -> LogDescription:
    """A log in another format than text: every column of numbers is read. Guesses go by short names without units."""
    listed = {sheet: _names_in(path, sheet) for sheet in _sheets(path)}
    sheet = max(listed, key=lambda one: known_names(listed[one]))
    full = _short_names(listed[sheet], file_kind(path))
    plain, units = units_in_names(tuple(full))
    full = dict(zip(plain, full.values(), strict=True))
    short = {name: one for one, name in full.items()}
    read, stated = _numbers_of(path, sheet, list(short))
    numbers = {one: read[name] for name, one in short.items() if name in read}
    units |= {short[name]: unit for name, unit in stated.items()}
    told = {short.get(name, name): kind for name, kind in told.items()}
    label = _label_column(plain, {name: ["x"] for name in plain}, told)
    codes, labels = None, []
    if label is not None and numbers:
        whole = (one for one, column in numbers.items() if np.isfinite(column).all())
        other = full[next(whole, next(iter(numbers)))]
        stream = columns_stream(path, (other,), full[label], sheet)
        codes, labels = _collected(stream, (other,))[1], stream.label_names
    fills = without_fills(numbers, tuple(numbers))
    guesses = as_told(guess_columns(plain, units, {}, numbers), told, numbers)
    columns = [replace(guess, name=full[guess.name]) for guess in guesses]
    columns += [ColumnGuess(n, "other", "it is in another group") for n in listed[sheet] if n not in short]
    facts = {}
    if len(listed) > 1:
        others = tuple(one for one in listed if one != sheet)
        facts["data.sheet"] = Guess(sheet, f"the sheet with the most known names of {len(listed)}", others)
    return LogDescription(
        path,
        None,
        tuple(columns),
        facts,
        {full[one]: column for one, column in numbers.items()},
        codes,
        tuple(labels),
        {full[one]: value for one, value in fills.items()},
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
    return sheets or [None]


def _names_in(path: Path, sheet: str | None) -> tuple[str, ...]:
    """Names of all columns of a container."""
    error = _refusal(path, sheet)
    if error is not None and not error.columns and sheet is None:
        raise error
    return () if error is None else error.columns


def _refusal(path: Path, sheet: str | None) -> DataError | None:
    """The answer to a request for no column: it lists the columns, or the sheets, of the file."""
    try:
        columns_stream(path, (_NO_COLUMN,), sheet=sheet)
    except DataError as error:
        return error
    return None
