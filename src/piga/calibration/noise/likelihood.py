"""The restricted likelihood of noise levels: the one formula, its information matrix, and the search for the levels.

A record is ``y = X theta + noise`` with covariance ``V = sum_k level_k unit_k``. All components of the noise, from
white noise to coloured noise, are estimated by this likelihood. They differ in the ``unit`` covariances only
(:mod:`piga.calibration.noise.components`). Levels have no lower bound as long as V is a covariance: only then is their
average over records right. The inverse information matrix is the covariance of the levels. It gives the degrees of freedom
[Kenward1997].
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtri

from piga.calibration.noise.settings import NOISE
from piga.results import Array


def restricted(logarithm: ArrayLike, square: ArrayLike, freedom: int | None = None) -> Array:
    """Minus twice the restricted log-likelihood, up to a constant.

    Parameters
    ----------
    logarithm:
        ``log|V| + log|X' V^-1 X|``.
    square:
        Residual sum of squares in ``V^-1``.
    freedom:
        Observations less parameters, where the scale of V is unknown: the likelihood is then that of the best scale,
        ``square/freedom``. None where the scale is known.
    """
    size = np.asarray(square, dtype=float)
    if freedom is not None:
        size = freedom * np.log(np.maximum(size, 1e-300))
    result: Array = size + np.asarray(logarithm, dtype=float)
    return result


def information(shares: Array) -> Array:
    """Fisher information (k, k) of levels, from the ``shares`` (k, n) of a unit of each in the variance of n independent values."""
    result: Array = 0.5 * shares @ shares.T
    return result


@dataclass(frozen=True)
class Contrasts:
    """Slow values of a record without its model, and the fast rest.

    ``y`` (n,) are the slow values. ``units`` (k, n, n) are their covariances by a unit of each component. The first
    component is white noise; ``fast`` more values with the sum of squares ``rest`` contain nothing else. ``block`` (n, count)
    leads from the slow rates to the slow values.
    """

    y: Array
    units: Array = field(repr=False)
    rest: float
    fast: int
    block: Array = field(repr=False)

    def turned(self, rates: Array) -> Array:
        """Covariance of the slow values by a covariance of the slow rates."""
        covariance: Array = self.block @ rates @ self.block.T
        return covariance

    def factor(self, levels: Array) -> Array | None:
        """Inverse of the lower triangular factor of V; None where V is not a covariance."""
        if levels[0] <= 0.0:
            return None
        try:
            lower = np.linalg.cholesky(np.tensordot(levels, self.units, 1))
        except np.linalg.LinAlgError:
            return None
        result: Array = np.linalg.inv(lower)
        return result

    def deviance(self, levels: Array, factor: Array) -> float:
        """Minus twice the restricted log-likelihood at ``levels`` with the ``factor`` that belongs to them."""
        white = factor @ self.y
        logarithm = self.fast * np.log(levels[0]) - 2.0 * np.log(np.abs(np.diag(factor))).sum()
        return float(restricted(logarithm, white @ white + self.rest / levels[0]))


@dataclass(frozen=True)
class Levels:
    """Estimated levels (k,), their covariance (k, k), and minus twice the log-likelihood."""

    values: Array
    covariance: Array
    deviance: float


def estimate(contrasts: Contrasts, start: Array) -> Levels | None:
    """Levels of greatest restricted likelihood, of either sign, by scoring; None if V is not a covariance at ``start``.

    A step that leaves the covariances or lowers the likelihood is halved.
    """
    levels, factor = start.astype(float), contrasts.factor(start)
    if factor is None:
        return None
    best = contrasts.deviance(levels, factor)
    for _ in range(NOISE.iterations):
        step = _solve(_expected(contrasts, levels, factor), _slope(contrasts, levels, factor))
        gain = 0.0
        for _ in range(NOISE.halvings):
            moved = levels + step
            other = contrasts.factor(moved)
            tried = np.inf if other is None else contrasts.deviance(moved, other)
            if other is not None and tried <= best:
                gain, levels, factor, best = best - tried, moved, other, tried
                break
            step = 0.5 * step
        if gain < NOISE.converged:
            break
    return Levels(levels, _inverse(_expected(contrasts, levels, factor)), best)


@dataclass(frozen=True)
class UpperLimit:
    """Largest level that a record does not exclude.

    ``replaced`` [1] is the share of the walk that the component then takes the place of.
    """

    level: float
    replaced: float


@dataclass(frozen=True)
class ProfileLikelihood:
    """Restricted likelihood of the level of one component, at the best white noise and walk (theory/noise, noise-limit).

    ``y`` (shares, n) are the slow values whitened by white noise and the rest of the walk, if the component takes the place of a
    share of the walk of the weights; ``inverses`` (shares, n, n) whiten them, ``logarithms`` are those of their covariances.
    """

    y: Array
    inverses: Array = field(repr=False)
    logarithms: Array
    rest: float
    freedom: int

    @classmethod
    def of(cls, contrasts: Contrasts, walk: Array | None) -> ProfileLikelihood:
        """From slow values with white noise alone, and their covariance (n, n) by the walk of the weights; None without one."""
        size = contrasts.y.size
        shares = (0.0,) if walk is None else NOISE.limit_shares
        lower = np.array(
            [np.linalg.cholesky(np.eye(size) - (0.0 if walk is None else share * walk)) for share in shares]
        )
        inverses = np.linalg.inv(lower)
        logarithms = 2.0 * np.log(np.einsum("sii->si", lower)).sum(axis=1)
        return cls(inverses @ contrasts.y, inverses, logarithms, contrasts.rest, size + contrasts.fast)

    def excludes(self, unit: Array, level: float, confidence: float) -> bool:
        """True if a level is excluded in comparison with a level of zero; cheaper than the limit."""
        ratio = level * self.freedom / (self.rest + float((self.y[0] ** 2).sum()))
        none, there = [], []
        for y, inverse, logarithm in zip(self.y, self.inverses, self.logarithms, strict=True):
            lower = np.linalg.cholesky(np.eye(y.size) + ratio * inverse @ unit @ inverse.T)
            white = np.linalg.solve(lower, y)
            size = logarithm + 2.0 * float(np.log(np.diag(lower)).sum())
            none.append(float(restricted(logarithm, y @ y + self.rest, self.freedom)))
            there.append(float(restricted(size, white @ white + self.rest, self.freedom)))
        return min(there) - min(none) > float(ndtri(confidence)) ** 2

    def limit(self, unit: Array, confidence: float) -> UpperLimit:
        """Upper limit of the level of a component whose unit has the covariance (n, n); inf where no level is excluded."""
        levels, deviances = [], []
        for y, inverse, logarithm in zip(self.y, self.inverses, self.logarithms, strict=True):
            values, vectors = np.linalg.eigh(inverse @ unit @ inverse.T)
            ratio = np.append(0.0, 10.0 ** np.arange(-4.0, 5.0, NOISE.limit_step) / values[-1])
            spread = 1.0 + ratio[:, None] * np.maximum(values, 0.0)
            total = ((vectors.T @ y) ** 2 / spread).sum(axis=1) + self.rest
            levels.append(ratio * total / self.freedom)
            deviances.append(restricted(logarithm + np.log(spread).sum(axis=1), total, self.freedom))
        table = np.array([np.interp(levels[0], own, d) for own, d in zip(levels, deviances, strict=True)])
        profile = table.min(axis=0)
        best = int(profile.argmin())
        rise = profile[best:] - profile[best] - float(ndtri(confidence)) ** 2
        if rise.max() <= 0.0:
            return UpperLimit(np.inf, 0.0)
        above = int(np.argmax(rise > 0.0))
        part = rise[above - 1] / (rise[above - 1] - rise[above])
        low, high = levels[0][best + above - 1], levels[0][best + above]
        shares = NOISE.limit_shares[: len(table)]
        return UpperLimit(float(low + part * (high - low)), shares[int(table[:, best + above].argmin())])


def _slope(contrasts: Contrasts, levels: Array, factor: Array) -> Array:
    """Derivative of the log-likelihood by the levels (k,)."""
    inverse = factor.T @ factor
    a = inverse @ contrasts.y
    turned = contrasts.units @ a
    slope = 0.5 * (turned @ a - np.tensordot(contrasts.units, inverse, 2))
    slope[0] += 0.5 * (contrasts.rest / levels[0] ** 2 - contrasts.fast / levels[0])
    result: Array = slope
    return result


def _expected(contrasts: Contrasts, levels: Array, factor: Array) -> Array:
    """Fisher information (k, k) of the levels."""
    whole = np.array([factor @ unit @ factor.T for unit in contrasts.units])
    result = information(whole.reshape(len(whole), -1))
    result[0, 0] += 0.5 * contrasts.fast / levels[0] ** 2
    return result


def _scaled(matrix: Array) -> tuple[Array, Array]:
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return matrix / np.outer(size, size), size


def _solve(matrix: Array, right: Array) -> Array:
    scaled, size = _scaled(matrix)
    result: Array = np.linalg.lstsq(scaled, right / size, rcond=NOISE.separable)[0] / size
    return result


def _inverse(matrix: Array) -> Array:
    scaled, size = _scaled(matrix)
    result: Array = np.linalg.pinv(scaled, rcond=NOISE.separable, hermitian=True) / np.outer(size, size)
    return result
