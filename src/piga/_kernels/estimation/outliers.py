"""Samples of an output angle that do not lie on its path: one pass with two local-level filters."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.jit import Array, kernel

CONFIRM = 8
"""Samples that must agree on another level before it counts as a jump."""
PATIENCE = 2
"""Misses beyond the hits after which a candidate level is dropped."""


@kernel
def scan_samples(
    d: Array, h: Array, white: float, walk: float, limit: float, floor: float, flags: NDArray[np.int8]
) -> None:
    """Mark samples off the path: 1 left out, 2 first sample after a jump.

    ``d`` (n,) are residual increments over intervals ``h`` (0 where a stretch begins). The residual angle
    is a random walk (``walk`` per second) read with white noise (``white``): a Kalman filter of its level
    predicts every sample. One that misses by more than ``limit`` standard deviations, and ``floor`` [rad], is
    left out and does not move the filter. A second filter follows the samples that are left out; when
    CONFIRM of them do, the angle has jumped and the second filter becomes the first. In a stretch shorter than that,
    the majority decides: if more samples agree on the second level than on the first, the first ones are left out. Fewer
    than CONFIRM samples before a jump of a stretch are left out too.
    """
    member = np.zeros(CONFIRM, dtype=np.int64)
    angle = level = variance = other = other_variance = 0.0
    hits = misses = accepted = begin = 0
    for i in range(d.size):
        flags[i] = 0
        if h[i] == 0.0:
            if i - begin < CONFIRM and hits > accepted:
                _keep_members(flags, member[:hits], begin, i)
            angle, level, variance = 0.0, 0.0, white
            hits, accepted, begin = 0, 1, i
            continue
        angle += d[i]
        variance += walk * h[i]
        other_variance += walk * h[i]
        miss = angle - level
        expected = variance + white
        if abs(miss) <= max(limit * math.sqrt(expected), floor):
            gain = variance / expected
            level += gain * miss
            variance *= 1.0 - gain
            hits = 0
            accepted += 1
            continue
        flags[i] = 1
        miss = angle - other
        expected = other_variance + white
        if hits > 0 and abs(miss) <= max(limit * math.sqrt(expected), floor):
            gain = other_variance / expected
            other += gain * miss
            other_variance *= 1.0 - gain
            member[hits] = i
            hits += 1
            if hits == CONFIRM:
                for k in range(CONFIRM):
                    flags[member[k]] = 0
                if accepted < CONFIRM:
                    for k in range(begin, member[0]):
                        flags[k] = 1
                flags[member[0]] = 2
                level, variance = other, other_variance
                hits, accepted, begin = 0, CONFIRM, member[0]
            continue
        misses += 1
        if hits == 0 or misses > hits + PATIENCE:
            other, other_variance = angle, white
            hits, misses = 1, 0
            member[0] = i
    if d.size - begin < CONFIRM and hits > accepted:
        _keep_members(flags, member[:hits], begin, d.size)


@kernel
def _keep_members(flags: NDArray[np.int8], member: NDArray[np.int64], begin: int, stop: int) -> None:
    """Leave out every sample of a stretch but the members of the level that most samples agree on."""
    for k in range(begin, stop):
        flags[k] = 1
    for k in range(member.size):
        flags[member[k]] = 0


@kernel
def merge_rows(columns: Array, h: Array, left_out: NDArray[np.bool_]) -> None:
    """Add the interval into each sample that is left out to the next one, in place; its own ``h`` becomes -1."""
    m, n = columns.shape
    for i in range(n):
        if not left_out[i] or h[i] == 0.0:
            continue
        onward = i + 1 < n and h[i + 1] > 0.0
        if onward:
            h[i + 1] += h[i]
        h[i] = -1.0
        for j in range(m):
            if onward:
                columns[j, i + 1] += columns[j, i]
            columns[j, i] = 0.0
