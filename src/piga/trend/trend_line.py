"""Days of a history, the line through them with an excess variance, a step in it, control chart and forecast.

Model of the days: ``y_i = b_0 + b_1 t_i + d_i + e_i``; ``var(e_i) = v_i`` is stated, ``var(d_i)`` is estimated from the
scatter (Paule and Mandel). Intervals of the line use the weighted residual sum and Student's t (Hartung and Knapp).
Forecasts are averaged over the causes that the scatter may have: each day for itself, a walk, a drift that walks.
Derivations and coverage: docs/theory/trend.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError
from piga.records.calibration.coefficient import coverage_factor, welch_satterthwaite
from piga.results import Array, Result

_LOW_SUM = 0.2
"""Probability of the quantile that bounds the weighted residual sum from below; few values may agree by chance."""
DOUBT = 0.01
"""Probability below which a small or large scatter contradicts the stated uncertainties."""
_TINY = 1e-12
"""Smallest standard uncertainty, relative to the largest value; prevents infinite weights."""
LEAST_DAYS = 3
"""Fewest days for a line with uncertainty."""
_SMOOTHING = 0.2
"""Weight of the newest score in the moving average of the control chart."""
CONTROL_LIMIT = 3.0
"""Control limit of scores and of their moving average, in its standard deviations."""
_BESIDE_STEP = 2
"""Fewest days before and after a step."""


@dataclass(frozen=True, eq=False, repr=False)
class Days(Result):
    """Values merged by day: mean time, weighted mean and its variance, (days,) each.

    ``shared`` (days, sources) are errors common to the values. ``within`` is the variance within days beyond the
    stated one (0 without repeats), ``freedom`` its degrees of freedom.
    """

    time: Array
    means: Array
    variances: Array
    shared: Array
    within: float
    freedom: int


def merge_by_day(time: Array, values: Array, variances: Array, days: NDArray[np.int64], shared: Array) -> Days:
    """Weighted mean of each day, with a common excess variance within days (Paule and Mandel).

    ``time``, ``values`` and ``variances`` (n,) are in the order of time; ``days`` (n,) numbers the days from 0. ``shared``
    (sources, n) are errors common to the values. They are not in the variances.
    """
    y = np.asarray(values, dtype=float)
    v = np.maximum(variances, (_TINY * float(np.abs(y).max() or 1.0)) ** 2)
    first = np.searchsorted(days, np.arange(int(days[-1]) + 1))
    freedom = y.size - first.size

    def means(excess: float) -> tuple[Array, Array, Array]:
        weight = 1.0 / (v + excess)
        total = np.add.reduceat(weight, first)
        return weight, total, y[first] + np.add.reduceat(weight * (y - y[first][days]), first) / total

    def residual_sum(excess: float) -> float:
        weight, _, mean = means(excess)
        return float(weight @ (y - mean[days]) ** 2)

    within = _excess_variance(residual_sum, freedom, float(v.mean())) if freedom else 0.0
    weight, total, mean = means(within)
    count = np.diff(first, append=y.size)
    return Days(
        time=np.add.reduceat(np.asarray(time, dtype=float), first) / count,
        means=mean,
        variances=1.0 / total,
        shared=np.add.reduceat(weight * shared, first, axis=1).T / total[:, None],
        within=within,
        freedom=freedom,
    )


def _excess_variance(residual_sum: Callable[[float], float], freedom: int, scale: float) -> float:
    """The variance at which the weighted ``residual_sum`` equals its degrees of freedom; zero if it is below them at zero.

    ``scale`` is a variance of the size that is to be expected.
    """
    from scipy.optimize import brentq

    if residual_sum(0.0) <= freedom:
        return 0.0
    while residual_sum(scale) > freedom:
        scale *= 4.0
    return scale * float(brentq(lambda part: residual_sum(part * scale) - freedom, 0.0, 1.0, xtol=1e-15))


@dataclass(frozen=True)
class Forecast:
    """Value at a time with its standard uncertainty and (effective) degrees of freedom."""

    time: float
    value: float
    std: float
    degrees_of_freedom: float

    def half_width(self, probability: float = 0.95) -> float:
        """Half-width of the interval of a probability, by Student's t."""
        return coverage_factor(max(self.degrees_of_freedom, 1.0), probability) * self.std

    def score(self, value: float) -> float:
        """Deviation of a value from this forecast, as a standard normal number of the same probability."""
        from scipy.special import ndtri_exp, stdtr

        deviation = (value - self.value) / self.std
        if math.isinf(self.degrees_of_freedom):
            return deviation
        tail = max(float(stdtr(self.degrees_of_freedom, -abs(deviation))), 1e-300)
        return math.copysign(float(ndtri_exp(math.log(tail))), deviation)


