"""The time base of a log: where increments may be formed and where they may not.

A *stretch* is a run of samples with regular time; increments are never formed across its ends. Time
that repeats, jumps back or leaves a gap is found here and counted, nothing is interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga.records.calibration import Event

Array = NDArray[np.float64]

GAP = 1.5
"""A step longer than this many nominal steps is a gap."""


@dataclass(frozen=True)
class TimeBase:
    """``keep``: samples used; ``begins``: kept samples that begin a stretch; ``nominal`` step [s]."""

    keep: NDArray[np.bool_]
    begins: NDArray[np.bool_]
    nominal: float
    events: tuple[Event, ...]


def examine_time(
    t: Array,
    segment: NDArray[np.int32],
    usable: NDArray[np.bool_],
    values: list[Array],
    rows: NDArray[np.int64],
) -> TimeBase:
    """Find repeats, backward jumps and gaps.

    Parameters
    ----------
    t, segment:
        Time [s] and segment index of every row, shape (n,).
    usable:
        False where a row was masked already (missing values).
    values:
        The other columns, to tell a repeated row from a conflicting one.
    rows:
        File row of each sample, for the messages.
    """
    index = np.flatnonzero(usable)
    events: list[Event] = []
    drop = _repeats(t, segment, index, values, rows, events)
    index = index[~drop]
    step, same = np.diff(t[index]), np.diff(segment[index]) == 0
    forward = step[same & (step > 0.0)]
    nominal = float(np.median(forward)) if forward.size else 0.0
    back, gap = same & (step <= 0.0), same & (step > GAP * nominal)
    begins = np.ones(index.size, dtype=bool)
    begins[1:] = ~same | back | gap
    if back.any():
        first = int(np.argmax(back)) + 1
        events.append(
            Event(
                "time-jump-back", int(back.sum()), int(rows[index[first]]), "no increment is formed across it"
            )
        )
    if gap.any():
        first = int(np.argmax(gap)) + 1
        longest = float(step[gap].max())
        missing = int(np.round(step[gap] / nominal - 1.0).sum())
        detail = f"longest {longest:.6g} s, about {missing} samples missing; no increment is formed across it"
        events.append(Event("gap", int(gap.sum()), int(rows[index[first]]), detail))
    keep = np.zeros(t.size, dtype=bool)
    keep[index] = True
    return TimeBase(keep, begins, nominal, tuple(events))


def _repeats(
    t: Array, segment: NDArray[np.int32], index: NDArray[np.int64], values: list[Array], rows: NDArray[np.int64],
    events: list[Event],
) -> NDArray[np.bool_]:  # fmt: skip
    """Rows to drop because their time repeats: the copy of an identical row, both of conflicting ones."""
    drop = np.zeros(index.size, dtype=bool)
    same_time = (np.diff(t[index]) == 0.0) & (np.diff(segment[index]) == 0)
    if not same_time.any():
        return drop
    first, second = index[:-1][same_time], index[1:][same_time]
    identical = np.ones(first.size, dtype=bool)
    for column in values:
        identical &= column[first] == column[second]
    position = np.flatnonzero(same_time)
    drop[position[identical] + 1] = True
    conflict = position[~identical]
    drop[conflict] = True
    drop[conflict + 1] = True
    if identical.any():
        events.append(
            Event("repeated-row", int(identical.sum()), int(rows[second[identical][0]]), "the copy is not used")
        )
    if conflict.size:
        at = int(rows[index[conflict[0] + 1]])
        events.append(
            Event("conflicting-row", int(conflict.size), at, "same time, other values: neither is used")
        )
    return drop
