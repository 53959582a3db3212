"""What samples tell of the time between them: second derivatives of an input, and velocity at other times.

The mean of a smooth input over an interval is the mean of both ends less ``h^2/12`` of its second derivative in the
middle. At a step, a kink or a bad sample, second differences change their sign or size from sample to sample. If the
sign changes, the second derivative is taken as zero. It is never more than twice the smaller of two neighbours, so
that nothing rings.

A running velocity is linear within each interval, where only the mean force is known.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from piga._kernels.jit import exact, inline

Array = NDArray[np.float64]

MOST_GROWTH = 2.0
"""The second derivative in an interval is at most this multiple of the smaller one of its neighbours."""


@inline
def limited(value: float, first: float, second: float) -> float:
    """A second derivative limited by two others; 0 if their signs differ."""
    low, high = min(first, second), max(first, second)
    return min(max(value, 0.0), MOST_GROWTH * max(low, 0.0)) + max(
        min(value, 0.0), MOST_GROWTH * min(high, 0.0)
    )


@exact
def curvature(x: Array, h: Array, i: int) -> float:
    """Second derivative from sample ``i`` of ``x`` and its neighbours; ``h[i]`` is the interval after sample ``i``."""
    return 2.0 * ((x[i + 1] - x[i]) / h[i] - (x[i] - x[i - 1]) / h[i - 1]) / (h[i - 1] + h[i])


@inline
def bow_of(h: float, curved: float) -> float:
    """Mean over an interval ``h`` less the mean of both ends, for a second derivative ``curved``."""
    return -h * h * (1.0 / 12.0) * curved


VALID, START, INDEX, TIME = 0, 1, 2, 3
VELOCITY = 4  # then as many sums of what was given out


class Increments(NamedTuple):
    """Velocity increments ``dv`` (n, c) that end at times ``t`` (n,), with the ``flags`` (n,) of their rows."""

    t: Array
    dv: Array
    flags: NDArray[np.int32]


@exact
def resample(given: Increments, period: float, state: Array, marks: NDArray[np.int32], out: Increments) -> int:
    """Resample increments to ``out`` at ``start + k period``; returns the number of its rows. State in and out.

    A new increment is the running velocity at its time less the sum of the increments already given out. Its flags
    are those of all rows that overlap it; ``marks`` holds those of the unfinished row.
    """
    t, dv, flags = given
    times, rows, row_flags = out
    width, count = dv.shape[1], 0
    sums = VELOCITY + width
    for j in range(t.size):
        if state[VALID] == 0.0:
            state[VALID], state[START], state[TIME] = 1.0, t[j], t[j]
            for c in range(width):
                state[VELOCITY + c] = dv[j, c]
            continue
        target = state[START] + (state[INDEX] + 1.0) * period
        while target <= t[j] * (1.0 + 1e-15):
            marks[0] |= flags[j]
            share = (target - state[TIME]) / (t[j] - state[TIME])
            times[count], row_flags[count], marks[0] = target, marks[0], 0
            for c in range(width):
                end = state[VELOCITY + c] + dv[j, c]
                velocity = state[VELOCITY + c] + dv[j, c] * share if target < t[j] else end
                rows[count, c] = velocity - state[sums + c]
                state[sums + c] += rows[count, c]
            count += 1
            state[INDEX] += 1.0
            target = state[START] + (state[INDEX] + 1.0) * period
        if target - period < t[j]:
            marks[0] |= flags[j]
        for c in range(width):
            state[VELOCITY + c] += dv[j, c]
        state[TIME] = t[j]
    return count
