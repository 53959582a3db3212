"""Positions of a stand, told by the column that logs its angle or speed: where it stands still, and where it moves.

The column is averaged over short blocks of rows. A position is a run of blocks whose mean stays within a tolerance of the mean of
the position so far: the noise of the column, or 1e-4 of its range. So a jump and a move end a position. A run that drifts through
its tolerance is a ramp. Runs much shorter than the longest one belong to moves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from piga.records.calibration import Event
from piga.results import Array

BLOCKS = 4000
"""Blocks into which a column is divided, at most; an edge of a position is known to one block."""
NOISE = 6.0
"""A block farther than this many standard deviations of a block mean from its position is outside."""
SAME = 1e-4
"""Share of the range of the column within which it stands still, whatever its noise."""
SHORT = 0.05
"""Positions shorter than this share of the longest one are parts of a move."""
LEAST_STILL = 0.2
"""Least share of the rows in positions; below it the stand is taken to move all the time."""
LEAST_ROWS = 16
"""Fewest rows of a position."""
_QUARTILE = 0.3186 * 6.0**0.5
"""Lower quartile of the second difference of three values of a normal distribution, in its standard deviations."""


def positions(x: Array) -> list[tuple[int, int]]:
    """First row and row after the last of each position of a column (n,). Rows without a number belong to none.

    The list is empty if the column nowhere stands still.
    """
    rows = np.flatnonzero(np.isfinite(x))
    if rows.size < 2 * LEAST_ROWS:
        return []
    width = max(rows.size // BLOCKS, 1)
    count = rows.size // width
    means = x[rows[: count * width]].reshape(count, width).mean(axis=1)
    tolerance = _tolerance(means, x[rows])
    runs = _runs(means, tolerance)
    still = [(a, b) for a, b in runs if (b - a) * width >= LEAST_ROWS and not _drifts(means[a:b], tolerance)]
    longest = max((b - a for a, b in still), default=0)
    kept = [_trimmed(means, a, b) for a, b in still if b - a >= SHORT * longest]
    if sum(b - a for a, b in kept) < LEAST_STILL * count:
        return []
    return [(int(rows[a * width]), int(rows[b * width - 1]) + 1) for a, b in kept if b > a]


def _drifts(means: Array, tolerance: float) -> bool:
    """True if the ends of a run differ by more than half the tolerance: it is a part of a slow ramp."""
    third = max(means.size // 3, 1)
    return abs(float(means[-third:].mean() - means[:third].mean())) > 0.5 * tolerance


def _trimmed(means: Array, start: int, stop: int) -> tuple[int, int]:
    """A run without the blocks at its ends that belong to a move, by the scatter of the run itself."""
    run = means[start:stop]
    middle = float(np.median(run))
    limit = NOISE * 1.4826 * float(np.median(np.abs(run - middle))) + 1e-12 * abs(middle)
    inside = np.flatnonzero(np.abs(run - middle) <= limit)
    first, last = start + int(inside[0]), start + int(inside[-1]) + 1
    return first + (first > 0), last - (last < means.size)


def _tolerance(means: Array, x: Array) -> float:
    """Largest distance of the mean of a block from that of its position."""
    steps = np.abs(np.diff(x))
    resolution = float(np.min(steps, where=steps > 0.0, initial=np.inf))
    noise = float(np.quantile(np.abs(np.diff(means, 2)), 0.25)) / _QUARTILE  # a straight move has none
    quantum = 1.5 * resolution if noise > 0.0 and np.isfinite(resolution) else 0.0
    return max(NOISE * noise, SAME * float(np.ptp(means)), min(quantum, 0.01 * float(np.ptp(means))))


def _runs(means: Array, tolerance: float) -> list[tuple[int, int]]:
    """Runs of blocks that stay within the tolerance of their own mean."""
    runs, start, total = [], 0, float(means[0])
    for k in range(1, means.size):
        if abs(means[k] - total / (k - start)) > tolerance:
            runs.append((start, k))
            start, total = k, 0.0
        total += float(means[k])
    return [*runs, (start, means.size)]


def segment_by_positions(
    x: Array, rows: NDArray[np.int64], name: str
) -> tuple[NDArray[np.int32], tuple[str, ...], list[Event]]:
    """Segment of each row (-1 in a move), the names of the segments, and the count of rows left out.

    Parameters
    ----------
    x:
        Angle or speed of the stand (n,), in the unit of the file.
    rows:
        Row of the file of each value.
    name:
        Name of the column, for the event.
    """
    segment = np.full(x.size, -1, np.int32)
    spans = positions(x)
    for k, (start, stop) in enumerate(spans):
        segment[start:stop] = k
    moving = np.flatnonzero(segment < 0)
    events = []
    if moving.size:
        detail = f"'{name}' does not stand still: rows between the {len(spans)} positions are not used"
        events.append(Event("moving", int(moving.size), int(rows[moving[0]]), detail))
    return segment, tuple(str(k + 1) for k in range(len(spans))), events


def settling(
    t: Array, segment: NDArray[np.int32], seconds: float, rows: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], list[Event]]:
    """Rows within the first ``seconds`` of each visit of a position, and their count.

    Parameters
    ----------
    t, segment, rows:
        Time [s], segment and row of the file of each row (n,).
    seconds:
        Time after the beginning of a visit that is left out [s].
    """
    begins = np.flatnonzero(np.diff(segment, prepend=segment[0] - 1) != 0)
    visit = np.cumsum(np.diff(segment, prepend=segment[0] - 1) != 0) - 1
    early = (t - t[begins][visit] < seconds) & (segment >= 0)
    if not early.any():
        return early, []
    detail = f"the first {seconds:g} s of each position are not used"
    return early, [Event("settling", int(np.count_nonzero(early)), int(rows[int(np.argmax(early))]), detail)]
