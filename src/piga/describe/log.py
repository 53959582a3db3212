"""Describe a log: its layout and the content of every column. Only the log is needed, and no column name is known."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.describe.columns import (
    FACTS,
    TOLD,
    ColumnGuess,
    guess_columns,
    kind_of_name,
    known_names,
    known_unit,
    plain,
    without_fills,
)
from piga.errors import DataError, PigaError
from piga.formats.columns import FileChunk, RecordStream
from piga.formats.container import TEXT_SUFFIXES, Sheet, columns_stream, file_kind
from piga.formats.text.convention import (
    COMMENT,
    GUESSED,
    INFINITE,
    MISSING,
    NO_UNIT,
    TextFormat,
    TextOptions,
    TextSource,
    find_format,
    is_units_row,
    joined_names,
    lines_of,
    split_line,
    unit_text,
    units_in_names,
)
from piga.formats.text.reader import is_number, split_cells
from piga.formats.text.time_stamp import forms_of
from piga.results import Array
from piga.text_files import open_regular

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
        The log, in any format that :func:`piga.formats.container.columns_stream` reads.
    told:
        What some columns hold, by name: ``{"CH3": "angle [deg]"}``. The others are guessed.
    """
    path = Path(path)
    open_regular(path, "the log of the test").close()
    if file_kind(path) in TEXT_SUFFIXES:
        return _describe_text(path, told or {})
    return _describe_container(path, told or {})


def _describe_text(path: Path, told: Mapping[str, str]) -> LogDescription:
    layout = text_layout(path)
    form, cells = layout.form, layout.sample.items()
    names = {name: name for name in form.names}
    numeric = tuple(name for name, some in cells if _mostly_numbers(some, form.decimal))
    label = _label_column(names, layout.sample, told)
    stamps = ((name, form) for name, some in cells if name not in numeric for form in forms_of(some[:50])[:1])
    stamp = next(stamps, None)
    read = tuple(name for name in (*numeric, *(stamp or ())[:1]) if name != label)
    options = replace(layout.options, mask_damaged=True, stamp=stamp)
    stream = columns_stream(path, read, label, options)
    numbers, codes = _collected(stream, read)
    if label in numeric and codes is not None:
        of_names = (
            float(name.replace(form.decimal, ".")) if is_number(name, form.decimal) else np.nan
            for name in stream.label_names
        )
        numbers[label] = np.array([*of_names, np.nan])[codes]  # the code of a row without a label is -1
    fills = without_fills(numbers, numeric)
    valued = {name: numbers[name] for name in numeric}
    columns = guess_columns(names, form.units, layout.sample, valued, told)
    labels = tuple(stream.label_names)
    return LogDescription(path, layout, tuple(columns), layout.facts, numbers, codes, labels, fills)


_MOST_WORDS = 0.2
"""Largest share of cells with words in a column of numbers."""


def _mostly_numbers(cells: list[str], decimal: str) -> bool:
    """True for a column of numbers, in which some cells may hold a word for a missing value."""
    words = sum(not is_number(cell, decimal) for cell in cells[:-1] or cells)
    return bool(cells) and words <= _MOST_WORDS * len(cells) and len(cells) > words


def _label_column(
    names: Mapping[str, str], sample: dict[str, list[str]], told: Mapping[str, str]
) -> str | None:
    """The column that may number the segments: as told, else by its name."""
    segments = [name for name, kind in told.items() if kind == "segment" and name in names]
    if segments:
        return segments[0]
    named = [name for name, one in names.items() if sample.get(name) and kind_of_name(one)[0] == "segment"]
    return named[0] if named else None


def _collected(
    stream: RecordStream, names: tuple[str, ...]
) -> tuple[dict[str, Array], NDArray[np.int32] | None]:
    """The first rows of a stream: numbers by column, and the codes of the labels."""
    chunks: list[FileChunk] = []
    for chunk in stream.chunks():
        chunks.append(chunk)
        if sum(one.rows.size for one in chunks) >= _MOST_LOG_ROWS:
            break
    codes = [chunk.codes for chunk in chunks if chunk.codes is not None]
    numbers = {name: np.concatenate([np.empty(0), *(one.numbers[name] for one in chunks)]) for name in names}
    return numbers, np.concatenate(codes) if codes else None


