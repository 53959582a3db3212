"""Figures on the screen: data and layout for plotly.js, small enough for a page."""

from __future__ import annotations

import html
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from piga.reports.render.decimate import envelope_rows
from piga.reports.render.figure import GRID, INK, LIGHT, SOFT, Axis, Figure, Panel, Series
from piga.reports.render.scene import rows_and_columns, series_key, shares_x

_PIXELS_PER_INCH = 96
_GAP_X, _GAP_Y, _GAP_TITLED = 0.11, 0.11, 0.22
_DIGITS = 6
_DAY = 86.4e6
"""Milliseconds of a day: plotly.js counts dates in them since 1970-01-01."""


def figure_spec(figure: Figure) -> dict[str, Any]:
    """The figure as a plotly.js document: ``data``, ``layout``, ``narrow`` (layout changes for a phone) and ``single``.

    ``single`` are the curves of single segments; their ``meta`` is the index of the segment. The ``meta`` of another
    trace is the index of the segment of each of its points.

    The traces carry the names of :func:`piga.reports.render.scene.series_key` as ``uid``. Numbers keep six
    significant digits of their own spread; the values shown under the pointer carry their units.
    """
    traces, single, layout, shown = [], [], _layout(figure), set()
    for index, panel in enumerate(figure.panels):
        for order, series in enumerate(panel.series):
            trace = _trace(series, panel, suffix=_suffix(index))
            trace["uid"] = series_key(figure, index, order)
            trace["showlegend"] = bool(series.name) and series.name not in shown
            shown.add(series.name)
            traces += [*_band_base(trace, series), trace]
        single += [
            _trace(series, panel, suffix=_suffix(index))
            | {"meta": segment, "uid": f"{figure.key}-single-{index}"}
            for segment, series in panel.of_segments
        ]
    return {"data": traces, "layout": layout, "narrow": _narrow(figure), "single": single}


def _suffix(index: int) -> str:
    return "" if index == 0 else str(index + 1)


def _text(text: str) -> str:
    """Text as plotly.js shows it: it reads a little HTML, which data must not write."""
    return html.escape(text, quote=False)


def _numbers(values: ArrayLike) -> list[float | None]:
    """JSON numbers with six digits of the values' spread; gaps are ``null``."""
    array = np.asarray(values, dtype=float)
    finite = array[np.isfinite(array)]
    if finite.size == 0:
        return [None] * array.size
    spread = float(np.ptp(finite)) or float(np.max(np.abs(finite))) or 1.0
    decimals = _DIGITS - 1 - math.floor(math.log10(spread))
    return [round(number, decimals) if math.isfinite(number) else None for number in array.tolist()]


def _logarithmic(values: ArrayLike) -> list[float | None]:
    return [
        float(f"{v:.{_DIGITS}g}") if math.isfinite(v) else None
        for v in np.asarray(values, dtype=float).tolist()
    ]


def _on(axis: Axis, values: ArrayLike) -> list[float | None]:
    if axis.dates:
        return _numbers(np.asarray(values, dtype=float) * _DAY)
    return _logarithmic(values) if axis.log else _numbers(values)


def _trace(series: Series, panel: Panel, suffix: str) -> dict[str, Any]:
    x, y = series.arrays()
    rows = envelope_rows(y)
    colour = LIGHT[series.role]
    trace: dict[str, Any] = {
        "x": _on(panel.x, x[rows]),
        "y": _on(panel.y, (y if series.upper is None else np.asarray(series.upper, dtype=float))[rows]),
        "xaxis": f"x{suffix}",
        "yaxis": f"y{suffix}",
        "name": _text(series.name),
        "legendgroup": _text(series.name),
        "hovertemplate": _hover(series, panel),
    }
    if series.rows is not None:
        trace["customdata"] = np.asarray(series.rows)[rows].astype(int).tolist()
    if series.segments is not None:
        trace["meta"] = np.asarray(series.segments)[rows].astype(int).tolist()
    if series.text is not None:
        trace["text"] = [_text(series.text[row]) for row in rows]
    if series.role == "muted" and not series.name:
        trace["hoverinfo"] = "skip"
        del trace["hovertemplate"]
    if series.error is not None:
        error = np.asarray(series.error, dtype=float)[rows]
        trace["error_y"] = {"array": _logarithmic(error), "color": colour, "thickness": 1, "width": 2}
    return trace | _look(series, colour)


