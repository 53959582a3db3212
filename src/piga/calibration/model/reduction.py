"""Mergeable linear least squares: rows in chunks of any size are reduced to one triangular factor.

``Reduction`` is the only solver of the calibration. Batch, recursive, per-segment and joint estimates all use it.
Threads reduce long records. Short records are reduced in one piece.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from piga._kernels.estimation.noise import whiten
from piga._kernels.estimation.sequential import absorb, back_substitute, gather
from piga.errors import ArgumentError
from piga.results import Array

BLOCK = 1024
"""Rows reduced at a time; a block of ten columns fits in the second-level cache."""
SHORT = 128
"""Most rows of a block that is summed in double-double at once."""


class Whitening(NamedTuple):
    """Weights of rows: ``carry`` (n,) on the innovation before, ``scale`` (n,), and ``state`` (m + 1,), the last innovations."""

    carry: Array
    scale: Array
    state: Array

    def apply(self, columns: Array) -> Array:
        """Whitened columns (m + 1, n), a new array; the state moves on."""
        out = np.empty(columns.shape)
        whiten(columns, self.carry, self.scale, self.state, out)
        return out


@dataclass(eq=False)
class Reduction:
    """Triangular summary of rows ``[x | y]``, accumulated in double-double.

    Attributes
    ----------
    names:
        Column names of x, m of them.
    weight, unit:
        The factorisation ``U' W U`` of the information matrix: W (2, m + 1) and unit upper triangular U
        (2, m + 1, m + 1), high and low parts.
    count:
        Rows absorbed.
    """

    names: tuple[str, ...]
    weight: Array
    unit: Array
    count: int = 0

    @classmethod
    def empty(cls, names: tuple[str, ...]) -> Reduction:
        """Summary without rows."""
        size = len(names) + 1
        unit = np.zeros((2, size, size))
        unit[0] = np.eye(size)
        return cls(names, np.zeros((2, size)), unit, 0)

    @property
    def factor(self) -> Array:
        """Upper triangular factor R, shape (m + 1, m + 1), last column for y."""
        return np.sqrt(self.weight[0])[:, None] * self.unit[0]

    def absorb(self, columns: Array, *, count: int | None = None) -> None:
        """Absorb rows given as ``columns`` (m + 1, n), last one y.

        ``count`` is the number of rows that contain information (n unless some are all zero).
        """
        size = len(self.names) + 1
        if columns.shape[0] != size:
            raise ArgumentError(
                f"columns: {columns.shape[0]} given, {size} needed", remedy="give one row for each name, then y"
            )
        self.absorb_few(few_rows(columns), columns.shape[1] if count is None else count)

    def absorb_few(self, rows: Array, count: int) -> None:
        """Absorb the rows that :func:`few_rows` made of ``count`` rows."""
        gather(self.weight, self.unit, rows, _ones(rows.shape[1]))
        self.count += count

    def add(self, x: ArrayLike, y: ArrayLike) -> None:
        """Absorb rows ``x`` (n, m) and ``y`` (n,)."""
        rows = np.column_stack([np.asarray(x, dtype=float), np.asarray(y, dtype=float)])
        self.absorb(rows.T)

    def merge(self, other: Reduction) -> None:
        """Absorb another summary of the same columns."""
        if other.names != self.names:
            raise ArgumentError(
                f"summaries of different columns: {self.names} and {other.names}",
                remedy="merge summaries that were made with the same terms",
            )
        gather(self.weight, self.unit, other.unit.copy(), other.weight)
        self.count += other.count

    def select(self, names: tuple[str, ...]) -> Reduction:
        """The summary for some of the columns, as if the other columns had never existed."""
        chosen = [*(self.names.index(name) for name in names), len(self.names)]
        result = Reduction.empty(names)
        gather(result.weight, result.unit, np.ascontiguousarray(self.unit[:, :, chosen]), self.weight)
        result.count = self.count
        return result

    def mixed(self, names: tuple[str, ...], matrix: Array) -> Reduction:
        """The summary for combinations of the columns: ``matrix`` (m + 1, len(names) + 1), observation last."""
        result = Reduction.empty(names)
        gather(result.weight, result.unit, self.unit @ matrix, self.weight)
        result.count = self.count
        return result

    @classmethod
    def of_factor(cls, names: tuple[str, ...], factor: Array, count: int) -> Reduction:
        """The summary of a triangular factor (m + 1, m + 1)."""
        summary = cls.empty(names)
        summary.absorb(np.ascontiguousarray(factor.T), count=count)
        return summary

    @classmethod
    def stacked(cls, parts: list[Reduction]) -> Reduction:
        """Merge several summaries by reflections, in double precision.

        Use it if the columns are nearly dependent in every part. Square-root-free rotations then lose digits.
        """
        factor = np.linalg.qr(np.vstack([part.factor for part in parts]), mode="r")
        return cls.of_factor(parts[0].names, np.asarray(factor), sum(part.count for part in parts))

    def without(self, names: tuple[str, ...]) -> Reduction:
        """The summary without these columns; they are estimated freely, not set to zero."""
        rest = tuple(name for name in self.names if name not in names)
        order = [*(self.names.index(name) for name in (*names, *rest)), len(self.names)]
        factor = np.asarray(np.linalg.qr(self.factor[:, order], mode="r"))
        return self.of_factor(rest, factor[len(names) :, len(names) :], self.count)

    def behind_first(self) -> Reduction:
        """The summary without the first column, which is estimated freely; all digits are kept."""
        return Reduction(self.names[1:], self.weight[:, 1:].copy(), self.unit[:, 1:, 1:].copy(), self.count)

    def less(self, name: str, multiple: float) -> Reduction:
        """The summary after ``multiple`` times a column is subtracted from the observations."""
        unit = self.unit.copy()
        unit[0, :, -1] -= multiple * self.unit[0, :, self.names.index(name)]
        result = Reduction.empty(self.names)
        gather(result.weight, result.unit, unit, self.weight)
        result.count = self.count
        return result

    def scaled(self, information: float) -> Reduction:
        """The summary of the same rows with ``information`` times the weight."""
        return Reduction(self.names, self.weight * information, self.unit.copy(), self.count)

    def solve(self) -> tuple[Array, Array, float]:
        """Estimate (m,), inverse information matrix (m, m) and residual sum of squares.

        The covariance is the inverse information times the noise variance.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the columns are exactly dependent.
        """
        m = len(self.names)
        factor = self.factor
        scale = np.linalg.norm(factor[:, :m], axis=0)
        if m and (scale == 0.0).any():
            raise np.linalg.LinAlgError("a column is zero")
        scaled = factor[:m, :m] / scale
        inverse = solve_upper(scaled, np.eye(m))
        solution = np.zeros((2, m))
        back_substitute(self.unit, solution)
        estimate = solution[0]
        covariance = inverse @ inverse.T / np.outer(scale, scale)
        return estimate, covariance, float(self.weight[0, m])


def few_rows(columns: Array) -> Array:
    """Rows (2, k, m + 1), high and low parts, with the information of ``columns`` (m + 1, n): of many rows a triangle."""
    size, count = columns.shape
    if count <= SHORT:
        rows = np.zeros((2, count, size))
        rows[0] = columns.T
    else:
        rows = np.zeros((2, size, size))
        for start in range(0, count, BLOCK):
            absorb(rows[0], np.array(columns[:, start : start + BLOCK], order="C"))
    return rows


def _ones(count: int) -> Array:
    """Weights 1 for ``count`` rows, high and low parts."""
    weights = np.zeros((2, count))
    weights[0] = 1.0
    return weights


def solve_upper(R: Array, right: Array) -> Array:
    """Solve ``R x = right`` for upper triangular R by back substitution."""
    if not np.all(np.diag(R)):
        raise np.linalg.LinAlgError("singular triangular factor")
    result = np.array(right, dtype=float, copy=True)
    for row in range(R.shape[0] - 1, -1, -1):
        result[row] -= R[row, row + 1 :] @ result[row + 1 :]
        result[row] /= R[row, row]
    return result


SHORT_RECORD = 1 << 16
"""Rows below which handing work to a thread takes longer than the work."""


class _AtOnce(Executor):
    """An executor that does the work immediately."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(fn(*args, **kwargs))
        return done


class _Shared(ThreadPoolExecutor):
    """Threads kept for the next user; starting a thread takes as long as one block of work."""

    def __exit__(self, *_error: object) -> None:
        """Keep the threads."""


@cache
def _shared(threads: int) -> _Shared:
    return _Shared(threads)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_shared.cache_clear)


def workers(rows: int, threads: int) -> Executor:
    """Executor for work on a record of ``rows`` rows; one thread does the work in order of submission."""
    return _AtOnce() if rows <= SHORT_RECORD else _shared(threads)


def beside(rows: int) -> Executor:
    """Executor for one task on a record that itself submits work to :func:`workers`."""
    return _AtOnce() if rows <= SHORT_RECORD else ThreadPoolExecutor(1)
