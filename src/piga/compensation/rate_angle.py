"""The output angle from a recorded output rate, whole or chunk by chunk."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def integrated_rate(t: Array, rate: Array, begins: NDArray[np.bool_]) -> Array:
    """Angle from a rate [rad]: trapezoid with end correction, see :class:`RateAngle`."""
    follower = RateAngle()
    return np.concatenate((follower.push(t, rate, begins), follower.finish()))


class RateAngle:
    """Angle from a rate, chunk by chunk: trapezoid with end correction, slopes by central differences.

    A sample waits for the one behind it. The result does not depend on the chunks, to the bit.
    """

    def __init__(self) -> None:
        self._t, self._rate, self._begins = np.zeros(0), np.zeros(0), np.zeros(0, dtype=np.bool_)
        self._angle, self._slope = 0.0, 0.0
        self._given = False

    def push(self, t: Array, rate: Array, begins: NDArray[np.bool_]) -> Array:
        """Angles [rad] of all samples but the last, and of the one that waited."""
        self._t, self._rate = np.concatenate((self._t, t)), np.concatenate((self._rate, rate))
        self._begins = np.concatenate((self._begins, begins))
        return self._go(self._t.size - 1)

    def finish(self) -> Array:
        """Angle of the sample that waits."""
        return self._go(self._t.size)

    def _go(self, stop: int) -> Array:
        """Angles of the samples up to ``stop`` that are not given yet; the one before them is kept, too."""
        first = 1 if self._given else 0
        if stop <= first:
            return np.zeros(0)
        slope = self._slopes()[:stop]
        if self._given:
            slope[0] = self._slope
        step = np.where(self._begins[1:stop], 0.0, np.diff(self._t[:stop]))
        rate = self._rate[:stop]
        turns = 0.5 * step * (rate[1:] + rate[:-1]) + step**2 / 12.0 * (slope[:-1] - slope[1:])
        angle = np.cumsum(np.concatenate(([self._angle], turns)))
        self._angle, self._slope, self._given = float(angle[-1]), float(slope[-1]), True
        self._t, self._rate, self._begins = (
            self._t[stop - 1 :],
            self._rate[stop - 1 :],
            self._begins[stop - 1 :],
        )
        return angle[first:]

    def _slopes(self) -> Array:
        """Slope at every sample, one-sided at both ends of a stretch."""
        step = np.diff(self._t)
        joined = ~self._begins[1:] & (step > 0.0)
        each = np.where(joined, np.diff(self._rate) / np.where(joined, step, 1.0), 0.0)
        left, right = np.concatenate(([0.0], each)), np.concatenate((each, [0.0]))
        before, behind = (
            np.concatenate(([0.0], np.where(joined, step, 0.0))),
            np.concatenate((np.where(joined, step, 0.0), [0.0])),
        )
        both = before + behind
        return np.where(both > 0.0, (left * behind + right * before) / np.where(both > 0.0, both, 1.0), 0.0)
