"""Read TDMS data (LabVIEW): channels by name, with their units."""

from __future__ import annotations

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
    long_column,
    make_table,
    no_column,
)
from piga.records.limits import MAX_UNPACKED, check_unpacked, extra_missing, first_line, open_regular

WAVEFORM_TIME = "waveform time"
"""Name of the time of a waveform: its channels state the interval between samples, and no channel holds the time."""
UNIT_KEYS = ("unit_string", "NI_UnitDescription", "unit")


def read_tdms(path: Path, numeric: tuple[str, ...], label: str | None) -> RawTable:
    """Read the named channels: ``channel`` if only one group has it, else ``group/channel``.

    Raises
    ------
    DataError
        If the file is damaged, lacks a channel, or several groups have a channel of that name.
    """
    try:
        import nptdms
    except ImportError:
        raise extra_missing(path, "TDMS", "tdms") from None
    numbers: dict[str, NDArray] = {}
    labels: dict[str, Label] = {}
    units: dict[str, str] = {}
    try:
        with open_regular(path) as stream, nptdms.TdmsFile.open(stream) as source:
            channels = [channel for group in source.groups() for channel in group.channels()]
            _check_size(path, channels, (*numeric, *([label] if label else [])))
            for name in dict.fromkeys(numeric):
                if name == WAVEFORM_TIME or name.endswith(f"/{WAVEFORM_TIME}"):
                    numbers[name], units[name] = _waveform_time(path, channels, name), "s"
                    continue
                channel = _find(path, channels, name)
                numbers[name] = _numbers(path, name, channel)
                unit = next((channel.properties[key] for key in UNIT_KEYS if key in channel.properties), "")
                if isinstance(unit, str) and unit:
                    units[name] = unit
            if label is not None:
                labels[label] = as_label(_find(path, channels, label)[:].tolist())
    except (DataError, MemoryError):
        raise
    except Exception as error:  # a damaged file can raise any exception in the library
        raise DataError(
            f"{path}: not a readable TDMS file ({first_line(error)})",
            remedy="was the logger stopped? copy it again",
        ) from None
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
    known = _waveforms(channels)
    group = name.removesuffix(WAVEFORM_TIME).rstrip("/") if "/" in name else next(iter(known), "")
    if group not in known or ("/" not in name and len(known) > 1):
        raise no_column(path, name, _names(channels))
    start, step, count = known[group]
    declared = 8 * count
    check_unpacked(path, min(declared, MAX_UNPACKED + 1), path.stat().st_size)
    return start + step * np.arange(count)


def _names(channels: list[Any]) -> list[str]:
    times = [f"{group}/{WAVEFORM_TIME}" for group in _waveforms(channels)]
    return [*(f"{channel.group_name}/{channel.name}" for channel in channels), *times]


def _numbers(path: Path, name: str, channel: Any) -> NDArray:
    """The numbers of a channel, read piece by piece as they were written. A long channel lies on disk."""
    column = long_column(channel.dtype)
    count = 0
    if channel.dtype.kind in "iuf":
        for piece in channel.data_chunks():
            count += len(piece)
            if len(piece):
                column.append(as_numbers(path, name, np.asarray(piece[:])), len(channel))
    if count == 0 or count != len(channel):  # no numbers, or cut off: the library raises any of these
        return as_numbers(path, name, np.asarray(channel[:]))
    return column.finish()


def _check_size(path: Path, channels: list[Any], names: tuple[str, ...]) -> None:
    """Compare declared lengths with the file size. TDMS is not compressed, so no channel can be longer than the file."""
    stored = [name for name in dict.fromkeys(names) if not name.endswith(WAVEFORM_TIME)]
    declared = sum(len(_find(path, channels, name)) for name in stored)
    if declared > path.stat().st_size:
        raise DataError(
            f"{path}: declares {declared} values, more than its {path.stat().st_size} bytes can hold",
            remedy="the file is damaged: copy it again",
        )
    check_unpacked(path, min(8 * declared, MAX_UNPACKED + 1), path.stat().st_size)


def _find(path: Path, channels: list[Any], name: str) -> Any:
    matching = [
        channel for channel in channels if name in (channel.name, f"{channel.group_name}/{channel.name}")
    ]
    if not matching:
        raise no_column(path, name, _names(channels))
    if len(matching) > 1:
        groups = ", ".join(f"'{channel.group_name}/{channel.name}'" for channel in matching[:5])
        raise DataError(f"{path}: several groups have a channel '{name}'", remedy=f"name it as one of {groups}")
    return matching[0]