def _describe_container(path: Path, told: Mapping[str, str]) -> LogDescription:
    """A log in another format than text: every column of numbers is read. Guesses go by short names without units."""
    error = DataError(f"{path}: no columns", remedy="check that this is the log")
    try:
        columns_stream(path, (_NO_COLUMN,))
    except DataError as refused:
        error = refused
    if not error.columns:
        raise error
    listed = error.columns
    names, units = _short_names(listed, file_kind(path))
    numbers: dict[str, Array] = {}
    for name in names:  # each by itself: groups may differ in their length
        with suppress(PigaError):
            stream = columns_stream(path, (name,))
            numbers |= _collected(stream, (name,))[0]
            units |= stream.units
    full = {short: name for name, short in names.items()}
    told = {full.get(name, name): kind for name, kind in told.items()}
    label = _label_column(names, {name: ["x"] for name in names}, told)
    codes, labels = None, []
    if label is not None and numbers:
        whole = (name for name, column in numbers.items() if np.isfinite(column).all())
        other = next(whole, next(iter(numbers)))
        stream = columns_stream(path, (other,), label)
        codes, labels = _collected(stream, (other,))[1], stream.label_names
    fills = without_fills(numbers, tuple(numbers))
    columns = guess_columns(names, units, {}, numbers, told)
    columns += [ColumnGuess(n, "other", "it is in another group") for n in listed if n not in names]
    return LogDescription(path, None, tuple(columns), {}, numbers, codes, tuple(labels), fills)


def _short_names(names: tuple[str, ...], kind: str) -> tuple[dict[str, str], dict[str, str]]:
    """Name of each column without groups and unit, and the units in the names.

    Of groups with equal names, that with the most known names.
    """
    split = {".mat": "[./]", ".tdms": "/", ".h5": "/", ".hdf5": "/", ".hdf": "/"}.get(kind)
    short = {name: re.split(split, name)[-1] if split else name for name in names if name}
    if len(set(short.values())) < len(short):
        groups: dict[str, dict[str, str]] = {}
        for name, one in short.items():
            groups.setdefault(name.removesuffix(one), {})[name] = one
        short = max(groups.values(), key=lambda group: known_names(group.values()))
    bare, units = units_in_names(tuple(short.values()))
    short = dict(zip(short, bare, strict=True))
    return short, {name: units[one] for name, one in short.items() if one in units}


# -- layout of a text log --------------------------------------------------------------------------------

_MOST_HEAD_LINES = 400
"""Lines of the head that are examined."""
SEPARATORS = ("\t", ";", "|", ",", " ")
"""Separators that are tried, the likelier ones first. A blank stands for any number of blanks and tabs."""
_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
_EMPTY = {*MISSING, *INFINITE}


@dataclass(frozen=True)
class Guess:
    """A value, the reason for it in a few words, and the ``alternatives``, likelier ones first."""

    value: Any
    reason: str
    alternatives: tuple[Any, ...] = ()


@dataclass(frozen=True)
class TextLayout:
    """Layout of a text log. ``guesses`` are keys of ``[data]``, ``facts`` keys of the run file that the preamble gives.

    ``sample``: the first cells of each column. The rows of the names are a pair where these stand over two rows; False if no row
    holds names: the columns are then A, B, C.
    """

    form: TextFormat
    options: TextOptions
    sample: dict[str, list[str]]
    guesses: dict[str, Guess]
    facts: dict[str, Guess]


def text_layout(path: Path) -> TextLayout:
    """Guess the layout of a text log, or of the sheet with the most known names, from the first lines."""
    if file_kind(path) == ".xlsx":
        return _sheet_layout(path)
    first = TextSource(path, None).encoding
    tried = sorted(GUESSED, key=lambda one: one != first) if first in GUESSED else [first]
    heads: dict[str, str] = {}
    for encoding in tried:
        with suppress(DataError):  # no text in this encoding
            heads[encoding] = TextSource(path, encoding).head.decode("utf-8", errors="replace")
    layouts = [_layout(head, path, encoding) for encoding, head in heads.items()]
    best = max(layouts, key=lambda one: known_names(one.form.names))
    if best.form.encoding in ("utf-8", "ascii"):
        return best
    others = tuple(one.form.encoding for one in layouts if one is not best)
    words = "the bytes are not UTF-8, and the column names are words in this encoding"
    why = words if len(tried) > 1 else "the file has a byte-order mark"
    return replace(best, guesses=best.guesses | {"encoding": Guess(best.form.encoding, why, others)})


