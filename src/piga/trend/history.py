"""The coefficients of one instrument over the years: stability, drift, control limits, forecasts.

Each record gives a value with a standard uncertainty. Sources of Type B that act alike in all records (the same
standard of gravity or angle) are *common*: averaging does not reduce them, and they cancel in differences between
records. Scatter within a day is turn-on to turn-on; more scatter between days is day to day. See docs/theory/trend.md.
"""

from __future__ import annotations

import datetime as dt
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.coefficient import NO_REFERENCE, Coefficient, coverage_factor
from piga.records.run_file import drawn_for
from piga.records.terms import shown_unit
from piga.results import Array, Reported, Result, drawn
from piga.threads import one_thread
from piga.trend.trend_line import (
    CONTROL_LIMIT,
    DOUBT,
    LEAST_DAYS,
    Forecast,
    Outlook,
    Step,
    TrendModel,
    clearest_step,
    merge_by_day,
    moving_average,
    outlook,
)
from piga.upper import doors

if TYPE_CHECKING:
    from types import ModuleType

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_SHORT = 0.25
"""Length of the history [years] below which a drift per year is an extrapolation and gets a remark (own choice)."""
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
class Chart(Result):
    """Control chart of the days: score of each day mean, its moving average, and the limit of the average."""

    time: Array
    score: Array
    average: Array
    limit: Array

    @property
    def shifted(self) -> NDArray[np.bool_]:
        """Days at which the moving average is beyond its limit."""
        return np.abs(self.average) > self.limit


@dataclass(frozen=True, eq=False, repr=False)
class CoefficientTrend(Result):
    """The trend of one coefficient; times in years since ``Trend.start``, values in ``unit``.

    ``last_shared`` (sources,) are the errors common to the last record and other records. ``step`` is the clearest step
    of the level, None with fewer than five days.
    """

    key: str
    unit: str
    points: tuple[Point, ...]
    chart: Chart
    model: TrendModel
    step: Step | None
    last_shared: Array

    @property
    def turn_on(self) -> float:
        """Standard deviation within days beyond the stated uncertainty; nan without repeats."""
        return math.sqrt(self.model.days.within) if self.model.days.freedom else math.nan

    @property
    def day_to_day(self) -> float:
        """Standard deviation between days beyond stated uncertainty and turn-on; nan with too few days."""
        return math.sqrt(self.model.line.excess) if self.model.line is not None else math.nan

    @property
    def drift(self) -> Forecast | None:
        """Change per year with its uncertainty, None with fewer than three days."""
        return self.model.drift

    @property
    def stepped(self) -> bool:
        """True if the clearest step is less likely by chance than a value beyond the control limits."""
        return self.step is not None and self.step.probability < math.erfc(CONTROL_LIMIT / math.sqrt(2.0))

    @cached_property
    def outlook(self) -> Outlook:
        """The models of the scatter, for forecasts."""
        return outlook(self.model.days)

    def coefficient_at(self, time: float) -> Forecast:
        """The coefficient at a turn-on at a time, including common errors of all records."""
        return self.outlook.at(time, self.model.days.within)

    def next_record(self, time: float) -> Forecast:
        """Forecast of a further record with the uncertainty and the standards of the last one."""
        own = self.points[-1].own ** 2 + self.model.days.within
        return self.outlook.at(time, own, self.last_shared)

    def alarms(self, dates: Sequence[dt.datetime]) -> Iterator[str]:
        """Records outside their forecast, a step of the level, a shift of the moving average; ``dates`` of the records."""
        scale, unit = shown_unit(self.key, self.unit)
        unit = f" {unit}".removesuffix(" 1")
        for point, date in zip(self.points, dates, strict=True):
            if point.outside and point.forecast is not None:
                side = "above" if point.score > 0.0 else "below"
                yield (
                    f"{self.key}: record {point.record} of {date:%Y-%m-%d} shows {point.value * scale:.7g}{unit}, "
                    f"{abs(point.score):.1f} standard deviations {side} the forecast from earlier records, "
                    f"{point.forecast.value * scale:.7g}{unit} (limit 3)."
                )

        def since(day: int) -> str:
            first = next(i for i, point in enumerate(self.points) if point.day == day)
            return f"{self.key}: from {dates[first]:%Y-%m-%d} (record {self.points[first].record})"

        if self.stepped and (step := self.step):
            size = _to_two_digits_of(step.std * scale, abs(step.size) * scale)
            yield (
                f"{since(step.day)} on the values are {size}{unit} {'higher' if step.size > 0.0 else 'lower'} than a line "
                "through the earlier ones says. If the instrument was changed then, judge its trend from that day on."
            )
        for day in np.flatnonzero(self.chart.shifted)[:1].tolist():
            side = "above" if self.chart.average[day] > 0.0 else "below"
            yield (
                f"{since(day)} the values stay {side} the forecast from earlier records: the moving average of their "
                "deviations passed its control limit."
            )

    def remarks(self) -> Iterator[str]:
        """A drift beyond its 95 % interval, and a scatter of the days that contradicts the stated uncertainties."""
        from scipy.special import chdtr, chdtrc

        drift, line = self.drift, self.model.line
        if drift is None or line is None:
            return
        if abs(drift.value) > drift.half_width():
            scale, unit = shown_unit(self.key, self.unit)
            value, half = drift.value * scale, drift.half_width() * scale
            shown, low, high = (_to_two_digits_of(half, end) for end in (value, value - half, value + half))
            unit = f"{unit} per year".removeprefix("1 ")
            yield f"{self.key} drifts by {shown} {unit} (95 %: {low} to {high})."
        nu, times = line.degrees_of_freedom, math.sqrt(line.chi2 / line.degrees_of_freedom)
        if chdtrc(nu, line.chi2) < DOUBT:
            yield (
                f"{self.key}: days scatter {times:.1f} times as much as the records' own uncertainties explain. "
                "The excess counts as day-to-day instability."
            )
        elif chdtr(nu, line.chi2) < DOUBT:
            yield (
                f"{self.key}: days scatter less than the records' own uncertainties say: these are stated too "
                "large, or contain a part that the records share."
            )


