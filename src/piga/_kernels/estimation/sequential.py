"""Estimates that take a record row by row: orthogonal (square-root) reduction, and recursions one sample at a time.

The factor ``R`` of the augmented matrix ``[X | y]`` is a fixed-size summary. The last column contains
``Q'y``, and its last diagonal element is the norm of the residual.

Long blocks are reduced by Householder reflections in double precision. Square-root-free rotations (Gentleman 1973, AS 75)
combine the results and short blocks in double-double. So the result does not depend on how the rows were split. There are
two recursions: that of the literature, and least squares by Givens rotations.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels import arithmetic as dd
from piga._kernels.jit import Array, exact, kernel, reducing_kernel

NOTHING = 1e-29
"""Share of an element below which a remainder is double-double rounding."""
SMALLEST = 1e-250
"""Squared column size below which a column is only rounding; equal columns leave ever smaller remainders."""


@reducing_kernel
def _dot(a: Array, b: Array) -> float:
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


@reducing_kernel
def _axpy(factor: float, a: Array, b: Array) -> None:
    for i in range(a.size):
        b[i] += factor * a[i]


@kernel
def absorb(R: Array, block: Array) -> None:
    """Reduce ``block`` (m, n), one column of the data matrix per row, into ``R`` (m, m) in place.

    Householder reflections on ``[R; block']``: column j of the stacked matrix has the one element
    ``R[j, j]`` on top. The block is used as workspace. R is not scaled: columns may have any size.
    """
    m = R.shape[0]
    for j in range(m):
        column = block[j]
        below = _dot(column, column)
        alpha = R[j, j]
        square = alpha * alpha + below
        if below == 0.0 or square < SMALLEST:
            continue
        norm = math.sqrt(square)
        if alpha > 0.0:
            norm = -norm
        top = alpha - norm
        factor = 1.0 / (norm * top)
        for k in range(j + 1, m):
            projection = (top * R[j, k] + _dot(column, block[k])) * factor
            R[j, k] += top * projection
            _axpy(projection, column, block[k])
        R[j, j] = norm


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


@exact
def gather(weight: Array, unit: Array, rows: Array, row_weight: Array) -> None:
    """Gather ``rows`` (2, n, m) of weights ``row_weight`` (2, n) into ``U' W U``, all in double-double.

    Numbers are high and low parts; the rows are used as workspace. ``weight`` (2, m) is W, ``unit``
    (2, m, m) the unit upper triangular U; ``R = sqrt(W) U`` is the triangular factor. For each row x of
    weight w and each pivot j: ``W' = W + w x_j^2``, ``x_k -= x_j U_jk``, ``U_jk += (w x_j / W') x_k``, ``w' = w W / W'``.
    A remainder below the carried digits is set to zero. As a pivot it would spread over the later columns.
    """
    n, m = rows.shape[1], rows.shape[2]
    for i in range(n):
        row, low = rows[0, i], rows[1, i]
        w = (row_weight[0, i], row_weight[1, i])
        if w[0] == 0.0:
            continue
        for j in range(m):
            x = (row[j], low[j])
            if x[0] == 0.0 and x[1] == 0.0:
                continue
            wx = dd.multiply(w, x)
            old = (weight[0, j], weight[1, j])
            new = dd.add(old, dd.multiply(wx, x))
            if new[0] <= 0.0:
                continue
            weight[0, j], weight[1, j] = new
            gain = dd.divide(wx, new)
            for k in range(j + 1, m):
                u = (unit[0, j, k], unit[1, j, k])
                product = dd.multiply(x, u)
                rest = dd.add((row[k], low[k]), (-product[0], -product[1]))
                if abs(rest[0]) < NOTHING * abs(row[k]):
                    rest = (0.0, 0.0)
                row[k], low[k] = rest
                unit[0, j, k], unit[1, j, k] = dd.add(u, dd.multiply(gain, rest))
            if old[0] == 0.0:
                break
            w = dd.divide(dd.multiply(w, old), new)


@exact
def back_substitute(unit: Array, solution: Array) -> None:
    """Solve ``U x = y`` in double-double; ``unit`` (2, m + 1, m + 1) unit upper triangular, y its last column."""
    m = solution.shape[1]
    for i in range(m - 1, -1, -1):
        x = (unit[0, i, m], unit[1, i, m])
        for k in range(i + 1, m):
            product = dd.multiply((unit[0, i, k], unit[1, i, k]), (solution[0, k], solution[1, k]))
            x = dd.add(x, (-product[0], -product[1]))
        solution[0, i], solution[1, i] = x


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
