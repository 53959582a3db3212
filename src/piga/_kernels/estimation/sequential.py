"""Estimates that take a record row by row: least squares by Givens rotations, and the recursion of the literature.

The factor ``R`` of the augmented matrix ``[X | y]`` is a fixed-size summary. The last column contains
``Q'y``, and its last diagonal element is the norm of the residual.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.jit import Array, kernel


@kernel
def absorb_row(R: Array, row: Array) -> None:
    """Reduce one row (m,) into ``R`` (m, m) by Givens rotations; the row is used as workspace."""
    m = row.size
    for j in range(m):
        b = row[j]
        if b == 0.0:
            continue
        a = R[j, j]
        norm = math.sqrt(a * a + b * b)
        inverse = 1.0 / norm
        c, s = a * inverse, b * inverse
        R[j, j] = norm
        for k in range(j + 1, m):
            upper = R[j, k]
            R[j, k] = c * upper + s * row[k]
            row[k] = c * row[k] - s * upper


@kernel
def absorb_rows(R: Array, columns: Array, marks: NDArray[np.int64], snapshots: Array) -> None:
    """Reduce the columns (m, n) row by row; after row ``marks[i] - 1`` copy R into ``snapshots[i]``."""
    m, n = columns.shape
    row = np.empty(m)
    mark = 0
    for i in range(n):
        for j in range(m):
            row[j] = columns[j, i]
        absorb_row(R, row)
        while mark < marks.size and marks[mark] == i + 1:
            snapshots[mark] = R
            mark += 1


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
