"""Weighted least squares on readouts in groups of rows: square-root reduction, covariance, doubts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga.errors import IdentifiabilityError

Array = NDArray[np.float64]

_SMALLEST_SIGMA = 1e-12
"""Floor of a group's noise level: a record without noise must not divide by zero."""


@dataclass(frozen=True)
class Group:
    """Rows of one kind with one noise level: ``residual`` (n,), ``regressors`` (n, p), ``sigma``.

    ``rows`` counts independent rows: fewer than n when the rows are filtered; 0 stands for n.
    """

    name: str
    residual: Array
    regressors: Array
    sigma: float = 1.0
    rows: float = 0.0

    def count(self) -> float:
        """Independent rows."""
        return self.rows or float(len(self.residual))


@dataclass(frozen=True)
class Solution:
    """A least-squares step (p,), its covariance (p, p) and the condition of the scaled problem."""

    step: Array
    covariance: Array
    condition: float


def solve(groups: Sequence[Group], names: Sequence[str]) -> Solution:
    """Weighted least squares by orthogonal reduction.

    Raises
    ------
    IdentifiabilityError
        If a combination of unknowns does not show in the rows; the message names it.
    """
    factor = reduced(groups)
    p = len(names)
    norms = np.linalg.norm(factor[:p, :p], axis=0)
    norms[norms == 0.0] = 1.0
    left, values, right = np.linalg.svd(factor[:p, :p] / norms)
    if values[-1] < 1e-11 * values[0]:
        raise IdentifiabilityError(
            f"the record cannot tell apart: {in_words(right[-1], names)}",
            remedy="use another source of observation, a longer record or unequal case speeds",
        )
    inverse = (right.T / values) @ left.T / norms[:, None]
    return Solution(inverse @ factor[:p, p], inverse @ inverse.T, float(values[0] / values[-1]))


def reduced(groups: Sequence[Group]) -> Array:
    """Triangular factor of the weighted rows ``[regressors | residual]``."""
    parts = [np.column_stack([g.regressors, g.residual]) / g.sigma for g in groups]
    factor: Array = np.linalg.qr(np.concatenate(parts), mode="r")  # type: ignore[assignment]
    return factor


def noise_levels(groups: Sequence[Group], unknowns: int) -> list[float]:
    """Standard deviation of each group from its residuals, degrees of freedom shared by independent rows.

    For filtered rows this is the level of white noise that would leave as much inside the filter's band,
    which is what the scatter of the unknowns depends on.
    """
    total = sum(g.count() for g in groups)
    levels = []
    for g in groups:
        freedom = max(g.count() * (1.0 - unknowns / total), 1.0)
        levels.append(max(float(np.sqrt(np.sum(g.residual**2) / freedom)), _SMALLEST_SIGMA))
    return levels


def in_words(direction: Array, names: Sequence[str]) -> str:
    """The unknowns with the largest share in a singular direction, e.g. ``polar.u + equatorial.v``."""
    order = np.argsort(-np.abs(direction))
    chosen = [k for k in order if abs(direction[k]) > 0.25 * abs(direction[order[0]])][:4]
    return ", ".join(names[k] for k in sorted(chosen))
