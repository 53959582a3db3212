"""Days of a history, the line through them with an excess variance, a step in it, control chart and forecast.

Model of the days: ``y_i = b_0 + b_1 t_i + d_i + e_i``; ``var(e_i) = v_i`` is stated, ``var(d_i)`` is estimated from the
scatter (Paule and Mandel). Intervals of the line use the weighted residual sum and Student's t (Hartung and Knapp).
Forecasts are averaged over the causes that the scatter may have: each day for itself, a walk, a drift that walks.
Derivations and coverage: docs/theory/trend.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga.errors import ArgumentError
from piga.records.calibration.coefficient import coverage_factor, welch_satterthwaite
from piga.results import Array, Result

_LOW_SUM = 0.2
"""Probability of the quantile that bounds the weighted residual sum from below; few values may agree by chance."""
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
    member = np.arange(days[-1] + 1)[:, None] == days
    v = np.maximum(variances, (_TINY * float(np.abs(values).max() or 1.0)) ** 2)
    since, freedom = values - values[0], values.size - len(member)

    def shares(excess: float) -> Array:
        weights = member / (v + excess)
        return weights / weights.sum(axis=1, keepdims=True)

    def residual_sum(excess: float) -> float:
        return float(np.sum((since - (shares(excess) @ since)[days]) ** 2 / (v + excess)))

    within = _excess_variance(residual_sum, freedom, float(v.mean())) if freedom else 0.0
    share = shares(within)
    return Days(
        time=member @ time / member.sum(axis=1),
        means=values[0] + share @ since,
        variances=1.0 / np.sum(member / (v + within), axis=1),
        shared=share @ shared.T,
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


@dataclass(frozen=True, eq=False, repr=False)
class Line(Result):
    """Weighted least squares of the day means: a straight line about their mean time, perhaps with a step.

    ``coefficients`` are the value at the mean time, the change per unit of time and, if there is one, the step. ``covariance``
    is theirs by the scatter, ``shared`` (coefficients, sources) the effect of errors common to the values.
    ``excess`` is the variance ``tau^2`` beyond the stated one; zero if the stated one explains the scatter.
    ``scale`` is the weighted residual sum over its degrees of freedom with the excess included: 1, or less if the values
    scatter less than stated, but not less than its 20 % quantile. ``chi2`` is the sum with the stated variances alone.
    """

    days: Days
    coefficients: Array
    covariance: Array
    shared: Array
    excess: float
    scale: float
    chi2: float
    degrees_of_freedom: int

    @property
    def drift(self) -> Forecast:
        """Change per unit of time."""
        parts = [self.covariance[1, 1], np.sum(self.shared[1] ** 2)], [self.degrees_of_freedom, math.inf]
        return _combined(1.0, self.coefficients[1], *parts)

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
        part, stated = np.array([1.0, time - self.days.time.mean()]), float(self.days.variances.mean())
        unsure = math.sqrt(2.0 / self.degrees_of_freedom) * (self.excess + stated)
        doubt = 0.5 * unsure * max(0.0, 1.0 - day / stated)
        scatter = float(part @ self.covariance @ part) + self.scale * (self.excess + day) + doubt
        variances = [scatter, inside, np.sum((part @ self.shared - shared) ** 2)]
        degrees = [self.degrees_of_freedom, self.days.freedom or math.inf, math.inf]
        return _combined(time, float(part @ self.coefficients), variances, degrees)


def _combined(time: float, value: float, variances: ArrayLike, degrees: ArrayLike) -> Forecast:
    freedom = float(welch_satterthwaite(np.sqrt(variances), degrees))
    return Forecast(time, float(value), math.sqrt(np.sum(variances)), freedom)


def line_through(days: Days, step: int | None = None) -> Line:
    """The line through three days or more; ``step``: with a step before this day."""
    from scipy.special import chdtri

    y, v = days.means - days.means[0], days.variances
    design = _design(days.time, days.time)
    if step is not None:
        design = np.column_stack([design, np.arange(y.size) >= step])
    freedom = y.size - design.shape[1]

    def weights(excess: float) -> tuple[Array, float]:
        """Weights (coefficients, days) of the estimates, and the weighted residual sum."""
        root = 1.0 / np.sqrt(v + excess)
        estimate = np.linalg.pinv(root[:, None] * design) * root
        return estimate, float(np.sum((root * (y - design @ (estimate @ y))) ** 2))

    excess = _excess_variance(lambda variance: weights(variance)[1], freedom, float(v.mean()))
    estimate, residual_sum = weights(excess)
    scale = max(residual_sum, float(chdtri(freedom, 1.0 - _LOW_SUM))) / freedom
    return Line(
        days=days,
        coefficients=estimate @ y + days.means[0] * (np.arange(len(estimate)) == 0),
        covariance=scale * (estimate * (v + excess)) @ estimate.T,
        shared=estimate @ days.shared,
        excess=excess,
        scale=scale,
        chi2=weights(0.0)[1],
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


_SIZES = np.concatenate([[0.0], 4.0 ** np.arange(-2.0, 3.5, 0.5)])
"""Variances of the scatter that are tried, relative to that about the line (or the mean stated variance)."""
_WALKS = ((0.0,), (0.3, 0.7, 1.0), (0.3, 0.7, 1.0))
"""Causes of the scatter, each by the shares of it that walk: each day for itself, a walk from 0, its integral."""
_LEAST_SHARE = 1e-10
"""Least stated variance relative to the scatter; a smaller one cannot be inverted."""


@dataclass(frozen=True, eq=False, repr=False)
class Outlook(Result):
    """Days of a history and the models (m,) of their scatter; variances relative to ``size``, that about the line.

    Each has a ``cause``, a variance that walks (``moving``), one that does not (``still``), a ``weight``, and the ``inverse`` of
    the equations of generalised least squares.
    """

    days: Days
    size: float
    cause: NDArray[np.int64]
    still: Array
    moving: Array
    weight: Array
    inverse: Array

    def at(self, time: float, variance: float = 0.0, shared: Array | None = None) -> Forecast:
        """Forecast of a value at ``time`` with a further own ``variance``, by generalised least squares.

        ``shared`` (sources,) are its errors common to the days; None: the coefficient itself, without errors.
        """
        days, start = self.days, self.days.time[0]
        beside = self.moving[:, None] * _shapes(days.time - start, time - start)[self.cause]
        own = self.moving * _shapes(time - start, time - start)[self.cause] + self.still
        line = np.broadcast_to(_design(days.time, time), (len(beside), 2))
        right = np.concatenate([beside, line], axis=1)
        solution = np.einsum("mij,mj->mi", self.inverse, right)
        variances = self.size * (own - np.sum(right * solution, axis=1)) + variance
        on_days = solution[:, : days.time.size]  # weights (m, days)
        values = on_days @ (days.means - days.means[0])
        mean = float(self.weight @ values)
        spread = float(self.weight @ (variances + (values - mean) ** 2))
        common = self.weight @ on_days @ days.shared - (0.0 if shared is None else shared)
        std = math.sqrt(max(spread, 0.0) + float(np.sum(common**2)))
        return Forecast(time, mean + float(days.means[0]), std, math.inf)


def outlook(days: Days) -> Outlook:
    """The models of the scatter of three days or more, weighted by their restricted likelihood."""
    n = days.time.size
    if n < LEAST_DAYS:
        raise ArgumentError("a forecast needs records of at least three days", remedy="wait for more records")
    since, y = days.time - days.time[0], days.means - days.means[0]
    design, shapes = _design(days.time, days.time), _shapes(since[:, None], since)
    about_line = np.eye(n) - design @ np.linalg.pinv(design)
    size = max(float(days.variances.mean()), float(y @ about_line @ y) / (n - 2))
    units = np.sum(about_line * shapes, axis=(1, 2)) / (n - 2)
    units[0] = 1.0  # nothing walks
    kinds = [
        (cause, part * (1.0 - share), part * share / units[cause], 1.0 / len(shares))
        for cause, shares in enumerate(_WALKS)
        for share in shares
        for part in _SIZES
    ]
    number, still, moving, before = np.array(kinds).T
    cause = number.astype(np.int64)
    equations = np.zeros((len(kinds), n + 2, n + 2))
    stated = np.maximum(days.variances / size, _LEAST_SHARE)
    equations[:, :n, :n] = moving[:, None, None] * shapes[cause]
    equations[:, range(n), range(n)] += stated + still[:, None]
    equations[:, :n, n:], equations[:, n:, :n] = design, design.T
    inverse = np.asarray(np.linalg.inv(equations), dtype=np.float64)
    left = np.einsum("i,mij,j->m", y, inverse[:, :n, :n], y) / size
    chance = np.log(before) - 0.5 * (np.linalg.slogdet(equations)[1] + left)
    weight = np.exp(chance - chance.max())
    return Outlook(days, size, cause, still, moving, weight / weight.sum(), inverse)


def _shapes(a: ArrayLike, b: ArrayLike) -> Array:
    """Covariance (3, ...) of each cause between times ``a`` and ``b`` since the first day."""
    least, most = np.minimum(a, b), np.maximum(a, b)
    return np.stack([0.0 * least, least, least**2 * (3.0 * most - least) / 6.0])


def _design(days: Array, time: ArrayLike) -> Array:
    """Columns (..., 2) of a line about the middle of the days, at times."""
    since = np.asarray(time) - days.mean()
    return np.stack([np.ones_like(since), since], axis=-1)
