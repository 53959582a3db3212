"""Recursive estimates, one sample at a time: the recursion of the literature, and least squares by Givens rotations."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.jit import Array, kernel


@kernel
def published_recursion(
    indicated: Array,
    a_x: Array,
    a_t: Array,
    s: Array,
    x: Array,
    P: Array,
    marks: NDArray[np.int64],
    history: Array,
) -> float:
    """Run the recursion over all samples; ``x`` and ``P`` are updated in place.

    ``y = indicated - a_x``, ``row = [a_t sin(s + x2), a_t x1 cos(s + x2), 1, a_x, a_x^2]`` cut to the
    states, ``gain = P row / (1 + row P row)``, as published [Wei2024, eq. 12-18 and 22-24]. After sample
    ``marks[i] - 1`` the state goes into ``history[i]``. Returns the sum of squared innovations.
    """
    m = x.size
    row = np.empty(m)
    Pr = np.empty(m)
    total = 0.0
    mark = 0
    for i in range(indicated.size):
        sine, cosine = math.sin(s[i] + x[1]), math.cos(s[i] + x[1])
        row[0] = a_t[i] * sine
        row[1] = a_t[i] * x[0] * cosine
        residual = indicated[i] - a_x[i] - a_t[i] * x[0] * sine
        if m > 2:
            row[2] = 1.0
            row[3] = a_x[i]
            row[4] = a_x[i] * a_x[i]
            residual -= x[2] + x[3] * a_x[i] + x[4] * a_x[i] * a_x[i]
        denominator = 1.0
        for j in range(m):
            Pr[j] = 0.0
            for k in range(m):
                Pr[j] += P[j, k] * row[k]
            denominator += row[j] * Pr[j]
        for j in range(m):
            gain = Pr[j] / denominator
            x[j] += gain * residual
            for k in range(m):
                P[j, k] -= gain * Pr[k]
        total += residual * residual
        while mark < marks.size and marks[mark] == i + 1:
            history[mark] = x
            mark += 1
    return total


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
