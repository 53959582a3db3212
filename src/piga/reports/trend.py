"""A trend shown: stability, drift, control chart and forecast on a page, in a terminal and as figures."""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from piga.records.terms import meaning_of, shown_unit
from piga.reports.render.figure import Axis, Figure, Plot, Role
from piga.reports.render.numbers import fixed, pretty_unit, printed, rounded, short, signed
from piga.reports.render.page import Cell, Notice, Page, Section, Table, TableOf, Tile
from piga.results import finite
from piga.trend.history import YEAR, CoefficientTrend, Point, Trend
from piga.trend.trend_line import CONTROL_LIMIT, Forecast
from piga.units import DAY

_GRID = 80


@dataclass(frozen=True)
class _TrendScale:
    """How values of a coefficient are drawn: ``(value - origin) * factor`` in ``unit``, named ``quantity``."""

    origin: float
    factor: float
    quantity: str
    unit: str

    def shown(self, values: np.ndarray | float) -> np.ndarray:
        """Values on the axis."""
        return (np.asarray(values, dtype=float) - self.origin) * self.factor


def scale_of(trend: CoefficientTrend) -> _TrendScale:
    """A round origin near the values, and micro-units (ppm of it for the scale factor)."""
    values = np.array([point.value for point in trend.points])
    spread = max(float(np.ptp(values)), *(point.own for point in trend.points)) or abs(float(values[0])) or 1.0
    place = -math.floor(math.log10(spread))
    origin = round(float(np.median(values)), place)
    if trend.key == "scale_factor" and origin:
        return _TrendScale(origin, 1e6 / origin, f"scale_factor / {fixed(origin, max(place, 0))} − 1", "ppm")
    unit = {"1": "10⁻⁶", "1/K": "10⁻⁶/K"}.get(trend.unit) or pretty_unit(f"u{trend.unit}")
    shown = fixed(origin * 1e6, max(place - 6, 0))
    quantity = f"{trend.key} − {shown}" if origin > 0 else f"{trend.key} + {shown.lstrip('−')}"
    return _TrendScale(origin, 1e6, quantity if origin else trend.key, unit)


DATE = Axis("date", "", dates=True)
"""The time axis: calendar dates, UTC."""


def _dates(start: dt.datetime, years: np.ndarray | float) -> np.ndarray:
    return start.timestamp() / DAY + np.asarray(years, dtype=float) * YEAR / DAY


def trend_figure(drifts: Trend, trend: CoefficientTrend, ahead: float | None = None) -> Figure:
    """Values and control chart of one coefficient; ``ahead`` is the time of the forecast in years since the start."""
    plot = Plot(f"trend-{trend.key.replace('_', '-')}", f"{trend.key} over time.", height=2.7)
    _add_values(plot, trend, drifts.start, ahead)
    if np.isfinite(trend.chart.score).any():
        _add_control(plot, trend, drifts.start)
    return plot.caption(
        "Above, the values with the 95 % interval of each record's own uncertainty, the line through the "
        "days, and the band in which a further record is expected. Below, how far each day lies from what the days "
        "before forecast, and the moving average of these scores. Good: points in the band, scores within ±3, "
        "the average within its own limits."
    )


def _add_values(plot: Plot, trend: CoefficientTrend, start: dt.datetime, ahead: float | None) -> None:
    scale = scale_of(trend)
    plot.panel(DATE, Axis(scale.quantity, scale.unit), trend.key)
    if trend.model.line is not None:
        grid = np.linspace(trend.points[0].time, max(float(trend.points[-1].time), ahead or 0.0), _GRID)
        further = [trend.next_record(float(time)) for time in grid]
        middle = scale.shown(np.array([forecast.value for forecast in further]))
        half = np.array([forecast.half_width() for forecast in further]) * scale.factor
        x = _dates(start, grid)
        plot.band(x, middle - half, middle + half, "95 % of further records").line(x, middle, "line", "model")
    kinds: tuple[tuple[str, Role, bool], ...] = (
        ("records", "data", False),
        ("out of control", "warning", True),
    )
    for name, role, outside in kinds:
        those = [point for point in trend.points if point.outside == outside]
        if those or not outside:
            plot.points(
                _dates(start, np.array([point.time for point in those])),
                scale.shown(np.array([point.value for point in those])),
                name,
                role,
                error=np.array([point.own_half_width for point in those]) * scale.factor,
                text=tuple(point.record for point in those),
            )
    if ahead is not None and trend.model.line is not None:
        forecast = trend.coefficient_at(ahead)
        at, value = _dates(start, ahead), scale.shown(forecast.value)
        error = [forecast.half_width() * scale.factor]
        plot.points([at], [value], "forecast of the coefficient", "after", error=error)


