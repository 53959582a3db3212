"""A record cut into stretches, each projected on its slowest cosines: all it tells of rates and ripple."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga.calibration.design import CACHE_BYTES, Design

Array = NDArray[np.float64]

MODES = 24
"""Cosines per stretch at least; four more per turn of the output and order of the model."""
MOST_MODES = 160


def modes_of(design: Design) -> int:
    """Contrasts per stretch: enough for the ripple of the fastest one, no more than the shortest allows."""
    run = design.run
    starts = np.flatnonzero(run.begins)
    lengths = np.diff(np.append(starts, run.size))
    ends = starts + lengths - 1
    turns = float(np.abs(run.output[ends] - run.output[starts]).max()) / (2.0 * math.pi)
    order = max((1, *design.request.harmonics))
    usable = lengths[lengths >= 8]
    if usable.size == 0:
        return 0
    return int(min(MODES + math.ceil(4.0 * turns * order), MOST_MODES, usable.min() - 2))


def all_stretches(design: Design, modes: int) -> list[Stretch] | None:
    """All stretches, to be kept as long as they take no more memory than the blocks of a design; else None."""
    if design.run.size * (len(design.names) + 2) * 8 > CACHE_BYTES:
        return None
    return list(stretches_of(design, modes))


@dataclass(frozen=True)
class Stretch:
    """One stretch: contrasts (K, bins), bin edges, sample times, angle columns (m + 1, n), their rows."""

    segment: int
    start: int
    contrasts: Array
    edges: NDArray[np.int64]
    t: Array
    columns: Array
    rows: Array

    def mean(self, values: Array) -> Array:
        """Means over the bins, last axis."""
        return np.add.reduceat(values, self.edges[:-1], axis=-1) / np.diff(self.edges)


def stretches_of(design: Design, modes: int) -> Iterator[Stretch]:
    """Stretches of at least eight samples, one segment in memory at a time."""
    run = design.run
    for start, segment, columns in _segments(design):
        marks = np.flatnonzero(run.begins[start : start + columns.shape[1]])
        for left, right in zip(marks, np.append(marks[1:], columns.shape[1]), strict=True):
            size = int(right - left)
            if size < 8:
                continue
            angle = np.cumsum(columns[:, left:right], axis=1)
            bins = min(size, 8 * modes)
            edges = np.linspace(0, size, bins + 1).astype(np.int64)
            contrasts = _contrasts(modes, bins)
            t = run.t[start + left : start + right]
            means = np.add.reduceat(angle, edges[:-1], axis=1) / np.diff(edges)
            yield Stretch(segment, start + int(left), contrasts, edges, t, angle, contrasts @ means.T)


def _segments(design: Design) -> Iterator[tuple[int, int, Array]]:
    """First row, index and increment columns (m + 1, n) of every segment's part of the record."""
    parts: list[Array] = []
    first, current = 0, -1
    for block in design.blocks():
        if current not in (-1, block.segment):
            yield first, current, np.concatenate(parts, axis=1)
            parts = []
        if not parts:
            first, current = block.start, block.segment
            if first == 1:
                first, parts = 0, [np.zeros((block.columns.shape[0], 1))]
        parts.append(block.columns)
    yield first, current, np.concatenate(parts, axis=1)


def _contrasts(modes: int, bins: int) -> Array:
    """Slowest cosines of the second kind, and the difference of the ends (which a random walk is known by)."""
    at = (np.arange(bins) + 0.5) / bins
    found = math.sqrt(2.0 / bins) * np.cos(np.pi * np.arange(1, modes)[:, None] * at)
    ends = np.zeros(bins)
    ends[0], ends[-1] = -1.0, 1.0
    return np.vstack([found, ends / math.sqrt(2.0)])
