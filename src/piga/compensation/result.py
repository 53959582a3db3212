"""Compensated records of one instrument or of a set: plain arrays with their units; also at another rate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga._kernels import arithmetic as kernels
from piga.compensation.model import FLAGS
from piga.errors import ArgumentError
from piga.records.calibration import Calibration
from piga.records.calibration.coverage import TYPE_A_ONLY
from piga.records.run import Run
from piga.results import Column, Reported, Result, Tabular, plotted

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class Compensated(Result, Reported, Tabular):
    """Specific force and velocity increments of one instrument; arrays share their length.

    Attributes
    ----------
    t:
        Time [s].
    ax:
        Specific force along the input axis [m/s^2]. Angle (or count) record: mean over the interval that ends
        at ``t``. Rate record: value at ``t``. nan where no increment is formed.
    dv:
        Velocity increment since the previous row [m/s]; 0 where no increment is formed.
    u_ax:
        Standard uncertainty of ``ax`` [m/s^2] from coefficients and noise; empty if not requested.
    flags:
        Bits, see :data:`piga.compensation.FLAGS`; empty if not requested.
    serial, method:
        Serial number of the instrument, and ``"exact"`` or ``"published"``.
    notes:
        Notes that every display of ``u_ax`` must show, from :func:`notes_on`; files hold them too.
    made_from:
        The record and the calibration, for :meth:`plot` and :meth:`report`. A pickle leaves them out.
    """

    t: Array
    ax: Array
    dv: Array
    u_ax: Array
    flags: NDArray[np.int32]
    serial: str = ""
    method: str = "exact"
    notes: tuple[str, ...] = field(default=())
    made_from: tuple[Run, Calibration] | None = field(default=None, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"made_from": None}

    def __copy__(self) -> Compensated:
        return replace(self)

    def in_brief(self) -> list[tuple[str, str]]:
        """What a notebook shows of the compensation."""
        facts = [
            ("instrument", self.serial or "not named"),
            ("method", self.method),
            ("rows", str(self.size)),
            ("velocity", f"{float(self.dv.sum()):.6g} m/s"),
        ]
        if self.u_ax.size:
            facts.append(("u_ax, median", f"{float(np.nanmedian(self.u_ax)):.3g} m/s^2"))
        if self.flags.size:
            raised = {name: int(np.count_nonzero(self.flagged(name))) for name in FLAGS}
            facts.append(("flags", ", ".join(f"{n} {name}" for name, n in raised.items() if n) or "none"))
        return facts + [("note", note) for note in self.notes]

    @property
    def size(self) -> int:
        """Number of rows."""
        return int(self.t.size)

    def flagged(self, name: str) -> NDArray[np.bool_]:
        """Rows with the flag ``name`` (see :data:`piga.compensation.FLAGS`)."""
        return (self.flags & FLAGS[name]) != 0

    def velocity(self) -> Array:
        """Running sum of ``dv`` [m/s]; it does not include the time between stretches."""
        return np.cumsum(self.dv)

    def plot(self, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Specific force, correction and uncertainty against time. See :class:`piga.results.Plots`."""
        return plotted(self, ax)

    def columns(self) -> dict[str, NDArray]:
        """The columns of the written file, in order."""
        columns = {"t": self.t, "ax": self.ax, "dv": self.dv}
        if self.u_ax.size:
            columns["u_ax"] = self.u_ax
        return columns | ({"flags": self.flags} if self.flags.size == self.size else {})

    def table_columns(self) -> dict[str, Column]:
        """The columns of the written file with their units."""
        return with_units(self.columns())

    def table_notes(self) -> tuple[str, ...]:
        """The notes on ``u_ax``."""
        return self.notes

    def to_parquet(self, path: str | Path) -> None:
        """Write a Parquet file; its metadata hold units, flag names and notes."""
        from piga.compensation.writers import write_table

        write_table(Path(path), self.columns(), "parquet", self.notes)

    def to_csv(self, path: str | Path) -> None:
        """Write a CSV file with units in the header. If ``u_ax`` is Type A only, its heading says so."""
        from piga.compensation.writers import write_table

        write_table(Path(path), self.columns(), "csv", self.notes)


def notes_on(*calibrations: Calibration) -> tuple[str, ...]:
    """Notes on the uncertainties from these calibrations. With several calibrations each note names the serial number."""
    alone = [c.serial or f"instrument {n}" for n, c in enumerate(calibrations, 1) if c.type_a_only]
    if not alone:
        return ()
    return (TYPE_A_ONLY if len(calibrations) == 1 else f"{', '.join(alone)}: {TYPE_A_ONLY}",)