def _look(series: Series, colour: str) -> dict[str, Any]:
    if series.mark == "bars":
        return {"type": "bar", "marker": {"color": colour}}
    line: dict[str, Any] = {"color": colour, "width": 1.0 if series.role == "muted" else 1.5}
    if series.dashed:
        line["dash"] = "dash"
    if series.mark == "steps":
        line["shape"] = "hvh"
    if series.mark == "band":
        line["width"] = 0
        return {"type": "scatter", "mode": "lines", "line": line, "fill": "tonexty", "fillcolor": f"{colour}2e"}
    mode = {"points": "markers", "line+points": "lines+markers"}.get(series.mark, "lines")
    return {"type": "scatter", "mode": mode, "line": line, "marker": {"color": colour, "size": 5}}


def _band_base(trace: dict[str, Any], series: Series) -> list[dict[str, Any]]:
    """Lower edge of a band: the filled trace lies on it."""
    if series.mark != "band":
        return []
    rows = envelope_rows(series.y)
    lower = trace | {
        "y": _numbers(np.asarray(series.y, dtype=float)[rows]),
        "fill": "none",
        "showlegend": False,
    }
    return [lower | {"uid": f"{trace['uid']}-lower", "hoverinfo": "skip", "hovertemplate": ""}]


def _hover(series: Series, panel: Panel) -> str:
    def value(axis: Axis, letter: str) -> str:
        if axis.dates:
            return f"{_text(axis.quantity)} %{{{letter}|%Y-%m-%d %H:%M}} UTC"
        unit = "" if axis.unit in ("", "1") else f" {_text(axis.unit)}"
        return f"{_text(axis.quantity)} %{{{letter}:.5~g}}{unit}"

    lines = [f"<b>{_text(series.name)}</b>"] if series.name else []
    lines += ["%{text}"] if series.text is not None else []
    return "<br>".join([*lines, value(panel.x, "x"), value(panel.y, "y")]) + "<extra></extra>"


def _axis(axis: Axis, *, title: bool) -> dict[str, Any]:
    spec: dict[str, Any] = {
        "title": {"text": _text(axis.label) if title else "", "standoff": 6, "font": {"size": 12}},
        "tickfont": {"size": 11},
        "gridcolor": GRID,
        "linecolor": SOFT,
        "tickcolor": SOFT,
        "showline": True,
        "ticks": "outside",
        "ticklen": 4,
        "zeroline": False,
        "automargin": True,
        "exponentformat": "power",
        "minexponent": 5,
    }
    if axis.log:
        spec |= {"type": "log", "dtick": 1}
    if axis.dates:
        spec |= {"type": "date", "nticks": 7, "tickformatstops": _DATE_STOPS}
    if axis.limits is not None:
        low, high = axis.limits
        spec["range"] = [math.log10(low), math.log10(high)] if axis.log else [low, high]
    return spec


_DATE_STOPS = [
    {"dtickrange": [None, 60_000], "value": "%H:%M:%S"},
    {"dtickrange": [60_000, 86_400_000], "value": "%Y-%m-%d<br>%H:%M"},
    {"dtickrange": [86_400_000, "M1"], "value": "%Y-%m-%d"},
    {"dtickrange": ["M1", "M6"], "value": "%Y-%m"},
    {"dtickrange": ["M12", None], "value": "%Y"},
]
"""Forms of a date by the distance between ticks, in milliseconds or months (M)."""