def _sheet_layout(path: Path) -> TextLayout:
    sheets: dict[str | None, Sheet] = {}
    try:
        sheets[None] = Sheet(path)
    except DataError as error:
        sheets = {fix.value: Sheet(path, fix.value) for fix in error.fixes}
        if not sheets:
            raise
    layouts = {}
    for name, sheet in sheets.items():
        with suppress(DataError) if len(sheets) > 1 else nullcontext():  # another sheet has the table
            layouts[name] = _layout(sheet.head.decode(), path, "utf-8", "\t")
    if not layouts:
        remedy = "check that this is the log"
        raise DataError(f"{path}: no sheet has a table of numbers", remedy=remedy)
    best = max(layouts, key=lambda one: known_names(layouts[one].form.names))
    guesses = {key: one for key, one in layouts[best].guesses.items() if key not in ("delimiter", "decimal")}
    facts = layouts[best].facts
    if best is not None:
        why, others = (
            f"the sheet with the most known names of {len(sheets)}",
            tuple(one for one in sheets if one != best),
        )
        facts["data.sheet"] = Guess(best, why, others)
    options = replace(layouts[best].options, sheet=best)
    return replace(layouts[best], options=options, guesses=guesses, facts=facts)


@dataclass(frozen=True)
class _TextTable:
    """A table of numbers in some lines: its separator, first data line, cells of a line, rows, and cells that are values."""

    separator: str
    start: int
    width: int
    rows: int
    values: int


def _layout(head: str, path: Path, encoding: str, separators: Sequence[str] = SEPARATORS) -> TextLayout:
    lines = lines_of(head)[:_MOST_HEAD_LINES]
    tables = [table for separator in separators if (table := _table(lines, separator)) is not None]
    if not tables:
        raise DataError(
            f"{path}: no table of numbers in the first {len(lines)} rows",
            remedy="check that this is the log; columns are separated by ; , | a tab or blanks",
        )
    table = max(tables, key=lambda one: (one.width > 1, one.separator != " ", one.values))
    names_in, units_at = _heads(lines, table)
    body = [_cells(line, table.separator) for line in lines[table.start :] if line.strip()]
    decimal = _decimal(body, table.separator)
    above = names_in[0] - 1 if names_in else table.start
    names_at = names_in if len(names_in) > 1 else names_in[0] if names_in else False
    passed = 0 if names_in else above
    options = TextOptions(passed, names_at, units_at or False, table.separator, decimal.value, encoding)
    form = find_format(head, path, encoding, options)
    sample = {
        name: [row[k] for row in body if len(row) > k and row[k] not in _EMPTY][:200]
        for k, name in enumerate(form.names)
        if name
    }
    shown = {"\t": "a tab", " ": "one or more blanks"}.get(table.separator, f"'{table.separator}'")
    split = f"{shown} splits {table.rows} rows into {table.width} cells each"
    guesses = {"delimiter": Guess(table.separator, split), "decimal": decimal}
    if names_at != 1 or COMMENT.sub("", lines[0]) != lines[0]:
        skipped = (
            f"; rows 1 to {above} are a preamble" if above > 1 else "; row 1 is a preamble" if above else ""
        )
        why = f"the first row above the numbers with {len(form.names)} names{skipped}"
        if not names_in:
            why = f"the numbers begin in row {above + 1}, and no row above names them: A, B, C{skipped}"
        elif len(names_in) > 1:
            why = "the names stand over two rows"
        guesses["header_row"] = Guess(names_at, why)
    if passed:
        guesses["skip_rows"] = Guess(passed, "lines before the numbers")
    if units_at:
        guesses["units_row"] = Guess(units_at, "it holds units and no numbers")
    return TextLayout(form, options, sample, guesses, _facts(lines[:above]))


def _cells(line: str, separator: str) -> list[str]:
    cells = split_cells(line.rstrip("\r\n"), separator) if separator != " " else None
    return [cell.strip().strip('"').strip() for cell in cells or split_line(line, separator)]


def _is_value(cell: str) -> bool:
    return bool(cell in _EMPTY or is_number(cell, ".") or _COMMA.fullmatch(cell) or forms_of([cell]))


_LEAST_ABOVE = 3
"""Rows of numbers above a damaged row that show that the table goes on there."""


