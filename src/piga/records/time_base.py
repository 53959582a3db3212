"""The time base of a log: where increments may be formed and where they may not.

A *stretch* is a sequence of samples with regular time. Increments are never formed across its ends. This module
detects and counts times that repeat, jump back or leave a gap. It interpolates nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga.records.calibration import Event
from piga.records.spool import Arrays, exact_median, spans, steps

Array = NDArray[np.float64]

GAP = 1.5
"""A step longer than this many nominal steps is a gap."""


def begins_stretch(step: Array, nominal: float) -> NDArray[np.bool_]:
    """True for a sample that begins a stretch: time repeats, jumps back or leaves a gap before it.

    ``step`` (n,) [s] is the time since the sample before. ``nominal`` [s] is the nominal interval. Files, arrays in
    memory and live streams all use this rule.
    """
    return np.asarray((step <= 0.0) | (step > GAP * nominal))


@dataclass(frozen=True)
class TimeBase:
    """``begins`` marks the used samples that begin a stretch. ``nominal`` is the nominal step [s]. ``events`` lists faults."""

    begins: NDArray[np.bool_]
    nominal: float
    events: tuple[Event, ...]


def drop_repeats(
    t: Array,
    segment: NDArray[np.int32],
    usable: NDArray[np.bool_],
    values: list[Array],
    rows: NDArray[np.int64],
) -> list[Event]:
    """Clear ``usable`` for rows with a repeated time: the second of two identical rows, both of two conflicting rows.

    Parameters
    ----------
    t, segment:
        Time [s] and segment index of every row, shape (n,).
    usable:
        False for rows that were masked before (missing values). This array is changed.
    values:
        All columns, to distinguish identical rows from conflicting ones.
    rows:
        File row of each sample, for the messages.
    """
    counts, first_rows = [0, 0], [0, 0]
    last = np.zeros(0, dtype=np.int64)
    for part in spans(t.size):
        index = np.concatenate((last, part.start + np.flatnonzero(usable[part])))
        last = index[-1:]
        at, places = t[index], segment[index]
        same = (np.diff(at) == 0.0) & (np.diff(places) == 0)
        if not same.any():
            continue
        first, second = index[:-1][same], index[1:][same]
        identical = np.ones(first.size, dtype=bool)
        for column in values:
            identical &= column[first] == column[second]
        usable[second] = False
        usable[first[~identical]] = False
        for kind, repeats in enumerate((second[identical], second[~identical])):
            if repeats.size and not counts[kind]:
                first_rows[kind] = int(rows[repeats[0]])
            counts[kind] += int(repeats.size)
    events = []
    if counts[0]:
        events.append(Event("repeated-row", counts[0], first_rows[0], "the copy is not used"))
    if counts[1]:
        detail = "same time, other values: neither is used"
        events.append(Event("conflicting-row", counts[1], first_rows[1], detail))
    return events


def examine_time(t: Array, segment: NDArray[np.int32], rows: NDArray[np.int64], arrays: Arrays) -> TimeBase:
    """Find backward jumps and gaps between the used samples. The nominal step is the median of all forward steps."""
    nominal = exact_median(lambda: _forward(t, segment))
    begins = arrays.empty(t.size, np.bool_)
    gaps = backs = missing = 0
    first_gap = first_back = None
    longest = 0.0
    for part in spans(t.size):
        step, same = steps(t, part), steps(segment, part) == 0
        gap = step > GAP * nominal
        back = step <= 0.0
        if part.start == 0:
            same[0] = False
        begins[part] = ~same | begins_stretch(step, nominal)
        if not (same & (gap | back)).any():
            continue
        gap &= same
        back &= same
        if back.any():
            backs += int(back.sum())
            first_back = part.start + int(np.argmax(back)) if first_back is None else first_back
        if gap.any():
            gaps += int(gap.sum())
            first_gap = part.start + int(np.argmax(gap)) if first_gap is None else first_gap
            longest = max(longest, float(step[gap].max()))
            missing += int(np.round(step[gap] / nominal - 1.0).sum()) if nominal > 0.0 else 0
    events = []
    if first_back is not None:
        row = int(rows[first_back])
        events.append(Event("time-jump-back", backs, row, "no increment is formed across it"))
    if first_gap is not None:
        detail = f"longest {longest:.6g} s, about {missing} samples missing; no increment is formed across it"
        events.append(Event("gap", gaps, int(rows[first_gap]), detail))
    return TimeBase(begins, nominal, tuple(events))


def _forward(t: Array, segment: NDArray[np.int32]) -> Iterator[Array]:
    """Steps forward inside segments."""
    for part in spans(t.size):
        step = steps(t, part)
        yield step[(steps(segment, part) == 0) & (step > 0.0)]
