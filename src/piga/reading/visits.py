"""Segments of a record: one per visit of a position, and a new one wherever the phase was lost."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from piga.records.calibration import Event
from piga.records.spool import Arrays, spans


@dataclass
class Visits:
    """Numbers the visits of labels in order: a label that comes back later is a new segment ``label#2``.

    ``names`` of the segments so far; ``events`` about rows without a label.
    """

    labels: list[str]
    names: list[str] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    _seen: dict[int, int] = field(default_factory=dict)
    _code: int | None = None
    _bare: list[int] = field(default_factory=list)

    def segment(self, codes: NDArray[np.int32], rows: NDArray[np.int64]) -> NDArray[np.int32]:
        """Segment index of each row; -1 without a label."""
        starts = np.flatnonzero(np.diff(codes, prepend=codes[:1]) != 0)
        starts = np.concatenate(([0], starts))
        index = np.empty(starts.size, dtype=np.int32)
        counts = np.diff(np.append(starts, codes.size))
        for at, (start, count) in enumerate(zip(starts.tolist(), counts.tolist(), strict=True)):
            index[at] = self._visit(int(codes[start]), count, int(rows[start]))
        return np.repeat(index, counts)

    def finish(self) -> None:
        """After the last row."""
        self._close()

    def _visit(self, code: int, count: int, row: int) -> int:
        if code != self._code:
            self._close()
            self._code = code
            if code >= 0:
                self._seen[code] = self._seen.get(code, 0) + 1
                again = self._seen[code]
                self.names.append(self.labels[code] if again == 1 else f"{self.labels[code]}#{again}")
        if code >= 0:
            return len(self.names) - 1
        self._bare = [self._bare[0] + count, self._bare[1]] if self._bare else [count, row]
        return -1

    def _close(self) -> None:
        if self._bare:
            count, row = self._bare
            self.events.append(Event("no-segment", count, row, "rows without a segment are not used"))
            self._bare = []


def split_lost(
    segment: NDArray[np.int32],
    labels: tuple[str, ...],
    lost: NDArray[np.bool_],
    rows: NDArray[np.int64],
    arrays: Arrays,
) -> tuple[NDArray[np.int32], tuple[str, ...], tuple[int, ...], list[Event]]:
    """Give every part behind a lost phase its own segment and phase group.

    Returns the segment of each row, the labels, the phase group of each segment, and what is to be said.
    """
    order = arrays.empty(segment.size, np.int32)
    names, groups = [labels[int(segment[0])]], [0]
    parts = {int(segment[0]): 1}
    total = inside = last = 0
    first = None
    for part in spans(segment.size):
        gone = lost[part]
        new = gone.copy()
        new[int(part.start == 0) :] |= np.diff(segment[max(part.start - 1, 0) : part.stop]) != 0
        if part.start == 0:
            new[0] = False
        begins = np.flatnonzero(new)
        if begins.size == 0:
            order[part] = last
            continue
        order[part] = last + np.cumsum(new)
        last = int(order[part.stop - 1])
        for at in begins.tolist():
            row = part.start + at
            old = int(segment[row])
            parts[old] = parts.get(old, 0) + 1
            names.append(labels[old] + ("" if parts[old] == 1 else f"/{parts[old]}"))
            groups.append(groups[-1] + int(gone[at]))
            if gone[at]:
                total, first = total + 1, row if first is None else first
                inside += int(old == segment[row - 1])
    events = []
    if first is not None:
        detail = "the counter may have rolled over unseen; the zero of the output angle is new there"
        events.append(Event("phase-lost", total, int(rows[first]), detail))
    if inside:
        events.append(Event("segment-split", inside, None, "a gap inside a segment, phase lost"))
    return order, tuple(names), tuple(groups), events
