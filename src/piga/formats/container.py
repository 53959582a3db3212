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

from piga.errors import EXTRAS, PigaError, install_command
from piga.formats.columns import TableStream, Wanted, label_text, matrix_columns, split_name
from piga.formats.xlsx import read_xlsx
from piga.records.limits import check_regular, first_line, open_regular

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


def _read_hdf5(wanted: Wanted) -> TableStream:
    """Read the named datasets: ``name`` or ``group/name``, ``name(:,2)`` of a matrix, ``name/field`` of a table."""
    import h5py

    with h5py.File(wanted.path, "r", locking=False) as source:
        units = {name: _unit(_find(source, wanted, name)[0].attrs) for name in wanted.numeric}
        return wanted.table(partial(_dataset, source, wanted), units)


def _unit(attributes: Any) -> str:
    return next((_text(attributes[key]) for key in _UNIT_KEYS if key in attributes), "")


def _dataset(source: Any, wanted: Wanted, name: str) -> NDArray:
    """One column of a dataset: numbers or texts (n,)."""
    import h5py

    item, field = _find(source, wanted, name)
    plain, kind, matlab = split_name(name)[0], item.dtype, _text(item.attrs.get("MATLAB_class"))
    _check_storage(item, wanted, plain)
    text = h5py.check_string_dtype(kind) is not None
    wanted.check_unpacked(int(item.size) * (max(kind.itemsize, 64) if text else kind.itemsize))
    if text:
        return wanted.vector(name, np.asarray(item.asstr(errors="replace")[...], dtype=str))
    if matlab == "cell" and h5py.check_ref_dtype(kind) is h5py.Reference:
        return wanted.vector(name, _cell_array(source, wanted, plain, item))
    if kind.hasobject:
        remedy = "store numbers or text in a plain dataset"
        raise wanted.refusal(f"'{plain}' holds objects or references", remedy, name)
    values = np.asarray(item[field] if field else item[...])
    if matlab:  # stored column by column
        values = _characters(values) if matlab == "char" else values.T
    return wanted.vector(name, values)


def _characters(values: NDArray) -> NDArray:
    """Rows of a MATLAB char array as text: UTF-16 units, stored column by column, padded with blanks."""
    rows = np.atleast_2d(values.T).astype("<u2")
    return np.array([row.tobytes().decode("utf-16-le", errors="replace").rstrip(" \0") for row in rows])


def _cell_array(source: Any, wanted: Wanted, name: str, item: Any) -> NDArray:
    """A MATLAB cell array of texts or single numbers. Its cells are references to objects of the same file."""
    import h5py

    cells: list[str] = []
    for reference in item[...].T.reshape(-1):
        cell = source[reference] if reference else None
        if not isinstance(cell, h5py.Dataset) or cell.dtype.kind not in "uif" or cell.size > _MAX_CELL:
            words = f"'{name}', cell {len(cells) + 1} holds no text and no number"
            raise wanted.refusal(words, "store one label for each sample", name)
        _check_storage(cell, wanted, name)
        values = np.asarray(cell[...])
        if cell.attrs.get("MATLAB_empty") or values.size == 0:
            cells.append("")
        elif _text(cell.attrs.get("MATLAB_class")) == "char":
            cells.append("".join(_characters(values)))
        else:
            cells.append(label_text(values.reshape(-1)[0].item()))
    return np.array(cells, dtype=str)


def _find(source: Any, wanted: Wanted, name: str) -> tuple[Any, str | None]:
    """Find a dataset by name, only through hard links, and the field of a compound dataset."""
    import h5py

    plain = split_name(name)[0]
    for separated in (plain.strip("/"), plain.replace(".", "/")):
        parts = separated.split("/")
        for at in range(len(parts)):
            link = source.get("/".join(parts[: at + 1]), getlink=True)
            if link is not None and not isinstance(link, h5py.HardLink):
                words = (
                    f"'{parts[at]}' is a link to another place ({type(link).__name__}), which is not followed"
                )
                raise wanted.refusal(words, "copy the dataset into the file (h5repack or h5copy)", name)
        for place, field in ((separated, None), ("/".join(parts[:-1]), parts[-1])):
            item = source.get(place) if place else None
            if isinstance(item, h5py.Dataset) and (
                item.dtype.names is None if field is None else field in (item.dtype.names or ())
            ):
                return item, field
    raise wanted.no_column(plain, _dataset_names(source))


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


