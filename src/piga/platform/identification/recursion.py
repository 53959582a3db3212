"""Identification sample by sample: the rows of the batch form taken in one by one, with the history kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from piga._kernels.platform.recursion import sequential_factor
from piga.platform.identification.estimate import Solution, noise_levels
from piga.platform.identification.identified import Identification, result
from piga.platform.identification.identify import gauss_newton
from piga.platform.identification.sources import STATIC_SOURCES, Record
from piga.platform.model.scenario import Place
from piga.platform.model.simulate import Readouts

Array = NDArray[np.float64]

_PRIOR = 1e-9
"""Diagonal of the first factor for columns of unit length: keeps it regular without weighing on the result."""


def identify_recursively(
    readouts: Readouts,
    place: Place,
    *,
    sources: Sequence[str] = STATIC_SOURCES,
    orders: int = 3,
    points: int = 200,
) -> Identification:
    """The same estimate sample by sample, with its history.

    The rows are linearised once about a batch solution over the first quarter of the record (at least four case
    turns), which also gives the noise levels, and taken in one by one by square-root (Givens) updates; the end
    agrees with the batch estimate to the second order of what the start was wrong by. ``points`` are kept.
    """
    record = Record.checked(readouts, sources, orders)
    span = float(readouts.times[-1] - readouts.times[0])
    early = Record.checked(readouts.first(max(4.0 * record.periods[1], 0.25 * span)), sources, orders)
    x, parts, start = gauss_newton(early, place)
    levels = {part.name: level for part, level in zip(parts, start.levels, strict=True)}
    times, ends = _taken_in(list(record.in_time(x, levels)), len(record.names) + 1, points)
    values, stds = np.empty((len(ends), len(record.names))), np.empty((len(ends), len(record.names)))
    for k, factor in enumerate(ends):
        inverse = np.linalg.inv(factor[:-1, :-1])
        values[k], stds[k] = inverse @ factor[:-1, -1], np.sqrt(np.sum(inverse**2, axis=1))
    end = record.moved(x, values[-1])
    parts = [group.reduced() for group in record.groups(end)]
    last = Solution(
        0.0 * values[-1], inverse @ inverse.T, start.condition, tuple(levels[p.name] for p in parts)
    )
    found = result(record, end, parts, replace(last, levels=tuple(noise_levels(parts, last))))
    seen = [record.names.index(name) for name in found.names]
    history = {"time": times, "values": found.values + (values - values[-1])[:, seen], "stds": stds[:, seen]}
    return replace(found, history=history)


def _taken_in(stream: list[tuple[Array, Array]], size: int, points: int) -> tuple[Array, Array]:
    """Times (k,) and factors (k, size, size) of ``points`` instants, the last row among them."""
    count = sum(len(times) for times, _ in stream)
    scale = np.ones(size)
    scale[:-1] = np.sqrt(sum(np.sum(rows[:, -size:-1] ** 2, axis=0) for _, rows in stream))
    kept = np.unique(np.linspace(max(count // 20, 4 * size), count - 1, points).astype(np.int64))
    ends, when, block, at, done = np.empty((len(kept), size, size)), [], _PRIOR * np.eye(size), 0, 0
    for times, rows in stream:
        rows[:, -size:] /= scale
        slow = rows.shape[1] - size
        factor = _PRIOR * np.eye(rows.shape[1])
        factor[slow:, slow:] = block
        here = kept[(kept >= at) & (kept < at + len(rows))] - at
        sequential_factor(rows, factor, here, ends[done : done + len(here)])
        when.append(times[here])
        block, at, done = factor[slow:, slow:], at + len(rows), done + len(here)
    return np.concatenate(when), ends * scale
