"""A trend shown: stability, drift, control chart and forecast on a page, in a terminal and as figures."""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from piga.records.calibration.coefficient import NO_REFERENCE
from piga.records.terms import shown_unit, term_words
from piga.reports.render.figure import Axis, Figure, Plot, Role
from piga.reports.render.numbers import ascii_text, fixed, pretty_unit, printed, rounded, short, signed
from piga.reports.render.page import Cell, Notice, Page, Section, Table, TableOf, Tile, Tone
from piga.results import finite
from piga.trend.history import YEAR, CoefficientTrend, Point, Trend
from piga.trend.trend_line import CONTROL_LIMIT, LEAST_DAYS, Forecast
from piga.units import DAY

_GRID = 80


def _axis_of(trend: CoefficientTrend) -> tuple[float, float, Axis]:
    """How values are drawn, ``(value - origin) * factor``: a round origin near them, and micro-units (ppm of the scale factor)."""
    values = np.array([point.value for point in trend.points])
    spread = max(float(np.ptp(values)), *(point.own for point in trend.points)) or abs(float(values[0])) or 1.0
    place = -math.floor(math.log10(spread))
    origin = round(float(np.median(values)), place)
    if trend.key == "scale_factor" and origin:
        return origin, 1e6 / origin, Axis(f"scale_factor / {fixed(origin, max(place, 0))} − 1", "ppm")
    unit = {"1": "10⁻⁶", "1/K": "10⁻⁶/K"}.get(trend.unit) or pretty_unit(f"u{trend.unit}")
    shown = fixed(origin * 1e6, max(place - 6, 0))
    quantity = f"{trend.key} − {shown}" if origin > 0 else f"{trend.key} + {shown.lstrip('−')}"
    return origin, 1e6, Axis(quantity if origin else trend.key, unit)


_DATE = Axis("date", "", dates=True)
"""The time axis: calendar dates, UTC."""


def _dates(start: dt.datetime, years: np.ndarray | float) -> np.ndarray:
    return start.timestamp() / DAY + np.asarray(years, dtype=float) * YEAR / DAY


def _trend_figure(drifts: Trend, trend: CoefficientTrend, ahead: float | None = None) -> Figure:
    """Values and control chart of one coefficient; ``ahead`` is the time of the forecast in years since the start."""
    plot = Plot(f"trend-{trend.key.replace('_', '-')}", f"{trend.key} over time.", height=2.7)
    _add_values(plot, trend, drifts.start, ahead)
    if np.isfinite(trend.scores).any():
        _add_control(plot, trend, drifts.start)
    return plot.caption(
        "Above, the values with the 95 % interval of each record's own uncertainty, and what the history says of a "
        "further record at any time, with its 95 % band. Below, how far each day lies from what the days "
        "before forecast, and the moving average of these scores. Good: points in the band, scores within ±3, "
        "the average within its own limits."
    )


def _add_values(plot: Plot, trend: CoefficientTrend, start: dt.datetime, ahead: float | None) -> None:
    origin, factor, axis = _axis_of(trend)

    def interval(forecasts: list[Forecast]) -> tuple[np.ndarray, np.ndarray]:
        values = np.array([[one.value - origin, one.half_width()] for one in forecasts])
        return values[:, 0] * factor, values[:, 1] * factor

    plot.panel(_DATE, axis, trend.key)
    if trend.line is not None:
        grid = np.linspace(trend.points[0].time, max(float(trend.points[-1].time), ahead or 0.0), _GRID)
        middle, half = interval([trend.next_record(float(time)) for time in grid])
        x = _dates(start, grid)
        plot.band(x, middle - half, middle + half, "95 % of further records").line(
            x, middle, "expected record", "model"
        )
    for name, role, outside in _KINDS:
        those = [point for point in trend.points if point.outside == outside]
        if those or not outside:
            value, time, error = np.array([(p.value, p.time, p.own_half_width) for p in those]).reshape(-1, 3).T
            names = tuple(point.record for point in those)
            y = (value - origin) * factor
            plot.points(_dates(start, time), y, name, role, error=error * factor, text=names)
    if ahead is not None and trend.line is not None:
        value, half = interval([trend.coefficient_at(ahead)])
        plot.points([_dates(start, ahead)], value, "forecast of the coefficient", "after", error=half)


_KINDS: tuple[tuple[str, Role, bool], ...] = (("records", "data", False), ("out of control", "warning", True))


