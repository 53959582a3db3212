"""Mergeable linear least squares: weighted rows are reduced to one triangle.

Rows ``[x | y]`` with m columns x are replaced by the triangular factor R of their QR decomposition (LAPACK, Householder
reflections). ``R'R`` equals ``[x | y]'[x | y]``, so R contains all that least squares needs. Triangles add up: the
triangle of two sets of rows is the triangle of both triangles stacked. A position, a run and a stored summary each
are one triangle; fits, comparisons and tests select columns, leave triangles out, or stack them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from piga.errors import ArgumentError
from piga.results import Array

BLOCK = 4096
"""Rows reduced at a time: a block of ten columns fits in the second-level cache."""


@dataclass(eq=False)
class Reduction:
    """Triangle of weighted rows ``[x | y]``.

    Attributes
    ----------
    names:
        Column names of x, m of them.
    factor:
        Upper triangular factor R (m + 1, m + 1), last column for y. Its diagonal is not negative.
    count:
        Rows absorbed.
    """

    names: tuple[str, ...]
    factor: Array
    count: int = 0

    @classmethod
    def empty(cls, names: tuple[str, ...]) -> Reduction:
        """Triangle without rows."""
        return cls(names, np.zeros((len(names) + 1, len(names) + 1)))

    @classmethod
    def stacked(cls, parts: Sequence[Reduction]) -> Reduction:
        """Triangle of the rows of several triangles with the same columns; ``parts`` is not empty.

        Raises
        ------
        ArgumentError
            If the columns differ.
        """
        for part in parts:
            if part.names != parts[0].names:
                raise ArgumentError(
                    f"summaries of different columns: {parts[0].names} and {part.names}",
                    remedy="merge summaries that were made with the same terms",
                )
        rows = np.vstack([part.factor for part in parts])
        return cls(parts[0].names, triangle(rows), sum(part.count for part in parts))

    def absorb(self, columns: Array, *, count: int | None = None) -> None:
        """Absorb rows given as ``columns`` (m + 1, n), last one y.

        ``count`` is the number of rows that contain information (n unless some are all zero).
        """
        size = len(self.names) + 1
        if columns.shape[0] != size:
            raise ArgumentError(
                f"columns: {columns.shape[0]} given, {size} needed", remedy="give one row for each name, then y"
            )
        blocks = (columns[:, start : start + BLOCK].T for start in range(0, columns.shape[1], BLOCK))
        self.factor = triangle(np.vstack([self.factor, *map(triangle, blocks)]))
        self.count += columns.shape[1] if count is None else count

    def select(self, names: tuple[str, ...]) -> Reduction:
        """The triangle for some of the columns, as if the other columns had never existed."""
        chosen = [*(self.names.index(name) for name in names), len(self.names)]
        return Reduction(names, triangle(self.factor[:, chosen]), self.count)

    def mixed(self, names: tuple[str, ...], matrix: Array) -> Reduction:
        """The triangle for combinations of the columns: ``matrix`` (m + 1, len(names) + 1), observation last."""
        return Reduction(names, triangle(self.factor @ matrix), self.count)

    def without(self, names: tuple[str, ...], variance: float = math.inf) -> Reduction:
        """The triangle without these columns: their coefficients are independent, have zero mean and ``variance``.

        With the default, their coefficients are estimated freely. ``variance`` 0 sets them to zero, as ``select`` does.
        """
        rest = tuple(name for name in self.names if name not in names)
        if variance == 0.0:
            return self.select(rest)
        order = [*(self.names.index(name) for name in (*names, *rest)), len(self.names)]
        prior = np.eye(len(names), len(order)) / math.sqrt(variance)
        factor = triangle(np.vstack([prior, self.factor[:, order]]))
        return Reduction(rest, factor[len(names) :, len(names) :], self.count)

    def less(self, name: str, multiple: float) -> Reduction:
        """The triangle after ``multiple`` times a column is subtracted from the observations."""
        rows = self.factor.copy()
        rows[:, -1] -= multiple * rows[:, self.names.index(name)]
        return Reduction(self.names, triangle(rows), self.count)

    def solve(self) -> tuple[Array, Array, float]:
        """Estimate (m,), inverse information matrix (m, m) and residual sum of squares.

        The covariance is the inverse information times the noise variance.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the columns are exactly dependent.
        """
        m = len(self.names)
        scale = np.linalg.norm(self.factor[:, :m], axis=0)
        if m and (scale == 0.0).any():
            raise np.linalg.LinAlgError("a column is zero")
        scaled = self.factor[:m, :m] / scale
        inverse = np.linalg.solve(scaled, np.eye(m)) / scale[:, None]
        estimate = np.linalg.solve(scaled, self.factor[:m, m]) / scale
        return estimate, inverse @ inverse.T, float(self.factor[m, m] ** 2)


def triangle(rows: Array) -> Array:
    """Square triangular factor (k, k) of rows (n, k) with a diagonal that is not negative."""
    factor = np.linalg.qr(rows, mode="r")
    result = np.zeros((rows.shape[1], rows.shape[1]))
    result[: len(factor)] = factor * np.where(np.diag(factor) < 0.0, -1.0, 1.0)[:, None]
    return result