def _check_storage(item: Any, wanted: Wanted, name: str) -> None:
    """Refuse data that lie in other files or need a plug-in."""
    if item.is_virtual or item.external:
        remedy = "repack it into one file (h5repack)"
        raise wanted.refusal(f"the data of '{name}' lie in other files", remedy, name)
    plan = item.id.get_create_plist()
    strange = {plan.get_filter(index)[0] for index in range(plan.get_nfilters())} - set(_PLAIN_FILTERS)
    if strange:
        words = (
            f"'{name}' is packed with filter {min(strange)}; only {', '.join(_PLAIN_FILTERS.values())} are read"
        )
        raise wanted.refusal(words, "repack it: h5repack -f GZIP=4", name)


def _text(value: object) -> str:
    if isinstance(value, bytes):
        return value.decode("utf-8", errors="replace")
    return value if isinstance(value, str) else ""


# -- MATLAB --------------------------------------------------------------------------------------------

_MAX_STRUCTS = 4
"""Most structs inside each other."""


def _read_mat(wanted: Wanted) -> TableStream:
    """Read the named variables: ``name``, ``struct.field``, or ``name(:,2)`` for a column of a matrix."""
    with open_regular(wanted.path) as stream:
        head = stream.read(520)
    if _HDF5_MARK in (head[:8], head[512:520]):
        return _read_hdf5(wanted)
    variables = _variables(wanted, [split_name(name)[0].split(".")[0] for name in wanted.names])
    return wanted.table(partial(_variable, wanted, variables), {})


def _variables(wanted: Wanted, names: list[str] | None) -> dict[str, Any]:
    """The named variables (None: all). A variable that is there and not named is None."""
    from scipy.io import loadmat, whosmat

    shapes = {name: shape for name, shape, _ in whosmat(wanted.path)}
    for name in shapes if names is None else set(names) & set(shapes):
        wanted.check_unpacked(8 * math.prod(shapes[name]))
    variables = loadmat(wanted.path, variable_names=names, chars_as_strings=True, struct_as_record=True)
    return {name: variables.get(name) for name in shapes}


def _variable(wanted: Wanted, variables: dict[str, Any], name: str) -> NDArray:
    first, *fields = split_name(name)[0].split(".")
    item = variables.get(first)
    for field in fields[:_MAX_STRUCTS]:
        inside = field in (getattr(getattr(item, "dtype", None), "names", None) or ())
        item = item[field].reshape(-1)[0] if item is not None and inside and item.size == 1 else None
    if not isinstance(item, np.ndarray) or item.dtype.names:
        everything = _variables(wanted, None).items()
        present = [below for one, variable in everything for below in _names_below(one, variable, 0)]
        raise wanted.no_column(name, present)
    return wanted.vector(name, item)


def _names_below(name: str, item: object, depth: int) -> list[str]:
    """Names of all columns of a variable: itself, columns of a matrix, and these in structs."""
    fields = getattr(getattr(item, "dtype", None), "names", None)
    if fields and isinstance(item, np.ndarray) and item.size == 1 and depth < _MAX_STRUCTS:
        inside = ((f"{name}.{field}", item[field].reshape(-1)[0]) for field in fields)
        return [one for path, part in inside for one in _names_below(path, part, depth + 1)]
    return matrix_columns(name, item.shape) if isinstance(item, np.ndarray) else [name]


# -- TDMS ----------------------------------------------------------------------------------------------

_WAVEFORM_TIME = "waveform time"
"""Name of the time of a waveform: its channels state the interval between samples, and no channel holds the time."""


def _read_tdms(wanted: Wanted) -> TableStream:
    """Read the named channels: ``channel`` if only one group has it, else ``group/channel``."""
    import nptdms

    with open_regular(wanted.path) as stream, nptdms.TdmsFile.open(stream) as source:
        channels = [channel for group in source.groups() for channel in group.channels()]
        units = {
            name: "s" if _is_time(name) else _unit(_channel(wanted, channels, name).properties)
            for name in wanted.numeric
        }
        return wanted.table(partial(_samples, wanted, channels), units)


