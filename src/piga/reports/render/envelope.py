"""The envelope of a long curve: few points that keep its extremes and its gaps.

Of a very long record, figures show the envelope and the first part of every segment.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga.records.calibration.diagnostics import Residuals

POINTS = 2000
"""Points that a drawn curve keeps at most."""
SHOWN = 1 << 20
"""Samples that figures work on at most."""
_OUTLINE = 50_000
"""Points of the residuals of a very long record."""


def envelope_rows(y: ArrayLike, limit: int = POINTS) -> NDArray[np.int64]:
    """Rows of ``y`` (n,) that keep its envelope, rising: lowest, highest and one gap row of each bucket, and both ends.

    Rows that are not finite are gaps of the curve. There are at most ``limit`` rows (at least 8); a shorter curve is whole.
    """
    values = np.asarray(y)
    if values.size <= limit:
        return np.arange(values.size)
    edges = np.linspace(0, values.size, (limit - 2) // 3 + 1).astype(np.int64)
    kept = [0, values.size - 1]
    for start, stop in pairwise(edges.tolist()):
        kept += [start + row for row in _bucket_rows(values[start:stop])]
    return np.unique(np.array(kept, dtype=np.int64))


def _bucket_rows(values: NDArray[Any]) -> list[int]:
    low, high = int(np.argmin(values)), int(np.argmax(values))
    if np.isfinite(values[low]) and np.isfinite(values[high]):
        return [low, high]
    finite = np.flatnonzero(np.isfinite(values))
    gap = int(np.argmin(np.isfinite(values)))
    if finite.size == 0:
        return [gap]
    return [gap, int(finite[np.argmin(values[finite])]), int(finite[np.argmax(values[finite])])]


def outline(residuals: Residuals) -> Residuals:
    """Rows that keep the envelope of the residuals against time; all of a short record."""
    if residuals.t.size <= SHOWN:
        return residuals
    edges = _edges(residuals.segment)
    ends = np.unique(np.concatenate((edges[:-1], edges[1:] - 1)))
    drawn = [envelope_rows(values, _OUTLINE) for values in (residuals.before, residuals.after)]
    return rows_of(residuals, np.unique(np.concatenate([ends, *drawn])))


def leading_part(residuals: Residuals) -> Residuals:
    """The first samples of every segment, neighbours as in the record; all of a short record."""
    if residuals.t.size <= SHOWN:
        return residuals
    edges = _edges(residuals.segment)
    share = max(SHOWN // (edges.size - 1), 8)
    rows = [np.arange(left, min(left + share, right)) for left, right in pairwise(edges.tolist())]
    return rows_of(residuals, np.concatenate(rows))


def _edges(segment: NDArray[np.int32]) -> NDArray[np.int64]:
    """Rows where segments begin, and the end of the last one."""
    return np.concatenate(([0], 1 + np.flatnonzero(np.diff(segment)), [segment.size]))


def rows_of(residuals: Residuals, rows: NDArray[np.int64]) -> Residuals:
    """These rows of the residuals."""
    names = ("row", "t", "psi", "a_x", "before", "after", "innovation", "segment")
    part: dict[str, Any] = {name: getattr(residuals, name)[rows] for name in names}
    run = None if residuals.run is None else residuals.run[rows]
    return replace(residuals, run=run, **part)
