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
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError, PigaError
from piga.output import HIDDEN
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

    def _in_unit(self, half: float, *values: float) -> tuple[str, ...]:
        """Values in the unit of the pages, to two digits of the uncertainty ``half``; the unit follows."""
        scale, unit = shown_unit(self.key, self.unit)
        last = 1 - math.floor(math.log10(half * scale))
        numbers = (round(value * scale, last) + 0.0 for value in values)
        shown = (f"{number:.{max(last, 0)}f}" if last < 5 else f"{number:.12g}" for number in numbers)
        return (*shown, f" {unit}".removesuffix(" 1"))

    def alarms(self, dates: Sequence[dt.datetime]) -> Iterator[str]:
        """Records outside their forecast, a step of the level, a shift of the moving average; ``dates`` of the records."""
        for point, date in zip(self.points, dates, strict=True):
            if point.outside and point.forecast is not None:
                side = "above" if point.score > 0.0 else "below"
                value, expected, unit = self._in_unit(point.forecast.std, point.value, point.forecast.value)
                yield (
                    f"{self.key}: record {point.record} of {date:%Y-%m-%d} shows {value}{unit}, {abs(point.score):.1f} "
                    f"standard deviations {side} the forecast from earlier records, {expected}{unit} (limit 3)."
                )

        def since(day: int) -> str:
            first = next(i for i, point in enumerate(self.points) if point.day == day)
            return f"{self.key}: from {dates[first]:%Y-%m-%d} (record {self.points[first].record})"

        if self.stepped and (step := self.step):
            size, unit = self._in_unit(step.std, abs(step.size))
            yield (
                f"{since(step.day)} on the values are {size}{unit} {'higher' if step.size > 0.0 else 'lower'} than a line "
                "through the earlier ones says. Drift, scatter and forecast contain this step. If the instrument was "
                "changed then, judge its trend from that day on."
            )
        for day in np.flatnonzero(np.abs(self.average) > self.limit)[:1].tolist():
            side = "above" if self.average[day] > 0.0 else "below"
            yield (
                f"{since(day)} the values stay {side} the forecast from earlier records: the moving average of their "
                "deviations passed its control limit."
            )

    def remarks(self) -> Iterator[str]:
        """What differs between two days; a drift; a scatter of the days that contradicts the stated uncertainties."""
        from scipy.special import chdtr, chdtrc

        drift, line = self.drift, self.line
        if line is None or drift is None:
            yield from self._difference()
            return
        if self.drifts:
            half = drift.half_width()
            ends = drift.value, drift.value - half, drift.value + half
            shown, low, high, unit = self._in_unit(half, *ends)
            yield f"{self.key} drifts by {shown}{unit} per year (95 %: {low} to {high})."
        nu, times = line.degrees_of_freedom, math.sqrt(line.chi2 / line.degrees_of_freedom)
        if chdtrc(nu, line.chi2) < DOUBT and not self.stepped:
            yield (
                f"{self.key}: days scatter {times:.1f} times as much as the records' own uncertainties explain. "
                "The excess counts as day-to-day instability."
            )
        elif chdtr(nu, line.chi2) < DOUBT:
            yield (
                f"{self.key}: days scatter less than the records' own uncertainties say: these are stated too "
                "large, or contain a part that the records share."
            )

    def _difference(self) -> Iterator[str]:
        """The change from one day to another, if it is beyond the control limit."""
        days = self.days
        change = float(days.means[-1] - days.means[0])
        common = float(np.sum((days.shared[-1] - days.shared[0]) ** 2))
        std = math.sqrt(float(days.variances.sum()) + common)
        if len(days.means) == 2 and abs(change) > CONTROL_LIMIT * std:
            size, unit = self._in_unit(std, abs(change))
            yield (
                f"{self.key}: the second day shows {size}{unit} {'more' if change > 0.0 else 'less'} than the first, "
                f"{abs(change) / std:.1f} standard uncertainties of the difference. A third day tells more."
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

    @property
    def judged(self) -> int:
        """Number of records with a forecast from earlier days; without one no alarm is possible."""
        return sum(point.forecast is not None for trend in self.coefficients[:1] for point in trend.points)

    def in_brief(self) -> list[tuple[str, str]]:
        """Instrument, records, alarms and remarks."""
        dates = f"{self.times[0]:%Y-%m-%d} to {self.times[-1]:%Y-%m-%d}"
        rows = [("instrument", self.serial), ("records", f"{len(self.records)}, {dates}, {self.judged} judged")]
        rows += [("alarm", alarm) for alarm in self.alarms]
        return rows + [("remark", remark) for remark in self.remarks]


@one_thread()
def read_history(sources: Iterable[Path], serial: str | None = None) -> Iterator[HistoryEntry]:
    """Records from files, or folders of them. The path of a file is the id; the time is that of the evaluation."""
    for path in calibration_files(sources):
        calibration = Calibration.from_json(path)
        time = dt.datetime.fromisoformat(calibration.provenance.created)
        if serial is None or calibration.serial == serial:
            yield str(path), time if time.tzinfo else time.replace(tzinfo=dt.UTC), calibration


def calibration_files(sources: Iterable[Path]) -> list[Path]:
    """The files that are named, and those in folders; what a command is still writing is none of them."""
    paths: list[Path] = []
    for source in sources:
        inside = sorted(source.rglob("calibration*.json")) if source.is_dir() else [source]
        inside = [path for path in inside if not any(part.startswith(HIDDEN) for part in path.parts)]
        if not inside:
            raise PigaError(f"{source}: holds no calibration.json", remedy="name another directory")
        paths += inside
    return list(dict.fromkeys(paths))


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
        days = merge_by_day(self.years, values, own**2, self.days, shared)
        line = line_through(days) if days.time.size >= LEAST_DAYS else None
        forecasts, scores, day_scores = self._expected(values, own, shared)
        lists = (part.tolist() for part in (self.years, self.days, own, half, scores))
        points = tuple(
            Point(name, time, day, c.value, c.std, c.expanded, *rest)
            for name, c, time, day, *rest in zip(self.names, coefficients, *lists, forecasts, strict=True)
        )
        found = points, days, line, clearest_step(days), day_scores, *moving_average(day_scores)
        return CoefficientTrend(key, coefficients[0].unit, *found, shared[:, -1].copy())

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
            line = line_through(merge_by_day(*earlier))
            for i in today.tolist():
                forecast = line.record_at(float(self.years[i]), float(own[i]), shared[:, i])
                forecasts[i], scores[i] = forecast, forecast.score(float(values[i]))
            weights = 1.0 / (own[today] ** 2 + line.days.within)
            mean = weights @ values[today] / weights.sum()
            common = shared[:, today] @ weights / weights.sum()
            expected = line.at(float(self.years[today].mean()), float(1.0 / weights.sum()), common)
            day_scores[day] = expected.score(float(mean))
        return forecasts, scores, day_scores

    def remarks(self) -> Iterator[str]:
        """What to know of the records to judge the figures."""
        calibrations = self.calibrations
        days, span, n = int(self.days[-1]) + 1, float(self.years[-1]), len(calibrations)
        if days < LEAST_DAYS:
            count = f"{days} day{'s' * (days > 1)}"
            yield (
                f"The records are of {count}: drift and forecast need three days or more. A file counts for the day of its "
                "evaluation; 'piga records add --measured' keeps that of the test."
            )
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