def _add_control(plot: Plot, trend: CoefficientTrend, start: dt.datetime) -> None:
    chart, limit = trend.chart, CONTROL_LIMIT
    seen = np.isfinite(chart.score)
    x = _dates(start, chart.time[seen])
    ends = x[[0, -1]] if x.size > 1 else x[[0, 0]] + np.array([-0.5, 0.5])
    plot.panel(DATE, "deviation from the forecast [std]", "Control chart")
    plot.points(x, chart.score[seen], "score of a day").line(x, chart.average[seen], "moving average", "model")
    plot.dashed(x, chart.limit[seen], "limit of the average", "model").dashed(
        x, -chart.limit[seen], "", "model"
    )
    plot.level(ends, limit, "limit of a score", "warning").level(ends, -limit, "", "warning")


def figures(drifts: Trend) -> dict[str, Callable[[], Figure]]:
    """The figure of each coefficient by its key; the first one also by no key."""
    by_key: dict[str, Callable[[], Figure]] = {
        trend.key: partial(trend_figure, drifts, trend) for trend in drifts.coefficients
    }
    return by_key | {"": next(iter(by_key.values()))}


def page(drifts: Trend, at: dt.datetime | None = None) -> Page:
    """Alarms first, then stability and drift of each coefficient, with a forecast for ``at`` where it is given."""
    ahead = None if at is None else drifts.years(at)
    span = drifts.years(drifts.times[-1])
    alarms = [Notice("problem", printed(alarm)) for alarm in drifts.alarms]
    remarks = (Notice("warning", printed(remark)) for remark in drifts.remarks)
    judged = (*(alarms or [Notice("good", "No record is out of control.")]), *remarks)
    sections = [
        Section("Judgement", "judgement", judged),
        Section("Stability and drift", "stability", (_LEAD, _summary_table(drifts, at))),
    ]
    sections += [_section(drifts, trend, ahead) for trend in drifts.coefficients]
    return Page(
        title=f"Trend of {drifts.serial}",
        subtitle=f"{len(drifts.records)} records from {drifts.times[0]:%Y-%m-%d} to {drifts.times[-1]:%Y-%m-%d}.",
        tiles=_tiles(drifts, span),
        sections=tuple(sections),
        kicker="piga · trend",
    )


def brief(drifts: Trend, at: dt.datetime | None = None) -> Page:
    """Alarms, remarks, stability and drift for terminal and notebook, and the figure of the first coefficient."""
    short = page(drifts, at).only("judgement", "stability")
    drawn = tuple(partial(trend_figure, drifts, trend) for trend in drifts.coefficients[:1])
    return replace(short, sections=(*short.sections, Section("", "first", drawn)))


_LEAD = (
    "Turn-on is the scatter inside a day, day to day the scatter between days, each beyond the records' own "
    "uncertainties; drift is the line through the days. Intervals are for 95 %, by Student's t. Errors that all "
    "records share (the same standard) cancel in drift and scatter, and are part of the value and its forecast."
)


def _tiles(drifts: Trend, span: float) -> tuple[Tile, ...]:
    days = len({point.day for point in drifts.coefficients[0].points}) if drifts.coefficients else 0
    drifting = [t.key for t in drifts.coefficients if t.drift and abs(t.drift.value) > t.drift.half_width()]
    count = len(drifts.alarms)
    period = fixed(span, 1) if span >= 1.0 else f"{span * 365.25:.0f}"
    return (
        Tile("Records", str(len(drifts.records)), "", "on 1 day" if days == 1 else f"on {days} days"),
        Tile("Span", period, "years" if span >= 1.0 else "days"),
        Tile("Alarms", str(count), "", "see below" if count else "all in control", "bad" if count else "good"),
        Tile(
            "Coefficients that drift",
            str(len(drifting)),
            f"of {len(drifts.coefficients)}",
            ", ".join(drifting) or "none beyond its uncertainty",
            "doubtful" if drifting else "good",
        ),
    )


def _summary_table(drifts: Trend, at: dt.datetime | None = None) -> Table:
    table = (
        TableOf(drifts.coefficients)
        .text("Coefficient", lambda trend: trend.key)
        .text("Unit", lambda trend: pretty_unit(shown_unit(trend.key, trend.unit)[1]) or "1")
        .number("On the last day", _last_day)
        .number("Turn-on", lambda trend: short(trend.turn_on * _scale(trend), 2), "std")
        .number("Day to day", lambda trend: short(trend.day_to_day * _scale(trend), 2), "std")
        .number("Drift per year", _drift)
    )
    if at is not None:
        years = drifts.years(at)
        table.number(f"Forecast for {at:%Y-%m-%d}", lambda trend: _at(trend, years) or "–")
    return table.table()


