"""Read MATLAB files: v7.3 as HDF5, v4 to v7 with SciPy."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.formats.columns import (
    RawTable,
    as_label,
    as_numbers,
    make_table,
    matrix_columns,
    no_column,
    split_name,
    vector,
)
from piga.formats.hdf5 import read_hdf5
from piga.records.limits import check_unpacked, open_regular

HDF5_MARK = b"\x89HDF\r\n\x1a\n"
MAX_LEVELS = 4
"""Most structs inside each other."""


def read_mat(path: Path, numeric: tuple[str, ...], label: str | None) -> RawTable:
    """Read the named variables of a MATLAB file.

    Parameters
    ----------
    path:
        The file.
    numeric, label:
        ``name``, ``struct.field``, or ``name(:,2)`` for a column of a matrix.

    Raises
    ------
    DataError
        If the unpacked size is too large, a variable is missing or is not a plain column.
    """
    with open_regular(path) as stream:
        head = stream.read(520)
    if HDF5_MARK in (head[:8], head[512:520]):
        return read_hdf5(path, numeric, label)
    wanted = [*numeric, *([label] if label else [])]
    variables = _load(path, [split_name(name)[0].split(".")[0] for name in wanted])
    numbers = {name: as_numbers(path, name, _column(path, variables, name)) for name in dict.fromkeys(numeric)}
    labels = None if label is None else (label, as_label(_cells(_column(path, variables, label))))
    return make_table(path, numbers, labels, {})


def _load(path: Path, names: list[str] | None) -> dict[str, Any]:
    """The named variables (None: all). A variable that is there and not named is None."""
    from scipy.io import loadmat, whosmat

    shapes = {name: shape for name, shape, _ in whosmat(path)}
    for name in shapes if names is None else set(names) & set(shapes):
        check_unpacked(path, 8 * math.prod(shapes[name]), path.stat().st_size)
    variables = loadmat(path, variable_names=names, chars_as_strings=True, struct_as_record=True)
    return {name: variables.get(name) for name in shapes}


def _column(path: Path, variables: dict[str, Any], name: str) -> NDArray:
    plain, column = split_name(name)
    first, *fields = plain.split(".")
    item = variables.get(first)
    for field in fields[:MAX_LEVELS]:
        names = getattr(getattr(item, "dtype", None), "names", None)
        if not names or field not in names or item is None or item.size != 1:
            raise no_column(path, name, _names(path))
        item = item[field].reshape(-1)[0]
    if not isinstance(item, np.ndarray) or item.dtype.names:
        raise no_column(path, name, _names(path))
    return vector(path, name, item, column)


def _names(path: Path) -> list[str]:
    """Names of all columns: vectors, columns of matrices, and these in structs."""
    return [one for name, item in _load(path, None).items() for one in _names_below(name, item, 0)]


def _names_below(name: str, item: object, depth: int) -> list[str]:
    fields = getattr(getattr(item, "dtype", None), "names", None)
    if fields and isinstance(item, np.ndarray) and item.size == 1 and depth < MAX_LEVELS:
        inside = ((f"{name}.{field}", item[field].reshape(-1)[0]) for field in fields)
        return [one for path, part in inside for one in _names_below(path, part, depth + 1)]
    return matrix_columns(name, item.shape) if isinstance(item, np.ndarray) else [name]


def _cells(values: NDArray) -> list[object]:
    """Texts of a char matrix or of a cell array of char rows. Numbers are unchanged."""
    if values.dtype.kind != "O":
        return list(values.tolist())
    return [
        cell.reshape(-1)[0] if isinstance(cell, np.ndarray) and cell.size == 1 else str(cell) for cell in values
    ]
