"""The coefficients of one instrument over the years: stability, drift, control limits, forecasts.

Each record gives a value with a standard uncertainty. Sources of Type B that act alike in all records (the same
standard of gravity or angle) are *common*: averaging does not reduce them, and they cancel in differences between
records. Scatter within a day is turn-on to turn-on; more scatter between days is day to day. See docs/theory/trend.md.
"""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.coefficient import coverage_factor
from piga.records.run_file import drawn_for
from piga.results import Array, Reported, Result, drawn
from piga.trend.trend_line import (
    CONTROL_LIMIT,
    LEAST_DAYS,
    Days,
    Forecast,
    Line,
    Outlook,
    Step,
    clearest_step,
    line_through,
    merge_by_day,
    moving_average,
    outlook,
)
from piga.upper import doors

if TYPE_CHECKING:
    from types import ModuleType

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


YEAR = 31557600.0
"""One year [s], as the unit ``year``."""
HistoryEntry = tuple[str, dt.datetime, Calibration]
"""Record id, time of the calibration (with time zone), and the calibration, as in a store."""
Common = float | Mapping[str, float]
"""Share (0 to 1) of the Type B variance common to the records: for all sources, or by source name (others: 1)."""


@dataclass(frozen=True)
class Point:
    """One record in a trend: value, combined standard uncertainty, and the record's own part of it, in file units.

    ``expanded`` is the 95 % half-width of the record, ``own_half_width`` that of the own part.
    ``forecast`` comes from the records of earlier days; None if there are too few. ``score`` is the deviation from the
    forecast as a standard normal number, nan without forecast.
    """

    record: str
    time: float
    day: int
    value: float
    std: float
    expanded: float
    own: float
    own_half_width: float
    score: float
    forecast: Forecast | None

    @property
    def outside(self) -> bool:
        """True when the value lies beyond the control limits."""
        return abs(self.score) > CONTROL_LIMIT


@dataclass(frozen=True, eq=False, repr=False)
class CoefficientTrend(Result):
    """The trend of one coefficient; times in years since ``Trend.start``, values in ``unit``.

    ``line`` is None with fewer than three days, ``step``, the clearest step of the level, with fewer than five. ``scores``
    (days,) is the control chart of the day means, ``average`` its moving average with the control limit ``limit``.
    ``last_shared`` (sources,) are the errors common to the last record and other records.
    """

    key: str
    unit: str
    points: tuple[Point, ...]
    days: Days
    line: Line | None
    step: Step | None
    scores: Array
    average: Array
    limit: Array
    last_shared: Array

    @property
    def turn_on(self) -> float:
        """Standard deviation within days beyond the stated uncertainty; nan without repeats."""
        return math.sqrt(self.days.within) if self.days.freedom else math.nan

    @property
    def day_to_day(self) -> float:
        """Standard deviation between days beyond stated uncertainty and turn-on; nan with too few days."""
        return math.nan if self.line is None else math.sqrt(self.line.excess)

    @property
    def drift(self) -> Forecast | None:
        """Change per year with its uncertainty, None with fewer than three days."""
        return None if self.line is None else self.line.drift

    @property
    def drifts(self) -> bool:
        """True if the drift is beyond its 95 % interval, and no step alarms: a line through a step is not a drift."""
        return self.drift is not None and abs(self.drift.value) > self.drift.half_width() and not self.stepped

    @property
    def stepped(self) -> bool:
        """True if the clearest step is less likely by chance than a value beyond the control limits."""
        return self.step is not None and self.step.probability < math.erfc(CONTROL_LIMIT / math.sqrt(2.0))

    @cached_property
    def outlook(self) -> Outlook:
        """The models of the scatter, for forecasts."""
        return outlook(self.days)

    def coefficient_at(self, time: float) -> Forecast:
        """The coefficient at a turn-on at a time, including common errors of all records."""
        return self.outlook.at(time, self.days.within)

    def next_record(self, time: float) -> Forecast:
        """Forecast of a further record with the uncertainty and the standards of the last one."""
        own = self.points[-1].own ** 2 + self.days.within
        return self.outlook.at(time, own, self.last_shared)


