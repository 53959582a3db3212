"""Resample velocity increments: the running velocity, linear within each interval, at new times."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from piga._kernels.jit import exact

Array = NDArray[np.float64]

VALID, START, INDEX, TIME = 0, 1, 2, 3
VELOCITY = 4  # then as many sums of what was given out


@exact
def resample(
    t: Array, dv: Array, flags: NDArray[np.int32], period: float, state: Array, marks: NDArray[np.int32],
    times: Array, rows: Array, found: NDArray[np.int32],
) -> int:  # fmt: skip
    """Resample increments (n, c) to ``rows`` at ``start + k period``; returns their number. State in and out.

    A new increment is the running velocity at its time less the sum of the increments already given out. ``found``
    holds the flags of all rows that overlap it; ``marks`` holds those of the unfinished row.
    """
    width, count = dv.shape[1], 0
    given = VELOCITY + width
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
            times[count], found[count], marks[0] = target, marks[0], 0
            for c in range(width):
                end = state[VELOCITY + c] + dv[j, c]
                velocity = state[VELOCITY + c] + dv[j, c] * share if target < t[j] else end
                rows[count, c] = velocity - state[given + c]
                state[given + c] += rows[count, c]
            count += 1
            state[INDEX] += 1.0
            target = state[START] + (state[INDEX] + 1.0) * period
        if target - period < t[j]:
            marks[0] |= flags[j]
        for c in range(width):
            state[VELOCITY + c] += dv[j, c]
        state[TIME] = t[j]
    return count
