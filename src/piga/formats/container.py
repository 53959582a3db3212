"""Read HDF5, MATLAB, TDMS and XLSX files whole: one table of the wanted columns. Their size is limited."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from piga.errors import EXTRAS, DataError, PigaError, Where
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
from piga.formats.xlsx import read_xlsx
from piga.records.limits import check_regular, check_unpacked, extra_missing, first_line, open_regular

HDF5_MARK = b"\x89HDF\r\n\x1a\n"
MAX_STRUCTS = 4
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
    variables = _variables(path, [split_name(name)[0].split(".")[0] for name in wanted])
    numbers = {
        name: as_numbers(path, name, _variable(path, variables, name)) for name in dict.fromkeys(numeric)
    }
    labels = None if label is None else (label, as_label(_label_cells(_variable(path, variables, label))))
    return make_table(path, numbers, labels, {})


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
    for field in fields[:MAX_STRUCTS]:
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
    if fields and isinstance(item, np.ndarray) and item.size == 1 and depth < MAX_STRUCTS:
        inside = ((f"{name}.{field}", item[field].reshape(-1)[0]) for field in fields)
        return [one for path, part in inside for one in _variable_names_below(path, part, depth + 1)]
    return matrix_columns(name, item.shape) if isinstance(item, np.ndarray) else [name]


def _label_cells(values: NDArray) -> list[object]:
    """Texts of a char matrix or of a cell array of char rows. Numbers are unchanged."""
    if values.dtype.kind != "O":
        return list(values.tolist())
    return [
        cell.reshape(-1)[0] if isinstance(cell, np.ndarray) and cell.size == 1 else str(cell) for cell in values
    ]


WAVEFORM_TIME = "waveform time"
"""Name of the time of a waveform: its channels state the interval between samples, and no channel holds the time."""
UNIT_KEYS = ("unit_string", "NI_UnitDescription", "unit")


def read_tdms(path: Path, numeric: tuple[str, ...], label: str | None) -> RawTable:
    """Read the named channels: ``channel`` if only one group has it, else ``group/channel``.

    Raises
    ------
    DataError
        If the file lacks a channel, or several groups have a channel of that name.
    """
    import nptdms

    numbers: dict[str, NDArray] = {}
    units: dict[str, str] = {}
    with open_regular(path) as stream, nptdms.TdmsFile.open(stream) as source:
        channels = [channel for group in source.groups() for channel in group.channels()]
        for name in dict.fromkeys(numeric):
            if name == WAVEFORM_TIME or name.endswith(f"/{WAVEFORM_TIME}"):
                numbers[name], units[name] = _waveform_time(path, channels, name), "s"
                continue
            channel = _channel(path, channels, name)
            numbers[name] = as_numbers(path, name, np.asarray(channel[:]))
            unit = next((channel.properties[key] for key in UNIT_KEYS if key in channel.properties), "")
            units |= {name: unit} if isinstance(unit, str) and unit else {}
        labels = None if label is None else (label, as_label(_channel(path, channels, label)[:].tolist()))
    return make_table(path, numbers, labels, units)


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
    times = [f"{group}/{WAVEFORM_TIME}" for group in _waveforms(channels)]
    return [*(f"{channel.group_name}/{channel.name}" for channel in channels), *times]


def _channel(path: Path, channels: list[Any], name: str) -> Any:
    """The channel of this name. It is not compressed, so it cannot have more values than the file has bytes."""
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
            columns=groups,
        )
    declared, size = len(matching[0]), path.stat().st_size
    if declared > size:
        raise DataError(
            f"{path}: '{name}' declares {declared} values, more than its {size} bytes can hold",
            remedy="the file is damaged: copy it again",
        )
    return matching[0]


class Container(NamedTuple):
    """A kind of file: its name, its reader, and what to do with a damaged file."""

    name: str
    read: Callable[[Path, tuple[str, ...], str | None], RawTable]
    remedy: str


_HDF5 = Container("HDF5", read_hdf5, "was it closed by the logger? copy or export it again")
CONTAINERS = {
    ".h5": _HDF5,
    ".hdf5": _HDF5,
    ".hdf": _HDF5,
    ".mat": Container("MATLAB", read_mat, "save it again with -v7 or -v7.3"),
    ".tdms": Container("TDMS", read_tdms, "was the logger stopped? copy it again"),
    ".xlsx": Container("XLSX", read_xlsx, "save it again as .xlsx, without a password"),
}
"""Kinds of containers by the ending of the file name."""


def read_container(
    path: Path, kind: str, numeric: tuple[str, ...], label: str | None, sheet: str | None = None
) -> RawTable:
    """Read the named columns of a container.

    Parameters
    ----------
    path:
        The file.
    kind:
        One of :data:`CONTAINERS`.
    numeric, label:
        Names of the number columns and of the segment column, as the reader of that format takes them.
    sheet:
        Name of the sheet in an ``.xlsx`` file.

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
            return read_xlsx(path, numeric, label, sheet)
        return container.read(path, numeric, label)
    except PigaError:
        raise
    except ImportError as error:
        raise extra_missing(path, container.name, EXTRAS[str(error.name).split(".")[0]]) from None
    except MemoryError:
        raise DataError(
            f"{path}: there is not enough memory to read it",
            remedy="the file is damaged, or export it as Parquet",
        ) from None
    except Exception as error:  # a damaged file can raise any exception in the library
        raise DataError(
            f"{path}: not a readable {container.name} file ({first_line(error)})", remedy=container.remedy
        ) from None