@dataclass(frozen=True, eq=False, repr=False)
class Line(Result):
    """Weighted least squares of the day means: a straight line about the time ``origin``, perhaps with a step.

    ``coefficients`` are the value at ``origin``, the change per unit of time and, if there is one, the step. ``covariance`` is
    theirs by the scatter, ``shared`` (coefficients, sources) the effect of errors common to the values.
    ``excess`` is the variance ``tau^2`` beyond the mean stated one, ``stated``; zero if the stated one explains the scatter.
    ``scale`` is the weighted residual sum over its degrees of freedom with the excess included: 1, or less if the values
    scatter less than stated, but not less than its 20 % quantile. ``chi2`` is the sum with the stated variances alone.
    """

    days: Days
    origin: float
    coefficients: Array
    covariance: Array
    shared: Array
    excess: float
    stated: float
    scale: float
    chi2: float
    degrees_of_freedom: int

    @property
    def drift(self) -> Forecast:
        """Change per unit of time."""
        parts = (self.covariance[1, 1], self.degrees_of_freedom), (np.sum(self.shared[1] ** 2), math.inf)
        return _combined(1.0, self.coefficients[1], parts)

    def record_at(self, time: float, own: float, shared: Array) -> Forecast:
        """Forecast of a record; ``own`` is its own standard uncertainty, ``shared`` the common errors."""
        usual = float(np.median(self.days.variances)) if self.days.freedom else math.inf
        day = min(own**2, usual)
        return self.at(time, day, shared, self.days.within + own**2 - day)

    def at(self, time: float, day: float, shared: Array, inside: float = 0.0) -> Forecast:
        """Forecast, by a line without step, of a value with variances ``day`` between days and ``inside`` within the day.

        The scatter of the days gives only the sum of instability and stated variance. A value with a smaller own variance
        needs the instability alone, which is uncertain. Up to half the standard uncertainty of the instability's variance,
        ``sqrt(2/nu) (tau^2 + v)`` with the mean stated ``v``, is therefore added. In simulation this keeps the intervals
        near 95 %.
        """
        part = np.array([1.0, time - self.origin])
        unsure = math.sqrt(2.0 / self.degrees_of_freedom) * (self.excess + self.stated)
        doubt = 0.5 * unsure * max(0.0, 1.0 - day / self.stated)
        scatter = float(part @ self.covariance @ part) + self.scale * (self.excess + day) + doubt
        parts = (
            (scatter, self.degrees_of_freedom),
            (inside, self.days.freedom or math.inf),
            (np.sum((part @ self.shared - shared) ** 2), math.inf),
        )
        return _combined(time, float(part @ self.coefficients), parts)


def _combined(time: float, value: float, parts: Sequence[tuple[float, float]]) -> Forecast:
    variances, degrees = np.array(parts, dtype=float).T
    freedom = float(welch_satterthwaite(np.sqrt(variances), degrees))
    return Forecast(time, float(value), math.sqrt(variances.sum()), freedom)