def _add_control(plot: Plot, trend: CoefficientTrend, start: dt.datetime) -> None:
    seen = np.isfinite(trend.scores)
    x = _dates(start, trend.days.time[seen])
    ends = x[[0, -1]] if x.size > 1 else x[[0, 0]] + np.array([-0.5, 0.5])
    plot.panel(_DATE, "deviation from the forecast [std]", "Control chart")
    plot.points(x, trend.scores[seen], "score of a day").line(x, trend.average[seen], "moving average", "model")
    for sign, name, score in ((1.0, "limit of the average", "limit of a score"), (-1.0, "", "")):
        plot.dashed(x, sign * trend.limit[seen], name, "model")
        plot.level(ends, sign * CONTROL_LIMIT, score, "warning")


def figures(drifts: Trend) -> dict[str, Callable[[], Figure]]:
    """The figure of each coefficient by its key; the first one also by no key."""
    by_key: dict[str, Callable[[], Figure]] = {
        trend.key: partial(_trend_figure, drifts, trend) for trend in drifts.coefficients
    }
    return by_key | {"": next(iter(by_key.values()))}


# --- sentences ------------------------------------------------------------------------------

_SHORT = 0.25
"""Length of the history [years] below which a drift per year is an extrapolation and gets a remark (own choice)."""
_DOUBT = 0.01
"""Probability below which a small or large scatter contradicts the stated uncertainties."""


def alarms(drifts: Trend) -> Iterator[str]:
    """Records outside their forecast, a step of the level, a shift of the moving average."""
    for trend in drifts.coefficients:
        for point, date in zip(trend.points, drifts.times, strict=True):
            if point.outside and point.forecast is not None:
                value, expected, unit = _in_unit(trend, point.forecast.std, point.value, point.forecast.value)
                yield (
                    f"{trend.key}: record {point.record} of {date:%Y-%m-%d} shows {value}{unit}, {abs(point.score):.1f} standard "
                    f"deviations {_side(point.score)} the forecast from earlier records, {expected}{unit} (limit 3)."
                )
        if trend.stepped and (step := trend.step):
            size, unit = _in_unit(trend, step.std, abs(step.size))
            yield (
                f"{_since(drifts, trend, step.day)} on the values are {size}{unit} {'higher' if step.size > 0.0 else 'lower'} "
                "than a line through the earlier ones says. Drift, scatter and forecast contain this step. If the instrument "
                "was changed then, judge its trend from that day on."
            )
        for day in np.flatnonzero(np.abs(trend.average) > trend.limit)[:1].tolist():
            yield (
                f"{_since(drifts, trend, day)} the values stay {_side(trend.average[day])} the forecast from earlier records: "
                "the moving average of their deviations passed its control limit."
            )


def _side(deviation: float) -> str:
    return "above" if deviation > 0.0 else "below"


def _since(drifts: Trend, trend: CoefficientTrend, day: int) -> str:
    first = next(i for i, point in enumerate(trend.points) if point.day == day)
    return f"{trend.key}: from {drifts.times[first]:%Y-%m-%d} (record {drifts.records[first]})"


def _in_unit(trend: CoefficientTrend, std: float, *values: float) -> tuple[str, ...]:
    """Values in the unit of the pages, rounded by their uncertainty; the unit follows."""
    scale, unit = shown_unit(trend.key, trend.unit)
    numbers = (ascii_text(rounded(value * scale, std * scale).value) for value in values)
    return (*numbers, f" {unit}".removesuffix(" 1"))


def remarks(drifts: Trend) -> Iterator[str]:
    """What drifts or scatters, and what to know of the records to judge the figures."""
    for trend in drifts.coefficients:
        yield from _remarks_on(trend)
    calibrations, span = drifts.calibrations, drifts.years(drifts.times[-1])
    days = len({time.toordinal() for time in drifts.times})
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
    of = f"of {len(calibrations)} records"
    if alone := sum(one.type_a_only for one in calibrations):
        yield f"{alone} {of}: {NO_REFERENCE}."
    if without := sum(not len(one.budget) for one in calibrations):
        yield (
            f"{without} {of} have no uncertainty budget: their whole uncertainty counts as their own, although a part "
            "may be shared."
        )


