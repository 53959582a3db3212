"""The saw-tooth error of counting: its harmonics along a path, and their covariance for an uncertain path."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.arithmetic.sine_cosine import fast_sine_cosine
from piga._kernels.jit import kernel, reducing_kernel

Array = NDArray[np.float64]

NEGLIGIBLE = 1e-6
"""Damping factor below which higher harmonics are left out."""
LANES = 64
"""Samples whose waves are computed side by side."""


@reducing_kernel
def add_waves(turned: Array, first: int, edges: NDArray[np.int64], cosines: Array, sines: Array) -> None:
    """Add ``exp(2 pi i m turned)``, m = 1 .. M, of a path [counts] to sums over bins (M, bins).

    The first sample is ``first`` rows behind the start from which ``edges`` (bins + 1,) are counted. Samples of a bin
    are worked on side by side, up to LANES of them.
    """
    harmonics = cosines.shape[0]
    c, s, re, im = np.empty(LANES), np.empty(LANES), np.empty(LANES), np.empty(LANES)
    at = j = 0
    while j < turned.size:
        if first + j >= edges[at + 1]:
            at += 1
            continue
        left = edges[at + 1] - first - j
        lanes = LANES if left > LANES else left
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
