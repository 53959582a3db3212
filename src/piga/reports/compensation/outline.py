"""Reduced data for the report of a compensated stream of any length, in bounded memory: one instrument or a set.

An outline against time (lowest and highest row of each bucket of rows; buckets grow with the stream), the leading
rows one by one for spectra (on disk), where each flag stands, and exact counts and sums.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from piga.compensation import FLAGS, Compensated, CompensatedSet, Mounted
from piga.compensation.compensator import NO_RATES, NONE, Chunk
from piga.compensation.sets.set_files import SetReading
from piga.records.arrays import ColumnWriter
from piga.records.calibration import Calibration, Residuals
from piga.records.run import Run
from piga.reports.calibration.tables import scale_factor
from piga.reports.render.envelope import SHOWN

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OutlineSizes:
    """Sizes of an outline: enough for a figure of any width, small against a long record."""

    piece: int = 1 << 15
    """Rows of a whole record in one piece."""
    rows: int = 1 << 16
    """Most rows of an outline; above them its buckets grow."""
    set_rows: int = 1 << 13
    """Most rows of the outline of one curve of a set."""
    marks: int = 4096
    """Most places of one flag; above them its buckets grow."""
    growth: int = 4
    """Factor by which a bucket grows."""


SIZES = OutlineSizes()
CURVES = ("indicated", "ax", "correction", "u_ax")
LEADING = [("t", "f8"), ("psi", "f8"), ("angle", "f8"), ("segment", "i4")]
"""Columns of the leading rows."""


@dataclass
class Outline:
    """Rows that keep the outline of all ``curves`` against time: ``rows`` by name, about ``kept``, and rows per bucket."""

    curves: tuple[str, ...] = CURVES
    kept: int = SIZES.rows
    rows: dict[str, Array] = field(default_factory=dict)
    bucket: int = 1

    def __post_init__(self) -> None:
        self.rows = {name: np.zeros(0) for name in ("row", "t", *self.curves)}

    def add(self, part: dict[str, Array]) -> None:
        """Append rows."""
        if not self.curves:
            return
        part = _extremes(part, self.curves, self.bucket)
        self.rows = {name: np.concatenate((self.rows[name], part[name])) for name in self.rows}
        while self.rows["row"].size > self.kept:
            self.bucket *= SIZES.growth
            self.rows = _extremes(self.rows, self.curves, self.bucket)


@dataclass
class Marks:
    """Where a flag stands: rows and times of the first flagged row per bucket, the count, first and last time."""

    row: Array = field(default_factory=lambda: np.zeros(0))
    t: Array = field(default_factory=lambda: np.zeros(0))
    bucket: int = 1
    count: int = 0
    first: float = math.nan
    last: float = math.nan

    def add(self, row: Array, t: Array) -> None:
        """Append flagged rows."""
        if row.size == 0:
            return
        self.first = self.first if self.count else float(t[0])
        self.count, self.last = self.count + row.size, float(t[-1])
        self.row, self.t = np.concatenate((self.row, row)), np.concatenate((self.t, t))
        while self.row.size > SIZES.marks:
            self.bucket *= SIZES.growth
            some = np.unique(self.row // self.bucket, return_index=True)[1]
            self.row, self.t = self.row[some], self.t[some]


class Watch:
    """Data that every outline keeps: rows, flags, and sums of squares by name."""

    def __init__(self, kind: str, sums: tuple[str, ...]) -> None:
        self.kind, self.marks = kind, {name: Marks() for name in FLAGS}
        self.size, self.flagged, self.start = 0, 0, math.nan
        self.squares, self.counts = dict.fromkeys(sums, 0.0), dict.fromkeys(sums, 0)

    def rms(self, name: str) -> float:
        """Root mean square of a curve over all rows that have a value [m/s^2]; nan where there is none."""
        return math.sqrt(self.squares[name] / self.counts[name]) if self.counts[name] else math.nan

    def _rows(self, t: Array) -> dict[str, Array]:
        """Numbers and times of the rows that come next."""
        if self.size == 0:
            self.start = float(t[0])
        return {"row": np.arange(self.size, self.size + t.size, dtype=float), "t": t}

    def _sum(self, rows: dict[str, Array], curves: dict[str, Array], flags: NDArray[np.integer]) -> None:
        """Add to the sums and counts."""
        for name in self.squares:
            known = curves[name][np.isfinite(curves[name])]
            self.squares[name] += float(known @ known)
            self.counts[name] += known.size
        for name, bit in FLAGS.items():
            here = (flags & bit) != 0
            self.marks[name].add(rows["row"][here], rows["t"][here])
        self.flagged += int(np.count_nonzero(flags & ~FLAGS["no_increment"]))
        self.size += rows["t"].size


class CompensationOutline(Watch):
    """Outline of a compensation, updated piece by piece: indicated force, compensated force, and flags.

    Parameters
    ----------
    kind:
        ``"angle"`` or ``"rate"``: what the output of the instrument is.
    scale_factor:
        K [(rad/s)/(m/s^2)] that turns the output rate into the indicated specific force.
    curves:
        Names of the curves to outline.
    """

    def __init__(self, kind: str, scale_factor: float, curves: tuple[str, ...] = CURVES) -> None:
        super().__init__(kind, ("correction", "u_ax"))
        self.scale_factor, self.velocity, self.outline = scale_factor, 0.0, Outline(curves)
        self._first = ColumnWriter(np.dtype(LEADING))
        self._leading, self._taken = np.empty(0, LEADING), 0
        self._t, self._output, self._omega = 0.0, 0.0, 0.0
        self._psi, self._angle = 0.0, 0.0
        self._label, self._segment = "", -1

    def piece(self, label: str, chunk: Chunk, result: Compensated) -> Array:
        """Add the samples of one segment and their compensation. Returns the indicated force [m/s^2]."""
        if label != self._label or self._segment < 0:
            self._label, self._segment = label, self._segment + 1
        turn, indicated, psi = self._indicated(chunk, (result.flags & FLAGS["no_increment"]) != 0)
        angle = self._angle + np.cumsum(turn - self.scale_factor * result.dv)
        self._angle = float(angle[-1])
        self._keep(chunk.t, psi, angle)
        self._count(chunk.t, indicated, result)
        return indicated

    def record(self, record: Run, result: Compensated) -> None:
        """Add a whole record."""
        changes = np.flatnonzero(np.diff(record.segment_index)) + 1
        edges = np.unique(np.concatenate((changes, np.arange(0, record.size, SIZES.piece), [record.size])))
        for start, stop in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            rows = slice(start, stop)
            base = NO_RATES if record.base_rate is None else record.base_rate[rows]
            chunk = Chunk(
                record.t[rows], record.output[rows], record.f[rows, 1], record.f[rows, 2], record.begins[rows],
                base, NONE, NONE,
            )  # fmt: skip
            part = Compensated(
                result.t[rows], result.ax[rows], result.dv[rows], result.u_ax[rows], result.flags[rows]
            )
            self.piece(f"{record.segment_index[start]}", chunk, part)

    def leading(self) -> Residuals:
        """The first rows, at most ``SHOWN``: the running correction as angle [rad] is ``before``, ``after`` is 0.

        Call this after the last piece.
        """
        if not self._leading.size:
            self._leading = self._first.finish()
        t, psi, angle, segment = (self._leading[name] for name, _ in LEADING)
        nothing = np.broadcast_to(0.0, t.size)
        return Residuals(
            np.arange(1, t.size + 1, dtype=np.int32), t, psi, nothing, angle, nothing, nothing, segment
        )

    def _keep(self, t: Array, psi: Array, angle: Array) -> None:
        """Keep the first rows, on disk."""
        rows = np.empty(min(t.size, SHOWN - self._taken), LEADING)
        if rows.size:
            for (name, _), values in zip(LEADING, (t, psi, angle), strict=False):
                rows[name] = values[: rows.size]
            rows["segment"] = self._segment
            self._first.append(rows)
            self._taken += rows.size

    def _indicated(self, chunk: Chunk, without: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
        """Turn into each row [rad], indicated specific force [m/s^2] and output angle [rad]."""
        t, output = chunk.t, chunk.output
        omega = chunk.base_rate[:, 0] if chunk.base_rate.shape[0] else np.zeros(t.size)
        without = without | chunk.begins
        without[0] |= self.size == 0
        h = np.where(without, 0.0, np.diff(t, prepend=self._t))
        base = 0.5 * h * (omega + np.concatenate(([self._omega], omega[:-1])))
        if self.kind == "rate":
            turn = 0.5 * h * (output + np.concatenate(([self._output], output[:-1])))
            psi = self._psi + np.cumsum(turn)
            indicated = (output + omega) / self.scale_factor
        else:
            turn, psi = np.where(without, 0.0, np.diff(output, prepend=self._output)), output
            spacing = np.where(h > 0.0, h, np.nan)
            indicated = (turn + base) / (self.scale_factor * spacing)
        self._t, self._output, self._omega = float(t[-1]), float(output[-1]), float(omega[-1])
        self._psi = float(psi[-1])
        return turn + base, indicated, psi

    def _count(self, t: Array, indicated: Array, result: Compensated) -> None:
        u = result.u_ax if result.u_ax.size else np.full(t.size, np.nan)
        curves = {"indicated": indicated, "ax": result.ax, "correction": indicated - result.ax, "u_ax": u}
        rows = self._rows(t)
        self.outline.add(rows | curves)
        self._sum(rows, curves, result.flags)
        self.velocity += float(result.dv.sum())

    def curve(self, name: str) -> tuple[Array, Array]:
        """Times since the first row [s], and the outline of a curve."""
        return self.outline.rows["t"] - self.start, self.outline.rows[name]


def _extremes(rows: dict[str, Array], curves: tuple[str, ...], bucket: int) -> dict[str, Array]:
    """Lowest, highest and a missing row of every curve in each bucket of rows."""
    if bucket == 1 or rows["row"].size == 0:
        return {name: np.array(values) for name, values in rows.items()}
    key = rows["row"] // bucket
    first = np.concatenate(([True], np.diff(key) != 0.0))
    last = np.concatenate((first[1:], [True]))
    some = []
    for name in curves:
        up, down = np.lexsort((rows[name], key)), np.lexsort((-rows[name], key))
        some += [up[first], up[last], down[first]]
    kept = np.unique(np.concatenate(some))
    return {name: values[kept] for name, values in rows.items()}


RAW, FORCE, CORRECTION = ("raw_x", "raw_y", "raw_z"), ("fx", "fy", "fz"), ("dx", "dy", "dz")


class SetOutline(Watch):
    """Outline of the compensation of a set, updated piece by piece.

    Parameters
    ----------
    kind:
        ``"angle"`` or ``"rate"``: what the output of the instruments is.
    instruments:
        Calibration and axes of each.
    """

    def __init__(self, kind: str, instruments: Sequence[Mounted]) -> None:
        self.misfits = tuple(f"misfit_{i}" for i in range(len(instruments)))
        super().__init__(kind, (*CORRECTION, "residual", *self.misfits))
        self.mounted, self.velocity = tuple(instruments), np.zeros(3)
        self._axes = np.array([item.axes for item in instruments], dtype=float)
        self._raw = np.linalg.pinv(self._axes[:, 0, :])
        self.instruments = [outline_of(kind, item.calibration, ()) for item in instruments]
        curves = (*RAW, *FORCE, *CORRECTION, "residual", *self.misfits)
        self.outlines = {name: Outline((name,), SIZES.set_rows) for name in curves}

    @property
    def redundant(self) -> bool:
        """True if the set has more instruments than unknowns, so that a misfit exists."""
        return len(self.mounted) > 3

    def piece(self, label: str, rows: SetReading, result: CompensatedSet) -> None:
        """Add a piece of the readings and their compensation."""
        along = []
        for i, single in enumerate(self.instruments):
            base = np.zeros((0, 3)) if rows.base_rate is None else rows.base_rate[i]
            chunk = Chunk(rows.t, rows.output[i], NONE, NONE, rows.begins, base, NONE, NONE)
            axis = self._axes[i, 0]
            flags = result.each[i] if result.each.size else result.flags
            along.append(
                single.piece(label, chunk, Compensated(rows.t, result.f @ axis, result.dv @ axis, NONE, flags))
            )
        self._count(rows.t, self._raw @ np.array(along), result)

    def curve(self, name: str) -> tuple[Array, Array]:
        """Times since the first row [s], and the outline of a curve."""
        return self.outlines[name].rows["t"] - self.start, self.outlines[name].rows[name]

    def _count(self, t: Array, raw: Array, result: CompensatedSet) -> None:
        curves = dict(zip((*RAW, *FORCE), (*raw, *result.f.T), strict=True))
        curves |= {name: raw[k] - result.f[:, k] for k, name in enumerate(CORRECTION)}
        nothing = np.full((len(self.misfits), t.size), np.nan)
        misfit = result.misfit if result.misfit.size else nothing
        curves |= {"residual": result.residual} | dict(zip(self.misfits, misfit, strict=True))
        rows = self._rows(t)
        for name, outline in self.outlines.items():
            outline.add(rows | {name: np.array(curves[name])})
        self._sum(rows, curves, result.flags)
        self.velocity = self.velocity + result.dv.sum(axis=0)


def outline_of(kind: str, calibration: Calibration, curves: tuple[str, ...] = CURVES) -> CompensationOutline:
    """A fresh outline for records of this kind (``"angle"`` or ``"rate"``) and calibration."""
    return CompensationOutline(kind, scale_factor(calibration), curves)
