"""Describe a log: its layout, and what every column holds. Nothing but the log is needed."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.describe.columns import ColumnGuess, guess_columns
from piga.describe.layout import Guess, Layout, text_layout
from piga.describe.names import kind_of_name
from piga.errors import DataError, PigaError
from piga.formats.columns import RecordStream
from piga.formats.text.convention import HeadRows, units_in_names
from piga.formats.text.faults import is_number
from piga.formats.text.reader import TextStream
from piga.formats.text.time_stamp import forms_of
from piga.reading.raw_columns import TEXT_SUFFIXES, file_kind, open_stream
from piga.records.run_file import DataTable, OutputColumn

Array = NDArray[np.float64]

MOST_ROWS = 2_000_000
"""Rows of a log whose values are examined."""
_NAMES = re.compile(r"the columns are: (.*)", re.DOTALL)


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
        Values of the number columns, at most :data:`MOST_ROWS` of each.
    labels:
        Segment label of each of these rows, as an index into ``label_names``; None without a segment column.
    """

    path: Path
    layout: Layout | None
    columns: tuple[ColumnGuess, ...]
    facts: dict[str, Guess] = field(default_factory=dict)
    numbers: dict[str, Array] = field(default_factory=dict)
    labels: NDArray[np.int32] | None = None
    label_names: tuple[str, ...] = ()

    def of(self, kind: str) -> list[ColumnGuess]:
        """Columns of a kind, by axis."""
        return sorted(
            (c for c in self.columns if c.kind == kind), key=lambda c: -1 if c.axis is None else c.axis
        )


def describe_log(path: str | Path) -> LogDescription:
    """Describe a log: encoding, preamble, header, units, separator, decimal mark, time stamps, and every column.

    Parameters
    ----------
    path:
        The log, in any format that :func:`piga.reading.raw_columns.open_stream` reads.

    Raises
    ------
    DataError
        If the file cannot be read, or holds no table of numbers.
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(f"{path}: no such file, or a folder", remedy="name the log of the test")
    if file_kind(path) in TEXT_SUFFIXES:
        return _describe_text(path)
    return _describe_container(path)


def _describe_text(path: Path) -> LogDescription:
    layout = text_layout(path)
    numeric = tuple(
        name
        for name, cells in layout.sample.items()
        if cells and all(is_number(cell, layout.decimal.value) for cell in cells[:-1] or cells)
    )
    label = _label_column(layout.names, layout.sample)
    stamp = next(
        (
            (name, forms_of(cells[:50])[0])
            for name, cells in layout.sample.items()
            if name not in numeric and forms_of(cells[:50])
        ),
        None,
    )
    read = (*numeric, stamp[0]) if stamp else numeric
    stream = TextStream(
        path,
        read,
        label,
        separator=layout.separator.value,
        decimal=layout.decimal.value,
        encoding=layout.encoding.value,
        rows=HeadRows(0, layout.header_row.value, layout.units_row.value),
        mask_damaged=True,
        stamp=stamp,
    )
    numbers, codes = _collected(stream, read)
    valued = {name: numbers[name] for name in numeric}
    columns = guess_columns(layout.names, layout.units, layout.sample, valued)
    return LogDescription(
        path, layout, tuple(columns), layout.facts, numbers, codes if label else None, tuple(stream.label_names)
    )


def _label_column(names: tuple[str, ...], sample: dict[str, list[str]]) -> str | None:
    """The column that may number the segments: by its name."""
    named = [name for name in names if sample.get(name) and kind_of_name(name)[0] == "segment"]
    return named[0] if named else None


def _collected(stream: RecordStream, names: tuple[str, ...]) -> tuple[dict[str, Array], Any]:
    """The first rows of a stream: numbers by column, and the codes of the labels."""
    parts: dict[str, list[Array]] = {name: [] for name in names}
    codes: list[Any] = []
    rows = 0
    for chunk in stream.chunks():
        for name in names:
            parts[name].append(chunk.numbers[name])
        if chunk.codes is not None:
            codes.append(chunk.codes)
        rows += chunk.rows.size
        if rows >= MOST_ROWS:
            break
    joined = {name: np.concatenate(part) if part else np.empty(0) for name, part in parts.items()}
    return joined, np.concatenate(codes) if codes else None


def _describe_container(path: Path) -> LogDescription:
    """A log in another format than text: the columns whose names are known are read."""
    names, units = units_in_names(_names_in(path))
    numbers: dict[str, Array] = {}
    for name in names:
        if kind_of_name(name)[0] not in ("segment", "date"):
            try:
                stream = open_stream(path.parent, DataTable(path.name, OutputColumn(name, "counts")))
                numbers |= _collected(stream, (name,))[0]
                units |= stream.units
            except PigaError:  # a column of text
                continue
    label = _label_column(names, {name: ["x"] for name in names})
    codes = None
    labels: tuple[str, ...] = ()
    if label is not None and numbers:
        other = next(iter(numbers))
        with_label = DataTable(path.name, OutputColumn(other, "counts"), segment=label)
        stream = open_stream(path.parent, with_label)
        codes, labels = _collected(stream, (other,))[1], tuple(stream.label_names)
    columns = guess_columns(names, units, {}, numbers)
    return LogDescription(path, None, tuple(columns), {}, numbers, codes, labels)


def _names_in(path: Path) -> tuple[str, ...]:
    """Names of all columns of a container. Its reader lists them when a column is not there."""
    try:
        open_stream(path.parent, DataTable(path.name, OutputColumn("\N{REPLACEMENT CHARACTER}", "counts")))
    except DataError as error:
        match = _NAMES.search(error.message)
        if match is None:
            raise
        return tuple(match.group(1).split(", "))
    raise DataError(f"{path}: no columns", remedy="write the run file by hand: docs/lab-data")
