"""Read HDF5 data, including MATLAB v7.3: datasets by name, only from the file itself and with built-in filters."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.errors import DataError
from piga.formats.columns import (
    RawTable,
    as_label,
    as_numbers,
    label_text,
    make_table,
    matrix_columns,
    no_column,
    split_name,
    vector,
)
from piga.records.limits import check_unpacked

PLAIN_FILTERS = {1: "gzip", 2: "shuffle", 3: "fletcher32"}
"""Filters built into the HDF5 library. No plug-in is ever loaded."""
MAX_NAMES, MAX_LEVELS = 200, 8
"""Most names that are listed, and most groups inside each other that are searched for them."""
MAX_CELL = 4096
"""Most characters of one text cell."""
UNIT_KEYS = ("unit", "units", "Unit", "Units")


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
        If the file lacks a dataset, or a dataset is external, virtual or compressed by a plug-in.
    """
    import h5py

    numbers: dict[str, NDArray] = {}
    units: dict[str, str] = {}
    with h5py.File(path, "r", locking=False) as source:
        for name in dict.fromkeys(numeric):
            item, field = _find(source, path, name)
            numbers[name] = as_numbers(path, name, _values(source, path, name, item, field))
            unit = next((_text(item.attrs[key]) for key in UNIT_KEYS if key in item.attrs), "")
            units |= {name: unit} if unit else {}
        labels = None
        if label is not None:
            item, field = _find(source, path, label)
            labels = label, as_label(_values(source, path, label, item, field).tolist())
    return make_table(path, numbers, labels, units)


def _values(source: Any, path: Path, name: str, item: Any, field: str | None) -> NDArray:
    """One column of a dataset: numbers or texts (n,)."""
    import h5py

    plain, column = split_name(name)
    _check_storage(item, path, plain)
    kind, matlab = item.dtype, _text(item.attrs.get("MATLAB_class"))
    text = h5py.check_string_dtype(kind) is not None
    check_unpacked(
        path, int(item.size) * (max(kind.itemsize, 64) if text else kind.itemsize), path.stat().st_size
    )
    if text:
        return vector(path, name, np.asarray(item.asstr(errors="replace")[...], dtype=str), column)
    if matlab == "cell" and h5py.check_ref_dtype(kind) is h5py.Reference:
        return vector(path, name, _cell_array(source, path, plain, item), column)
    if kind.hasobject:
        raise DataError(
            f"{path}: '{plain}' holds objects or references", remedy="store numbers or text in a plain dataset"
        )
    values = np.asarray(item[field] if field else item[...])
    if matlab:  # stored column by column
        values = _characters(values) if matlab == "char" else values.T
    return vector(path, name, values, column)


def _characters(values: NDArray) -> NDArray:
    """Rows of a MATLAB char array as text: UTF-16 units, stored column by column, padded with blanks."""
    rows = np.atleast_2d(values.T).astype("<u2")
    return np.array([row.tobytes().decode("utf-16-le", errors="replace").rstrip(" \0") for row in rows])


def _cell_array(source: Any, path: Path, name: str, item: Any) -> NDArray:
    """A MATLAB cell array of texts or single numbers. Its cells are references to objects of the same file."""
    import h5py

    cells: list[str] = []
    for reference in item[...].T.reshape(-1):
        cell = source[reference] if reference else None
        if not isinstance(cell, h5py.Dataset) or cell.dtype.kind not in "uif" or cell.size > MAX_CELL:
            raise DataError(
                f"{path}: '{name}', cell {len(cells) + 1} holds no text and no number",
                remedy="store one label for each sample",
            )
        _check_storage(cell, path, name)
        values = np.asarray(cell[...])
        if cell.attrs.get("MATLAB_empty") or values.size == 0:
            cells.append("")
        elif _text(cell.attrs.get("MATLAB_class")) == "char":
            cells.append("".join(_characters(values)))
        else:
            cells.append(label_text(values.reshape(-1)[0].item()))
    return np.array(cells, dtype=str)


def _find(source: Any, path: Path, name: str) -> tuple[Any, str | None]:
    """Find a dataset by name, only through hard links, and the field of a compound dataset."""
    import h5py

    plain = split_name(name)[0]
    for separated in (plain, plain.replace(".", "/")):
        item: Any = source
        parts = [part for part in separated.split("/") if part]
        for at, part in enumerate(parts):
            if isinstance(item, h5py.Dataset):
                if at == len(parts) - 1 and part in (item.dtype.names or ()):
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
    raise no_column(path, plain, _names(source))


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
                shape = item.shape[::-1] if _text(item.attrs.get("MATLAB_class")) else item.shape
                fields = [f"{prefix}{key}/{part}" for part in item.dtype.names or ()]
                names += fields or matrix_columns(f"{prefix}{key}", shape or ())
            elif isinstance(item, h5py.Group) and depth < MAX_LEVELS:
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


def _text(value: object) -> str:
    if isinstance(value, bytes):
        return value.decode("utf-8", errors="replace")
    return value if isinstance(value, str) else ""
