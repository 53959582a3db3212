"""Sums over residuals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from piga._kernels.jit import reducing_kernel

Array = NDArray[np.float64]

_PART = 2048


@reducing_kernel
def lagged_products(x: Array, out: Array) -> None:
    """``out[k] = sum x[i] x[i + k]`` for k = 0 .. out.size - 1, in parts that stay in the first-level cache."""
    n = x.size
    for start in range(0, n, _PART):
        stop = min(start + _PART, n)
        for k in range(out.size):
            total = 0.0
            for i in range(start, min(stop, n - k)):
                total += x[i] * x[i + k]
            out[k] += total
