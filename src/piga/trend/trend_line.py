"""A straight line through values with known uncertainties, with an excess variance, forecasts and control chart.

Model: ``y_i = b_0 + b_1 (t_i - t_0) + d_i + e_i``. ``var(e_i) = v_i`` is stated. ``var(d_i) = tau^2`` is estimated
from the scatter (Paule and Mandel's condition: the weighted residual sum equals its expectation). Intervals
use the weighted residual sum and Student's t with ``n - 2`` degrees of freedom (Hartung and Knapp). With equal
``v_i`` they are those of ordinary least squares, with one exception: the sum is never taken below its 20 %
quantile, for values that scatter far less than ``v_i``.

One object holds one line (floats) or the lines of many days ((k,) arrays); the same formulas serve both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga._kernels.estimation.trend import Points, days_so_far, inner_excess, merge_days
from piga.errors import ArgumentError
from piga.records.calibration.coefficient import coverage_factor, welch_satterthwaite
from piga.results import Array, Result

Values = Any
"""A float for one line, or an array (k,) for k lines."""


@dataclass(frozen=True)
class TrendSettings:
    """Limits of the trend line (own choices)."""

    low_sum: float = 0.2
    """Probability of the quantile that bounds the weighted residual sum from below; few values may agree by chance."""
    doubt: float = 0.01
    """Probability below which a small or large scatter contradicts the stated uncertainties."""
    tiny: float = 1e-12
    """Smallest standard uncertainty, relative to the largest value; prevents infinite weights."""
    least_days: int = 3
    """Fewest days for a line with uncertainty."""
    short: float = 0.25
    """Length of the history [years] below which a drift per year is an extrapolation and gets a remark."""
    smoothing: float = 0.2
    """Weight of the newest score in the moving average of the control chart."""
    control_limit: float = 3.0
    """Control limit of scores and of their moving average, in its standard deviations."""


TREND = TrendSettings()


@dataclass(frozen=True, eq=False, repr=False)
class Line(Result):
    """A straight line through the day means, about their weighted mean time ``origin``.

    Attributes
    ----------
    level, slope:
        Value at ``origin``, and change per unit of time. The two are not correlated.
    level_variance, slope_variance:
        Their variances from the scatter about the line.
    shared:
        (2, sources) or (k, 2, sources): effect of errors common to the values on level and slope.
    excess, stated:
        Variance ``tau^2`` beyond the stated one, zero if the stated one explains the scatter; mean stated variance.
    scale:
        Weighted residual sum over ``n - 2`` with the excess included: 1, or less if the values scatter less
        than stated, but not less than its 20 % quantile.
    chi2:
        Weighted residual sum with the stated variances alone; ``n - 2`` degrees of freedom.
    """

    origin: Values
    level: Values
    slope: Values
    level_variance: Values
    slope_variance: Values
    shared: Array
    excess: Values
    scale: Values
    chi2: Values
    degrees_of_freedom: Values
    stated: Values

    @property
    def excess_std(self) -> Values:
        """Standard uncertainty of the excess, ``sqrt(2/(n - 2)) (tau^2 + v)`` with the mean stated ``v``."""
        return (2.0 / self.degrees_of_freedom) ** 0.5 * (self.excess + self.stated)

    def at(self, time: Values) -> tuple[Values, Values]:
        """Value of the line and its variance from the scatter."""
        since = time - self.origin
        return self.level + self.slope * since, self.level_variance + self.slope_variance * since**2

    def shared_at(self, time: Values) -> Array:
        """(..., sources) effect of common errors on the value at ``time``."""
        since = np.asarray(time - self.origin)[..., None]
        return self.shared[..., 0, :] + since * self.shared[..., 1, :]


@dataclass(frozen=True)
class Forecast:
    """Values at a time with their standard uncertainty and (effective) degrees of freedom."""

    time: Values
    value: Values
    std: Values
    degrees_of_freedom: Values

    def half_width(self, probability: float = 0.95) -> float:
        """Half-width of the interval of a probability, by Student's t."""
        return coverage_factor(max(self.degrees_of_freedom, 1.0), probability) * float(self.std)

    def score(self, value: Values) -> Values:
        """Deviation of a value from this forecast, as a standard normal number of the same probability."""
        from scipy.special import ndtri_exp, stdtr

        deviation = (value - self.value) / self.std
        known = np.isinf(self.degrees_of_freedom)
        tail = stdtr(np.where(known, 1.0, self.degrees_of_freedom), -np.abs(deviation))
        normal = np.copysign(ndtri_exp(np.log(np.maximum(tail, 1e-300))), deviation)
        return np.where(known, deviation, normal)[()]

    def rows(self) -> list[Forecast]:
        """The forecasts as a list, one per line."""
        columns = (self.time, self.value, self.std, self.degrees_of_freedom)
        return [Forecast(*row) for row in zip(*(column.tolist() for column in columns), strict=True)]


