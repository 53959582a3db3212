"""Harmonics of the saw-tooth that counting is, summed over bins of samples."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.jit import kernel

Array = NDArray[np.float64]


@kernel
def add_waves(
    turned: Array, ramp: Array, slope: float, first: int, edges: NDArray[np.int64], cosines: Array, sines: Array
) -> None:
    """Add ``exp(2 pi i m x)``, ``x = turned + slope ramp`` [counts], to sums over bins (harmonics, bins).

    The first sample is ``first`` rows behind the start from which ``edges`` (bins + 1,) are counted; the powers
    follow from the first one.
    """
    harmonics = cosines.shape[0]
    at = np.searchsorted(edges, first, side="right") - 1
    for j in range(turned.size):
        if first + j >= edges[at + 1]:
            at += 1
        x = turned[j] + slope * ramp[j]
        phase = 2.0 * math.pi * (x - math.floor(x))
        c, s = math.cos(phase), math.sin(phase)
        re, im = c, s
        for m in range(harmonics):
            cosines[m, at] += re
            sines[m, at] += im
            re, im = re * c - im * s, re * s + im * c
