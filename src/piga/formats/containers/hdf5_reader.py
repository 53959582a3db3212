"""Read HDF5 data, including MATLAB v7.3: datasets by name, only through hard links and with built-in filters."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.errors import DataError
from piga.formats.columns import (
    PIECE_ROWS,
    Label,
    RawTable,
    as_label,
    as_numbers,
    label_text,
    long_column,
    make_table,
    matrix_columns,
    no_column,
    split_name,
    vector,
)
from piga.records.limits import check_unpacked, extra_missing, first_line

PLAIN_FILTERS = {1: "gzip", 2: "shuffle", 3: "fletcher32"}
"""Filters built into the HDF5 library. No plug-in is ever loaded."""
MAX_NAMES = 200
MAX_CELL = 4096
"""Most characters of one text cell."""


def read_hdf5(path: Path, numeric: tuple[str, ...], label: str | None) -> RawTable:
    """Read the named datasets.

    Parameters
    ----------
    path:
        The file.
    numeric, label:
        ``name`` or ``group/name`` of a dataset, ``name(:,2)`` for a column of a matrix, or
        ``name/field`` for a field of a table.

    Raises
    ------
    DataError
        If the file is damaged, lacks a dataset, or a dataset is external, virtual or compressed by a plug-in.
    """
    try:
        import h5py
    except ImportError:
        raise extra_missing(path, "HDF5 (and MATLAB v7.3)", "hdf5") from None
    numbers: dict[str, NDArray] = {}
    labels: dict[str, Label] = {}
    units: dict[str, str] = {}
    try:
        with h5py.File(path, "r", locking=False) as source:
            budget = _Budget(path)
            for name in dict.fromkeys(numeric):
                values, unit = _read(source, path, name, budget)
                numbers[name] = as_numbers(path, name, values)
                if unit:
                    units[name] = unit
            if label is not None:
                labels[label] = as_label(_read(source, path, label, budget)[0].tolist())
    except (OSError, RuntimeError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{path}: not a readable HDF5 file ({first_line(error)})",
            remedy="was it closed by the logger? copy or export it again",
        ) from None
    return make_table(path, numbers, labels, units)


class _Budget:
    """Counts the bytes requested so far and limits them."""

    def __init__(self, path: Path) -> None:
        self.path, self.size, self.used = path, path.stat().st_size, 0

    def take(self, count: int) -> None:
        self.used += count
        check_unpacked(self.path, self.used, self.size)


def _read(source: Any, path: Path, name: str, budget: _Budget) -> tuple[NDArray, str]:
    import h5py

    plain, column = split_name(name)
    item, field = _find(source, path, plain)
    _check_storage(item, path, plain)
    kind = item.dtype
    if h5py.check_string_dtype(kind) is not None:
        budget.take(int(item.size) * max(kind.itemsize, 64))
        return vector(path, name, np.asarray(item.asstr(errors="replace")[...], dtype=str), column), ""
    if h5py.check_ref_dtype(kind) is h5py.Reference and _text(item.attrs.get("MATLAB_class")) == "cell":
        return vector(path, name, _cell_array(source, path, plain, item, budget), column), ""
    if kind.hasobject:
        raise DataError(
            f"{path}: '{plain}' holds objects or references", remedy="store numbers or text in a plain dataset"
        )
    budget.take(int(item.size) * kind.itemsize)
    if column is None and _is_line(item):
        return _line(path, name, item), _unit(item)
    values = np.asarray(item[field] if field else item[...])
    if _text(item.attrs.get("MATLAB_class")):
        values = _characters(values) if _text(item.attrs.get("MATLAB_class")) == "char" else values.T
    return vector(path, name, values, column), _unit(item)


def _is_line(item: Any) -> bool:
    """True for one column of numbers, stored as a column or as a row."""
    line = item.ndim == 1 or (item.ndim == 2 and 1 in item.shape)
    return line and item.dtype.kind in "iuf" and _text(item.attrs.get("MATLAB_class")) != "char"


def _line(path: Path, name: str, item: Any) -> NDArray:
    """The numbers of a dataset with one column, read in pieces of whole chunks. A long column lies on disk."""
    rows = max(PIECE_ROWS, *(item.chunks or (0,)))
    column = long_column(item.dtype)
    for start in range(0, item.size, rows):
        part = slice(start, start + rows)
        piece = item[part] if item.ndim == 1 else item[0, part] if item.shape[0] == 1 else item[part, 0]
        column.append(as_numbers(path, name, piece), item.size)
    return column.finish()


def _characters(values: NDArray) -> NDArray:
    """Rows of a MATLAB char array as text: UTF-16 units, stored column by column, padded with blanks."""
    rows = np.atleast_2d(values.T).astype("<u2")
    return np.array([row.tobytes().decode("utf-16-le", errors="replace").rstrip(" \0") for row in rows])


def _cell_array(source: Any, path: Path, name: str, item: Any, budget: _Budget) -> NDArray:
    """A MATLAB cell array of texts or single numbers. Its cells are references to objects of the same file."""
    import h5py

    budget.take(64 * int(item.size))
    cells: list[str] = []
    for reference in item[...].T.reshape(-1):
        cell = source[reference] if reference else None
        if not isinstance(cell, h5py.Dataset) or cell.dtype.kind not in "uif" or cell.size > MAX_CELL:
            raise DataError(
                f"{path}: '{name}', cell {len(cells) + 1} holds no text and no number",
                remedy="store one label for each sample",
            )
        _check_storage(cell, path, name)
        budget.take(int(cell.size) * cell.dtype.itemsize)
        values, kind = np.asarray(cell[...]), _text(cell.attrs.get("MATLAB_class"))
        if cell.attrs.get("MATLAB_empty") or values.size == 0:
            cells.append("")
        elif kind == "char":
            cells.append("".join(_characters(values)))
        else:
            cells.append(label_text(values.reshape(-1)[0].item()))
    return np.array(cells, dtype=str)


def _find(source: Any, path: Path, name: str) -> tuple[Any, str | None]:
    """Find a dataset by name, only through hard links, and the field of a compound dataset."""
    import h5py

    parts = [part for part in name.replace(".", "/").split("/") if part]
    for wanted in ([part for part in name.split("/") if part], parts):
        item: Any = source
        for at, part in enumerate(wanted):
            if isinstance(item, h5py.Dataset):
                if at == len(wanted) - 1 and item.dtype.names and part in item.dtype.names:
                    return item, part
                break
            if part not in item:
                break
            link = item.get(part, getlink=True)
            if not isinstance(link, h5py.HardLink):
                raise DataError(
                    f"{path}: '{part}' is a link to another place ({type(link).__name__}), which is not followed",
                    remedy="copy the dataset into the file (h5repack or h5copy)",
                )
            item = item[part]
        else:
            if isinstance(item, h5py.Dataset) and item.dtype.names is None:
                return item, None
    raise no_column(path, name, _names(source))


def _names(source: Any) -> list[str]:
    """Names of the datasets, breadth first, up to a limit."""
    import h5py

    names: list[str] = []
    queue = [("", source, 0)]
    while queue and len(names) < MAX_NAMES:
        prefix, group, depth = queue.pop(0)
        for key in group:
            if not isinstance(group.get(key, getlink=True), h5py.HardLink) or key.startswith("#"):
                continue
            item = group[key]
            if isinstance(item, h5py.Dataset):
                fields = item.dtype.names
                shape = item.shape[::-1] if _text(item.attrs.get("MATLAB_class")) else item.shape
                whole = matrix_columns(f"{prefix}{key}", shape or ())
                names += [f"{prefix}{key}/{part}" for part in fields] if fields else whole
            elif isinstance(item, h5py.Group) and depth < 8:
                queue.append((f"{prefix}{key}/", item, depth + 1))
    return names


def _check_storage(item: Any, path: Path, name: str) -> None:
    """Refuse data that lie in other files or need a plug-in."""
    if item.is_virtual or item.external:
        raise DataError(
            f"{path}: the data of '{name}' lie in other files", remedy="repack it into one file (h5repack)"
        )
    plan = item.id.get_create_plist()
    for index in range(plan.get_nfilters()):
        code = plan.get_filter(index)[0]
        if code not in PLAIN_FILTERS:
            raise DataError(
                f"{path}: '{name}' is packed with filter {code}; only {', '.join(PLAIN_FILTERS.values())} are read",
                remedy="repack it: h5repack -f GZIP=4",
            )


def _unit(item: Any) -> str:
    for key in ("unit", "units", "Unit", "Units"):
        if key in item.attrs:
            return _text(item.attrs[key])
    return ""


def _text(value: object) -> str:
    if isinstance(value, bytes):
        return value.decode("utf-8", errors="replace")
    return value if isinstance(value, str) else ""
