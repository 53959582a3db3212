"""Several stands one after the other, as one test."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError
from piga.stand.imperfections import Imperfections
from piga.stand.profile import Segment, Stand, plan, segment_index

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Composite:
    """Parts in order, with a pause of ``pause`` [s] between them in which the instrument is carried over.

    During the pause force and base rate go linearly from the end of one part to the start of the next;
    it is not recorded. Labels are ``part.segment``.
    """

    parts: tuple[Stand, ...]
    pause: float = 60.0

    kind = "composite"

    def __post_init__(self) -> None:
        if not self.parts:
            raise ArgumentError("composite: no parts", remedy="add [[stand.parts]] tables")
        if self.pause <= 0.0:
            raise ArgumentError("composite pause must be positive")

    @property
    def accepted(self) -> tuple[str, ...]:
        """Imperfections of any part; each part takes those that it has."""
        return tuple(sorted({name for part in self.parts for name in part.accepted}))

    @property
    def fastest(self) -> float:
        """The smallest of its parts."""
        return min(part.fastest for part in self.parts)

    def _plans(self) -> list[tuple[float, tuple[Segment, ...]]]:
        start, plans = 0.0, []
        for part in self.parts:
            plans.append((start, part.segments()))
            start += plans[-1][1][-1].stop + self.pause
        return plans

    def segments(self) -> tuple[Segment, ...]:
        """Segments of all parts, and the pauses between them."""
        rows: list[tuple[str, float, bool]] = []
        for k, (_, segments) in enumerate(self._plans()):
            if k:
                rows.append((f"pause before {k}", self.pause, False))
            rows.extend((f"{k}.{s.label}", s.duration, s.recorded) for s in segments)
        return plan(rows)

    def motion(self, t: Array, errors: Imperfections) -> tuple[Array, Array]:
        """Specific force and base rate in base axes, (n, 3) each."""
        plans = self._plans()
        force, rate = np.zeros((t.size, 3)), np.zeros((t.size, 3))
        blocks = tuple(Segment(str(k), start, segments[-1].stop) for k, (start, segments) in enumerate(plans))
        index = segment_index(t, blocks)
        for k, part in enumerate(self.parts):
            rows = np.flatnonzero(index == k)
            if rows.size == 0:
                continue
            end = blocks[k].duration
            local = t[rows] - blocks[k].start
            force[rows], rate[rows] = part.motion(np.minimum(local, end), _own(part, errors))
            if k + 1 < len(self.parts):
                share = np.clip((local - end) / self.pause, 0.0, 1.0)[:, None]
                first = self.parts[k + 1].motion(np.zeros(1), _own(self.parts[k + 1], errors))
                force[rows] += share * (first[0] - force[rows])
                rate[rows] += share * (first[1] - rate[rows])
        return force, rate


def _own(part: Stand, errors: Imperfections) -> Imperfections:
    """The imperfections that the part has; the others are left out."""
    foreign = [name for name in errors.stand_specific() if name not in part.accepted]
    zeros = {name: getattr(Imperfections(), name) for name in foreign}
    return replace(errors, **zeros)
