"""Resample velocity increments to another rate without losing velocity."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga._kernels.arithmetic import resample as kernels
from piga.compensation.model import FLAGS
from piga.compensation.result import Compensated, CompensatedSet
from piga.errors import ArgumentError

Array = NDArray[np.float64]


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
        times, dv, found = self._push(part.t, part.dv, flags)
        ax = np.where(found & FLAGS["no_increment"], np.nan, dv / self._period)
        return Compensated(times, ax, dv, np.zeros(0), found, part.serial, part.method)

    def push_set(self, part: CompensatedSet) -> dict[str, NDArray]:
        """Columns ``t, fx, fy, fz, dvx, dvy, dvz, flags`` of a set at the new rate, as in :meth:`push_rows`."""
        times, dv, found = self._push(part.t, part.dv, part.flags)
        mean = np.where((found & FLAGS["no_increment"])[:, None], np.nan, dv / self._period)
        columns: dict[str, NDArray] = {"t": times}
        for prefix, values in (("f", mean), ("dv", dv)):
            columns |= {prefix + axis: np.ascontiguousarray(values[:, i]) for i, axis in enumerate("xyz")}
        return columns | {"flags": found}

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
                f"t[{row}]: {times[row]:.9g} s does not lie behind the time before",
                remedy="resample the parts between jumps of the clock one by one",
            )
        start = self._state[kernels.START] if known else (times[0] if times.size else 0.0)
        end = times[-1] if times.size else start
        room = max(int((end - start) / self._period - self._state[kernels.INDEX]) + 2, 0)
        marks = np.zeros(times.size, dtype=np.int32) if flags is None else flags
        new, rows, found = np.empty(room), np.empty((room, values.shape[1])), np.empty(room, dtype=np.int32)
        count = kernels.resample(
            times, values, marks, self._period, self._state, self._marks, new, rows, found
        )  # fmt: skip
        return new[:count], rows[:count].reshape(count, *np.shape(dv)[1:]), found[:count]
