"""Noise of angle increments: whitening of a first-order moving average.

An output angle has white angle noise (variance r) and angle random walk (q per second). The noise of its increment
is ``w_n + e_n - e_(n-1)``. The variance is ``q h_n + 2 r``. The covariance of neighbours is ``-r``.
In units of r, with ``kappa = q/r``, the innovations algorithm is a one-pole recursion:
``v_n = kappa h_n + 2 - 1/v_(n-1)``, ``i_n = d_n + i_(n-1)/v_(n-1)``, variance of ``i_n`` is ``r v_n``.
It restarts where a stretch begins (``h = 0``).

Samples that do not lie on the path of the output are told by one pass with two local-level filters (:func:`scan_samples`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.jit import Array, kernel

LARGE, SMALL = 2.0**300, 2.0**-300
"""Size above which the recurrence of the variances is scaled down, and the scale factor."""


@kernel
def innovation_weights(
    h: Array, white: float, walk: float, previous: float, carry: Array, scale: Array
) -> float:
    """Weights of the recursion for one block.

    ``white`` = r, ``walk`` = q. ``previous`` is the variance of the last innovation before the block (0
    when a stretch begins). Writes ``carry[i]``: factor on the innovation before row i; ``scale[i]``: one
    over the standard deviation. Rows with ``h = 0`` get zeros; those with ``h < 0`` (samples left out) pass
    the innovation on. Returns the last variance.
    """
    kappa = walk / white if white > 0.0 else 0.0
    old, new = (1.0, previous / white) if previous > 0.0 and white > 0.0 else (0.0, 1.0)
    for i in range(h.size):  # variance of every innovation, and that of the one before (0: none, -1: passed on)
        if h[i] <= 0.0:
            scale[i] = 0.0
            carry[i] = -1.0 if h[i] < 0.0 else 0.0
            if h[i] == 0.0:
                old, new, previous = 0.0, 1.0, 0.0
            continue
        carry[i] = previous
        old, new = new, (kappa * h[i] + 2.0) * new - old
        previous = white * (new / old) if white > 0.0 else walk * h[i]
        scale[i] = previous
        if new > LARGE:
            old, new = old * SMALL, new * SMALL
    for i in range(h.size):
        before = carry[i]
        carry[i] = white / before if before > 0.0 else -before
        scale[i] = 1.0 / math.sqrt(scale[i]) if scale[i] > 0.0 else 0.0
    return previous


@kernel
def whiten(columns: Array, carry: Array, scale: Array, state: Array, out: Array) -> None:
    """Run the recursion over every row of ``columns`` (m, n); ``state`` (m,) holds the last innovations.

    Each step waits for the step before, so four rows are computed side by side. If fewer than four remain, the last one is
    repeated.
    """
    m, n = columns.shape
    for j in range(0, m, 4):
        k, p, q = min(j + 1, m - 1), min(j + 2, m - 1), min(j + 3, m - 1)
        first, second, third, fourth = state[j], state[k], state[p], state[q]
        for i in range(n):
            first = columns[j, i] + carry[i] * first
            second = columns[k, i] + carry[i] * second
            third = columns[p, i] + carry[i] * third
            fourth = columns[q, i] + carry[i] * fourth
            out[j, i] = first * scale[i]
            out[k, i] = second * scale[i]
            out[p, i] = third * scale[i]
            out[q, i] = fourth * scale[i]
        state[j], state[k], state[p], state[q] = first, second, third, fourth


@kernel
def rate_sums(d: Array, h: Array, edges: NDArray[np.int64], kappa: float, out: Array) -> float:
    """Whiten residual increments ``d`` (n,) and their intervals ``h`` at ``kappa = q/r``, with r = 1, and sum by position.

    Writes ``h'Wh``, ``h'Wd`` and ``d'Wd`` of the rows between ``edges`` (G + 1,) to ``out`` (G, 3). Returns the sum of the
    logarithms of the variances of the innovations.
    """
    logarithm, product = 0.0, 1.0
    variance = unit = miss = 0.0
    for g in range(edges.size - 1):
        hh = hd = dd = 0.0
        for i in range(edges[g], edges[g + 1]):
            if h[i] <= 0.0:
                if h[i] == 0.0:
                    variance = 0.0
                continue
            gain = 1.0 / variance if variance > 0.0 else 0.0
            variance = kappa * h[i] + 2.0 - gain
            unit = h[i] + gain * unit
            miss = d[i] + gain * miss
            weight = 1.0 / variance
            hh += weight * unit * unit
            hd += weight * unit * miss
            dd += weight * miss * miss
            product *= variance
            if product > LARGE:
                logarithm += math.log(product)
                product = 1.0
        out[g, 0], out[g, 1], out[g, 2] = hh, hd, dd
    return logarithm + math.log(product)


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