def _scale(trend: CoefficientTrend) -> float:
    return shown_unit(trend.key, trend.unit)[0]


def _at(trend: CoefficientTrend, years: float) -> str:
    """Value on the line with its interval; empty without a line."""
    return _interval(trend.coefficient_at(years), _scale(trend)) if trend.model.line else ""


def _last_day(trend: CoefficientTrend) -> str:
    point, scale = trend.points[-1], _scale(trend)
    return _at(trend, point.time) or rounded(point.value * scale, point.expanded * scale).interval


def _drift(trend: CoefficientTrend) -> str | Cell:
    drift = trend.drift
    if drift is None:
        return "–"
    clear = abs(drift.value) > drift.half_width()
    return Cell(_interval(drift, _scale(trend)), "doubtful" if clear else "")


def _interval(forecast: Forecast, scale: float) -> str:
    return rounded(forecast.value * scale, forecast.half_width() * scale).interval


def _section(drifts: Trend, trend: CoefficientTrend, ahead: float | None) -> Section:
    figure = partial(trend_figure, drifts, trend, ahead)
    lead = f"{meaning_of(trend.key)[:1].upper()}{meaning_of(trend.key)[1:]}."
    anchor = f"coefficient-{trend.key.replace('_', '-')}"
    return Section(trend.key, anchor, (lead, figure, _record_table(drifts, trend)))


def _record_table(drifts: Trend, trend: CoefficientTrend) -> Table:
    scale, unit = shown_unit(trend.key, trend.unit)
    shown = pretty_unit(unit)
    caption = "Records, each with the forecast from earlier records. A forecast needs three earlier days."
    dated = list(zip(trend.points, drifts.times, strict=True))
    return (
        TableOf(dated)
        .text("Record", lambda row: row[0].record)
        .number("Date", lambda row: f"{row[1]:%Y-%m-%d\u00a0%H:%M}")
        .number("Value", lambda row: rounded(row[0].value * scale, row[0].std * scale).value, shown)
        .number("u without the shared part", lambda row: short(row[0].own * scale, 2), shown)
        .number("u", lambda row: short(row[0].std * scale, 2), shown)
        .number("U (95 %)", lambda row: short(row[0].expanded * scale, 2), shown)
        .number(
            "Forecast ± 95 %",
            lambda row: "–" if row[0].forecast is None else _interval(row[0].forecast, scale),
            shown,
        )
        .number("Score", lambda row: _score(row[0]))
        .table(caption)
    )


def _score(point: Point) -> Cell:
    score = "–" if point.forecast is None else signed(point.score, 1)
    return Cell(score, "bad" if point.outside else "")


def trend_document(drifts: Trend, *, at: dt.datetime | None = None) -> dict[str, Any]:
    """The trend as plain JSON values, in file units; nan becomes null."""
    return {
        "schema": "piga.trend/1",
        "serial": drifts.serial,
        "start": drifts.times[0].isoformat(),
        "alarms": list(drifts.alarms),
        "remarks": list(drifts.remarks),
        "coefficients": [_coefficient_document(drifts, trend, at) for trend in drifts.coefficients],
    }


def _coefficient_document(drifts: Trend, trend: CoefficientTrend, at: dt.datetime | None) -> dict[str, Any]:
    line = trend.model.line
    return {
        "name": trend.key,
        "unit": trend.unit,
        "turn_on_std": finite(trend.turn_on),
        "day_to_day_std": finite(trend.day_to_day),
        "drift_per_year": _forecast_document(trend.drift),
        "forecast": None if at is None or line is None else _dated(trend.coefficient_at(drifts.years(at)), at),
        "next_record": None if at is None or line is None else _dated(trend.next_record(drifts.years(at)), at),
        "records": [
            {
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
            for point, time in zip(trend.points, drifts.times, strict=True)
        ],
    }


def _dated(forecast: Forecast, at: dt.datetime) -> dict[str, Any]:
    return {"date": at.isoformat(), **(_forecast_document(forecast) or {})}


def _forecast_document(forecast: Forecast | None) -> dict[str, Any] | None:
    if forecast is None:
        return None
    return {
        "value": forecast.value,
        "std": forecast.std,
        "degrees_of_freedom": finite(forecast.degrees_of_freedom),
        "half_width_95": forecast.half_width(),
    }
