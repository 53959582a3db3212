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
    the majority decides: if more samples agree on the second level than on the first, the first ones are left out.
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
                if accepted < 3:
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


@kernel
def correct_samples(d: Array, begins: NDArray[np.bool_], flags: NDArray[np.int8], wrong: Array) -> None:
    """Error of every reading: jumps so far, and spikes relative to their good neighbours.

    ``d`` (n,) are residual increments. A jump (flag 2) is the change of the residual angle since the last good sample. The
    residual angle without jumps is linear between good samples of a stretch and constant outside them.
    """
    angle = shift = base = level = calm_angle = 0.0
    good, calm, first = -1, False, 0
    for i in range(d.size):
        if begins[i]:
            _close(wrong, first, good, i, level, base, shift)
            angle, base, good, calm, first = 0.0, shift, -1, False, i
        else:
            angle += d[i]
        if flags[i] == 1:
            wrong[i] = angle
            continue
        if flags[i] == 0:
            calm, calm_angle = True, angle
        elif calm:
            shift += angle - calm_angle
        now = angle - (shift - base)
        if good >= 0:
            _bridge(wrong, good, i, level, now, base)
        else:
            _bridge(wrong, first - 1, i, now, now, base)
        wrong[i], good, level = shift, i, now
    _close(wrong, first, good, d.size, level, base, shift)


@kernel
def _bridge(wrong: Array, before: int, after: int, left: float, right: float, base: float) -> None:
    """Error of samples between two good ones: residual angle ``wrong`` less the straight line."""
    for k in range(before + 1, after):
        wrong[k] += base - (left + (right - left) * (k - before) / (after - before))


@kernel
def _close(wrong: Array, first: int, good: int, stop: int, level: float, base: float, shift: float) -> None:
    """Error at the end of a stretch, after its last good sample; a stretch without good samples keeps earlier jumps."""
    if good >= 0:
        _bridge(wrong, good, stop, level, level, base)
    else:
        wrong[first:stop] = shift
