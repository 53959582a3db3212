"""Arrays out of a container as columns: one length, numbers or labels, nothing else."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from piga.errors import DataError
from piga.formats.columns import RawTable
from piga.records.spool import Arrays, Growing

_COLUMN_OF = re.compile(r"^(.*)\(:,\s*(\d+)\)$")

Label = tuple[NDArray[np.int32], tuple[str, ...]]

PIECE_ROWS = 1 << 18
"""Rows that are unpacked at a time; as many are held in memory in any case."""


def split_name(name: str) -> tuple[str, int | None]:
    """``f(:,2)`` is column 2 (counted from 1, as MATLAB does) of the matrix ``f``."""
    match = _COLUMN_OF.match(name)
    return (match.group(1), int(match.group(2))) if match else (name, None)


def no_column(path: Path, name: str, present: Iterable[str]) -> DataError:
    """The error for a column that is not in the file; lists what is."""
    names = list(present)
    shown = ", ".join(names[:40]) + (f" and {len(names) - 40} more" if len(names) > 40 else "")
    return DataError(
        f"{path}: no column '{name}'; the columns are: {shown or 'none'}",
        remedy="correct the column name in [data]",
    )


def vector(path: Path, name: str, values: NDArray, column: int | None) -> NDArray:
    """One column of an array: a vector, or column ``column`` of a matrix.

    Raises
    ------
    DataError
        If the array has more dimensions, or the matrix needs a column to be named.
    """
    if values.ndim == 2 and column is not None:
        if not 1 <= column <= values.shape[1]:
            raise DataError(
                f"{path}: column '{name}': the matrix has {values.shape[1]} columns",
                remedy="columns count from 1",
            )
        return values[:, column - 1]
    flat = values.reshape(-1) if values.ndim == 2 and 1 in values.shape else values
    if flat.ndim != 1 or column is not None:
        raise DataError(
            f"{path}: '{name}' has the shape {values.shape}, a column is needed",
            remedy=f"name a column of a matrix as '{split_name(name)[0]}(:,1)'",
        )
    return flat


def as_numbers(path: Path, name: str, values: NDArray) -> NDArray[np.float64] | NDArray[np.int64]:
    """A number column as float64, or int64 where it holds integers.

    Raises
    ------
    DataError
        If it holds something else: text, complex numbers, dates, objects.
    """
    if values.dtype.kind in "iu":
        if values.size and (int(values.max()) > 2**63 - 1):
            raise DataError(
                f"{path}: column '{name}' holds {values.max()}, more than 64 bit integers can",
                remedy="export the counter as a signed integer",
            )
        return values.astype(np.int64, copy=False)
    if values.dtype.kind == "f" and values.dtype.itemsize <= 8:
        return values.astype(np.float64, copy=False)
    raise DataError(
        f"{path}: column '{name}' holds {values.dtype.name}, not numbers",
        remedy="store it as double or integer",
    )


def long_column(dtype: np.dtype) -> Growing:
    """What :func:`as_numbers` makes of pieces of a column of this kind; a long one lies on disk."""
    return Arrays(Path(tempfile.gettempdir())).growing(
        np.float64 if dtype.kind == "f" else np.int64, PIECE_ROWS
    )


def as_label(values: Iterable[object]) -> Label:
    """Codes and names of a label column; whole numbers are written without a point, empty cells are -1."""
    names: dict[str, int] = {}
    return label_codes(values, names), tuple(names)


def label_codes(values: Iterable[object], names: dict[str, int]) -> NDArray[np.int32]:
    """Codes of some cells of a label column; ``names`` are those met so far, new ones at the end."""
    codes = [
        -1 if (text := label_text(value)) == "" else names.setdefault(text, len(names)) for value in values
    ]
    return np.array(codes, dtype=np.int32)


def label_text(value: object) -> str:
    """A segment label from any cell: bytes decoded, whole numbers without a point, nothing for None and nan."""
    if value is None:
        return ""
    if isinstance(value, bytes):
        value = value.decode("utf-8", errors="replace")
    if isinstance(value, (float, np.floating)):
        number = float(value)
        return "" if np.isnan(number) else str(int(number)) if number.is_integer() else repr(number)
    return str(value).strip()


def make_table(
    path: Path, numbers: dict[str, NDArray], labels: dict[str, Label], units: dict[str, str]
) -> RawTable:
    """A table of columns that must be of one length.

    Raises
    ------
    DataError
        If lengths differ or there is no row.
    """
    lengths = {name: int(column.shape[0]) for name, column in numbers.items()}
    lengths |= {name: int(codes.size) for name, (codes, _) in labels.items()}
    first, rows = next(iter(lengths.items()))
    for name, length in lengths.items():
        if length != rows:
            raise DataError(
                f"{path}: column '{name}' has {length} rows, column '{first}' has {rows}",
                remedy="export columns that were sampled together",
            )
    if rows == 0:
        raise DataError(f"{path}: no data row", remedy="check that the logger wrote data")
    return RawTable(path, numbers, labels, rows, 1, units)
