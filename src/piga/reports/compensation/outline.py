"""Reduced data for the page of a compensation: envelopes against time, rows for spectra, where each flag stands, and sums."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga.compensation import FLAGS, Compensated, CompensatedSet, Mounted
from piga.records.arrays import changes, middles
from piga.records.calibration import Calibration, Residuals
from piga.records.run import Run
from piga.reports.calibration.tables import scale_factor
from piga.reports.render.envelope import envelope_rows
from piga.reports.render.figure import XYZ

Array = NDArray[np.float64]
Flags = NDArray[np.int32]

CURVE_POINTS = 1 << 15
"""Most points of an envelope; fewer rows are kept whole."""
LEADING_ROWS = 1 << 20
"""Rows of an instrument that its spectrum uses at most."""
MARKS = 4096
"""Most places of one flag that are drawn."""


@dataclass(frozen=True)
class Marks:
    """Where a flag stands: times of flagged rows, evenly thinned, their count, first and last time."""

    t: Array
    count: int
    first: float
    last: float


def _marks_of(t: Array) -> Marks:
    """The marks of rows at these times."""
    first, last = (float(t[0]), float(t[-1])) if t.size else (math.nan, math.nan)
    return Marks(t[:: math.ceil(t.size / MARKS) or 1], t.size, first, last)


def rms(values: Array) -> float:
    """Root mean square of the values that are finite; nan where there is none."""
    finite = values[np.isfinite(values)]
    return math.sqrt(float(finite @ finite) / finite.size) if finite.size else math.nan


@dataclass(frozen=True)
class Indication:
    """One instrument: rms of its correction [m/s^2], rows of each flag, and its first rows for a spectrum.

    In ``leading`` the running correction as angle [rad] is ``before``; ``after`` is 0.
    """

    calibration: Calibration
    scale_factor: float
    correction: float
    flagged: dict[str, int]
    leading: Residuals


def _indication_of(
    record: Run, calibration: Calibration, begins: NDArray[np.bool_], ax: Array, dv: Array, flags: Flags
) -> tuple[Indication, Array]:
    """An instrument with its compensation, and the indicated specific force [m/s^2]."""
    K, output = scale_factor(calibration), record.output
    without = begins | ((flags & FLAGS["no_increment"]) != 0)
    without[0] = True
    h = np.where(without, 0.0, changes(record.t))
    omega = np.broadcast_to(0.0, h.size) if record.base_rate is None else record.base_rate[:, 0]
    base = h * middles(omega)
    if record.kind == "rate":
        turn = h * middles(output)
        psi, indicated = np.cumsum(turn), (output + omega) / K
    else:
        turn, psi = np.where(without, 0.0, changes(output)), output
        indicated = (turn + base) / (K * np.where(h > 0.0, h, np.nan))
    rows = slice(0, LEADING_ROWS)
    angle = np.cumsum(turn[rows] + base[rows] - K * dv[rows])
    nothing = np.broadcast_to(0.0, angle.size)
    segment = record.segment_index[rows] if record.segment_index.size else np.zeros(angle.size, np.int32)
    leading = Residuals(
        np.arange(1, angle.size + 1, dtype=np.int32), record.t[rows], psi[rows], nothing, angle, nothing, nothing,
        segment,
    )  # fmt: skip
    flagged = {name: int(np.count_nonzero(flags & bit)) for name, bit in FLAGS.items()}
    return Indication(calibration, K, rms(indicated - ax), flagged, leading), indicated


class CompensationOutline:
    """Outline of a compensation.

    Curves by name, for each of the ``components`` (``a_x``; or ``f_x``, ``f_y``, ``f_z`` of a set): the component itself,
    ``indicated``, ``correction`` and ``u`` before its name; of a set also ``residual`` and a ``misfit`` of each instrument.
    """

    def __init__(
        self, kind: str, result: Compensated | CompensatedSet, mounted: Sequence[Mounted] = ()
    ) -> None:
        self.kind, self.mounted = kind, tuple(mounted)
        self.components = tuple(f"f_{axis}" for axis in XYZ) if mounted else ("a_x",)
        self.instruments: list[Indication] = []
        self.size, self.start = result.size, float(result.t[0])
        self.flagged = int(np.count_nonzero(result.flags & ~FLAGS["no_increment"]))
        self.velocity = np.atleast_1d(result.dv.sum(axis=0))
        self.marks = {name: _marks_of(result.t[result.flagged(name)]) for name in FLAGS}
        self._t = result.t
        self._curves: dict[str, tuple[Array, Array]] = {}
        self._rms: dict[str, float] = {}

    @property
    def redundant(self) -> bool:
        """True if there are more instruments than unknowns, so that a misfit exists."""
        return len(self.mounted) > 3

    def add(self, name: str, values: Array) -> None:
        """Add a curve of all rows."""
        rows = envelope_rows(values, CURVE_POINTS)
        self._curves[name], self._rms[name] = (self._t[rows] - self.start, values[rows]), rms(values)

    def add_component(self, name: str, indicated: Array, force: Array, u: Array) -> None:
        """Add the curves of a component [m/s^2]; ``u`` may be empty."""
        for kind, values in (
            ("", force),
            ("indicated ", indicated),
            ("correction ", indicated - force),
            ("u ", u),
        ):
            if values.size:
                self.add(kind + name, values)

    def curve(self, name: str) -> tuple[Array, Array]:
        """Times since the first row [s], and the envelope of a curve."""
        return self._curves[name]

    def has(self, name: str) -> bool:
        """Whether the curve has a value."""
        return math.isfinite(self.rms(name))

    def rms(self, name: str) -> float:
        """Root mean square of all values of a curve; nan where there is none."""
        return self._rms.get(name, math.nan)


def of_record(record: Run, calibration: Calibration, result: Compensated) -> CompensationOutline:
    """Outline of a single instrument."""
    outline = CompensationOutline(record.kind, result)
    one, indicated = _indication_of(record, calibration, record.begins, result.ax, result.dv, result.flags)
    outline.instruments.append(one)
    outline.add_component("a_x", indicated, result.ax, result.u_ax)
    return outline


def of_set(records: Sequence[Run], mounted: Sequence[Mounted], result: CompensatedSet) -> CompensationOutline:
    """Outline of a set; ``result`` with details."""
    outline = CompensationOutline(records[0].kind, result, mounted)
    begins = np.logical_or.reduce([record.begins for record in records])
    from_axes = np.linalg.pinv(np.array([item.axes[0] for item in mounted], dtype=float))
    indicated = np.zeros((3, result.size))
    for i, (record, item) in enumerate(zip(records, mounted, strict=True)):
        axis, flags = (
            np.asarray(item.axes[0], dtype=float),
            result.each[i] if result.each.size else result.flags,
        )
        one, along = _indication_of(record, item.calibration, begins, result.f @ axis, result.dv @ axis, flags)
        outline.instruments.append(one)
        for k, share in enumerate(from_axes[:, i]):
            indicated[k] += share * along
        if outline.redundant:
            outline.add(f"misfit {i}", result.misfit[i])
    for k, name in enumerate(outline.components):
        outline.add_component(
            name, indicated[k], result.f[:, k], result.u_f[:, k] if result.u_f.size else result.u_f
        )
    if outline.redundant:
        outline.add("residual", result.residual)
    return outline