@dataclass(frozen=True, eq=False, repr=False)
class CompensatedSet(Result, Tabular):
    """Specific force and velocity increments in the common frame; arrays share their length n.

    ``t`` [s]; ``f`` (n, 3) [m/s^2], ``dv`` (n, 3) [m/s], ``u_f`` (n, 3) [m/s^2] (or (0, 3)). ``residual``
    [m/s^2] is the root of the summed squared misfits of the instruments (0 for three). ``flags`` are those of one
    instrument; a flag is set if it is set for any instrument.
    """

    t: Array
    f: Array
    dv: Array
    u_f: Array
    residual: Array
    flags: NDArray[np.int32]
    misfit: Array = field(default_factory=lambda: np.zeros((0, 0)))
    each: NDArray[np.int32] = field(default_factory=lambda: np.zeros((0, 0), np.int32))

    def plot(self, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Specific force in the common frame, and its uncertainty. See :class:`piga.results.Plots`."""
        return plotted(self, ax)

    @property
    def size(self) -> int:
        """Number of rows."""
        return int(self.t.size)

    def flagged(self, name: str) -> NDArray[np.bool_]:
        """Rows with the flag ``name``."""
        return (self.flags & FLAGS[name]) != 0

    def columns(self) -> dict[str, NDArray]:
        """The columns of the written file, in order."""
        columns: dict[str, NDArray] = {"t": self.t}
        for prefix, values in (("f", self.f), ("dv", self.dv), ("u_f", self.u_f)):
            if values.shape[0]:
                columns |= {prefix + axis: np.ascontiguousarray(values[:, i]) for i, axis in enumerate("xyz")}
        return columns | {"residual": self.residual, "flags": self.flags}

    def table_columns(self) -> dict[str, Column]:
        """The columns of the written file with their units."""
        return with_units(self.columns())


def with_units(columns: dict[str, NDArray]) -> dict[str, Column]:
    """Columns with the units of the written files."""
    from piga.compensation.writers import unit_of_column

    return {name: Column(values, unit_of_column(name)) for name, values in columns.items()}


class Resampler:
    """Resample velocity increments to the times ``start + k period``, chunk by chunk.

    The running velocity is the sum of the increments. It is linear within each interval, because only the mean force
    is known there. A new increment is the running velocity at the new time less the sum of the increments already
    given out. Rounding errors therefore do not accumulate, and no velocity is lost. The result does not depend on
    the chunks, to the bit.

    Parameters
    ----------
    period:
        New interval [s].
    """

    def __init__(self, period: float) -> None:
        if not (period > 0.0 and math.isfinite(period)):
            raise ArgumentError(f"period: {period!r} s is not positive", remedy="e.g. 0.01")
        self._period = period
        self._state: Array | None = None
        self._marks = np.zeros(1, dtype=np.int32)

    @property
    def waiting(self) -> Array:
        """Velocity received but not yet given out [m/s], per component."""
        if self._state is None:
            return np.zeros(0)
        velocity, given = np.split(self._state[kernels.VELOCITY :], 2)
        return np.asarray(velocity - given)

    def carried(self) -> dict[str, Any]:
        """The state, for :meth:`go_on`."""
        return {
            "state": None if self._state is None else self._state.tolist(),
            "marks": self._marks.tolist(),
        }

    def go_on(self, carried: dict[str, Any]) -> None:
        """Continue from a stored state."""
        self._state = None if carried["state"] is None else np.array(carried["state"])
        self._marks = np.array(carried["marks"], dtype=np.int32)

    def push(self, t: ArrayLike, dv: ArrayLike) -> tuple[Array, Array]:
        """Add increments ``dv`` (n,) or (n, 3) [m/s] since the previous sample, at the times ``t`` (n,) [s].

        The first sample only sets the start. Its increment is held back.

        Returns
        -------
        t, dv:
            New times, and the increments since the previous new time.

        Raises
        ------
        ArgumentError
            If the times do not increase.
        """
        times, rows, _ = self._push(t, dv, None)
        return times, rows

    def push_rows(self, part: Compensated) -> Compensated:
        """Compensated rows at the new rate.

        ``ax`` is the mean force over the new interval. It is nan where no increment was formed. A row has the flags of
        all rows that it overlaps. There is no ``u_ax``, because the noise of neighbouring rows is correlated.
        """
        flags = part.flags if part.flags.size == part.size else None
        times, dv, flags = self._push(part.t, part.dv, flags)
        ax = np.where(flags & FLAGS["no_increment"], np.nan, dv / self._period)
        return Compensated(times, ax, dv, np.zeros(0), flags, part.serial, part.method)

    def push_set(self, part: CompensatedSet) -> dict[str, NDArray]:
        """Columns ``t, fx, fy, fz, dvx, dvy, dvz, flags`` of a set at the new rate, as in :meth:`push_rows`."""
        times, dv, flags = self._push(part.t, part.dv, part.flags)
        mean = np.where((flags & FLAGS["no_increment"])[:, None], np.nan, dv / self._period)
        columns: dict[str, NDArray] = {"t": times}
        for prefix, values in (("f", mean), ("dv", dv)):
            columns |= {prefix + axis: np.ascontiguousarray(values[:, i]) for i, axis in enumerate("xyz")}
        return columns | {"flags": flags}

    def _push(
        self, t: ArrayLike, dv: ArrayLike, flags: NDArray[np.int32] | None
    ) -> tuple[Array, Array, NDArray[np.int32]]:
        times = np.atleast_1d(np.asarray(t, dtype=float))
        values = np.ascontiguousarray(np.asarray(dv, dtype=float).reshape(times.size, -1))
        if self._state is None:
            self._state = np.zeros(kernels.VELOCITY + 2 * values.shape[1])
        known = self._state[kernels.VALID] != 0.0
        steps = np.diff(times, prepend=self._state[kernels.TIME] if known else -np.inf)
        if not (steps > 0.0).all():
            row = int(np.argmin(steps > 0.0))
            raise ArgumentError(
                f"t[{row}]: {times[row]:.9g} s is not after the time before",
                remedy="resample the parts between jumps of the clock separately",
            )
        start = self._state[kernels.START] if known else (times[0] if times.size else 0.0)
        end = times[-1] if times.size else start
        room = max(int((end - start) / self._period - self._state[kernels.INDEX]) + 2, 0)
        marks = np.zeros(times.size, dtype=np.int32) if flags is None else flags
        out = kernels.Increments(
            np.empty(room), np.empty((room, values.shape[1])), np.empty(room, dtype=np.int32)
        )
        given = kernels.Increments(times, values, marks)
        count = kernels.resample(given, self._period, self._state, self._marks, out)
        return out.t[:count], out.dv[:count].reshape(count, *np.shape(dv)[1:]), out.flags[:count]
