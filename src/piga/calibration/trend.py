"""How the coefficients of one instrument move over the years: stability, drift, control limits, forecasts.

Each record gives a value with a standard uncertainty. Its part of Type B from sources that act alike in all
records (the same standard of gravity or angle) is *common*: no number of records averages it away, and it
cancels in differences between records. The rest is the record's own. Records of one day are merged first:
what scatters inside a day is turn-on to turn-on, what scatters between days beyond that is day to day, and
what is left as a line is drift. Own derivation; see docs/trend.md.
"""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga.calibration.control_chart import LIMIT, moving_average
from piga.calibration.degrees_of_freedom import welch_satterthwaite
from piga.calibration.trend_line import Groups, LineFit, fit_line, merge_groups
from piga.errors import ArgumentError
from piga.records.calibration import Calibration
from piga.records.coverage import Coverage, coverage_factor

Array = NDArray[np.float64]

YEAR = 31557600.0
"""One year [s], as the unit ``year``."""
HistoryEntry = tuple[str, dt.datetime, Calibration]
"""Record id, time of the calibration (with time zone), calibration: what a store's ``history`` gives."""
Common = float | Mapping[str, float]
"""Part (0 to 1) of the Type B variance that records share: for all sources, or by source name (others: 1)."""


@dataclass(frozen=True)
class Forecast:
    """A value for a time with its standard uncertainty and (effective) degrees of freedom."""

    time: float
    value: float
    std: float
    degrees_of_freedom: float

    def half_width(self, probability: float = 0.95) -> float:
        """Half the interval of that probability, by Student's t."""
        return coverage_factor(max(self.degrees_of_freedom, 1.0), probability) * self.std

    def score(self, value: float) -> float:
        """Deviation of a value from this forecast, as the standard normal number of the same probability."""
        from scipy.special import ndtri_exp, stdtr

        deviation = (value - self.value) / self.std
        if math.isinf(self.degrees_of_freedom):
            return deviation
        tail = max(float(stdtr(self.degrees_of_freedom, -abs(deviation))), 1e-300)
        return math.copysign(float(ndtri_exp(math.log(tail))), deviation)


@dataclass(frozen=True)
class Model:
    """Records merged by day, and the line through the days; times in years.

    Attributes
    ----------
    groups:
        Day means and the scatter inside days.
    line:
        Line through the day means, None with fewer than three days.
    common:
        (sources, records) contributions that the records share.
    """

    groups: Groups
    line: LineFit | None
    common: Array

    @property
    def drift(self) -> Forecast | None:
        """Change per year, None with fewer than three days."""
        if self.line is None:
            return None
        known = self.line.weights[1] @ self.groups.weights @ self.common.T
        scatter = float(self.line.covariance[1, 1])
        parts = [(scatter, float(self.line.degrees_of_freedom)), (float(known @ known), math.inf)]
        return _combined(1.0, float(self.line.coefficients[1]), parts)

    def coefficient_at(self, time: float) -> Forecast:
        """The coefficient at a turn-on at that time, with the errors that all records share."""
        return self._forecast(time, 0.0, self._within, np.zeros(self.common.shape[0]))

    def record_at(self, time: float, own: float, shared: Array) -> Forecast:
        """What a record is expected to show; ``own`` is its own standard uncertainty, ``shared`` the rest."""
        if not self.groups.freedom:
            return self._forecast(time, own**2, 0.0, shared)
        day = min(own**2, float(np.median(self.groups.variances)))
        return self._forecast(time, day, self._within + own**2 - day, shared)

    def day_at(self, time: float, own: Array, shared: Array) -> Forecast:
        """What the mean of a day's records is expected to be; ``own`` (n,) as in :meth:`record_at`."""
        return self._forecast(time, 1.0 / float(np.sum(1.0 / (own**2 + self._within))), 0.0, shared)

    @property
    def _within(self) -> float:
        return self.groups.within if self.groups.freedom else 0.0

    def _forecast(self, time: float, day: float, inside: float, shared: Array) -> Forecast:
        """``day`` and ``inside`` are variances that a value has beside the line's: as a day mean, and more.

        The scatter of the days gives instability and stated variance together. For a value whose own variance
        is smaller than theirs the two must be told apart, and that is uncertain: up to half the standard
        uncertainty of the instability's variance is added, which keeps the intervals near 95 % in simulation.
        """
        line = self.line
        if line is None:
            raise ArgumentError(
                "a forecast needs records of at least three days", remedy="wait for more records"
            )
        value, variance = line.at(time)
        known = line.basis(time) @ line.weights @ self.groups.weights @ self.common.T - shared
        doubt = 0.5 * line.excess_std * max(0.0, 1.0 - day / line.stated)
        parts = [
            (variance + line.scale * (line.excess + day) + doubt, float(line.degrees_of_freedom)),
            (inside, float(self.groups.freedom) or math.inf),
            (float(known @ known), math.inf),
        ]
        return _combined(time, value, parts)