@dataclass(frozen=True, eq=False, repr=False)
class Trend(Reported, Result):
    """Trends of all coefficients of one instrument; ``start`` is the time from which years are counted."""

    serial: str
    start: dt.datetime
    records: tuple[str, ...]
    times: tuple[dt.datetime, ...]
    calibrations: tuple[Calibration, ...]
    coefficients: tuple[CoefficientTrend, ...]

    def __getitem__(self, key: str) -> CoefficientTrend:
        for trend in self.coefficients:
            if trend.key == key:
                return trend
        raise KeyError(f"no trend of '{key}'; there are: {', '.join(t.key for t in self.coefficients)}")

    def years(self, date: dt.datetime) -> float:
        """Years from ``start`` to a date."""
        return (date - self.start).total_seconds() / YEAR

    def plot(self, key: str = "", ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Values of the coefficient ``key`` (the first one) and its control chart. See :func:`piga.results.drawn`."""
        return drawn(doors().shown_trend().figures(self)[key](), ax)

    def _subject(self) -> ModuleType:
        return doors().shown_trend()

    @property
    def judged(self) -> int:
        """Number of records with a forecast from earlier days; without one no alarm is possible."""
        return sum(point.forecast is not None for trend in self.coefficients[:1] for point in trend.points)

    @property
    def alarms(self) -> tuple[str, ...]:
        """Sentences: records outside their forecast, steps of the level, shifts of the moving average."""
        return tuple(doors().shown_trend().alarms(self))

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences: what drifts or scatters, and what to know of the records to judge the figures."""
        return tuple(doors().shown_trend().remarks(self))


def find_trend(history: Iterable[HistoryEntry], *, common: Common = 1.0) -> Trend:
    """Trend of every coefficient that all records hold.

    Parameters
    ----------
    history:
        Records of one instrument, in any order.
    common:
        Share of the Type B variance common to the records (default: all of it). A source with a new value in each
        test (``..._repeatability``) is not common unless it is named.

    Raises
    ------
    ArgumentError
        For fewer than two records, several instruments, a duplicate record, or a share outside 0 to 1.
    """
    entries = list(history)
    _check(entries, common)
    entries.sort(key=lambda entry: (entry[1], entry[0]))
    names, _, calibrations = zip(*entries, strict=True)
    times = tuple(time.astimezone(dt.UTC) for _, time, _ in entries)
    days = np.unique([time.toordinal() for time in times], return_inverse=True)[1].astype(np.int64)
    years = np.array([(time - times[0]).total_seconds() / YEAR for time in times])
    by_key = [{c.key: c for c in one.coefficients} for one in calibrations]
    trends = []
    for key, last in by_key[-1].items():
        if last.name == "phi" or not all(key in one for one in by_key):  # there is one phase per power-up
            continue
        each = [one[key] for one in by_key]
        shared, doubt = _shared(calibrations, key, common)
        values, stds, freedoms = np.array([(c.value, c.std, c.degrees_of_freedom) for c in each]).T
        own = np.sqrt(np.maximum(stds**2 - np.sum(shared**2, axis=0), (1e-3 * stds) ** 2))
        doubt = stds**4 / freedoms - doubt
        degrees = np.divide(own**4, doubt, out=np.full_like(own, math.inf), where=doubt > 0.0)
        half = np.asarray(coverage_factor(degrees)) * own
        merged = merge_by_day(years, values, own**2, days, shared)
        line = line_through(merged) if merged.time.size >= LEAST_DAYS else None
        forecasts, scores, day_scores = _expected(years, values, own, days, shared)
        lists = (column.tolist() for column in (years, days, own, half, scores))
        points = tuple(
            Point(name, time, day, c.value, c.std, c.expanded, *rest)
            for name, c, time, day, *rest in zip(names, each, *lists, forecasts, strict=True)
        )
        chart = day_scores, *moving_average(day_scores), shared[:, -1].copy()
        trends.append(CoefficientTrend(key, last.unit, points, merged, line, clearest_step(merged), *chart))
    return Trend(calibrations[0].serial, times[0], names, times, calibrations, tuple(trends))


def _check(entries: Sequence[HistoryEntry], common: Common) -> None:
    serials = sorted({calibration.serial for _, _, calibration in entries})
    names = [name for name, *_ in entries]
    if len(entries) < 2:
        words = f"a trend needs at least two records, not {len(entries)}"
        raise ArgumentError(words, remedy="add calibrations of the instrument")
    if len(serials) > 1:
        words = f"the records are of different instruments: {', '.join(serials)}"
        raise ArgumentError(words, remedy="give those of one")
    for name, time, _ in entries:
        if names.count(name) > 1:
            raise ArgumentError(f"record '{name}' is given twice", remedy="give each record once")
        if time.tzinfo is None:
            raise ArgumentError(f"record '{name}': its time has no time zone", remedy="give it in UTC")
    for source, part in (common if isinstance(common, Mapping) else {"common": common}).items():
        if not 0.0 <= part <= 1.0:
            words = f"{source}: a shared part of {part!r} is not between 0 and 1"
            raise ArgumentError(words, remedy="give a share of the variance, e.g. 0.5")


def _shared(calibrations: Sequence[Calibration], key: str, common: Common) -> tuple[Array, Array]:
    """Contributions (sources, records) of Type B that are common to all records, and their part of ``u^4/nu``.

    ``sum(u_i^4/nu_i) = u^4/nu`` over all sources (JCGM 100, G.2b).
    """
    rows = [(k, row) for k, one in enumerate(calibrations) for row in one.budget if row.type == "B"]
    places = {source: i for i, source in enumerate(sorted({row.source for _, row in rows}))}
    shared, doubt = np.zeros((len(places), len(calibrations))), np.zeros(len(calibrations))
    for k, row in rows:
        part, size = _shared_part(common, row.source), row.contributions.get(key, 0.0)
        shared[places[row.source], k] += math.sqrt(part) * size
        doubt[k] += (1.0 - (1.0 - part) ** 2) * size**4 / (row.degrees_of_freedom or math.inf)
    return shared, doubt


def _shared_part(common: Common, source: str) -> float:
    """Share of the variance of a Type B source that is common to all records, as :func:`find_trend` says."""
    if isinstance(common, Mapping) and source in common:
        return float(common[source])
    if drawn_for(source.split(" ", maxsplit=1)[0]) != "reference":
        return 0.0
    return 1.0 if isinstance(common, Mapping) else float(common)


def _expected(
    years: Array, values: Array, own: Array, days: NDArray[np.int64], shared: Array
) -> tuple[list[Forecast | None], Array, Array]:
    """Forecast of each record from earlier days, and scores of records and days (nan: too few days)."""
    scores, day_scores = np.full(values.size, math.nan), np.full(int(days[-1]) + 1, math.nan)
    forecasts: list[Forecast | None] = [None] * values.size
    for day in range(LEAST_DAYS, day_scores.size):
        before, today = days < day, np.flatnonzero(days == day)
        earlier = years[before], values[before], own[before] ** 2, days[before], shared[:, before]
        line = line_through(merge_by_day(*earlier))
        for i in today.tolist():
            forecast = line.record_at(float(years[i]), float(own[i]), shared[:, i])
            forecasts[i], scores[i] = forecast, forecast.score(float(values[i]))
        weights = 1.0 / (own[today] ** 2 + line.days.within)
        common = shared[:, today] @ weights / weights.sum()
        expected = line.at(float(years[today].mean()), float(1.0 / weights.sum()), common)
        day_scores[day] = expected.score(float(weights @ values[today] / weights.sum()))
    return forecasts, scores, day_scores
