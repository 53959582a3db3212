"""What a report keeps of a compensated set of any length: the set as a whole, and every instrument of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from piga.compensation import FLAGS, Compensated, CompensatedSet, Mounted
from piga.compensation.sets.set_files import Rows
from piga.compensation.step import NONE, Chunk
from piga.records.terms import si_factor
from piga.reports.compensation.outline import CompensationOutline, Marks, Outline

Array = NDArray[np.float64]

AXES = ("x", "y", "z")
CURVE_KEPT = 1 << 13
"""Rows of the outline of one curve: there are many."""
RAW, FORCE, CORRECTION = ("raw_x", "raw_y", "raw_z"), ("fx", "fy", "fz"), ("dx", "dy", "dz")


class SetOutline:
    """Watches a set piece by piece.

    Parameters
    ----------
    kind:
        ``"angle"`` or ``"rate"``: what the output of the instruments is.
    instruments:
        Calibration and axes of each.
    """

    def __init__(self, kind: str, instruments: Sequence[Mounted]) -> None:
        self.kind, self.mounted = kind, tuple(instruments)
        self._axes = np.array([item.axes for item in instruments], dtype=float)
        self._raw = np.linalg.pinv(self._axes[:, 0, :])
        self.instruments = [CompensationOutline(kind, _scale_factor(item), ()) for item in instruments]
        self.misfits = tuple(f"misfit_{i}" for i in range(len(instruments)))
        curves = (*RAW, *FORCE, *CORRECTION, "residual", *self.misfits)
        self.outlines = {name: Outline((name,), CURVE_KEPT) for name in curves}
        self.marks = {name: Marks() for name in FLAGS}
        self.size, self.flagged, self.start, self.velocity = 0, 0, 0.0, np.zeros(3)
        self.squares = dict.fromkeys((*CORRECTION, "residual", *self.misfits), 0.0)
        self.counts = dict.fromkeys(self.squares, 0)

    @property
    def redundant(self) -> bool:
        """True when the set can contradict itself."""
        return len(self.mounted) > 3

    def piece(self, label: str, rows: Rows, found: CompensatedSet) -> None:
        """Take what was read, and what became of it."""
        along = []
        for i, single in enumerate(self.instruments):
            base = np.zeros((0, 3)) if rows.base_rate is None else rows.base_rate[i]
            chunk = Chunk(rows.t, rows.output[i], NONE, NONE, rows.begins, base, NONE, NONE)
            axis = self._axes[i, 0]
            flags = found.each[i] if found.each.size else found.flags
            along.append(
                single.piece(label, chunk, Compensated(rows.t, found.f @ axis, found.dv @ axis, NONE, flags))
            )
        self._count(rows.t, self._raw @ np.array(along), found)

    def rms(self, name: str) -> float:
        """Root mean square of a correction, the residual or a misfit [m/s^2]; nan where there is none."""
        return float(np.sqrt(self.squares[name] / self.counts[name])) if self.counts[name] else float("nan")

    def _count(self, t: Array, raw: Array, found: CompensatedSet) -> None:
        if self.size == 0:
            self.start = float(t[0])
        row = np.arange(self.size, self.size + t.size, dtype=float)
        curves = dict(zip((*RAW, *FORCE), (*raw, *found.f.T), strict=True))
        curves |= {name: raw[k] - found.f[:, k] for k, name in enumerate(CORRECTION)}
        nothing = np.full((len(self.misfits), t.size), np.nan)
        misfit = found.misfit if found.misfit.size else nothing
        curves |= {"residual": found.residual} | dict(zip(self.misfits, misfit, strict=True))
        for name, outline in self.outlines.items():
            outline.add({"row": row, "t": t, name: np.array(curves[name])})
        for name in self.squares:
            known = curves[name][np.isfinite(curves[name])]
            self.squares[name] += float(known @ known)
            self.counts[name] += known.size
        for name, bit in FLAGS.items():
            here = (found.flags & bit) != 0
            self.marks[name].add(row[here], t[here])
        self.flagged += int(np.count_nonzero(found.flags & ~FLAGS["no_increment"]))
        self.velocity = self.velocity + found.dv.sum(axis=0)
        self.size += t.size


def _scale_factor(item: Mounted) -> float:
    values = [c.value for c in item.calibration.coefficients if c.name == "scale_factor"]
    return values[0] * si_factor("scale_factor") if values else item.calibration.scale_factor_nominal
