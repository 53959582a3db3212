"""Forecast of a coefficient from its days, averaged over what the scatter about the line may be.

The scatter of the days about a line has one of three causes: each day scatters for itself, the value walks, or its
drift walks (ageing). A history of a few years rarely tells which, and they forecast differently. So the forecast is an
average: each cause is believed alike beforehand, with any size of the scatter and any share of it, and the restricted
likelihood of the days gives the weights.

Covariance of the days: ``V + s ((1 - share) I + share W)``. ``V`` is stated, ``s`` the variance of the scatter. ``W``
is ``min(t_i, t_j)`` for a walk and ``m^2 (3 M - m)/6`` with ``m = min, M = max`` for a drift that walks, scaled so
that ``W`` scatters about a line like ``I``. Each model predicts by generalised least squares.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from piga.results import Array, Result
from piga.trend.trend_line import TOO_FEW, TREND, Days, Forecast

SIZES = np.concatenate([[0.0], 4.0 ** np.arange(-2.0, 3.5, 0.5)])
"""Variances of the scatter that are tried, relative to that about the line (or the mean stated variance)."""
SHARES = (0.3, 0.7, 1.0)
"""Shares of the scatter that walk."""
_LEAST_WEIGHT = 1e-6


def walk(a: Array, b: Array) -> Array:
    """Covariance of a walk that begins at 0, at times ``a`` (n,) and ``b`` (m,)."""
    return np.minimum.outer(a, b)


def walking_drift(a: Array, b: Array) -> Array:
    """Covariance of the integral of a walk."""
    first, last = np.minimum.outer(a, b), np.maximum.outer(a, b)
    return first**2 * (3.0 * last - first) / 6.0


def independent(a: Array, b: Array) -> Array:
    """Covariance between scatter of a day and that of another day: none."""
    return np.zeros((a.size, b.size))


CAUSES = (independent, walk, walking_drift)


@dataclass(frozen=True)
class _Model:
    """One covariance: its cause, variance that walks (``moving``) and that does not (``still``), Cholesky factor, weight."""

    cause: int
    still: float
    moving: float
    factor: Array
    weight: float


@dataclass(frozen=True, eq=False, repr=False)
class Outlook(Result):
    """Days of a history and the models of their scatter, by weight."""

    days: Days
    models: tuple[_Model, ...]

    def at(self, time: float, variance: float = 0.0, shared: Array | None = None) -> Forecast:
        """Forecast of a value at ``time`` with a further own ``variance``.

        ``shared`` (sources,) are its errors common to the days; None: the coefficient itself, without errors.
        """
        days, since = self.days, self.days.time - self.days.time[0]
        ahead = np.array([time - days.time[0]])
        design = _design(days.time)
        there = np.array([1.0, (time - days.time.mean()) / np.ptp(days.time)])
        weights, values, variances = np.zeros(since.size), [], []
        for model in self.models:
            covariance = CAUSES[model.cause]
            beside = model.moving * covariance(since, ahead)[:, 0]
            own = model.moving * float(covariance(ahead, ahead)[0, 0]) + model.still + variance
            whitened = np.linalg.solve(model.factor, np.column_stack([design, beside, days.means]))
            X, g, y = whitened[:, :2], whitened[:, 2], whitened[:, 3]
            q, r = np.linalg.qr(X)
            direction = np.linalg.solve(r.T, there - X.T @ g)
            on_days = g + q @ direction  # weights on the whitened days
            values.append(float(on_days @ y))
            variances.append(own - float(g @ g) + float(direction @ direction))
            weights += model.weight * np.linalg.solve(model.factor.T, on_days)
        chance = np.array([model.weight for model in self.models])
        mean = float(chance @ values)
        known = weights @ days.shared
        if shared is not None:
            known = known - shared
        spread = float(chance @ (np.array(variances) + (np.array(values) - mean) ** 2))
        return Forecast(time, mean, math.sqrt(max(spread, 0.0) + float(np.sum(known**2))), math.inf)


def outlook(days: Days) -> Outlook:
    """The models of the scatter of three days or more.

    Raises
    ------
    ArgumentError
        With fewer than three days.
    """
    n = days.time.size
    if n < TREND.least_days:
        raise TOO_FEW
    since, design = days.time - days.time[0], _design(days.time)
    q, _ = np.linalg.qr(design)
    about_line = np.eye(n) - q @ q.T
    left = about_line @ days.means
    size = max(float(days.variances.mean()), float(left @ left) / (n - 2))
    models, chances = [], []
    for cause, covariance in enumerate(CAUSES):
        shape = covariance(since, since)
        unit = float(np.sum(about_line * shape)) / (n - 2) or 1.0
        shares = SHARES if cause else (0.0,)
        for share in shares:
            for part in SIZES * size:
                still, moving = part * (1.0 - share), part * share / unit
                factor = np.linalg.cholesky(np.diag(days.variances + still) + moving * shape)
                chances.append(_log_likelihood(factor, design, days.means) - math.log(len(shares)))
                models.append(_Model(cause, still, moving, factor, 0.0))
    weights = np.exp(np.array(chances) - max(chances))
    weights = np.where(weights < _LEAST_WEIGHT * weights.sum(), 0.0, weights)
    weights /= weights.sum()
    return Outlook(
        days,
        tuple(
            replace(model, weight=weight)
            for model, weight in zip(models, weights.tolist(), strict=True)
            if weight > 0.0
        ),
    )


def _design(time: Array) -> Array:
    return np.column_stack([np.ones(time.size), (time - time.mean()) / np.ptp(time)])


def _log_likelihood(factor: Array, design: Array, values: Array) -> float:
    """Restricted log-likelihood of the days about a line, but for a constant."""
    whitened = np.linalg.solve(factor, np.column_stack([design, values - values.mean()]))
    r: Array = np.linalg.qr(whitened, mode="r")  # type: ignore[assignment]
    log_size = np.sum(np.log(np.diag(factor))) + np.sum(np.log(np.abs(np.diag(r)[:2])))
    return -float(log_size) - 0.5 * float(r[2, 2] ** 2)