@dataclass(frozen=True, eq=False, repr=False)
class Trend(Result, Reported):
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

    def plot(self, key: str = "", ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Values of the coefficient ``key`` (the first one) and its control chart. See :func:`piga.results.drawn`."""
        return drawn(doors().shown_trend().figures(self)[key](), ax)

    def _subject(self) -> ModuleType:
        return doors().shown_trend()

    def in_brief(self) -> list[tuple[str, str]]:
        """What a notebook shows of the trend."""
        drifts = {
            c.key: f"{c.drift.value:.3g} +- {c.drift.std:.2g} a year" if c.drift else "too few days"
            for c in self.coefficients
        }
        return [
            ("instrument", self.serial),
            ("records", f"{len(self.records)}, {self.times[0]:%Y-%m-%d} to {self.times[-1]:%Y-%m-%d}"),
            ("alarms", "; ".join(self.alarms) or "none"),
            *drifts.items(),
        ]


@one_thread()
def find_trend(history: Iterable[HistoryEntry], *, common: Common = 1.0) -> Trend:
    """Trend of every coefficient that all records hold.

    Parameters
    ----------
    history:
        Records of one instrument, in any order. They are read one by one; a generator works.
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
    times = [time.astimezone(dt.UTC) for _, time, _ in entries]
    calibrations = [calibration for *_, calibration in entries]
    records = _Records(
        names=tuple(name for name, *_ in entries),
        years=np.array([(time - times[0]).total_seconds() / YEAR for time in times]),
        days=np.unique([time.toordinal() for time in times], return_inverse=True)[1].astype(np.int64),
        calibrations=calibrations,
        common=common,
    )
    by_key = [{c.key: c for c in one.coefficients} for one in calibrations]
    everywhere = set.intersection(*(set(one) for one in by_key))
    trends = tuple(
        records.trend(key, [one[key] for one in by_key])
        for key, c in by_key[-1].items()
        if key in everywhere and c.name != "phi"  # there is one phase per power-up
    )
    return Trend(
        calibrations[0].serial,
        times[0],
        records.names,
        tuple(times),
        trends,
        tuple(alarm for trend in trends for alarm in trend.alarms(times)),
        (*(remark for trend in trends for remark in trend.remarks()), *records.remarks()),
    )


def _check(entries: Sequence[HistoryEntry], common: Common) -> None:
    serials = sorted({calibration.serial for _, _, calibration in entries})
    shares = common if isinstance(common, Mapping) else {"common": common}
    if len(entries) < 2:
        words = f"a trend needs at least two records, not {len(entries)}"
        raise ArgumentError(words, remedy="add calibrations of the instrument")
    if len(serials) > 1:
        words = f"the records are of different instruments: {', '.join(serials)}"
        raise ArgumentError(words, remedy="give those of one")
    for name, count in Counter(name for name, *_ in entries).items():
        if count > 1:
            raise ArgumentError(f"record '{name}' is given twice", remedy="give each record once")
    for name, time, _ in entries:
        if time.tzinfo is None:
            raise ArgumentError(f"record '{name}': its time has no time zone", remedy="give it in UTC")
    for source, part in shares.items():
        if not 0.0 <= part <= 1.0:
            words = f"{source}: a shared part of {part!r} is not between 0 and 1"
            raise ArgumentError(words, remedy="give a share of the variance, e.g. 0.5")


@dataclass(frozen=True)
class _Records:
    """The records in the order of time: names, years since the first (n,), days (n,) numbered from 0, calibrations."""

    names: tuple[str, ...]
    years: Array
    days: NDArray[np.int64]
    calibrations: list[Calibration]
    common: Common

    def trend(self, key: str, coefficients: Sequence[Coefficient]) -> CoefficientTrend:
        """Trend of one coefficient, which each record gives."""
        values, stds, freedoms = np.array([(c.value, c.std, c.degrees_of_freedom) for c in coefficients]).T
        shared, doubt = self._shared(key)
        own = np.sqrt(np.maximum(stds**2 - np.sum(shared**2, axis=0), (1e-3 * stds) ** 2))
        doubt = stds**4 / freedoms - doubt
        degrees = np.divide(own**4, doubt, out=np.full_like(own, math.inf), where=doubt > 0.0)
        half = np.asarray(coverage_factor(degrees)) * own
        model = TrendModel(merge_by_day(self.years, values, own**2, self.days, shared))
        forecasts, scores, day_scores = self._expected(values, own, shared)
        lists = (part.tolist() for part in (self.years, self.days, own, half, scores))
        points = tuple(
            Point(name, time, day, c.value, c.std, c.expanded, *rest)
            for name, c, time, day, *rest in zip(self.names, coefficients, *lists, forecasts, strict=True)
        )
        chart = Chart(model.days.time, day_scores, *moving_average(day_scores))
        step = clearest_step(model.days)
        return CoefficientTrend(key, coefficients[0].unit, points, chart, model, step, shared[:, -1].copy())

    def _shared(self, key: str) -> tuple[Array, Array]:
        """Contributions (sources, records) of Type B that are common to all records, and their part of ``u^4/nu``.

        ``sum(u_i^4/nu_i) = u^4/nu`` over all sources (JCGM 100, G.2b).
        """
        rows = [(k, row) for k, one in enumerate(self.calibrations) for row in one.budget if row.type == "B"]
        places = {source: i for i, source in enumerate(sorted({row.source for _, row in rows}))}
        shared, doubt = np.zeros((len(places), len(self.names))), np.zeros(len(self.names))
        for k, row in rows:
            part, size = _shared_part(self.common, row.source), row.contributions.get(key, 0.0)
            shared[places[row.source], k] += math.sqrt(part) * size
            doubt[k] += (1.0 - (1.0 - part) ** 2) * size**4 / (row.degrees_of_freedom or math.inf)
        return shared, doubt

    def _expected(self, values: Array, own: Array, shared: Array) -> tuple[list[Forecast | None], Array, Array]:
        """Forecast of each record from earlier days, and scores of records and days (nan: too few days)."""
        count = int(self.days[-1]) + 1
        scores, day_scores = np.full(values.size, math.nan), np.full(count, math.nan)
        forecasts: list[Forecast | None] = [None] * values.size
        for day in range(LEAST_DAYS, count):
            before, today = self.days < day, np.flatnonzero(self.days == day)
            earlier = self.years[before], values[before], own[before] ** 2, self.days[before], shared[:, before]
            model = TrendModel(merge_by_day(*earlier))
            for i in today.tolist():
                forecast = model.record_at(float(self.years[i]), float(own[i]), shared[:, i])
                forecasts[i], scores[i] = forecast, forecast.score(float(values[i]))
            weights = 1.0 / (own[today] ** 2 + model.days.within)
            mean = weights @ values[today] / weights.sum()
            common = shared[:, today] @ weights / weights.sum()
            expected = model.at(float(self.years[today].mean()), float(1.0 / weights.sum()), common)
            day_scores[day] = expected.score(float(mean))
        return forecasts, scores, day_scores

    def remarks(self) -> Iterator[str]:
        """What to know of the records to judge the figures."""
        calibrations = self.calibrations
        days, span, n = int(self.days[-1]) + 1, float(self.years[-1]), len(calibrations)
        if days < LEAST_DAYS:
            yield f"The records are of {days} day{'s' * (days > 1)}: drift and forecast need three days or more."
        elif span < _SHORT:
            yield f"The records span {span * 365.25:.0f} days only: a drift per year is an extrapolation."
        if len({calibration.terms for calibration in calibrations}) > 1:
            yield (
                "The records were calibrated with different terms: a coefficient may have taken over what another "
                "record left to a term of its own."
            )
        alone = sum(one.type_a_only for one in calibrations)
        if alone:
            yield f"{alone} of {n} records: {NO_REFERENCE}."
        without = sum(not len(calibration.budget) for calibration in calibrations)
        if without:
            yield (
                f"{without} of {n} records have no uncertainty budget: their whole uncertainty counts as "
                "their own, although a part may be shared."
            )


def _shared_part(common: Common, source: str) -> float:
    """Share of the variance of a Type B source that is common to all records.

    A source with a new value in each test is not common unless it is named.
    """
    if isinstance(common, Mapping) and source in common:
        return float(common[source])
    if drawn_for(source.split(" ", maxsplit=1)[0]) != "reference":
        return 0.0
    return 1.0 if isinstance(common, Mapping) else float(common)


def _to_two_digits_of(half: float, number: float) -> str:
    last = 1 - math.floor(math.log10(half))
    return f"{round(number, last):.{max(last, 0)}f}" if last < 5 else f"{round(number, last):.12g}"