@dataclass(frozen=True)
class Point:
    """One record in a trend: value, whole standard uncertainty and its own part, in file units.

    ``coverage`` is that of the record's coefficient, ``own_expanded`` the half-width for 95 % of its own part.
    ``forecast`` is what the records of earlier days let expect of this one, or None while there are too few;
    ``score`` the deviation from it.
    """

    record: str
    time: float
    day: int
    value: float
    std: float
    own: float
    coverage: Coverage
    own_expanded: float
    forecast: Forecast | None

    @property
    def score(self) -> float:
        """Deviation from the forecast as a standard normal number; nan without one."""
        return math.nan if self.forecast is None else self.forecast.score(self.value)

    @property
    def outside(self) -> bool:
        """True when the value lies beyond the control limits."""
        return abs(self.score) > LIMIT


@dataclass(frozen=True)
class Chart:
    """Control chart of the days: score of each day mean, its moving average, and the limit of that."""

    time: Array
    score: Array
    average: Array
    limit: Array

    @property
    def shifted(self) -> NDArray[np.bool_]:
        """Days at which the moving average is beyond its limit."""
        return np.abs(self.average) > self.limit


@dataclass(frozen=True)
class CoefficientTrend:
    """The trend of one coefficient; times in years since ``Trend.start``, values in ``unit``."""

    key: str
    unit: str
    points: tuple[Point, ...]
    chart: Chart
    model: Model

    @property
    def turn_on(self) -> float:
        """Standard deviation inside days beyond the stated uncertainty; nan without repeats."""
        return math.sqrt(self.model.groups.within) if self.model.groups.freedom else math.nan

    @property
    def day_to_day(self) -> float:
        """Standard deviation between days beyond stated uncertainty and turn-on; nan with too few days."""
        return math.sqrt(self.model.line.excess) if self.model.line is not None else math.nan

    @property
    def drift(self) -> Forecast | None:
        """Change per year with its uncertainty, None with fewer than three days."""
        return self.model.drift

    def next_record(self, time: float) -> Forecast:
        """What a further record, as good as the last one and by the same standards, is expected to show."""
        return self.model.record_at(time, self.points[-1].own, self.model.common[:, -1])


@dataclass(frozen=True)
class Trend:
    """Trends of all coefficients of one instrument.

    ``start`` is the time from which years are counted; ``alarms`` and ``remarks`` are sentences.
    """

    serial: str
    start: dt.datetime
    records: tuple[str, ...]
    times: tuple[dt.datetime, ...]
    coefficients: tuple[CoefficientTrend, ...]
    alarms: tuple[str, ...]
    remarks: tuple[str, ...]

    def __getitem__(self, key: str) -> CoefficientTrend:
        for trend in self.coefficients:
            if trend.key == key:
                return trend
        raise KeyError(f"no trend of '{key}'; there are: {', '.join(t.key for t in self.coefficients)}")

    def years(self, date: dt.datetime) -> float:
        """Years from ``start`` to a date."""
        return (date - self.start).total_seconds() / YEAR


def find_trend(history: Sequence[HistoryEntry], *, common: Common = 1.0) -> Trend:
    """Trend of every coefficient that all records hold.

    Parameters
    ----------
    history:
        Records of one instrument, in any order.
    common:
        Part of the Type B variance that the records share (default: all of it).

    Raises
    ------
    ArgumentError
        For fewer than two records, several instruments, a record named twice, or a part outside 0 to 1.
    """
    from piga.calibration.trend_words import alarms_in_words, remarks_in_words

    _check(history, common)
    entries = sorted(history, key=lambda entry: (entry[1], entry[0]))
    times = [time.astimezone(dt.UTC) for _, time, _ in entries]
    days = np.unique([time.toordinal() for time in times], return_inverse=True)[1].astype(np.int64)
    years = np.array([(time - times[0]).total_seconds() / YEAR for time in times])
    calibrations = [calibration for _, _, calibration in entries]
    names = tuple(name for name, _, _ in entries)
    trends = tuple(
        _coefficient_trend(key, names, years, days, calibrations, common) for key in _shared_keys(calibrations)
    )
    return Trend(
        calibrations[0].serial,
        times[0],
        names,
        tuple(times),
        trends,
        alarms_in_words(trends, names, times),
        remarks_in_words(trends, calibrations, days, float(years[-1])),
    )


def _check(entries: Sequence[HistoryEntry], common: Common) -> None:
    if len(entries) < 2:
        raise ArgumentError(
            f"a trend needs at least two records, not {len(entries)}",
            remedy="add calibrations of the instrument",
        )
    serials = sorted({calibration.serial for _, _, calibration in entries})
    if len(serials) > 1:
        raise ArgumentError(
            f"the records are of different instruments: {', '.join(serials)}", remedy="give those of one"
        )
    names = [name for name, _, _ in entries]
    for name, time, _ in entries:
        if names.count(name) > 1:
            raise ArgumentError(f"record '{name}' is given twice", remedy="give each record once")
        if time.tzinfo is None:
            raise ArgumentError(f"record '{name}': its time has no time zone", remedy="give it in UTC")
    for source, part in common.items() if isinstance(common, Mapping) else [("common", common)]:
        if not 0.0 <= part <= 1.0:
            raise ArgumentError(f"{source}: a shared part of {part!r} is not between 0 and 1")


