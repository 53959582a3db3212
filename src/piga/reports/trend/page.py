"""The page and the text of a trend: stability, drift, control chart, forecast."""

from __future__ import annotations

import datetime as dt
import math
import re
from pathlib import Path
from typing import Any

from piga._version import __version__
from piga.records.terms import meaning_of, shown_unit
from piga.reports.render.numbers import fixed, pretty_unit, printed, rounded, short, signed
from piga.reports.render.page import (
    Block,
    Cell,
    Column,
    FigureBlock,
    Notice,
    Page,
    Section,
    Table,
    Text,
    Tile,
    write_page,
)
from piga.reports.trend.figures import trend_figure
from piga.trend.history import CoefficientTrend, Trend
from piga.trend.trend_line import Forecast


def write_trend_report(found: Trend, path: Path, *, at: dt.datetime | None = None) -> Path:
    """Write the page as one HTML file that opens offline; ``at`` is the date of the forecast."""
    return write_page(trend_page(found, at=at), path)


def trend_page(found: Trend, *, at: dt.datetime | None = None) -> Page:
    """Alarms first, then stability and drift of each coefficient, with a forecast for ``at`` where it is given."""
    ahead = None if at is None else found.years(at)
    span = found.years(found.times[-1])
    blocks: list[Block] = [Notice("problem", alarm) for alarm in found.alarms]
    blocks = blocks or [Notice("good", "No record is out of control.")]
    blocks += [Notice("warning", remark) for remark in found.remarks]
    sections = [
        Section("Judgement", "judgement", tuple(blocks)),
        Section("Stability and drift", "stability", (Text(_LEAD, lead=True), summary_table(found, at))),
    ]
    sections += [_section(found, trend, ahead) for trend in found.coefficients]
    return Page(
        title=f"Trend of {found.serial}",
        subtitle=f"{len(found.records)} records from {found.times[0]:%Y-%m-%d} to {found.times[-1]:%Y-%m-%d}.",
        tiles=_tiles(found, span),
        sections=tuple(sections),
        kicker="piga · trend",
        footer=f"Made by piga {__version__}. This file holds all it shows: it opens without a network, and prints on A4.",
    )


_LEAD = (
    "Turn-on is what scatters inside a day, day to day what scatters between days, each beyond the records' own "
    "uncertainties; drift is the line through the days. Intervals are for 95 %, by Student's t. Errors that all "
    "records share (the same standard) cancel in drift and scatter, and are part of the value and its forecast."
)


def _tiles(found: Trend, span: float) -> tuple[Tile, ...]:
    days = len({point.day for point in found.coefficients[0].points}) if found.coefficients else 0
    drifting = [t.key for t in found.coefficients if t.drift and abs(t.drift.value) > t.drift.half_width()]
    count = len(found.alarms)
    period = f"{fixed(span, 1)}" if span >= 1.0 else f"{span * 365.25:.0f}"
    return (
        Tile("Records", str(len(found.records)), "", f"on {days} days"),
        Tile("Span", period, "years" if span >= 1.0 else "days"),
        Tile("Alarms", str(count), "", "see below" if count else "all in control", "bad" if count else "good"),
        Tile(
            "Coefficients that drift",
            str(len(drifting)),
            f"of {len(found.coefficients)}",
            ", ".join(drifting) or "none beyond its uncertainty",
            "doubtful" if drifting else "good",
        ),
    )


def summary_table(found: Trend, at: dt.datetime | None = None) -> Table:
    """One row per coefficient: value on the last day, stability, drift, forecast."""
    columns = [
        Column("Coefficient", align="text"),
        Column("Unit", align="text"),
        Column("On the last day"),
        Column("Turn-on", "std"),
        Column("Day to day", "std"),
        Column("Drift per year"),
    ]
    if at is not None:
        columns.append(Column(f"Forecast for {at:%Y-%m-%d}"))
    rows = [_summary_row(found, trend, at) for trend in found.coefficients]
    return Table(tuple(columns), tuple(rows))


def _summary_row(found: Trend, trend: CoefficientTrend, at: dt.datetime | None) -> tuple[str | Cell, ...]:
    scale, unit = shown_unit(trend.key, trend.unit)
    last = trend.points[-1].time
    row: list[str | Cell] = [
        trend.key,
        pretty_unit(unit) or "1",
        _interval(trend.model.coefficient_at(last), scale) if trend.model.line else _plain(trend, scale),
        _spread(trend.turn_on * scale),
        _spread(trend.day_to_day * scale),
    ]
    drift = trend.drift
    if drift is None:
        row.append("–")
    else:
        clear = abs(drift.value) > drift.half_width()
        row.append(Cell(_interval(drift, scale), "doubtful" if clear else ""))
    if at is not None:
        row.append(_interval(trend.model.coefficient_at(found.years(at)), scale) if trend.model.line else "–")
    return tuple(row)


def _plain(trend: CoefficientTrend, scale: float) -> str:
    point = trend.points[-1]
    return _with_interval(point.value * scale, point.coverage.half_width * scale)


def _interval(forecast: Forecast, scale: float) -> str:
    return _with_interval(forecast.value * scale, forecast.half_width() * scale)