def _remarks_on(trend: CoefficientTrend) -> Iterator[str]:
    """What differs between two days; a drift; a scatter of the days that contradicts the stated uncertainties."""
    from scipy.special import chdtr, chdtrc

    drift, line, days = trend.drift, trend.line, trend.days
    if line is None or drift is None:
        change = float(days.means[-1] - days.means[0])
        std = math.sqrt(float(days.variances.sum() + np.sum((days.shared[-1] - days.shared[0]) ** 2)))
        if len(days.means) == 2 and abs(change) > CONTROL_LIMIT * std:
            size, unit = _in_unit(trend, std, abs(change))
            yield (
                f"{trend.key}: the second day shows {size}{unit} {'more' if change > 0.0 else 'less'} than the first, "
                f"{abs(change) / std:.1f} standard uncertainties of the difference. A third day tells more."
            )
        return
    if trend.drifts:
        half = drift.half_width()
        shown, low, high, unit = _in_unit(trend, half, drift.value, drift.value - half, drift.value + half)
        yield f"{trend.key} drifts by {shown}{unit} per year (95 %: {low} to {high})."
    nu = line.degrees_of_freedom
    if chdtrc(nu, line.chi2) < _DOUBT and not trend.stepped:
        yield (
            f"{trend.key}: days scatter {math.sqrt(line.chi2 / nu):.1f} times as much as the records' own uncertainties "
            "explain. The excess counts as day-to-day instability."
        )
    elif chdtr(nu, line.chi2) < _DOUBT:
        yield (
            f"{trend.key}: days scatter less than the records' own uncertainties say: these are stated too large, or contain "
            "a part that the records share."
        )


# --- page -----------------------------------------------------------------------------------

_UNJUDGED = "No record is judged yet: that needs records of three earlier days."


def page(drifts: Trend, at: dt.datetime | None = None) -> Page:
    """Alarms first, then stability and drift of each coefficient, with a forecast for ``at`` where it is given."""
    alarms = [Notice("problem", printed(alarm)) for alarm in drifts.alarms]
    remarks = (Notice("warning", printed(remark)) for remark in drifts.remarks)
    calm = "No record is out of control." if drifts.judged else _UNJUDGED
    judged = (*(alarms or [Notice("good" if drifts.judged else "info", calm)]), *remarks)
    lead = (
        "Turn-on is the scatter inside a day, day to day the scatter between days, each beyond the records' own "
        "uncertainties; drift is the line through the days. Intervals are for 95 %. Errors that all "
        "records share (the same standard) cancel in drift and scatter, and are part of the value and its forecast."
    )
    return Page(
        title=f"Trend of {drifts.serial}",
        subtitle=f"{len(drifts.records)} records from {drifts.times[0]:%Y-%m-%d} to {drifts.times[-1]:%Y-%m-%d}.",
        tiles=_tiles(drifts),
        sections=(
            Section("Judgement", "judgement", judged),
            Section("Stability and drift", "stability", (lead, _summary_table(drifts, at))),
            *(
                _section(drifts, trend, None if at is None else drifts.years(at))
                for trend in drifts.coefficients
            ),
        ),
        kicker="piga · trend",
    )


def brief(drifts: Trend, at: dt.datetime | None = None) -> Page:
    """Alarms, remarks, stability and drift for terminal and notebook, and the figure of the first coefficient."""
    short = page(drifts, at).only("judgement", "stability")
    drawn = tuple(partial(_trend_figure, drifts, trend) for trend in drifts.coefficients[:1])
    return replace(short, sections=(*short.sections, Section("", "first", drawn)))


def _tiles(drifts: Trend) -> tuple[Tile, ...]:
    span = drifts.years(drifts.times[-1])
    days = len({point.day for point in drifts.coefficients[0].points}) if drifts.coefficients else 0
    drifting = [trend.key for trend in drifts.coefficients if trend.drifts]
    count, of = len(drifts.alarms), f"of {len(drifts.coefficients)}"
    judged = f"{drifts.judged} of {len(drifts.records)} records judged"
    period, unit = (fixed(span, 1), "years") if span >= 1.0 else (f"{span * 365.25:.0f}", "days")
    which = ", ".join(drifting) or ("none beyond its uncertainty" if days >= LEAST_DAYS else "needs three days")
    calm: Tone = "good" if drifts.judged else "quiet"
    return (
        Tile("Records", str(len(drifts.records)), "", "on 1 day" if days == 1 else f"on {days} days"),
        Tile("Span", period, unit),
        Tile("Alarms", str(count), "", judged, "bad" if count else calm),
        Tile("Coefficients that drift", str(len(drifting)), of, which, "doubtful" if drifting else calm),
    )


