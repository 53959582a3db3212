"""What figures show of a record with very many samples: its outline, and the first part of every segment."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from piga.records.calibration import Residuals
from piga.records.spool import gathered, spans
from piga.reports.render.decimate import envelope_rows

SHOWN = 1 << 20
"""Samples that figures work on at most."""
OUTLINE = 50_000


def outline(residuals: Residuals) -> Residuals:
    """Rows that keep the outline of the residuals against time; all of a short record."""
    if residuals.t.size <= SHOWN:
        return residuals
    edges = np.append(_starts(residuals.segment), residuals.t.size)
    ends = np.unique(np.concatenate((edges[:-1], edges[1:] - 1)))
    drawn = [envelope_rows(values, OUTLINE) for values in (residuals.before, residuals.after)]
    return _rows(residuals, np.unique(np.concatenate([ends, *drawn])))


def leading_part(residuals: Residuals) -> Residuals:
    """The first samples of every segment, neighbours as in the record; all of a short record."""
    if residuals.t.size <= SHOWN:
        return residuals
    edges = np.append(_starts(residuals.segment), residuals.t.size)
    share = max(SHOWN // (edges.size - 1), 8)
    rows = [np.arange(left, min(left + share, right)) for left, right in pairwise(edges.tolist())]
    return _rows(residuals, np.concatenate(rows))


def _starts(segment: NDArray[np.int32]) -> NDArray[np.int64]:
    """Rows where segments begin."""
    found = [np.zeros(1, np.int64)]
    for part in spans(segment.size):
        around = segment[max(part.start - 1, 0) : part.stop]
        found.append(max(part.start - 1, 0) + 1 + np.flatnonzero(np.diff(around)))
    return np.concatenate(found)


def _rows(residuals: Residuals, rows: NDArray[np.int64]) -> Residuals:
    names = ("row", "t", "psi", "a_x", "before", "after", "innovation", "segment")
    run = None if residuals.run is None else gathered(residuals.run, rows)
    return replace(residuals, run=run, **{name: gathered(getattr(residuals, name), rows) for name in names})
