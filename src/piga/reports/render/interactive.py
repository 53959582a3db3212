"""Figures on the screen: data and layout for plotly.js, small enough for a page."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga.reports.render.figure import GRID, INK, LIGHT, SOFT, Axis, Figure, Panel, Series, bar_width

_PIXELS_PER_INCH = 96
_GAP_X, _GAP_Y = 0.2, 0.16
_BELOW, _ABOVE = 46, 34
"""Pixels that a row needs for its x axis below the panel and for a title above it."""
_DIGITS = 6
_MANY = 300.0
"""Ratio of the largest to the smallest value above which a logarithmic axis has whole decades only."""
_DAY = 86.4e6
"""Milliseconds of a day: plotly.js counts dates in them since 1970-01-01."""


def figure_spec(figure: Figure) -> dict[str, Any]:
    """The figure as a plotly.js document: ``data``, ``layout``, and ``narrow`` (layout changes for a phone).

    The ``meta`` of a trace is the index of the segment of each of its points. Numbers keep six significant digits of their
    own spread; the values shown under the pointer carry their units.
    """
    traces, shown = [], set()
    for index, panel in enumerate(figure.panels):
        for order, series in enumerate(panel.series):
            trace = _trace(series, panel, suffix=_suffix(index))
            trace["uid"] = f"{figure.key}-p{index}-s{order}"
            trace["showlegend"] = bool(series.name) and series.name not in shown
            shown.add(series.name)
            traces += [*_band_base(trace, series), trace]
    return {"data": traces, "layout": _layout(figure), "narrow": _narrow(figure)}


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
    colour, name = LIGHT[series.role], _text(series.name)
    trace: dict[str, Any] = {
        "x": _on(panel.x, x),
        "y": _on(panel.y, y if series.upper is None else series.upper),
        "xaxis": f"x{suffix}",
        "yaxis": f"y{suffix}",
        "name": name,
        "legendgroup": name,
    }
    silent = series.role == "muted" and not series.name
    trace |= {"hoverinfo": "skip"} if silent else {"hovertemplate": _hover(series, panel)}
    if series.segments is not None:
        trace["meta"] = np.asarray(series.segments).astype(int).tolist()
    text: Sequence[str] = [panel.x.names[round(place) - 1] for place in x if panel.x.names]
    text = text if series.text is None else series.text
    if len(text):
        trace["text"] = [_text(one) for one in text]
    if series.error is not None:
        trace["error_y"] = {"array": _logarithmic(series.error), "color": colour, "thickness": 1, "width": 2}
    return trace | _look(series, colour)


def _look(series: Series, colour: str) -> dict[str, Any]:
    if series.mark == "bars":
        return {
            "type": "bar",
            "marker": {"color": colour},
            "textposition": "none",
            "width": bar_width(series.x),
        }
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
    if series.mark != "band":
        return []
    lower = trace | {"y": _numbers(series.y), "fill": "none", "showlegend": False}
    return [lower | {"uid": f"{trace['uid']}-lower", "hoverinfo": "skip", "hovertemplate": ""}]


def _hover(series: Series, panel: Panel) -> str:
    def value(axis: Axis, letter: str) -> str:
        if axis.dates:
            return f"{_text(axis.quantity)} %{{{letter}|%Y-%m-%d %H:%M}} UTC"
        unit = "" if axis.unit in ("", "1") else f" {_text(axis.unit)}"
        return f"{_text(axis.quantity)} %{{{letter}:.5~g}}{unit}"

    lines = [f"<b>{_text(series.name)}</b>"] if series.name else []
    lines += ["%{text}"] if series.text is not None or panel.x.names else []
    lines += [] if panel.x.names else [value(panel.x, "x")]
    return "<br>".join([*lines, value(panel.y, "y")]) + "<extra></extra>"


def _log_ticks(series: Sequence[NDArray[np.float64]]) -> str | int:
    """Ticks of a logarithmic axis: 1, 2, 5 in each decade (``D2``), or whole decades if there are many."""
    values = np.concatenate([np.empty(0), *series])
    values = values[values > 0.0]
    return "D2" if values.size and values.max() < _MANY * values.min() else 1


_AXIS: dict[str, Any] = {
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
"""Look of an axis."""


def _axis(axis: Axis, series: Sequence[NDArray[np.float64]], *, title: bool) -> dict[str, Any]:
    text = {"text": _text(axis.label) if title else "", "standoff": 6, "font": {"size": 12}}
    spec: dict[str, Any] = {"title": text, **_AXIS}
    if axis.log:
        spec |= {"type": "log", "dtick": _log_ticks(series)}
    if axis.dates:
        spec |= {"type": "date", "nticks": 7}
    if axis.names:
        places, names = list(range(1, len(axis.names) + 1)), [_text(name) for name in axis.names]
        spec |= {"tickvals": places, "ticktext": names}
    if axis.limits is not None:
        spec["range"] = [math.log10(end) if axis.log else end for end in axis.limits]
    return spec


def _layout(figure: Figure) -> dict[str, Any]:
    """Layout with one cell of the grid for each panel. Panel titles stand above their panels, at the left."""
    rows, columns = figure.grid
    titles = [_title(panel, _suffix(index)) for index, panel in enumerate(figure.panels) if panel.title]
    height = _height(rows, figure.height)
    legend = {"orientation": "h", "x": 0, "xanchor": "left", "yanchor": "bottom"}
    layout: dict[str, Any] = {
        "height": height,
        "margin": {"l": 64, "r": 12, "t": 70 if titles else 44, "b": 48},
        "font": {"family": "system-ui, sans-serif", "size": 13, "color": INK},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "hovermode": "closest",
        "separators": ".\u202f",
        "legend": legend | {"y": _legend_place(figure, height)},
        "grid": _grid(figure, rows, columns),
        "annotations": titles,
    }
    last = _suffix(len(figure.panels) - 1)
    for index, panel in enumerate(figure.panels):
        suffix = _suffix(index)
        inside = figure.shares_x and suffix != last
        drawn = [series.arrays() for series in panel.series]
        x = _axis(panel.x, [x for x, _ in drawn], title=not inside) | {"anchor": f"y{suffix}"}
        y = _axis(panel.y, [y for _, y in drawn], title=True) | {"anchor": f"x{suffix}"}
        if inside:
            x |= {"matches": f"x{last}", "showticklabels": False}
        if panel.equal:
            y |= {"scaleanchor": f"x{suffix}", "constrain": "domain"}
            x |= {"constrain": "domain", "nticks": 6}
        layout |= {f"xaxis{suffix}": x, f"yaxis{suffix}": y}
    return layout


def _legend_place(figure: Figure, height: int) -> float:
    """The legend begins above the titles of the first row; a share of the height of the plots."""
    room = 24 if any(panel.title for panel in figure.panels) else 6
    return round(1.0 + room / (height - 110.0), 3)


def _height(rows: int, inches: float) -> int:
    return round(inches * rows * _PIXELS_PER_INCH + 40)


def _grid(figure: Figure, rows: int, columns: int) -> dict[str, Any]:
    """Cells of the panels, with room for the words between two rows."""
    titled = any(panel.title for panel in figure.panels)
    words = _BELOW * (not figure.shares_x) + _ABOVE * titled
    gap = max(_GAP_Y, words / (figure.height * _PIXELS_PER_INCH)) if rows > 1 else 0.0
    return {"rows": rows, "columns": columns, "pattern": "independent", "xgap": _GAP_X, "ygap": round(gap, 3)}


def _title(panel: Panel, suffix: str) -> dict[str, Any]:
    place = {"x": 0, "y": 1, "xref": f"x{suffix} domain", "yref": f"y{suffix} domain"}
    look = {"showarrow": False, "xanchor": "left", "yanchor": "bottom", "font": {"size": 13}}
    return {"text": f"<b>{_text(panel.title)}</b>"} | place | look


def _narrow(figure: Figure) -> dict[str, Any]:
    """Layout changes where the page is narrow: panels below each other, smaller letters and margins."""
    count = len(figure.panels)
    height = _height(count, 3.3 if any(panel.equal for panel in figure.panels) else 2.9) + 20
    return {
        "font.size": 11,
        "margin.l": 50,
        "margin.r": 6,
        "height": height,
        "legend.y": _legend_place(figure, height),
        "grid": _grid(figure, count, 1),
    }
