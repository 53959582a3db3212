"""Read MATLAB files: v7.3 as HDF5, v4 to v7 with SciPy."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.errors import DataError
from piga.formats.columns import (
    Label,
    RawTable,
    as_label,
    as_numbers,
    make_table,
    matrix_columns,
    no_column,
    split_name,
    vector,
)
from piga.formats.containers.hdf5_reader import read_hdf5
from piga.records.limits import check_unpacked, first_line, open_regular

HDF5_MARK = b"\x89HDF\r\n\x1a\n"
COMPRESSED = 15
MAX_LEVELS = 4


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
        If the file is damaged, its unpacked size is too large, a variable is missing or is not a plain column.
    """
    with open_regular(path) as stream:
        head = stream.read(520)
    if HDF5_MARK in (head[:8], head[512:520]):
        return read_hdf5(path, numeric, label)
    if head[:4].isascii() and head[:6] == b"MATLAB":
        _check_unpacked(path, head)
    variables = _load(
        path, [split_name(name)[0].split(".")[0] for name in (*numeric, *([label] if label else []))]
    )
    numbers = {name: as_numbers(path, name, _column(path, variables, name)) for name in dict.fromkeys(numeric)}
    labels: dict[str, Label] = {}
    if label is not None:
        labels[label] = as_label(_cells(_column(path, variables, label)))
    return make_table(path, numbers, labels, {})


def _load(path: Path, names: list[str] | None) -> dict[str, Any]:
    """The named variables (None: all). A variable that is there and not named is None."""
    from scipy.io import loadmat, whosmat

    try:
        present = [entry[0] for entry in whosmat(path)]
        variables = loadmat(path, variable_names=names, chars_as_strings=True, struct_as_record=True)
    except MemoryError:
        raise
    except Exception as error:  # a damaged file can raise any exception in SciPy
        raise DataError(
            f"{path}: not a readable MATLAB file ({first_line(error)})",
            remedy="save it again with -v7 or -v7.3",
        ) from None
    return {name: variables.get(name) for name in present}


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


def _check_unpacked(path: Path, head: bytes) -> None:
    """Unpack the compressed elements of a v5 to v7 file without keeping them, and stop at the limit."""
    order = "<" if head[126:128] == b"IM" else ">"
    packed = path.stat().st_size
    unpacked = 0
    with open_regular(path) as stream:
        stream.seek(128)
        while len(tag := stream.read(8)) == 8:
            kind, size = struct.unpack(order + "II", tag)
            if kind != COMPRESSED:
                stream.seek(size, 1)
                continue
            unpack = zlib.decompressobj()
            while size > 0 and (piece := stream.read(min(size, 1 << 16))):
                size -= len(piece)
                while piece:
                    try:
                        unpacked += len(unpack.decompress(piece, 1 << 20))
                    except zlib.error as error:
                        raise DataError(
                            f"{path}: not a readable MATLAB file ({error})", remedy="save it again"
                        ) from None
                    piece = unpack.unconsumed_tail
                    check_unpacked(path, unpacked, packed)
