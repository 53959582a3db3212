"""Reduced data for the page of a compensation of any length, in bounded memory: one instrument, or several solved together.

Envelopes against time, the leading rows one by one for spectra, where each flag stands, and exact counts and sums.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga.compensation import FLAGS, Compensated, CompensatedSet, Mounted
from piga.compensation.compensator import NO_RATES, NONE, Chunk
from piga.compensation.files import SetReading
from piga.records.calibration import Calibration, Residuals
from piga.records.run import Run
from piga.reports.calibration.tables import scale_factor
from piga.reports.render.envelope import Envelope
from piga.reports.render.figure import XYZ

Array = NDArray[np.float64]

PIECE = 1 << 15
"""Rows of a whole record in one piece."""
CURVE_POINTS = 1 << 14
"""Points of an envelope; up to twice as many rows are kept whole."""
LEADING_ROWS = 1 << 20
"""Rows of an instrument that its spectrum uses at most."""
MARKS = 4096
"""Most places of one flag; of more, every second is kept."""


@dataclass
class Marks:
    """Where a flag stands: times of flagged rows, evenly thinned, their count, first and last time."""

    t: Array = field(default_factory=lambda: np.zeros(0))
    every: int = 1
    count: int = 0
    first: float = math.nan
    last: float = math.nan

    def add(self, t: Array) -> None:
        """Append the times of flagged rows."""
        if t.size == 0:
            return
        self.first = self.first if self.count else float(t[0])
        self.t = np.concatenate((self.t, t[-self.count % self.every :: self.every]))
        self.count, self.last = self.count + t.size, float(t[-1])
        while self.t.size > MARKS:
            self.t, self.every = self.t[::2], 2 * self.every


class Sums:
    """Root mean squares of named curves that come part by part."""

    def __init__(self) -> None:
        self._squares: dict[str, float] = {}
        self._counts: dict[str, int] = {}

    def add(self, name: str, values: Array) -> None:
        """Append values; those that are not finite do not count."""
        finite = values[np.isfinite(values)]
        self._squares[name] = self._squares.get(name, 0.0) + float(finite @ finite)
        self._counts[name] = self._counts.get(name, 0) + finite.size

    def has(self, name: str) -> bool:
        """Whether the curve has a value."""
        return self._counts.get(name, 0) > 0

    def rms(self, name: str) -> float:
        """Root mean square of all values; nan where there is none."""
        return math.sqrt(self._squares[name] / self._counts[name]) if self.has(name) else math.nan


class Indication:
    """The indicated specific force of one instrument, and its leading rows for a spectrum.

    Parameters
    ----------
    kind:
        ``"angle"`` or ``"rate"``: what the output of the instrument is.
    calibration:
        Its scale factor K turns the output rate into the indicated specific force.
    """

    def __init__(self, kind: str, calibration: Calibration) -> None:
        self.kind, self.calibration, self.scale_factor = kind, calibration, scale_factor(calibration)
        self.correction, self.flagged = Sums(), dict.fromkeys(FLAGS, 0)
        self._leading: list[tuple[Array, Array, Array, NDArray[np.int32]]] = []
        self._kept, self._label, self._segment = 0, "", -1
        self._t, self._output, self._omega, self._psi, self._angle = 0.0, 0.0, 0.0, 0.0, 0.0

    def add(self, label: str, chunk: Chunk, ax: Array, dv: Array, flags: NDArray[np.integer]) -> Array:
        """Append samples of the segment ``label`` with their compensation. Returns the indicated force [m/s^2]."""
        if label != self._label or self._segment < 0:
            self._label, self._segment = label, self._segment + 1
        turn, indicated, psi = self._turned(chunk, (flags & FLAGS["no_increment"]) != 0)
        angle = self._angle + np.cumsum(turn - self.scale_factor * dv)
        self._angle = float(angle[-1])
        rows = slice(0, max(LEADING_ROWS - self._kept, 0))
        if rows.stop:
            segment = np.full(chunk.t[rows].size, self._segment, np.int32)
            self._leading.append((chunk.t[rows].copy(), psi[rows].copy(), angle[rows], segment))
            self._kept += segment.size
        self.correction.add("correction", indicated - ax)
        for name, bit in FLAGS.items():
            self.flagged[name] += int(np.count_nonzero(flags & bit))
        return indicated

    def leading(self) -> Residuals:
        """The first rows: the running correction as angle [rad] is ``before``, ``after`` is 0."""
        t, psi, angle, segment = (np.concatenate(column) for column in zip(*self._leading, strict=True))
        nothing = np.broadcast_to(0.0, t.size)
        return Residuals(
            np.arange(1, t.size + 1, dtype=np.int32), t, psi, nothing, angle, nothing, nothing, segment
        )

    def _turned(self, chunk: Chunk, without: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
        """Turn into each row [rad], indicated specific force [m/s^2] and output angle [rad]."""
        t, output = chunk.t, chunk.output
        omega = chunk.base_rate[:, 0] if chunk.base_rate.shape[0] else np.zeros(t.size)
        without = without | chunk.begins
        without[0] |= self._kept == 0
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


class CompensationOutline:
    """Outline of a compensation, updated piece by piece.

    Curves by name, for each of the ``components`` (``a_x``; or ``f_x``, ``f_y``, ``f_z`` of a set): the component itself,
    ``indicated``, ``correction`` and ``u`` before its name; of a set also ``residual`` and a ``misfit`` of each instrument.

    Parameters
    ----------
    kind:
        ``"angle"`` or ``"rate"``: what the output of the instruments is.
    instruments:
        A calibration; or calibration and axes of each instrument of a set.
    """

    def __init__(self, kind: str, instruments: Calibration | Sequence[Mounted]) -> None:
        single = isinstance(instruments, Calibration)
        mounted = () if isinstance(instruments, Calibration) else tuple(instruments)
        calibrations = (
            [instruments] if isinstance(instruments, Calibration) else [m.calibration for m in mounted]
        )
        self.kind, self.mounted = kind, mounted
        self.components = ("a_x",) if single else tuple(f"f_{axis}" for axis in XYZ)
        self.instruments = [Indication(kind, calibration) for calibration in calibrations]
        self._input_axes = np.eye(1) if single else np.array([m.axes[0] for m in mounted], dtype=float)
        self._from_axes = np.linalg.pinv(self._input_axes)
        self.size, self.flagged, self.start = 0, 0, math.nan
        self.velocity, self.sums = np.zeros(len(self.components)), Sums()
        self.marks = {name: Marks() for name in FLAGS}
        self._envelope = Envelope(CURVE_POINTS)

    @property
    def redundant(self) -> bool:
        """True if there are more instruments than unknowns, so that a misfit exists."""
        return len(self.mounted) > 3

    def piece(self, label: str, chunk: Chunk, result: Compensated) -> None:
        """Append samples of one segment of a single instrument."""
        indicated = self.instruments[0].add(label, chunk, result.ax, result.dv, result.flags)
        u = result.u_ax[None] if result.u_ax.size else None
        self._add(chunk.t, indicated[None], result.ax[None], result.dv[None], u, result.flags)

    def set_piece(self, label: str, rows: SetReading, result: CompensatedSet) -> None:
        """Append rows of a set."""
        along = []
        for i, (instrument, axis) in enumerate(zip(self.instruments, self._input_axes, strict=True)):
            base = NO_RATES if rows.base_rate is None else rows.base_rate[i]
            chunk = Chunk(rows.t, rows.output[i], NONE, NONE, rows.begins, base, NONE, NONE)
            flags = result.each[i] if result.each.size else result.flags
            along.append(instrument.add(label, chunk, result.f @ axis, result.dv @ axis, flags))
        more = {"residual": result.residual} if self.redundant else {}
        more |= {f"misfit {i}": misfit for i, misfit in enumerate(result.misfit)} if self.redundant else {}
        u = result.u_f.T if result.u_f.size else None
        indicated = self._from_axes @ np.array(along)
        self._add(rows.t, indicated, result.f.T, result.dv.T, u, result.flags, **more)

    def record(self, record: Run, result: Compensated) -> None:
        """Append a whole record of a single instrument."""
        changes = np.flatnonzero(np.diff(record.segment_index)) + 1
        edges = np.unique(np.concatenate((changes, np.arange(0, record.size, PIECE), [record.size])))
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

    def curve(self, name: str) -> tuple[Array, Array]:
        """Times since the first row [s], and the envelope of a curve."""
        t, values = self._envelope.curve(name)
        return t - self.start, values

    def _add(
        self, t: Array, indicated: Array, force: Array, dv: Array, u: Array | None, flags: NDArray[np.integer],
        **more: ArrayLike,
    ) -> None:  # fmt: skip
        if self.size == 0:
            self.start = float(t[0])
        curves = {name: np.asarray(values, dtype=float) for name, values in more.items()}
        for k, name in enumerate(self.components):
            curves |= {name: force[k], f"indicated {name}": indicated[k]}
            curves[f"correction {name}"] = indicated[k] - force[k]
            if u is not None:
                curves[f"u {name}"] = u[k]
        self._envelope.add(t, **curves)
        for name, values in curves.items():
            self.sums.add(name, values)
        for name, bit in FLAGS.items():
            self.marks[name].add(t[(flags & bit) != 0])
        self.flagged += int(np.count_nonzero(flags & ~FLAGS["no_increment"]))
        self.velocity = self.velocity + dv.sum(axis=1)
        self.size += t.size
