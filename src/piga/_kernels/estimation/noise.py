"""Noise of angle increments: whitening of a first-order moving average, and the saw-tooth error of counting.

An output angle has white angle noise (variance r) and angle random walk (q per second). The noise of its increment
is ``w_n + e_n - e_(n-1)``. The variance is ``q h_n + 2 r``. The covariance of neighbours is ``-r``.
In units of r, with ``kappa = q/r``, the innovations algorithm is a one-pole recursion:
``v_n = kappa h_n + 2 - 1/v_(n-1)``, ``i_n = d_n + i_(n-1)/v_(n-1)``, variance of ``i_n`` is ``r v_n``.
It restarts where a stretch begins (``h = 0``).

The saw-tooth is given by its harmonics along a path, and by their covariance for an uncertain path.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.arithmetic import fast_sine_cosine
from piga._kernels.jit import Array, kernel, reducing_kernel

LARGE, SMALL = 2.0**300, 2.0**-300
"""Size above which the recurrence of the variances is scaled down, and the scale factor."""
UNCHECKED = 16
"""Rows between two looks at that size: each may be a gap of 1e9 sample intervals without an overflow."""
CANDIDATES = 8
"""Candidates of kappa whose likelihood is computed in one pass over the residuals."""


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
def likelihoods(d: Array, h: Array, kappas: Array, out_log: Array, out_square: Array) -> None:
    """Sums of ``log v`` and ``i^2/v`` of the residual increments for each of the candidates of kappa (k,).

    With ``p_n = v_1 v_2 .. v_n`` and ``s_n = p_(n-1) i_n`` no step waits for a division:
    ``p_n = (kappa h_n + 2) p_(n-1) - p_(n-2)``, ``s_n = s_(n-1) + p_(n-1) d_n`` and ``i_n^2/v_n = s_n^2/(p_(n-1) p_n)``. The sum
    of the logarithms is the logarithm of the last p. Accumulates into ``out_log`` and ``out_square`` (k,).
    """
    candidates = kappas.size
    state = np.empty((4, candidates))  # made here: aligned to whole vectors, which is three times as fast
    before, product, total, square = state[0], state[1], state[2], state[3]
    for k in range(candidates):
        before[k] = total[k] = square[k] = 0.0
        product[k] = 1.0
    count = 0
    for i in range(d.size + 1):
        begins = i == d.size or h[i] == 0.0
        if begins or count == UNCHECKED:
            count = 0
            for k in range(candidates):
                if begins or product[k] > LARGE:
                    out_log[k] += math.log(product[k])
                    kept = 0.0 if begins else 1.0 / product[k]
                    before[k] *= kept
                    total[k] *= kept
                    product[k] = 1.0
        if begins or h[i] < 0.0:
            continue
        step, increment = h[i], d[i]
        for k in range(candidates):
            following = (kappas[k] * step + 2.0) * product[k] - before[k]
            gathered = total[k] + product[k] * increment
            square[k] += gathered * gathered / (product[k] * following)
            before[k] = product[k]
            product[k] = following
            total[k] = gathered
        count += 1
    for k in range(candidates):
        out_square[k] += square[k]


NEGLIGIBLE = 1e-6
"""Damping factor below which higher harmonics are left out."""
WAVES = 64
"""Samples whose waves are computed side by side."""


@reducing_kernel
def add_waves(
    turned: Array, first: int, edges: NDArray[np.int64], work: Array, cosines: Array, sines: Array
) -> None:
    """Add ``exp(2 pi i m turned)``, m = 1 .. M, of a path [counts] to sums over bins (M, bins).

    The first sample is ``first`` rows behind the start from which ``edges`` (bins + 1,) are counted. Samples of a bin
    are worked on side by side, up to WAVES of them. ``work`` (4, WAVES) is scratch space.
    """
    harmonics = cosines.shape[0]
    c, s, re, im = work[0], work[1], work[2], work[3]
    at = j = 0
    while j < turned.size:
        if first + j >= edges[at + 1]:
            at += 1
            continue
        left = edges[at + 1] - first - j
        lanes = WAVES if left > WAVES else left
        lanes = lanes if lanes < turned.size - j else turned.size - j
        for k in range(lanes):
            fraction = turned[j + k] - math.floor(turned[j + k])
            s[k], c[k] = fast_sine_cosine(2.0 * math.pi * fraction)
            re[k], im[k] = c[k], s[k]
        for m in range(harmonics):
            cosine, sine = 0.0, 0.0
            for k in range(lanes):
                cosine += re[k]
                sine += im[k]
                real = re[k] * c[k] - im[k] * s[k]
                im[k] = re[k] * s[k] + im[k] * c[k]
                re[k] = real
            cosines[m, at] += cosine
            sines[m, at] += sine
        j += lanes


@kernel
def saw_tooth_covariance(
    cosine: Array, sine: Array, power: Array, times: Array, ramp: Array, walk: float, spread: float, out: Array
) -> None:
    """Covariance of the saw-tooth between bins, by harmonic, added to ``out``.

    ``cosine``, ``sine`` (M, J): means over each of J bins of the harmonics m = 1 .. M of the phase along the
    path; ``power`` (M,): their variances. The difference of phase between two bins is uncertain with
    variance ``walk |times_a - times_b| + spread (ramp_a - ramp_b)^2`` [counts^2], normally distributed: harmonic m is
    damped by ``exp(-2 pi^2 m^2 variance)``. ``out`` (H + 1, J, J): harmonics 1 .. H, and all further ones together.
    """
    harmonics, bins = cosine.shape
    last = out.shape[0] - 1
    for a in range(bins):
        for b in range(a + 1):
            slope = ramp[a] - ramp[b]
            variance = walk * abs(times[a] - times[b]) + spread * slope * slope
            ratio = math.exp(-2.0 * math.pi**2 * variance)
            square = ratio * ratio
            damped = ratio
            for m in range(harmonics):
                value = power[m] * damped * (cosine[m, a] * cosine[m, b] + sine[m, a] * sine[m, b])
                at = m if m < last else last
                out[at, a, b] += value
                if a != b:
                    out[at, b, a] += value
                ratio *= square
                damped *= ratio
                if damped < NEGLIGIBLE:
                    break
