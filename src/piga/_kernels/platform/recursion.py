"""Kernel of the recursive least squares: square-root information, one row at a time."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.jit import kernel

Array = NDArray[np.float64]


@kernel
def sequential_factor(rows: Array, factor: Array, kept: NDArray[np.int64], ends: Array) -> None:
    """Reduce ``rows`` (n, p + 1) = [regressors | residual] one by one by Givens rotations.

    The triangular ``factor`` (p + 1, p + 1) is advanced in place; its last block, as large as ``ends[k]``
    (q, q), is copied there after row ``kept[k]``: the estimate of the last q - 1 unknowns needs no more.
    """
    size = rows.shape[1]
    first = size - ends.shape[1]
    row = np.empty(size)
    slot = 0
    for i in range(rows.shape[0]):
        for j in range(size):
            row[j] = rows[i, j]
        for j in range(size):
            if row[j] == 0.0:
                continue
            norm = math.hypot(factor[j, j], row[j])
            c, s = factor[j, j] / norm, row[j] / norm
            for k in range(j, size):
                upper, lower = factor[j, k], row[k]
                factor[j, k] = c * upper + s * lower
                row[k] = c * lower - s * upper
        if slot < kept.shape[0] and i == kept[slot]:
            ends[slot] = factor[first:, first:]
            slot += 1
