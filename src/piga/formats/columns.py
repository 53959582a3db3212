"""Columns of a data file in memory, in chunks or whole, and conversion of Arrow arrays to NumPy."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from piga.errors import DataError, Where
from piga.records.calibration import Event

CHUNK_ROWS = 1 << 16
"""Rows per chunk of a Parquet file or a container."""
MOST_LISTED = 60
"""Most columns that a message lists."""

Label = tuple[NDArray[np.int32], tuple[str, ...]]
"""Codes (n,) of a segment column, -1 where it is empty, and the names in order of appearance."""


@dataclass(frozen=True)
class FileChunk:
    """Consecutive rows of a file.

    Attributes
    ----------
    numbers:
        float64 values (n,) by column name, in the unit of the file. A missing value is nan.
    codes:
        Segment column as indices into the stream's ``label_names`` (-1: no label), or None.
    rows:
        1-based file row of each row.
    """

    numbers: dict[str, NDArray[np.float64]]
    codes: NDArray[np.int32] | None
    rows: NDArray[np.int64]


class RecordStream(Protocol):
    """A data file being read.

    ``units``: unit of each column for which the file states one. ``label_names``: segment labels so far, in order of
    appearance. ``chunks()`` gives the rows once. ``events()``, called after the last chunk, gives faults and omissions.
    """

    units: dict[str, str]

    @property
    def label_names(self) -> list[str]:
        """Segment labels so far."""
        ...

    def chunks(self) -> Iterator[FileChunk]:
        """The rows in order."""
        ...

    def events(self) -> list[Event]:
        """Faults and omissions; complete after the last chunk."""
        ...


@dataclass
class RawTable:
    """A file read whole: columns of equal length, in the unit of the file. It is a :class:`RecordStream`.

    Attributes
    ----------
    path:
        The file.
    numbers:
        float64 or int64 values (n,) by column name. A missing value is nan.
    label:
        Codes (n,) of the segment column and its names, or None.
    rows:
        Number of rows.
    units:
        Unit of each column for which the file states one.
    noted:
        Faults and omissions.
    row_numbers:
        1-based file row of each row; None: they are counted from 1.
    """

    path: Path
    numbers: dict[str, NDArray[np.float64] | NDArray[np.int64]]
    label: Label | None
    rows: int
    units: dict[str, str] = field(default_factory=dict)
    noted: tuple[Event, ...] = ()
    row_numbers: NDArray[np.int64] | None = None

    @property
    def label_names(self) -> list[str]:
        """Segment labels in order of appearance."""
        return [] if self.label is None else list(self.label[1])

    def chunks(self) -> Iterator[FileChunk]:
        """The rows in order."""
        for start in range(0, self.rows, CHUNK_ROWS):
            part = slice(start, min(start + CHUNK_ROWS, self.rows))
            numbers = {name: column[part].astype(float, copy=False) for name, column in self.numbers.items()}
            yield FileChunk(numbers, None if self.label is None else self.label[0][part], self.file_rows(part))

    def events(self) -> list[Event]:
        """Faults and omissions."""
        return list(self.noted)

    def file_rows(self, part: slice) -> NDArray[np.int64]:
        """1-based file rows of some data rows (blank lines are counted, as an editor does)."""
        if self.row_numbers is not None:
            return self.row_numbers[part]
        return np.arange(1 + part.start, 1 + part.stop, dtype=np.int64)


def column_letter(index: int) -> str:
    """Spreadsheet letter of a 0-based column index: 0 is A, 26 is AA."""
    letters = ""
    index += 1
    while index:
        index, rest = divmod(index - 1, 26)
        letters = chr(ord("A") + rest) + letters
    return letters


def plain_values(column: Any, kind: type[np.generic]) -> NDArray[Any]:
    """Copy of the memory of an Arrow array. Null entries have arbitrary values.

    Arrow's ``to_numpy`` and ``fill_null`` would load pandas, if it is installed, and take 40 MB.
    """
    values = np.frombuffer(column.buffers()[1] or b"", dtype=kind, count=column.offset + len(column))
    return np.array(values[column.offset :])


def numbers_of(column: Any) -> NDArray[np.float64]:
    """Values of an Arrow array of numbers as float64; null becomes nan."""
    import pyarrow as pa

    kind = column.type
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
        column = column.cast(pa.float64(), safe=False)
    # NumPy converts plain numbers: Arrow's cast loads its compute functions, which takes a tenth of a second.
    values = plain_values(column, column.type.to_pandas_dtype()).astype(np.float64, copy=False)
    if column.null_count:
        values[nulls_of(column)] = np.nan
    return values


def nulls_of(column: Any) -> NDArray[np.bool_]:
    """True for null entries of an Arrow array."""
    bitmap = column.buffers()[0]
    if bitmap is None:
        return np.zeros(len(column), dtype=np.bool_)
    bits = np.unpackbits(np.frombuffer(bitmap, dtype=np.uint8), bitorder="little")
    return bits[column.offset : column.offset + len(column)] == 0


@dataclass
class LabelCodes:
    """Codes of label cells. A name has the same code in all chunks. New names are appended to ``names``."""

    names: list[str]
    known: dict[str, int] = field(default_factory=dict)

    def of(self, column: Any) -> NDArray[np.int32]:
        """Codes of an Arrow array; -1 where it is null."""
        import pyarrow as pa

        coded = pa.types.is_dictionary(column.type)
        encoded = column if coded else column.cast(pa.string()).dictionary_encode()
        indices = encoded.indices.cast(pa.int32())
        index, empty = plain_values(indices, np.int32), nulls_of(indices)
        index[empty] = len(encoded.dictionary)
        table = np.full(len(encoded.dictionary) + 1, -1, dtype=np.int32)
        used, first = np.unique(index[~empty], return_index=True)
        used = used[np.argsort(first)]
        words = encoded.dictionary.cast(pa.string())
        for place in used:
            word = words[int(place)].as_py()
            table[place] = -1 if word is None else self.code(word)
        return table[index]

    def code(self, word: str) -> int:
        """Code of a label. A new label gets the next code."""
        if word not in self.known:
            self.known[word] = len(self.names)
            self.names.append(word)
        return self.known[word]


@dataclass
class MissingCount:
    """Missing values by column: their number and the file row of the first."""

    counts: dict[str, tuple[int, int]] = field(default_factory=dict)

    def see(self, name: str, column: Any, rows: NDArray[np.int64]) -> None:
        """Count the null entries of an Arrow array, whose entries stand in these file rows."""
        if column.null_count:
            count, first = self.counts.get(name, (0, int(rows[np.argmax(nulls_of(column))])))
            self.counts[name] = count + column.null_count, first

    def events(self, order: tuple[str, ...]) -> list[Event]:
        """One event for each column with missing values."""
        counts = [(name, *self.counts[name]) for name in order if name in self.counts]
        return [Event("missing-value", count, first, f"column '{name}'") for name, count, first in counts]


_COLUMN_OF = re.compile(r"^(.*)\(:,\s*(\d+)\)$")


def split_name(name: str) -> tuple[str, int | None]:
    """``f(:,2)`` is column 2 (counted from 1, as MATLAB does) of the matrix ``f``."""
    match = _COLUMN_OF.match(name)
    return (match.group(1), int(match.group(2))) if match else (name, None)


def matrix_columns(name: str, shape: tuple[int, ...]) -> list[str]:
    """Names of the columns of an array: its own, or ``f(:,1)`` and so on for a matrix with few columns."""
    if len(shape) == 2 and 1 < shape[1] <= MOST_LISTED and shape[0] > 1:
        return [f"{name}(:,{k + 1})" for k in range(shape[1])]
    return [name]


def no_column(
    path: Path,
    name: str,
    present: Iterable[str],
    row: int | None = None,
    remedy: str = "correct the column name in [data]",
) -> DataError:
    """The error for a column that is not in the file. It lists the columns of the file, whose names stand in ``row``."""
    names = tuple(present)
    more = f" and {len(names) - MOST_LISTED} more" if len(names) > MOST_LISTED else ""
    shown = ", ".join(names[:MOST_LISTED]) + more
    return DataError(
        f"{path}: {'' if row is None else f'row {row}: '}no column '{name}'; the columns are: {shown or 'none'}",
        remedy=remedy,
        where=Where(path, row, (name,)),
        columns=names,
    )


def vector(path: Path, name: str, values: NDArray, column: int | None) -> NDArray:
    """One column of an array: the array itself if it is a vector, or column ``column`` of a matrix.

    Raises
    ------
    DataError
        If the array has more than two dimensions, or is a matrix and no column is given.
    """
    if values.ndim == 2 and column is not None:
        if not 1 <= column <= values.shape[1]:
            raise DataError(
                f"{path}: column '{name}': the matrix has {values.shape[1]} columns",
                remedy="columns count from 1",
                where=Where(path, columns=(name,)),
            )
        return values[:, column - 1]
    flat = values.reshape(-1) if values.ndim == 2 and 1 in values.shape else values
    if flat.ndim != 1 or column is not None:
        raise DataError(
            f"{path}: '{name}' has the shape {values.shape}, a column is needed",
            remedy=f"name a column of a matrix as '{split_name(name)[0]}(:,1)'",
            where=Where(path, columns=(name,)),
        )
    return flat


def as_numbers(path: Path, name: str, values: NDArray) -> NDArray[np.float64] | NDArray[np.int64]:
    """A number column as float64, or as int64 if it holds integers.

    Raises
    ------
    DataError
        If it holds something else: text, complex numbers, dates, objects.
    """
    if values.dtype.kind in "iu":
        if values.size and (int(values.max()) > 2**63 - 1):
            raise DataError(
                f"{path}: column '{name}' holds {values.max()}, more than a signed 64-bit integer can hold",
                remedy="export the counter as a signed integer",
                where=Where(path, columns=(name,)),
            )
        return values.astype(np.int64, copy=False)
    if values.dtype.kind == "f" and values.dtype.itemsize <= 8:
        return values.astype(np.float64, copy=False)
    raise DataError(
        f"{path}: column '{name}' holds {values.dtype.name}, not numbers",
        remedy="store it as double or integer",
        where=Where(path, columns=(name,)),
    )


def as_label(values: Iterable[object]) -> Label:
    """Codes and names of a label column. Whole numbers are written without a decimal point. Empty cells have code -1."""
    coded = LabelCodes([])
    codes = [-1 if (text := label_text(value)) == "" else coded.code(text) for value in values]
    return np.array(codes, dtype=np.int32), tuple(coded.names)


def label_text(value: object) -> str:
    """Segment label of a cell. Bytes are decoded, whole numbers have no decimal point, None and nan give an empty text.

    A cell of MATLAB is an array of one value.
    """
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0].item()
    if value is None:
        return ""
    if isinstance(value, bytes):
        value = value.decode("utf-8", errors="replace")
    if isinstance(value, (float, np.floating)):
        number = float(value)
        return "" if np.isnan(number) else str(int(number)) if number.is_integer() else repr(number)
    return str(value).strip()


def make_table(
    path: Path,
    numeric: Iterable[str],
    label: str | None,
    column: Callable[[str], NDArray],
    units: Mapping[str, str],
) -> RawTable:
    """A table of columns of equal length, each read by ``column``. ``label`` names the segment column.

    Raises
    ------
    DataError
        If a number column holds something else, lengths differ, or there are no rows.
    """
    numbers = {name: as_numbers(path, name, column(name)) for name in dict.fromkeys(numeric)}
    labels = None if label is None else as_label(column(label).tolist())
    lengths = {name: int(values.size) for name, values in numbers.items()}
    if label is not None and labels is not None:
        lengths[label] = int(labels[0].size)
    first, rows = next(iter(lengths.items()))
    for name, length in lengths.items():
        if length != rows:
            raise DataError(
                f"{path}: column '{name}' has {length} rows, column '{first}' has {rows}",
                remedy="export columns that were sampled together",
                where=Where(path, columns=(name, first)),
            )
    if rows == 0:
        raise DataError(f"{path}: no data row", remedy="check that the logger wrote data")
    return RawTable(path, numbers, labels, rows, {name: unit for name, unit in units.items() if unit})