def _table(lines: list[str], separator: str) -> _TextTable | None:
    """The rows at the end of the head that this separator splits into the same number of cells, most of them numbers.

    A single damaged row does not end the table if rows of numbers stand above it.
    """
    filled = [index for index, line in enumerate(lines) if line.strip()]
    width, start, rows, values = 0, 0, 0, 0
    for place in range(len(filled) - 1, -1, -1):
        index = filled[place]
        cells = _cells(lines[index], separator)
        fits = _is_row(cells)
        if fits and rows == 0:
            width = len(cells)
        if not fits or (rows > 1 and abs(len(cells) - width) > 1):
            if rows < 2 and index > len(lines) - 4:  # a cut or damaged last row
                rows, width, values = 0, 0, 0
                continue
            above = [_cells(lines[k], separator) for k in filled[max(place - _LEAST_ABOVE, 0) : place]]
            if len(above) == _LEAST_ABOVE and all(_is_row(row, width, empty=False) for row in above):
                continue
            break
        width, start, rows = (len(cells) if rows == 1 else width), index, rows + 1
        values += sum(map(_is_value, cells))
    return _TextTable(separator, start, width, rows, values) if rows >= 2 else None


def _is_row(cells: list[str], width: int | None = None, *, empty: bool = True) -> bool:
    """True if at least half of the cells are values and one is a number. ``empty``: empty cells count as values."""
    numbers = sum(_is_value(cell) and cell not in _EMPTY for cell in cells)
    values = sum(_is_value(cell) for cell in cells) if empty else numbers
    return 2 * values >= len(cells) and numbers > 0 and width in (None, len(cells))


def _heads(lines: list[str], table: _TextTable) -> tuple[tuple[int, ...], int | None]:
    """Rows of the names above the first data row, counted from 1: none, one, or two over which they stand; row of the units."""
    above = [k for k in range(table.start) if lines[k].strip()][-2:]
    rows = {k: tuple(_cells(COMMENT.sub("", lines[k]), table.separator)) for k in above}
    wide = [k for k in above if abs(len(rows[k]) - table.width) <= 1]
    if not wide or wide[-1] != above[-1]:
        return (), None
    at, units_at = wide[-1], None
    last, first = (_cells(lines[k], table.separator) for k in (at, table.start))
    units = [cell for cell in last if unit_text(cell) in NO_UNIT or known_unit(unit_text(cell))]
    if len(wide) > 1 and len(units) > max(known_names(last), len(last) // 2 - 1) and is_units_row(last, first):
        at, units_at = wide[-2], at + 1
    names, upper = rows[at], tuple(_cells(COMMENT.sub("", lines[at - 1]), table.separator)) if at else ()
    if not 1 < len(upper) <= len(names):
        return (at + 1,), units_at
    alone, together = (known_names(units_in_names(one)[0]) for one in (names, joined_names(upper, names)))
    each = len(upper) == len(names) and all(cell and not _is_value(cell) for cell in upper)
    return (at, at + 1) if together >= alone + (not each) else (at + 1,), units_at


def _decimal(body: list[list[str]], separator: str) -> Guess:
    cells = [cell for row in body for cell in row]
    commas = [cell for cell in cells if _COMMA.fullmatch(cell)]
    if separator == "," or not commas:
        return Guess(
            ".", "the numbers have a point" if any("." in cell for cell in cells) else "no number has decimals"
        )
    unsure = all(re.fullmatch(r"[-+]?[1-9]\d{0,2},\d{3}", cell) for cell in commas)
    return Guess(",", f"numbers such as {commas[0]}", (".",) if unsure else ())


def _facts(lines: list[str]) -> dict[str, Guess]:
    """Values by key of the run file, from the lines of a preamble: ``Seriennummer: G-0417``."""
    facts: dict[str, Guess] = {}
    for number, line in enumerate(lines, start=1):
        name, *rest = re.split(r"[:=：;\t]+|(?<=\S),(?=\s*\S)", line.strip().lstrip("#%").strip(), maxsplit=1)
        value = re.split(r"[;\t]", rest[0].strip().strip('"'))[0] if rest else ""
        value = value.strip().strip('"').rstrip(",").strip()
        key = next((key for key, words in FACTS.items() if re.fullmatch("|".join(words), plain(name))), None)
        if value and key is not None:
            unit = re.search(r"[\[(（]([^\])）]+)[\])）]", name)
            value = f"{value} {unit.group(1)}" if unit and key != "instrument.serial" else value
            facts[key] = Guess(value, f"row {number}: '{' '.join(line.split())[:60]}'")
    return facts