def line_through(days: Days, step: int | None = None) -> Line:
    """The line through three days or more; ``step``: with a step before this day."""
    from scipy.special import chdtri

    t, y, v = days.time, days.means, days.variances
    origin = float(t.mean())
    columns = [np.ones(t.size), t - origin] + ([] if step is None else [np.arange(t.size) >= step])
    design, since = np.stack(columns, axis=1), y - y[0]
    freedom = t.size - design.shape[1]

    def weights(excess: float) -> tuple[Array, float]:
        """Weights (coefficients, days) of the estimates, and the weighted residual sum."""
        root = 1.0 / np.sqrt(v + excess)
        q, r = np.linalg.qr(root[:, None] * design)
        estimate = np.linalg.solve(r, q.T * root)
        return estimate, float(np.sum((root * (since - design @ (estimate @ since))) ** 2))

    chi2 = weights(0.0)[1]
    excess = _excess_variance(lambda variance: weights(variance)[1], freedom, float(v.mean()))
    estimate, residual_sum = weights(excess)
    scale = max(residual_sum, float(chdtri(freedom, 1.0 - _LOW_SUM))) / freedom
    coefficients = estimate @ since
    coefficients[0] += y[0]
    return Line(
        days=days,
        origin=origin,
        coefficients=coefficients,
        covariance=scale * (estimate * (v + excess)) @ estimate.T,
        shared=estimate @ days.shared,
        excess=excess,
        stated=float(v.mean()),
        scale=scale,
        chi2=chi2,
        degrees_of_freedom=freedom,
    )


@dataclass(frozen=True)
class Step:
    """A step of the level: ``day`` is the first day after it. ``probability``: that chance makes one as clear in a history."""

    day: int
    size: float
    std: float
    probability: float


def clearest_step(days: Days) -> Step | None:
    """The clearest step that stands beside a line through all days; None with fewer than five days.

    For each place the line is fitted with a step there, with its own excess variance (Paule and Mandel). The probability is
    that of Student's t, times the number of places (Bonferroni).
    """
    from scipy.special import stdtr

    places = range(_BESIDE_STEP, days.time.size - _BESIDE_STEP + 1)
    if days.time.size < 5:
        return None
    steps = []
    for place in places:
        line = line_through(days, place)
        size, std = float(line.coefficients[2]), math.sqrt(line.covariance[2, 2])
        chance = 2.0 * len(places) * float(stdtr(line.degrees_of_freedom, -abs(size) / std))
        steps.append(Step(place, size, std, min(1.0, chance)))
    return min(steps, key=lambda step: step.probability)


def moving_average(scores: Array) -> tuple[Array, Array]:
    """Exponentially weighted moving average of the scores, and its control limit.

    For independent standard normal scores the variance after ``n`` of them is
    ``w/(2 - w) (1 - (1 - w)^(2 n))``.
    """
    averages, limits = np.full((2, scores.size), np.nan)
    seen, weight, average = np.flatnonzero(~np.isnan(scores)), _SMOOTHING, 0.0
    for k in seen:
        average += weight * (np.clip(scores[k], -CONTROL_LIMIT, CONTROL_LIMIT) - average)
        averages[k] = average
    remembered = (1.0 - weight) ** (2 * np.arange(1, seen.size + 1))
    limits[seen] = CONTROL_LIMIT * np.sqrt(weight / (2.0 - weight) * (1.0 - remembered))
    return averages, limits


# -- forecast ---------------------------------------------------------------------------------------------

_SIZES = np.concatenate([[0.0], 4.0 ** np.arange(-2.0, 3.5, 0.5)])
"""Variances of the scatter that are tried, relative to that about the line (or the mean stated variance)."""
_WALKS = ((0.0,), (0.3, 0.7, 1.0), (0.3, 0.7, 1.0))
"""Causes of the scatter, each by the shares of it that walk: each day for itself, a walk from 0, its integral."""
_LEAST_WEIGHT, _LEAST_SHARE = 1e-6, 1e-10
"""Least weight of a model, and least stated variance relative to the scatter; smaller ones cannot be inverted."""


