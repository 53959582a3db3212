"""A straight line through values whose uncertainties are known, with an excess variance: the core of a trend.

Model: ``y_i = b_0 + b_1 (t_i - t_0) + d_i + e_i`` with ``var(e_i) = v_i`` stated and ``var(d_i) = tau^2`` found
from the scatter (Paule and Mandel's condition: the weighted residual sum equals its expectation). Intervals
use the weighted residual sum and Student's t with ``n - p`` degrees of freedom (Hartung and Knapp), so that
with equal ``v_i`` they are those of ordinary least squares, unless the values scatter far less than the stated
``v_i`` let expect: the sum is not taken below its 20 % quantile.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError

Array = NDArray[np.float64]

LEAST = 0.2
"""Probability of the quantile below which the weighted residual sum is not believed: chance makes few values agree."""
DOUBT = 0.01
"""Probability of a scatter so small (or so large) that it contradicts the stated uncertainties."""
TINY = 1e-12
"""Least standard uncertainty taken, relative to the largest value: keeps exact values from infinite weight."""


@dataclass(frozen=True)
class LineFit:
    """A fitted level (p = 1) or straight line (p = 2) in ``t - origin``.

    Attributes
    ----------
    coefficients, covariance:
        (p,) and (p, p): level at ``origin`` and slope; covariance from the scatter about the line.
    weights:
        (p, n): ``coefficients = weights @ y``; carries errors that the values share.
    excess, stated:
        Variance ``tau^2`` beyond the stated one, zero if the stated one explains the scatter; mean stated one.
    scale:
        Weighted residual sum over ``n - p`` after the excess: 1, or less when the values scatter less
        than stated, but not less than its 20 % quantile.
    chi2:
        Weighted residual sum with the stated variances alone; has ``n - p`` degrees of freedom.
    """

    origin: float
    coefficients: Array
    covariance: Array
    weights: Array
    excess: float
    scale: float
    chi2: float
    degrees_of_freedom: int
    stated: float

    @property
    def excess_std(self) -> float:
        """Standard uncertainty of the excess, ``sqrt(2/(n - p)) (tau^2 + v)`` with the mean stated ``v``."""
        return float(np.sqrt(2.0 / self.degrees_of_freedom)) * (self.excess + self.stated)

    def basis(self, time: float) -> Array:
        """Derivative (p,) of the line at ``time`` by its coefficients."""
        return np.array([1.0, time - self.origin])[: self.coefficients.size]

    def at(self, time: float) -> tuple[float, float]:
        """Value of the line and its variance from the scatter."""
        x = self.basis(time)
        return float(x @ self.coefficients), float(x @ self.covariance @ x)


def fit_line(
    time: Array, values: Array, variances: Array, *, slope: bool = True, origin: float | None = None
) -> LineFit:
    """Weighted fit of a level or a line with excess variance.

    Parameters
    ----------
    time, values, variances:
        (n,) each; stated variances are those of errors that the values do not share.
    slope:
        False for a level alone.
    origin:
        Time of the level; the weighted mean time when left out.

    Raises
    ------
    ArgumentError
        If there are no more values than coefficients, or all times are equal and a slope is wanted.
    """
    from scipy.special import chdtri

    t, y = np.asarray(time, dtype=float), np.asarray(values, dtype=float)
    p = 2 if slope else 1
    if y.size <= p:
        raise ArgumentError(
            f"a {'line' if slope else 'level'} with uncertainty needs {p + 1} values, not {y.size}"
        )
    if slope and np.ptp(t) == 0.0:
        raise ArgumentError("a drift needs values at different times")
    v = np.maximum(np.asarray(variances, dtype=float), (TINY * float(np.abs(y).max() or 1.0)) ** 2)
    centre = float(np.average(t, weights=1.0 / v)) if origin is None else origin
    X = np.column_stack([np.ones_like(t), t - centre])[:, :p]
    chi2 = _residual_sum(X, y, v)
    excess = _excess(X, y, v, y.size - p)
    covariance, weights = _solve(X, v + excess)
    coefficients = weights @ y
    found = float(np.sum((y - X @ coefficients) ** 2 / (v + excess)))
    scale = max(found, float(chdtri(y.size - p, 1.0 - LEAST))) / (y.size - p)
    freedom, stated = y.size - p, float(v.mean())
    return LineFit(centre, coefficients, scale * covariance, weights, excess, scale, chi2, freedom, stated)


def _solve(X: Array, variances: Array) -> tuple[Array, Array]:
    """``(X' W X)^-1`` and the map from values to coefficients, by QR of the weighted columns."""
    root = 1.0 / np.sqrt(variances)
    q, r = np.linalg.qr(X * root[:, None])
    inverse = np.linalg.inv(r)
    return inverse @ inverse.T, inverse @ (q.T * root)


def _residual_sum(X: Array, y: Array, variances: Array) -> float:
    residual = y - X @ (_solve(X, variances)[1] @ y)
    return float(np.sum(residual**2 / variances))


def _excess(X: Array, y: Array, v: Array, freedom: int) -> float:
    """The ``tau^2 >= 0`` at which the weighted residual sum equals its degrees of freedom."""
    from scipy.optimize import brentq

    def surplus(excess: float) -> float:
        return _residual_sum(X, y, v + excess) - freedom

    if freedom == 0 or surplus(0.0) <= 0.0:
        return 0.0
    upper = float(np.median(v))
    while surplus(upper) > 0.0:
        upper *= 4.0
    return float(brentq(surplus, 0.0, upper, xtol=1e-14 * upper, rtol=1e-14))


@dataclass(frozen=True)
class Groups:
    """Values merged by group (day): mean time, weighted mean, its variance, and the way there.

    ``within`` is the variance inside groups beyond the stated one (nan without repeats), ``spread`` the
    pooled standard deviation inside groups, ``freedom`` its degrees of freedom; ``means = weights @ values``.
    """

    time: Array
    means: Array
    variances: Array
    weights: Array
    within: float
    spread: float
    freedom: int


def merge_groups(time: Array, values: Array, variances: Array, labels: NDArray[np.int64]) -> Groups:
    """Weighted mean of each group with a common excess variance inside groups (Paule and Mandel)."""
    v = np.maximum(variances, (TINY * float(np.abs(values).max() or 1.0)) ** 2)
    count = int(labels.max()) + 1
    membership = (labels == np.arange(count)[:, None]).astype(float)
    freedom = values.size - count
    within = _excess(membership.T.copy(), values, v, freedom) if freedom else np.nan
    total = v + (within if freedom else 0.0)
    weights = membership / total
    weights /= weights.sum(axis=1, keepdims=True)
    sizes = membership.sum(axis=1)
    deviation = values - ((membership @ values) / sizes)[labels]
    spread = float(np.sqrt(np.sum(deviation**2) / freedom)) if freedom else np.nan
    return Groups(
        (membership @ time) / sizes,
        weights @ values,
        1.0 / (membership / total).sum(axis=1),
        weights,
        float(within),
        spread,
        freedom,
    )