def _summary_table(drifts: Trend, at: dt.datetime | None = None) -> Table:
    def last_day(trend: CoefficientTrend) -> str:
        point, scale = trend.points[-1], _scale(trend)
        return _at(trend, point.time) or rounded(point.value * scale, point.expanded * scale).interval

    def drift(trend: CoefficientTrend) -> str | Cell:
        shown = "–" if trend.drift is None else _interval(trend.drift, _scale(trend))
        return Cell(shown, "doubtful" if trend.drifts or trend.stepped else "")

    table = (
        TableOf(drifts.coefficients)
        .text("Coefficient", lambda trend: trend.key)
        .text("Unit", lambda trend: pretty_unit(shown_unit(trend.key, trend.unit)[1]) or "1")
        .number("On the last day", last_day)
        .number("Turn-on", lambda trend: short(trend.turn_on * _scale(trend), 2), "std")
        .number("Day to day", lambda trend: short(trend.day_to_day * _scale(trend), 2), "std")
        .number("Drift per year", drift)
    )
    if at is not None:
        years = drifts.years(at)
        table.number(f"Forecast for {at:%Y-%m-%d}", lambda trend: _at(trend, years) or "–")
    return table.table()


def _scale(trend: CoefficientTrend) -> float:
    return shown_unit(trend.key, trend.unit)[0]


def _at(trend: CoefficientTrend, years: float) -> str:
    """Value at a time with its interval; empty without a line."""
    return _interval(trend.coefficient_at(years), _scale(trend)) if trend.line else ""


def _interval(forecast: Forecast | None, scale: float) -> str:
    return "–" if forecast is None else rounded(forecast.value * scale, forecast.half_width() * scale).interval


def _section(drifts: Trend, trend: CoefficientTrend, ahead: float | None) -> Section:
    """Meaning, figure and records of one coefficient."""
    scale, unit = shown_unit(trend.key, trend.unit)
    shown = pretty_unit(unit)
    table = (
        TableOf(list(zip(trend.points, drifts.times, strict=True)))
        .text("Record", lambda row: row[0].record)
        .number("Date", lambda row: f"{row[1]:%Y-%m-%d\u00a0%H:%M}")
        .number("Value", lambda row: rounded(row[0].value * scale, row[0].std * scale).value, shown)
        .number("u without the shared part", lambda row: short(row[0].own * scale, 2), shown)
        .number("u", lambda row: short(row[0].std * scale, 2), shown)
        .number("U (95 %)", lambda row: short(row[0].expanded * scale, 2), shown)
        .number("Forecast ± 95 %", lambda row: _interval(row[0].forecast, scale), shown)
        .number("Score", lambda row: _score(row[0]))
    )
    caption = "Records, each with the forecast from earlier records. A forecast needs three earlier days."
    lead = f"{term_words(trend.key).meaning[:1].upper()}{term_words(trend.key).meaning[1:]}."
    content = (lead, partial(_trend_figure, drifts, trend, ahead), table.table(caption))
    return Section(trend.key, f"coefficient-{trend.key.replace('_', '-')}", content)


def _score(point: Point) -> Cell:
    score = "–" if point.forecast is None else signed(point.score, 1)
    return Cell(score, "bad" if point.outside else "")


def trend_document(drifts: Trend, *, at: dt.datetime | None = None) -> dict[str, Any]:
    """The trend as plain JSON values, in file units; nan becomes null."""

    def ahead(trend: CoefficientTrend, forecast: Callable[[float], Forecast]) -> dict[str, Any] | None:
        if at is None or trend.line is None:
            return None
        return {"date": at.isoformat(), **(_forecast_document(forecast(drifts.years(at))) or {})}

    return {
        "schema": "piga.trend/1",
        "serial": drifts.serial,
        "start": drifts.times[0].isoformat(),
        "alarms": list(drifts.alarms),
        "remarks": list(drifts.remarks),
        "coefficients": [
            {
                "name": trend.key,
                "unit": trend.unit,
                "turn_on_std": finite(trend.turn_on),
                "day_to_day_std": finite(trend.day_to_day),
                "drift_per_year": _forecast_document(trend.drift),
                "forecast": ahead(trend, trend.coefficient_at),
                "next_record": ahead(trend, trend.next_record),
                "records": [
                    _record_document(point, time)
                    for point, time in zip(trend.points, drifts.times, strict=True)
                ],
            }
            for trend in drifts.coefficients
        ],
    }


def _record_document(point: Point, time: dt.datetime) -> dict[str, Any]:
    return {
        "record": point.record,
        "time": time.isoformat(),
        "value": point.value,
        "std": point.std,
        "half_width_95": point.expanded,
        "own_std": point.own,
        "own_half_width_95": point.own_half_width,
        "expected": _forecast_document(point.forecast),
        "score": finite(point.score),
        "out_of_control": point.outside,
    }


def _forecast_document(forecast: Forecast | None) -> dict[str, Any] | None:
    if forecast is None:
        return None
    return {
        "value": forecast.value,
        "std": forecast.std,
        "degrees_of_freedom": finite(forecast.degrees_of_freedom),
        "half_width_95": forecast.half_width(),
    }
