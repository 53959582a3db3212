"""Kernel of the recursive least squares: square-root information, one row at a time."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.jit import kernel

Array = NDArray[np.float64]


@kernel
def sequential_factor(rows: Array, prior: float, kept: NDArray[np.int64], factors: Array) -> None:
    """Take in ``rows`` (n, r, p + 1) = [regressors | residual] by Givens turns.

    The triangular factor (p + 1, p + 1) starts at ``prior`` times the unit matrix and is copied to
    ``factors[k]`` after instant ``kept[k]``.
    """
    size = rows.shape[2]
    factor = factors[0] * 0.0
    for j in range(size):
        factor[j, j] = prior
    row = factor[0] * 0.0
    slot = 0
    for i in range(rows.shape[0]):
        for r in range(rows.shape[1]):
            for j in range(size):
                row[j] = rows[i, r, j]
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
            factors[slot] = factor
            slot += 1