def _shared_keys(calibrations: Sequence[Calibration]) -> list[str]:
    """Coefficients that all records hold, in the order of the last; phases are left out (one per power-up)."""
    kept = [{c.key for c in calibration.coefficients} for calibration in calibrations]
    everywhere = set.intersection(*kept)
    return [c.key for c in calibrations[-1].coefficients if c.key in everywhere and c.name != "phi"]


def _coefficient_trend(
    key: str,
    names: tuple[str, ...],
    years: Array,
    days: NDArray[np.int64],
    calibrations: Sequence[Calibration],
    common: Common,
) -> CoefficientTrend:
    values = np.array([calibration[key].value for calibration in calibrations])
    stds = np.array([calibration[key].std for calibration in calibrations])
    shared = common_contributions(key, calibrations, common)
    own = np.sqrt(np.maximum(stds**2 - np.sum(shared**2, axis=0), (1e-3 * stds) ** 2))
    models = [_model(years, values, own, days, shared, days < day) for day in range(3, int(days[-1]) + 1)]
    points = []
    for i, day in enumerate(days):
        forecast = models[day - 3].record_at(years[i], own[i], shared[:, i]) if day > 2 else None
        points.append(
            Point(
                names[i],
                float(years[i]),
                int(day),
                float(values[i]),
                float(stds[i]),
                float(own[i]),
                calibrations[i][key].coverage,
                _own_expanded(calibrations[i], key, float(own[i]), common),
                forecast,
            )
        )
    model = _model(years, values, own, days, shared, np.ones(days.size, dtype=bool))
    chart = _chart(years, values, own, days, shared, models)
    return CoefficientTrend(key, calibrations[0][key].unit, tuple(points), chart, model)


def _own_expanded(calibration: Calibration, key: str, own: float, common: Common) -> float:
    """Half-width for 95 % of a record's own part: k for its own effective degrees of freedom, times ``own``.

    ``sum(u_i^4/nu_i) = u^4/nu`` over all sources (JCGM 100, G.2b). The shared part of each source is taken off.
    """
    c = calibration[key]
    doubt = c.std**4 / c.degrees_of_freedom
    for row in calibration.budget:
        if row.get("type") == "B":
            part = _shared_part(common, str(row["source"]))
            amount = float(row.get("contributions", {}).get(key, 0.0))
            doubt -= (1.0 - (1.0 - part) ** 2) * amount**4 / (row.get("degrees_of_freedom") or math.inf)
    degrees = own**4 / doubt if doubt > 0.0 else math.inf
    return coverage_factor(degrees) * own


def _shared_part(common: Common, source: str) -> float:
    """Part of the variance of a source of Type B that all records share."""
    return float(common.get(source, 1.0) if isinstance(common, Mapping) else common)


def _model(
    years: Array,
    values: Array,
    own: Array,
    days: NDArray[np.int64],
    shared: Array,
    used: NDArray[np.bool_],
) -> Model:
    """Model of the used records."""
    groups = merge_groups(years[used], values[used], own[used] ** 2, days[used])
    line = fit_line(groups.time, groups.means, groups.variances) if groups.means.size > 2 else None
    return Model(groups, line, shared[:, used])


def _chart(
    years: Array, values: Array, own: Array, days: NDArray[np.int64], shared: Array, models: list[Model]
) -> Chart:
    """Score of each day mean against the days before; none for the first three."""
    scores = [math.nan] * min(3, int(days[-1]) + 1)
    for day, model in enumerate(models, start=3):
        today = days == day
        weights = 1.0 / (own[today] ** 2 + (model.groups.within if model.groups.freedom else 0.0))
        weights /= weights.sum()
        expected = model.day_at(float(years[today].mean()), own[today], shared[:, today] @ weights)
        scores.append(expected.score(float(weights @ values[today])))
    times = np.array([years[days == day].mean() for day in range(int(days[-1]) + 1)])
    return Chart(times, np.array(scores), *moving_average(np.array(scores)))


def common_contributions(key: str, calibrations: Sequence[Calibration], common: Common) -> Array:
    """What each source of Type B does alike in all records, (sources, records), from their budgets."""
    sources = sorted({str(row["source"]) for c in calibrations for row in c.budget if row.get("type") == "B"})
    table = np.zeros((len(sources), len(calibrations)))
    for column, calibration in enumerate(calibrations):
        for row in calibration.budget:
            if row.get("type") == "B":
                amount = float(row.get("contributions", {}).get(key, 0.0))
                table[sources.index(str(row["source"])), column] += amount
    parts = np.array([_shared_part(common, source) for source in sources], dtype=float)
    return table * np.sqrt(parts).reshape(-1, 1)


def _combined(time: float, value: float, parts: Sequence[tuple[float, float]]) -> Forecast:
    """Forecast from independent variances with their degrees of freedom."""
    own = np.sqrt([variance for variance, _ in parts])
    return Forecast(time, value, math.hypot(*own), welch_satterthwaite(own, [freedom for _, freedom in parts]))