@dataclass(frozen=True)
class TrendModel:
    """Records merged by day, and the line through the days; times in years.

    Attributes
    ----------
    line:
        Line through the day means, None with fewer than three days.
    within, freedom:
        Variance within days beyond the stated one (0 without repeats), and its degrees of freedom.
    day_variance:
        Median variance of a day mean.
    """

    line: Line | None
    within: Values
    freedom: Values
    day_variance: Values

    def take(self, index: int | NDArray[np.int64]) -> TrendModel:
        """One of many models, or several."""
        line = self.line
        if line is not None:
            line = Line(*(getattr(line, field.name)[index] for field in fields(line)))
        return TrendModel(line, self.within[index], self.freedom[index], self.day_variance[index])

    @property
    def drift(self) -> Forecast | None:
        """Change per year, None with fewer than three days."""
        line = self.line
        if line is None:
            return None
        known = np.sum(line.shared[..., 1, :] ** 2, axis=-1)
        parts = ((line.slope_variance, line.degrees_of_freedom), (known, math.inf))
        return _combined(1.0, line.slope, parts)

    def coefficient_at(self, time: Values) -> Forecast:
        """The coefficient at a turn-on at a time, including common errors of all records."""
        return self._forecast(time, 0.0, self.within, None)

    def record_at(self, time: Values, own: Values, shared: Array) -> Forecast:
        """Forecast of a record; ``own`` is its own standard uncertainty, ``shared`` the common errors."""
        day = np.where(self.freedom, np.minimum(own**2, self.day_variance), own**2)
        return self._forecast(time, day, self.within + own**2 - day, shared)

    def day_at(self, time: Values, variance: Values, shared: Array) -> Forecast:
        """Forecast of the mean of a day's records; ``variance`` is its own variance."""
        return self._forecast(time, variance, 0.0, shared)

    def _forecast(self, time: Values, day: Values, inside: Values, shared: Array | None) -> Forecast:
        """Forecast with variances beside that of the line: ``day`` between days, and ``inside`` within the day.

        The scatter of the days gives only the sum of instability and stated variance. A value with a smaller own variance
        needs the instability alone, which is uncertain. Up to half the standard uncertainty of the instability's
        variance is therefore added. In simulation this keeps the intervals near 95 %.
        """
        line = self.line
        if line is None:
            raise ArgumentError(
                "a forecast needs records of at least three days", remedy="wait for more records"
            )
        value, variance = line.at(time)
        known = line.shared_at(time)
        if shared is not None:
            known = known - shared
        doubt = 0.5 * line.excess_std * np.maximum(0.0, 1.0 - day / line.stated)
        parts = (
            (variance + line.scale * (line.excess + day) + doubt, line.degrees_of_freedom),
            (inside, np.where(self.freedom, self.freedom, math.inf)),
            (np.sum(known**2, axis=-1), math.inf),
        )
        return _combined(time, value, parts)


def _combined(time: Values, value: Values, parts: tuple[tuple[Values, Values], ...]) -> Forecast:
    """Forecast from independent variances with their degrees of freedom."""
    shape = np.shape(value)
    variances = np.stack([np.broadcast_to(variance, shape) for variance, _ in parts], axis=-1)
    degrees = np.stack([np.broadcast_to(np.asarray(nu, dtype=float), shape) for _, nu in parts], axis=-1)
    std = np.sqrt(variances.sum(axis=-1))[()]
    return Forecast(time, value, std, welch_satterthwaite(np.sqrt(variances), degrees))


@dataclass(frozen=True)
class Days:
    """Values merged by day: mean time, weighted mean and its variance, (days,) each.

    ``within`` is the variance within days beyond the stated one (0 without repeats), ``freedom`` its degrees of freedom.
    """

    time: Array
    means: Array
    variances: Array
    within: float
    freedom: int