@dataclass(frozen=True, eq=False, repr=False)
class Outlook(Result):
    """Days of a history and the models (m,) of their scatter.

    Each has a ``cause``, a variance that walks (``moving``), one that does not (``still``), a ``weight``, and the inverse of the
    covariance of the days (``inverse``).
    """

    days: Days
    cause: NDArray[np.int64]
    still: Array
    moving: Array
    weight: Array
    inverse: Array

    def at(self, time: float, variance: float = 0.0, shared: Array | None = None) -> Forecast:
        """Forecast of a value at ``time`` with a further own ``variance``, by generalised least squares.

        ``shared`` (sources,) are its errors common to the days; None: the coefficient itself, without errors.
        """
        days, design = self.days, _design(self.days.time, self.days.time)
        there, since = _design(days.time, np.array([time]))[0], days.time - days.time[0]
        ahead = np.array([time - days.time[0]])
        beside = self.moving[:, None] * _shapes(since, ahead)[self.cause, :, 0]
        own = self.moving * _shapes(ahead, ahead)[self.cause, 0, 0] + self.still + variance
        alone, weighed = np.einsum("mij,mj->mi", self.inverse, beside), self.inverse @ design
        off = there - alone @ design
        direction = np.linalg.solve(design.T @ weighed, off[:, :, None])
        on_days = alone + (weighed @ direction)[:, :, 0]  # weights (m, days)
        values = on_days @ (days.means - days.means[0])
        mean = float(self.weight @ values)
        variances = own - np.sum(alone * beside, axis=1) + np.sum(direction[:, :, 0] * off, axis=1)
        spread = float(self.weight @ (variances + (values - mean) ** 2))
        common = self.weight @ on_days @ days.shared - (0.0 if shared is None else shared)
        std = math.sqrt(max(spread, 0.0) + float(np.sum(common**2)))
        return Forecast(time, mean + float(days.means[0]), std, math.inf)


def outlook(days: Days) -> Outlook:
    """The models of the scatter of three days or more, weighted by their restricted likelihood."""
    n = days.time.size
    if n < LEAST_DAYS:
        raise ArgumentError("a forecast needs records of at least three days", remedy="wait for more records")
    since, design = days.time - days.time[0], _design(days.time, days.time)
    q, _ = np.linalg.qr(design)
    about_line = np.eye(n) - q @ q.T
    left = about_line @ days.means
    size = max(float(days.variances.mean()), float(left @ left) / (n - 2))
    shapes = _shapes(since, since)
    units = np.sum(about_line * shapes, axis=(1, 2)) / (n - 2)
    units[0] = 1.0  # nothing walks
    kinds = [(cause, share, 1.0 / len(shares)) for cause, shares in enumerate(_WALKS) for share in shares]
    cause, share, before = (np.repeat(column, _SIZES.size) for column in zip(*kinds, strict=True))
    part = np.tile(_SIZES * size, len(kinds))
    still, moving = part * (1.0 - share), part * share / units[cause]
    stated = np.maximum(days.variances, _LEAST_SHARE * size)
    covariance = moving[:, None, None] * shapes[cause] + (stated + still[:, None])[:, None] * np.eye(n)
    factor = np.linalg.cholesky(covariance)
    whitened = np.linalg.solve(factor, np.column_stack([design, days.means - days.means[0]]))
    r = np.abs(np.linalg.qr(whitened, mode="r"))
    chance = np.log(before) - np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
    chance -= np.log(r[:, 0, 0] * r[:, 1, 1]) + 0.5 * r[:, 2, 2] ** 2
    weight = np.exp(chance - chance.max())
    kept = weight >= _LEAST_WEIGHT * weight.sum()
    weight = weight[kept] / weight[kept].sum()
    return Outlook(days, cause[kept], still[kept], moving[kept], weight, np.linalg.inv(covariance[kept]))


def _shapes(a: Array, b: Array) -> Array:
    """Covariance (3, n, m) of each cause between days at times ``a`` (n,) and ``b`` (m,) since the first one."""
    least, most = np.minimum.outer(a, b), np.maximum.outer(a, b)
    return np.stack([0.0 * least, least, least**2 * (3.0 * most - least) / 6.0])


def _design(days: Array, time: Array) -> Array:
    """Columns (n, 2) of a line about the middle of the days, at times (n,)."""
    return np.column_stack([np.ones(time.size), (time - days.mean()) / np.ptp(days)])
