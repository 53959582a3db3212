"""Velocity increments at another rate, no velocity lost."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga.errors import ArgumentError

Array = NDArray[np.float64]


class Resampler:
    """Bring velocity increments to the times ``start + k period``, chunk by chunk.

    The running velocity is taken as linear inside each interval (its mean force is what is known); a new
    increment is the difference of the velocity at two new times. The sum of all increments given out, and of
    what still waits, is the sum of those put in: the part of an interval that is not yet given out is carried.

    Parameters
    ----------
    period:
        New interval [s].
    """

    def __init__(self, period: float) -> None:
        if not (period > 0.0 and math.isfinite(period)):
            raise ArgumentError(f"period: {period!r} s is not positive", remedy="e.g. 0.01")
        self._period = period
        self._start: float | None = None
        self._index = 0
        self._time = 0.0
        self._waiting: Array = np.zeros(0)

    @property
    def waiting(self) -> Array:
        """Velocity taken in and not yet given out [m/s], per component."""
        return self._waiting.copy()

    def push(self, t: ArrayLike, dv: ArrayLike) -> tuple[Array, Array]:
        """Add increments ``dv`` (n,) or (n, 3) [m/s] since the sample before, at the times ``t`` (n,) [s].

        The first sample only sets the start; its increment is kept waiting.

        Returns
        -------
        t, dv:
            New times and increments since the new time before.
        """
        times = np.atleast_1d(np.asarray(t, dtype=float))
        values = np.asarray(dv, dtype=float).reshape(times.size, -1)
        new_times: list[float] = []
        rows: list[Array] = []
        for time, value in zip(times, values, strict=True):
            if self._start is None:
                self._start = self._time = float(time)
                self._waiting = value.copy()
                continue
            rest, before = value.copy(), self._time
            while (target := self._start + (self._index + 1) * self._period) <= time * (1.0 + 1e-15):
                share = rest * (min(target, time) - before) / (time - before) if target < time else rest
                rows.append(self._waiting + share)
                new_times.append(target)
                rest, before, self._waiting = rest - share, target, np.zeros_like(rest)
                self._index += 1
            self._waiting = self._waiting + rest
            self._time = float(time)
        shape = (len(rows), *np.asarray(dv).shape[1:])
        return np.array(new_times), np.array(rows, dtype=float).reshape(shape)
