"""Weighted least squares on readouts in groups of rows: square-root reduction, covariance, doubts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from piga.errors import IdentifiabilityError
from piga.results import Array, Result

_SMALLEST_SIGMA = 1e-12
"""Smallest noise level of a group. It avoids division by zero for a record without noise."""


@dataclass(frozen=True)
class UnknownGroup:
    """Rows of one kind with one noise level: ``residual`` (n,), ``regressors`` (n, p).

    ``rows`` is the number of independent rows. It is less than n if a trend was removed from them; 0 means n.
    """

    name: str
    residual: Array
    regressors: Array
    rows: float = 0.0

    def reduced(self) -> Reduced:
        """Triangular factor (p + 1, p + 1) of ``[regressors | residual]``. An estimate needs nothing else."""
        table = np.column_stack([self.regressors, self.residual])
        factor: Array = np.linalg.qr(table, mode="r")  # type: ignore[assignment]
        return Reduced(self.name, factor, self.rows or float(len(self.residual)))


@dataclass(frozen=True)
class Reduced:
    """A group reduced to its triangular ``factor`` (p + 1, p + 1) and the number of independent rows."""

    name: str
    factor: Array
    rows: float

    def squares(self, step: Array) -> float:
        """Sum of squares of the residuals after ``step`` (p,)."""
        left = self.factor[:, -1] - self.factor[:, :-1] @ step
        return float(left @ left)


@dataclass(frozen=True, eq=False, repr=False)
class LeastSquares(Result):
    """A least-squares step (p,), its covariance (p, p), the condition of the scaled problem, noise levels."""

    step: Array
    covariance: Array
    condition: float
    levels: tuple[float, ...]


def solve(parts: Sequence[Reduced], levels: Sequence[float], names: Sequence[str]) -> LeastSquares:
    """Weighted least squares with the noise ``levels`` (standard deviations) of the groups.

    Raises
    ------
    IdentifiabilityError
        If a combination of unknowns cannot be determined from the rows. The message names it.
    """
    p = len(names)
    stacked = np.concatenate([part.factor / level for part, level in zip(parts, levels, strict=True)])
    factor: Array = np.linalg.qr(stacked, mode="r")  # type: ignore[assignment]
    norms = np.linalg.norm(factor[:p, :p], axis=0)
    norms[norms == 0.0] = 1.0
    left, values, right = np.linalg.svd(factor[:p, :p] / norms)
    if values[-1] < 1e-11 * values[0]:
        raise IdentifiabilityError(
            f"the record cannot tell apart: {in_words(right[-1], names)}",
            remedy="use another source of observation, a longer record or unequal case speeds",
        )
    inverse = (right.T / values) @ left.T / norms[:, None]
    condition = float(values[0] / values[-1])
    return LeastSquares(inverse @ factor[:p, p], inverse @ inverse.T, condition, tuple(levels))


def noise_levels(parts: Sequence[Reduced], solution: LeastSquares) -> list[float]:
    """Standard deviation of each group from its residuals after the step of ``solution``.

    Each group loses the degrees of freedom that its rows gave to the estimate: the sum of their leverages,
    ``trace(J C J') / sigma^2``.
    """
    levels = []
    for part, level in zip(parts, solution.levels, strict=True):
        rows = part.factor[:, :-1] / level
        leverage = float(np.sum((rows @ solution.covariance) * rows))
        freedom = max(part.rows - leverage, 1.0)
        levels.append(max(float(np.sqrt(part.squares(solution.step) / freedom)), _SMALLEST_SIGMA))
    return levels


def by_source(parts: Sequence[Reduced], solution: LeastSquares) -> tuple[dict[str, float], dict[str, float]]:
    """Noise level of each group, and the root mean square of its residuals after the step of ``solution``."""
    noise = {part.name: level for part, level in zip(parts, solution.levels, strict=True)}
    return noise, {part.name: float(np.sqrt(part.squares(solution.step) / part.rows)) for part in parts}


def solve_with_noise(parts: Sequence[Reduced], names: Sequence[str]) -> LeastSquares:
    """Weighted least squares with noise levels estimated from the residuals of the same rows."""
    levels = [max(float(np.linalg.norm(p.factor[:, -1]) / np.sqrt(p.rows)), _SMALLEST_SIGMA) for p in parts]
    solution = solve(parts, levels, names)
    for _ in range(20):
        estimated = noise_levels(parts, solution)
        settled = np.allclose(estimated, solution.levels, rtol=1e-4, atol=0.0)
        solution = solve(parts, estimated, names)
        if settled:
            break
    return solution


def in_words(direction: Array, names: Sequence[str]) -> str:
    """The unknowns with the largest share in a singular direction, e.g. ``polar.u + equatorial.v``."""
    order = np.argsort(-np.abs(direction))
    chosen = [k for k in order if abs(direction[k]) > 0.25 * abs(direction[order[0]])][:4]
    return ", ".join(names[k] for k in sorted(chosen))