def _row_gap(figure: Figure) -> float:
    """Share of the height between rows: more where axis labels and panel titles meet there."""
    titled = any(panel.title for panel in figure.panels[rows_and_columns(figure)[1] :])
    return _GAP_TITLED if titled and not shares_x(figure) else _GAP_Y


def _domains(rows: int, columns: int, index: int, gap: float = _GAP_Y) -> tuple[list[float], list[float]]:
    row, column = divmod(index, columns)
    gap_x, gap_y = (_GAP_X if columns > 1 else 0.0), (gap if rows > 1 else 0.0)
    wide, tall = (1.0 - gap_x * (columns - 1)) / columns, (1.0 - gap_y * (rows - 1)) / rows
    left, top = column * (wide + gap_x), 1.0 - row * (tall + gap_y)
    return [round(left, 4), round(left + wide, 4)], [round(max(top - tall, 0.0), 4), round(top, 4)]


def _layout(figure: Figure) -> dict[str, Any]:
    rows, columns = rows_and_columns(figure)
    layout: dict[str, Any] = {
        "height": round(figure.height * rows * _PIXELS_PER_INCH + 40),
        "margin": {"l": 64, "r": 12, "t": 44, "b": 48},
        "font": {"family": "system-ui, sans-serif", "size": 13, "color": INK},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "hovermode": "closest",
        "separators": ".\u202f",
        "legend": {"orientation": "h", "x": 0, "y": 1.02, "xanchor": "left", "yanchor": "bottom"},
        "annotations": [],
    }
    gap = _row_gap(figure)
    for index, panel in enumerate(figure.panels):
        domains = _domains(rows, columns, index, gap)
        _place_panel(layout, figure, index, domains)
        if panel.title:
            layout["annotations"].append(_panel_title(panel.title, domains))
            layout["margin"]["t"] = 70
            layout["legend"]["y"] = 1.09
    return layout


def _place_panel(
    layout: dict[str, Any], figure: Figure, index: int, domains: tuple[list[float], list[float]]
) -> None:
    panel, suffix, shared = figure.panels[index], _suffix(index), shares_x(figure)
    last = index == len(figure.panels) - 1
    x = _axis(panel.x, title=not shared or last) | {"domain": domains[0], "anchor": f"y{suffix}"}
    y = _axis(panel.y, title=True) | {"domain": domains[1], "anchor": f"x{suffix}"}
    if shared and not last:
        x |= {"matches": f"x{_suffix(len(figure.panels) - 1)}", "showticklabels": False}
    if panel.equal:
        y |= {"scaleanchor": f"x{suffix}", "constrain": "domain"}
        x |= {"constrain": "domain", "nticks": 6}
    layout |= {f"xaxis{suffix}": x, f"yaxis{suffix}": y}


def _panel_title(title: str, domains: tuple[list[float], list[float]]) -> dict[str, Any]:
    place = {"x": domains[0][0], "y": domains[1][1], "xref": "paper", "yref": "paper"}
    look = {"showarrow": False, "xanchor": "left", "yanchor": "bottom", "font": {"size": 13}}
    return {"text": f"<b>{_text(title)}</b>"} | place | look


def _narrow(figure: Figure) -> dict[str, Any]:
    """Layout changes where the page is narrow: panels below each other, smaller letters and margins."""
    count = len(figure.panels)
    changes: dict[str, Any] = {
        "font.size": 11,
        "margin.l": 50,
        "margin.r": 6,
        "height": round((3.3 if any(p.equal for p in figure.panels) else 2.9) * count * _PIXELS_PER_INCH + 60),
    }
    if rows_and_columns(figure)[1] == 1:
        return changes
    titled = iter(range(count))
    for index, panel in enumerate(figure.panels):
        x, y = _domains(count, 1, index)
        changes |= {f"xaxis{_suffix(index)}.domain": x, f"yaxis{_suffix(index)}.domain": y}
        if panel.title:
            note = f"annotations[{next(titled)}]"
            changes |= {f"{note}.x": x[0], f"{note}.y": y[1]}
    return changes
