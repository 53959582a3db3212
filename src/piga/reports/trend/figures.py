"""Figures of a trend: values with line, band and forecast; control chart below."""

from __future__ import annotations

import datetime as dt
import math
from dataclasses import dataclass

import numpy as np

from piga.reports.render.figure import Axis, Figure, Panel, Series
from piga.reports.render.numbers import fixed, pretty_unit
from piga.trend.history import YEAR, CoefficientTrend, Trend
from piga.trend.trend_line import LIMIT, Forecast

_GRID = 80


@dataclass(frozen=True)
class Scale:
    """How values of a coefficient are drawn: ``(value - origin) * factor`` in ``unit``, named ``quantity``."""

    origin: float
    factor: float
    quantity: str
    unit: str

    def shown(self, values: np.ndarray | float) -> np.ndarray:
        """Values on the axis."""
        return (np.asarray(values, dtype=float) - self.origin) * self.factor


def scale_of(trend: CoefficientTrend) -> Scale:
    """A round origin near the values, and micro-units (ppm of it for the scale factor)."""
    values = np.array([point.value for point in trend.points])
    spread = max(float(np.ptp(values)), *(point.own for point in trend.points)) or abs(float(values[0])) or 1.0
    place = -math.floor(math.log10(spread))
    origin = round(float(np.median(values)), place)
    if trend.key == "scale_factor" and origin:
        return Scale(origin, 1e6 / origin, f"scale_factor / {fixed(origin, max(place, 0))} − 1", "ppm")
    unit = {"1": "10⁻⁶", "1/K": "10⁻⁶/K"}.get(trend.unit) or pretty_unit(f"u{trend.unit}")
    shown = fixed(origin * 1e6, max(place - 6, 0)).replace("-", "−")
    quantity = f"{trend.key} − {shown}" if origin > 0 else f"{trend.key} + {shown.lstrip('−')}"
    return Scale(origin, 1e6, quantity if origin else trend.key, unit)


DATE = Axis("date", "", dates=True)
"""The time axis: calendar dates, UTC."""


def _dates(start: dt.datetime, years: np.ndarray | float) -> np.ndarray:
    """Positions on the axis of times in years since the start."""
    return start.timestamp() / 86400.0 + np.asarray(years, dtype=float) * YEAR / 86400.0


def trend_figure(found: Trend, trend: CoefficientTrend, ahead: float | None) -> Figure:
    """Values and control chart of one coefficient; ``ahead`` is the time of the forecast in years since the start."""
    start, scale = found.start, scale_of(trend)
    panels = [_values(trend, start, scale, ahead)]
    if np.isfinite(trend.chart.score).any():
        panels.append(_control(trend, start))
    return Figure(
        f"trend-{trend.key.replace('_', '-')}",
        f"{trend.key} over time.",
        tuple(panels),
        caption="Above, the values with the 95 % interval of each record's own uncertainty, the line through the "
        "days, and the band in which a further record is expected. Below, how far each day lies from what the days "
        "before let expect, and the moving average of these scores. Good: points in the band, scores within ±3, "
        "the average within its own limits.",
        height=2.7,
    )


def _values(trend: CoefficientTrend, start: dt.datetime, scale: Scale, ahead: float | None) -> Panel:
    times = np.array([point.time for point in trend.points])
    values = np.array([point.value for point in trend.points])
    bars = np.array([point.own_half_width for point in trend.points]) * scale.factor
    outside = np.array([point.outside for point in trend.points])
    series: list[Series] = []
    if trend.model.line is not None:
        series += _line(trend, start, scale, max(float(times[-1]), ahead or 0.0))
    names = tuple(point.record for point in trend.points)
    series.append(_points(start, scale, times, values, bars, ~outside, names, alarm=False))
    if outside.any():
        series.append(_points(start, scale, times, values, bars, outside, names, alarm=True))
    if ahead is not None and trend.model.line is not None:
        forecast = trend.model.coefficient_at(ahead)
        series.append(
            Series(
                np.atleast_1d(_dates(start, ahead)),
                np.atleast_1d(scale.shown(forecast.value)),
                "forecast of the coefficient",
                mark="points",
                role="after",
                error=np.array([forecast.half_width() * scale.factor]),
            )
        )
    return Panel(DATE, Axis(scale.quantity, scale.unit), tuple(series), title=trend.key)


def _points(
    start: dt.datetime,
    scale: Scale,
    times: np.ndarray,
    values: np.ndarray,
    bars: np.ndarray,
    chosen: np.ndarray,
    names: tuple[str, ...],
    *,
    alarm: bool,
) -> Series:
    return Series(
        _dates(start, times[chosen]),
        scale.shown(values[chosen]),
        "out of control" if alarm else "records",
        mark="points",
        role="warning" if alarm else "data",
        error=bars[chosen],
        text=tuple(name for name, one in zip(names, chosen, strict=True) if one),
    )


def _line(trend: CoefficientTrend, start: dt.datetime, scale: Scale, last: float) -> list[Series]:
    grid = np.linspace(trend.points[0].time, last, _GRID)
    further: list[Forecast] = [trend.next_record(float(time)) for time in grid]
    middle = scale.shown(np.array([forecast.value for forecast in further]))
    half = np.array([forecast.half_width() for forecast in further]) * scale.factor
    x = _dates(start, grid)
    return [
        Series(x, middle - half, "95 % of further records", mark="band", role="muted", upper=middle + half),
        Series(x, middle, "line", role="model"),
    ]


def _control(trend: CoefficientTrend, start: dt.datetime) -> Panel:
    chart = trend.chart
    seen = np.isfinite(chart.score)
    x = _dates(start, chart.time[seen])
    ends = x[[0, -1]] if x.size > 1 else x[[0, 0]] + np.array([-0.5, 0.5])
    series = [
        Series(x, chart.score[seen], "score of a day", mark="points", role="data"),
        Series(x, chart.average[seen], "moving average", role="model"),
        Series(x, chart.limit[seen], "limit of the average", role="model", dashed=True),
        Series(x, -chart.limit[seen], "", role="model", dashed=True),
        Series(ends, [LIMIT, LIMIT], "limit of a score", role="warning", dashed=True),
        Series(ends, [-LIMIT, -LIMIT], "", role="warning", dashed=True),
    ]
    return Panel(DATE, Axis("deviation from the forecast", "std"), tuple(series), title="Control chart")