def _with_interval(value: float, half: float) -> str:
    """``value ± half``, a power of ten written once."""
    number = rounded(value, half)
    if not number.exponent:
        return f"{printed(number.value)} ± {printed(number.uncertainty)}"
    mantissa, spread = (text.partition("e")[0] for text in (number.value, number.uncertainty))
    power = printed(f"1e{number.exponent}").removeprefix("1")
    return f"({printed(mantissa)} ± {spread}){power}"


def _spread(value: float) -> str:
    return "–" if math.isnan(value) else printed(short(value, 2))


def _section(found: Trend, trend: CoefficientTrend, ahead: float | None) -> Section:
    figure = FigureBlock(trend_figure(found, trend, ahead))
    lead = Text(f"{meaning_of(trend.key)[:1].upper()}{meaning_of(trend.key)[1:]}.", lead=True)
    anchor = f"coefficient-{trend.key.replace('_', '-')}"
    return Section(trend.key, anchor, (lead, figure, record_table(found, trend)))


def record_table(found: Trend, trend: CoefficientTrend) -> Table:
    """Every record with what was expected of it."""
    scale, unit = shown_unit(trend.key, trend.unit)
    shown = pretty_unit(unit)
    columns = (
        Column("Record", align="text"),
        Column("Date"),
        Column("Value", shown),
        Column("u, own part", shown),
        Column("u, whole", shown),
        Column("95 %, whole", shown),
        Column("Expected ± 95 %", shown),
        Column("Score"),
    )
    rows: list[tuple[str | Cell, ...]] = []
    for point, time in zip(trend.points, found.times, strict=True):
        number = rounded(point.value * scale, point.std * scale)
        expected = "–" if point.forecast is None else _interval(point.forecast, scale)
        score = "–" if point.forecast is None else printed(signed(point.score, 1))
        rows.append(
            (
                point.record,
                f"{time:%Y-%m-%d\u00a0%H:%M}",
                printed(number.value),
                printed(short(point.own * scale, 2)),
                printed(short(point.std * scale, 2)),
                printed(short(point.coverage.half_width * scale, 2)),
                expected,
                Cell(score, "bad" if point.outside else ""),
            )
        )
    return Table(columns, tuple(rows), "Records: an expectation needs three earlier days.")


def trend_text(found: Trend, *, at: dt.datetime | None = None) -> str:
    """Summary for the terminal."""
    table = summary_table(found, at)
    lines = [[column.heading for column in table.columns]]
    lines += [[_ascii(cell.text) for cell in row] for row in table.cells]
    width = [max(len(line[column]) for line in lines) for column in range(len(table.columns))]
    head = f"Trend of {found.serial}: {len(found.records)} records, {found.times[0]:%Y-%m-%d} to {found.times[-1]:%Y-%m-%d}"
    body = [
        "  "
        + "  ".join(
            text.ljust(w) if i < 2 else text.rjust(w)
            for i, (text, w) in enumerate(zip(line, width, strict=True))
        )
        for line in lines
    ]
    alarms = [f"alarm: {alarm}" for alarm in found.alarms] or ["no alarm"]
    remarks = [f"note: {remark}" for remark in found.remarks]
    return "\n".join([head, "", *(line.rstrip() for line in body), "", *alarms, *remarks])


_ASCII = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹−–µ", "-0123456789--u")


def _ascii(text: str) -> str:
    """A line of a table for any terminal."""
    plain = re.sub(r"\s×\s10", "e", text).replace("±", "+-").replace("²", "^2").replace("³", "^3")
    return re.sub(r"[\u00a0\u202f]", "", plain).translate(_ASCII)


def trend_document(found: Trend, *, at: dt.datetime | None = None) -> dict[str, Any]:
    """The trend as plain JSON values, in file units; nan becomes null."""
    return {
        "schema": "piga.trend/1",
        "serial": found.serial,
        "start": found.times[0].isoformat(),
        "alarms": list(found.alarms),
        "remarks": list(found.remarks),
        "coefficients": [_coefficient_document(found, trend, at) for trend in found.coefficients],
    }


def _coefficient_document(found: Trend, trend: CoefficientTrend, at: dt.datetime | None) -> dict[str, Any]:
    line = trend.model.line
    return {
        "name": trend.key,
        "unit": trend.unit,
        "turn_on_std": _number(trend.turn_on),
        "day_to_day_std": _number(trend.day_to_day),
        "drift_per_year": _forecast_document(trend.drift),
        "forecast": None
        if at is None or line is None
        else _dated(trend.model.coefficient_at(found.years(at)), at),
        "next_record": None if at is None or line is None else _dated(trend.next_record(found.years(at)), at),
        "records": [
            {
                "record": point.record,
                "time": time.isoformat(),
                "value": point.value,
                "std": point.std,
                "half_width_95": point.coverage.half_width,
                "own_std": point.own,
                "own_half_width_95": point.own_half_width,
                "expected": _forecast_document(point.forecast),
                "score": _number(point.score),
                "out_of_control": point.outside,
            }
            for point, time in zip(trend.points, found.times, strict=True)
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
        "degrees_of_freedom": _number(forecast.degrees_of_freedom),
        "half_width_95": forecast.half_width(),
    }


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
