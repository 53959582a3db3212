"""Read HDF5, MATLAB, TDMS and XLSX files whole: one table of the wanted columns. Their size is limited.

HDF5 data, including MATLAB v7.3, are read only from the file itself and with built-in filters. No plug-in is ever loaded.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from piga.errors import EXTRAS, DataError, PigaError, Where, install_command
from piga.formats.columns import (
    TableStream,
    label_text,
    make_table,
    matrix_columns,
    no_column,
    split_name,
    vector,
)
from piga.formats.xlsx import read_xlsx
from piga.records.limits import check_regular, check_unpacked, first_line, open_regular

# -- HDF5 ----------------------------------------------------------------------------------------------

_HDF5_MARK = b"\x89HDF\r\n\x1a\n"
_PLAIN_FILTERS = {1: "gzip", 2: "shuffle", 3: "fletcher32"}
"""Filters built into the HDF5 library."""
_MAX_NAMES, _MAX_LEVELS = 200, 8
"""Most names that are listed, and most groups inside each other of which they are listed."""
_MAX_CELL = 4096
"""Most characters of one text cell."""
_UNIT_KEYS = ("unit", "units", "Unit", "Units", "unit_string", "NI_UnitDescription")
"""Attributes of an HDF5 dataset or a TDMS channel that state its unit."""


def _read_hdf5(path: Path, numeric: tuple[str, ...], label: str | None) -> TableStream:
    """Read the named datasets.

    Parameters
    ----------
    path:
        The file.
    numeric, label:
        ``name`` or ``group/name`` of a dataset, ``name(:,2)`` for a column of a matrix, or
        ``name/field`` for a field of a table.
    """
    import h5py

    with h5py.File(path, "r", locking=False) as source:
        units = {name: _unit(_find(source, path, name)[0].attrs) for name in numeric}
        return make_table(path, numeric, label, partial(_dataset, source, path), units)


def _unit(attributes: Any) -> str:
    return next((_text(attributes[key]) for key in _UNIT_KEYS if key in attributes), "")


def _dataset(source: Any, path: Path, name: str) -> NDArray:
    """One column of a dataset: numbers or texts (n,)."""
    import h5py

    item, field = _find(source, path, name)
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
        if not isinstance(cell, h5py.Dataset) or cell.dtype.kind not in "uif" or cell.size > _MAX_CELL:
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
    for separated in (plain.strip("/"), plain.replace(".", "/")):
        parts = separated.split("/")
        for at in range(len(parts)):
            link = source.get("/".join(parts[: at + 1]), getlink=True)
            if link is not None and not isinstance(link, h5py.HardLink):
                raise DataError(
                    f"{path}: '{parts[at]}' is a link to another place ({type(link).__name__}), which is not followed",
                    remedy="copy the dataset into the file (h5repack or h5copy)",
                )
        for place, field in ((separated, None), ("/".join(parts[:-1]), parts[-1])):
            item = source.get(place) if place else None
            if isinstance(item, h5py.Dataset) and (
                item.dtype.names is None if field is None else field in (item.dtype.names or ())
            ):
                return item, field
    raise no_column(path, plain, _dataset_names(source))


def _dataset_names(source: Any) -> list[str]:
    """Names of the datasets of the file itself, up to a limit. Links are not followed."""
    import h5py

    names: list[str] = []

    def visit(name: str, item: Any) -> bool | None:
        if isinstance(item, h5py.Dataset) and not name.startswith("#") and name.count("/") <= _MAX_LEVELS:
            shape = item.shape[::-1] if _text(item.attrs.get("MATLAB_class")) else item.shape
            fields = [f"{name}/{part}" for part in item.dtype.names or ()]
            names.extend(fields or matrix_columns(name, shape or ()))
        return len(names) >= _MAX_NAMES or None

    source.visititems(visit)
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
        if code not in _PLAIN_FILTERS:
            raise DataError(
                f"{path}: '{name}' is packed with filter {code}; only {', '.join(_PLAIN_FILTERS.values())} are read",
                remedy="repack it: h5repack -f GZIP=4",
            )


def _text(value: object) -> str:
    if isinstance(value, bytes):
        return value.decode("utf-8", errors="replace")
    return value if isinstance(value, str) else ""


# -- MATLAB --------------------------------------------------------------------------------------------

_MAX_STRUCTS = 4
"""Most structs inside each other."""


def read_mat(path: Path, numeric: tuple[str, ...], label: str | None) -> TableStream:
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
    if _HDF5_MARK in (head[:8], head[512:520]):
        return _read_hdf5(path, numeric, label)
    wanted = [*numeric, *([label] if label else [])]
    variables = _variables(path, [split_name(name)[0].split(".")[0] for name in wanted])
    return make_table(path, numeric, label, partial(_variable, path, variables), {})


def _variables(path: Path, names: list[str] | None) -> dict[str, Any]:
    """The named variables (None: all). A variable that is there and not named is None."""
    from scipy.io import loadmat, whosmat

    shapes = {name: shape for name, shape, _ in whosmat(path)}
    for name in shapes if names is None else set(names) & set(shapes):
        check_unpacked(path, 8 * math.prod(shapes[name]), path.stat().st_size)
    variables = loadmat(path, variable_names=names, chars_as_strings=True, struct_as_record=True)
    return {name: variables.get(name) for name in shapes}


def _variable(path: Path, variables: dict[str, Any], name: str) -> NDArray:
    plain, column = split_name(name)
    first, *fields = plain.split(".")
    item = variables.get(first)
    for field in fields[:_MAX_STRUCTS]:
        names = getattr(getattr(item, "dtype", None), "names", None)
        if not names or field not in names or item is None or item.size != 1:
            raise no_column(path, name, _variable_names(path))
        item = item[field].reshape(-1)[0]
    if not isinstance(item, np.ndarray) or item.dtype.names:
        raise no_column(path, name, _variable_names(path))
    return vector(path, name, item, column)


def _variable_names(path: Path) -> list[str]:
    """Names of all columns: vectors, columns of matrices, and these in structs."""
    return [
        one for name, item in _variables(path, None).items() for one in _variable_names_below(name, item, 0)
    ]


def _variable_names_below(name: str, item: object, depth: int) -> list[str]:
    fields = getattr(getattr(item, "dtype", None), "names", None)
    if fields and isinstance(item, np.ndarray) and item.size == 1 and depth < _MAX_STRUCTS:
        inside = ((f"{name}.{field}", item[field].reshape(-1)[0]) for field in fields)
        return [one for path, part in inside for one in _variable_names_below(path, part, depth + 1)]
    return matrix_columns(name, item.shape) if isinstance(item, np.ndarray) else [name]


# -- TDMS ----------------------------------------------------------------------------------------------

_WAVEFORM_TIME = "waveform time"
"""Name of the time of a waveform: its channels state the interval between samples, and no channel holds the time."""


def _read_tdms(path: Path, numeric: tuple[str, ...], label: str | None) -> TableStream:
    """Read the named channels: ``channel`` if only one group has it, else ``group/channel``."""
    import nptdms

    with open_regular(path) as stream, nptdms.TdmsFile.open(stream) as source:
        channels = [channel for group in source.groups() for channel in group.channels()]
        units = {
            name: "s" if _is_time(name) else _unit(_channel(path, channels, name).properties)
            for name in numeric
        }
        return make_table(path, numeric, label, partial(_samples, path, channels), units)


def _is_time(name: str) -> bool:
    return name.rpartition("/")[2] == _WAVEFORM_TIME


def _samples(path: Path, channels: list[Any], name: str) -> NDArray:
    if _is_time(name):
        return _waveform_time(path, channels, name)
    return np.asarray(_channel(path, channels, name)[:])


def _waveforms(channels: list[Any]) -> dict[str, tuple[float, float, int]]:
    """Start, interval [s] and length of the waveforms, by group. A group whose channels differ has none."""
    groups: dict[str, set[tuple[float, float, int]]] = {}
    for channel in channels:
        step, start = (float(channel.properties.get(key, 0.0)) for key in ("wf_increment", "wf_start_offset"))
        groups.setdefault(channel.group_name, set()).add((start, step, len(channel)))
    return {
        group: next(iter(one)) for group, one in groups.items() if len(one) == 1 and next(iter(one))[1] > 0.0
    }


def _waveform_time(path: Path, channels: list[Any], name: str) -> NDArray:
    """Time of the samples [s] of a group, or of the only group, from what its channels state."""
    waveforms = _waveforms(channels)
    group = name.rpartition("/")[0] or next(iter(waveforms), "")
    if group not in waveforms or ("/" not in name and len(waveforms) > 1):
        raise no_column(path, name, _channel_names(channels))
    start, step, count = waveforms[group]
    check_unpacked(path, 8 * count, path.stat().st_size)
    return start + step * np.arange(count)


def _channel_names(channels: list[Any]) -> list[str]:
    times = [f"{group}/{_WAVEFORM_TIME}" for group in _waveforms(channels)]
    return [*(f"{channel.group_name}/{channel.name}" for channel in channels), *times]


def _channel(path: Path, channels: list[Any], name: str) -> Any:
    """The channel of this name."""
    matching = [
        channel for channel in channels if name in (channel.name, f"{channel.group_name}/{channel.name}")
    ]
    if not matching:
        raise no_column(path, name, _channel_names(channels))
    if len(matching) > 1:
        groups = tuple(f"{channel.group_name}/{channel.name}" for channel in matching)
        raise DataError(
            f"{path}: several groups have a channel '{name}'",
            remedy=f"name it as one of {', '.join(map(repr, groups[:5]))}",
            where=Where(path, columns=(name,)),
        )
    check_unpacked(path, 8 * len(matching[0]), path.stat().st_size)
    return matching[0]


# -- all of them ----------------------------------------------------------------------------------------


class Container(NamedTuple):
    """A kind of file: its name, its reader, and what to do with a damaged file."""

    name: str
    read: Callable[[Path, tuple[str, ...], str | None], TableStream]
    remedy: str


_HDF5 = Container("HDF5", _read_hdf5, "was it closed by the logger? copy or export it again")
CONTAINERS = {
    ".h5": _HDF5,
    ".hdf5": _HDF5,
    ".hdf": _HDF5,
    ".mat": Container("MATLAB", read_mat, "save it again with -v7 or -v7.3"),
    ".tdms": Container("TDMS", _read_tdms, "was the logger stopped? copy it again"),
    ".xlsx": Container("XLSX", read_xlsx, "save it again as .xlsx, without a password"),
}
"""Kinds of containers by the ending of the file name."""


def read_container(
    path: Path,
    kind: str,
    numeric: tuple[str, ...],
    label: str | None,
    sheet: str | None = None,
    missing: tuple[str, ...] = (),
) -> TableStream:
    """Read the named columns of a container.

    Parameters
    ----------
    path:
        The file.
    kind:
        One of :data:`CONTAINERS`.
    numeric, label:
        Names of the number columns and of the segment column, as the reader of that format takes them.
    sheet, missing:
        Name of the sheet, and words that mean a missing value, in an ``.xlsx`` file.

    Raises
    ------
    DataError
        If the file cannot be read as requested, or unpacks to more than is read.
    """
    container = CONTAINERS[kind]
    check_regular(path, "[data] file is relative to the run file")
    if kind == ".xlsx" and path.with_name(f"~${path.name}").exists():
        raise DataError(f"{path}: is open in a spreadsheet program", remedy="close it there, then try again")
    try:
        if kind == ".xlsx":
            return read_xlsx(path, numeric, label, sheet, missing)
        return container.read(path, numeric, label)
    except PigaError:
        raise
    except ImportError as error:
        extra = EXTRAS[str(error.name).split(".")[0]]
        raise DataError(
            f"{path}: reading {container.name} needs the extra '{extra}', which is not installed",
            remedy=f"install it with: {install_command(extra)}",
        ) from None
    except MemoryError:
        raise DataError(
            f"{path}: there is not enough memory to read it",
            remedy="the file is damaged, or export it as Parquet",
        ) from None
    except Exception as error:  # a damaged file can raise any exception in the library
        raise DataError(
            f"{path}: not a readable {container.name} file ({first_line(error)})", remedy=container.remedy
        ) from None
