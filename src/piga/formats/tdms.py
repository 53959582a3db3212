"""Read TDMS data (LabVIEW): channels by name, with their units."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.errors import DataError, Where
from piga.formats.columns import RawTable, as_label, as_numbers, make_table, no_column
from piga.records.limits import check_unpacked, open_regular

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
            channel = _find(path, channels, name)
            numbers[name] = as_numbers(path, name, np.asarray(channel[:]))
            unit = next((channel.properties[key] for key in UNIT_KEYS if key in channel.properties), "")
            units |= {name: unit} if isinstance(unit, str) and unit else {}
        labels = None if label is None else (label, as_label(_find(path, channels, label)[:].tolist()))
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
        raise no_column(path, name, _names(channels))
    start, step, count = waveforms[group]
    check_unpacked(path, 8 * count, path.stat().st_size)
    return start + step * np.arange(count)


def _names(channels: list[Any]) -> list[str]:
    times = [f"{group}/{WAVEFORM_TIME}" for group in _waveforms(channels)]
    return [*(f"{channel.group_name}/{channel.name}" for channel in channels), *times]


def _find(path: Path, channels: list[Any], name: str) -> Any:
    """The channel of this name. It is not compressed, so it cannot have more values than the file has bytes."""
    matching = [
        channel for channel in channels if name in (channel.name, f"{channel.group_name}/{channel.name}")
    ]
    if not matching:
        raise no_column(path, name, _names(channels))
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