def merge_by_day(time: Array, values: Array, variances: Array, days: NDArray[np.int64]) -> Days:
    """Weighted mean of each day, with a common excess variance within days (Paule and Mandel).

    Parameters
    ----------
    time, values, variances:
        (n,) each, day by day.
    days:
        (n,) number of the day, from 0, in rising order.
    """
    y, v, first = np.asarray(values, dtype=float), _not_exact(values, variances), day_starts(days)
    count = first.size - 1
    freedom = y.size - count
    within = inner_excess(y, v, first, count, freedom, 0.0) if freedom else 0.0
    merged = Points(np.empty(count), np.empty(count), np.empty(count))
    merge_days(Points(np.asarray(time, dtype=float), y, v), first, count, within, merged)
    return Days(merged.t, merged.y, merged.v, within, freedom)


def day_starts(days: NDArray[np.int64]) -> NDArray[np.int64]:
    """(days + 1,) index of the first value of each day, and the number of values."""
    return np.searchsorted(days, np.arange(int(days[-1]) + 2)).astype(np.int64)


def lines_so_far(
    time: Array, values: Array, variances: Array, days: NDArray[np.int64], shared: Array
) -> TrendModel:
    """Lines through the days before each day, from the fourth day on; the last line is through all days.

    Parameters
    ----------
    time, values, variances, days:
        As for :func:`merge_by_day`; variances of errors that are not common to the values.
    shared:
        (sources, n) errors common to the values.

    Returns
    -------
    Model
        With (days - 2,) lines: the first through three days, the last through all.

    Raises
    ------
    ArgumentError
        With fewer than three days, or all of them at one time.
    """
    first = day_starts(days)
    count = first.size - 1
    if count < TREND.least_days:
        raise ArgumentError(
            f"values of {count} days: too few for a line with uncertainty",
            remedy=f"give values of {TREND.least_days} days or more",
        )
    t = np.asarray(time, dtype=float)
    if np.ptp(t) == 0.0:
        raise ArgumentError(
            "all values are of one time: no drift can be seen", remedy="give values of different times"
        )
    figures = np.empty((count + 1 - TREND.least_days, 11))
    known = np.empty((figures.shape[0], 2, shared.shape[0]))
    y, v = np.asarray(values, dtype=float), _not_exact(values, variances)
    days_so_far(t, y, v, first, np.ascontiguousarray(shared), TREND.least_days, figures, known)
    repeats = (first - np.arange(count + 1))[TREND.least_days :]
    return TrendModel(_line(figures, known), figures[:, 0], repeats, figures[:, 10])


def _line(figures: Array, known: Array) -> Line:
    """The lines from the results of the kernel."""
    from scipy.special import chdtri

    _, origin, level, slope, weight, moment, excess, chi2, residual_sum, stated, _ = figures.T
    freedom = np.arange(TREND.least_days, TREND.least_days + figures.shape[0]) - 2.0
    scale = np.maximum(residual_sum, chdtri(freedom, 1.0 - TREND.low_sum)) / freedom
    return Line(
        origin=origin,
        level=level,
        slope=slope,
        level_variance=scale / weight,
        slope_variance=scale / moment,
        shared=known,
        excess=excess,
        scale=scale,
        chi2=chi2,
        degrees_of_freedom=freedom,
        stated=stated,
    )


def _not_exact(values: Array, variances: Array) -> Array:
    """The variances with a lower bound, so that no value has infinite weight."""
    return np.maximum(variances, (TREND.tiny * float(np.abs(values).max() or 1.0)) ** 2)


def moving_average(scores: Array, weight: float = TREND.smoothing) -> tuple[Array, Array]:
    """Exponentially weighted moving average of the scores, and its control limit.

    For independent standard normal scores the variance after ``n`` of them is
    ``w/(2 - w) (1 - (1 - w)^(2 n))``.
    """
    averages, limits = np.full(scores.size, np.nan), np.full(scores.size, np.nan)
    average, seen, most = 0.0, 0, TREND.control_limit
    for i, score in enumerate(scores):
        if math.isnan(score):
            continue
        seen += 1
        average = weight * float(np.clip(score, -most, most)) + (1.0 - weight) * average
        averages[i] = average
        limits[i] = most * math.sqrt(weight / (2.0 - weight) * (1.0 - (1.0 - weight) ** (2 * seen)))
    return averages, limits