def _is_time(name: str) -> bool:
    return name.rpartition("/")[2] == _WAVEFORM_TIME


def _samples(wanted: Wanted, channels: list[Any], name: str) -> NDArray:
    if _is_time(name):
        return _waveform_time(wanted, channels, name)
    return np.asarray(_channel(wanted, channels, name)[:])


def _waveforms(channels: list[Any]) -> dict[str, tuple[float, float, int]]:
    """Start, interval [s] and length of the waveforms, by group. A group whose channels differ has none."""
    groups: dict[str, set[tuple[float, float, int]]] = {}
    for channel in channels:
        step, start = (float(channel.properties.get(key, 0.0)) for key in ("wf_increment", "wf_start_offset"))
        groups.setdefault(channel.group_name, set()).add((start, step, len(channel)))
    return {
        group: next(iter(one)) for group, one in groups.items() if len(one) == 1 and next(iter(one))[1] > 0.0
    }


def _waveform_time(wanted: Wanted, channels: list[Any], name: str) -> NDArray:
    """Time of the samples [s] of a group, or of the only group, from what its channels state."""
    waveforms = _waveforms(channels)
    group = name.rpartition("/")[0] or next(iter(waveforms), "")
    if group not in waveforms or ("/" not in name and len(waveforms) > 1):
        raise wanted.no_column(name, _channel_names(channels))
    start, step, count = waveforms[group]
    wanted.check_unpacked(8 * count)
    return start + step * np.arange(count)


def _channel_names(channels: list[Any]) -> list[str]:
    times = [f"{group}/{_WAVEFORM_TIME}" for group in _waveforms(channels)]
    return [*(f"{channel.group_name}/{channel.name}" for channel in channels), *times]


def _channel(wanted: Wanted, channels: list[Any], name: str) -> Any:
    """The channel of this name."""
    full = {f"{channel.group_name}/{channel.name}": channel for channel in channels}
    matching = [one for one, channel in full.items() if name in (channel.name, one)]
    if not matching:
        raise wanted.no_column(name, _channel_names(channels))
    if len(matching) > 1:
        remedy = f"name it as one of {', '.join(map(repr, matching[:5]))}"
        raise wanted.refusal(f"several groups have a channel '{name}'", remedy, name)
    wanted.check_unpacked(8 * len(full[matching[0]]))
    return full[matching[0]]


# -- all of them ----------------------------------------------------------------------------------------


class Container(NamedTuple):
    """A kind of file: its name, its reader, and what to do with a damaged file."""

    name: str
    read: Callable[[Wanted], TableStream]
    remedy: str


_HDF5 = Container("HDF5", _read_hdf5, "was it closed by the logger? copy or export it again")
CONTAINERS = {
    ".h5": _HDF5,
    ".hdf5": _HDF5,
    ".hdf": _HDF5,
    ".mat": Container("MATLAB", _read_mat, "save it again with -v7 or -v7.3"),
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
    """Read the named columns of a container of a ``kind`` in :data:`CONTAINERS`. The others are those of :class:`Wanted`.

    Raises
    ------
    DataError
        If the file cannot be read as requested, or unpacks to more than is read.
    """
    wanted, container = Wanted(path, numeric, label, sheet, missing), CONTAINERS[kind]
    check_regular(path, "[data] file is relative to the run file")
    if kind == ".xlsx" and path.with_name(f"~${path.name}").exists():
        raise wanted.refusal("is open in a spreadsheet program", "close it there, then try again")
    try:
        return container.read(wanted)
    except PigaError:
        raise
    except ImportError as error:
        extra = EXTRAS[str(error.name).split(".")[0]]
        words = f"reading {container.name} needs the extra '{extra}', which is not installed"
        raise wanted.refusal(words, f"install it with: {install_command(extra)}") from None
    except MemoryError:
        remedy = "the file is damaged, or export it as Parquet"
        raise wanted.refusal("there is not enough memory to read it", remedy) from None
    except Exception as error:  # a damaged file can raise any exception in the library
        words = f"not a readable {container.name} file ({first_line(error)})"
        raise wanted.refusal(words, container.remedy) from None
