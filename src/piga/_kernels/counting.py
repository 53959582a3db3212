"""The saw-tooth that counting adds: its harmonics along a path, and their covariance where that is known only roughly."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.jit import kernel

Array = NDArray[np.float64]

NEGLIGIBLE = 1e-6
"""Damping factor from which on higher harmonics are left out."""


@kernel
def add_waves(turned: Array, first: int, edges: NDArray[np.int64], cosines: Array, sines: Array) -> None:
    """Add ``exp(2 pi i m turned)``, m = 1 .. M, of a path [counts] to sums over bins (M, bins).

    The first sample is ``first`` rows behind the start from which ``edges`` (bins + 1,) are counted.
    """
    harmonics = cosines.shape[0]
    at = np.searchsorted(edges, first, side="right") - 1
    for j in range(turned.size):
        if first + j >= edges[at + 1]:
            at += 1
        phase = 2.0 * math.pi * (turned[j] - math.floor(turned[j]))
        c, s = math.cos(phase), math.sin(phase)
        re, im = c, s
        for m in range(harmonics):
            cosines[m, at] += re
            sines[m, at] += im
            re, im = re * c - im * s, re * s + im * c


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
                at = min(m, last)
                out[at, a, b] += value
                if a != b:
                    out[at, b, a] += value
                ratio *= square
                damped *= ratio
                if damped < NEGLIGIBLE:
                    break
