"""Figures on paper: SVG for pages, SVG, PNG or PDF files for journals. Same input, same bytes."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from piga.errors import ArgumentError, PigaError
from piga.reports.decimate import envelope_rows
from piga.reports.figure import Axis, Figure, Panel, Series
from piga.reports.palette import GRID, INK, LIGHT, SOFT, css_names

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

WIDTH = 7.2
"""Width of a figure [inch]: two columns of a journal."""

PRINTED = 1200
"""Points that a printed curve keeps at most: two for each hundredth of an inch."""

_STYLE: dict[str, Any] = {
    "font.family": ["DejaVu Sans"],
    "font.size": 8.5,
    "axes.titlesize": 9.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 8.5,
    "axes.labelcolor": INK,
    "axes.edgecolor": SOFT,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.1,
    "lines.markersize": 3.2,
    "path.simplify": True,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "pdf.fonttype": 42,
}


@contextmanager
def _style(figure: Figure, fonttype: str) -> Iterator[None]:
    try:
        import matplotlib as mpl
    except ImportError:
        message = "figures need Matplotlib, which is not installed"
        raise PigaError(message, remedy="install it with: pip install 'piga[report]'") from None
    style: Any = _STYLE | {"svg.hashsalt": figure.key, "svg.fonttype": fonttype}
    with mpl.rc_context(style):
        yield


def rows_and_columns(figure: Figure) -> tuple[int, int]:
    """Rows and columns of panels."""
    columns = max(1, min(figure.columns, len(figure.panels)))
    return math.ceil(len(figure.panels) / columns), columns


def shares_x(figure: Figure) -> bool:
    """Whether stacked panels have one x axis: same quantity and unit in all of them."""
    axes = {(panel.x.quantity, panel.x.unit, panel.x.log) for panel in figure.panels}
    return len(figure.panels) > 1 and rows_and_columns(figure)[1] == 1 and len(axes) == 1


def series_key(figure: Figure, panel: int, series: int) -> str:
    """Name of a series in both renderings, e.g. ``spectrum-p0-s1``."""
    return f"{figure.key}-p{panel}-s{series}"


def figure_svg(figure: Figure, *, width: float = WIDTH) -> str:
    """The figure as an SVG element, ``width`` [inch], for a page: text stays text, colours follow its theme."""
    buffer = io.StringIO()
    with _style(figure, "none"):
        _drawn(figure, width).savefig(buffer, format="svg", metadata=_NO_METADATA["svg"])
    return _for_page(buffer.getvalue(), figure)


def write_figure(figure: Figure, path: Path, *, width: float = WIDTH, dpi: int = 300) -> Path:
    """Write the figure as ``.svg``, ``.pdf`` or ``.png`` with its letters as outlines or embedded fonts.

    ``width`` [inch]; ``dpi`` counts for ``.png``.

    Raises
    ------
    ArgumentError
        If the file name ends otherwise.
    """
    kind = path.suffix.lower().removeprefix(".")
    if kind not in _NO_METADATA:
        raise ArgumentError(
            f"{path}: figures are written as .svg, .pdf or .png", remedy="choose one of these endings"
        )
    with _style(figure, "path"):
        drawn = _drawn(figure, width)
        drawn.savefig(path, format=kind, dpi=dpi, metadata=_NO_METADATA[kind], facecolor="white")
    return path


_NO_METADATA: dict[str, dict[str, None]] = {
    "svg": {"Date": None, "Creator": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
    "png": {"Software": None},
}


def _drawn(figure: Figure, width: float) -> Canvas:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    rows, columns = rows_and_columns(figure)
    canvas = Canvas(figsize=(width, figure.height * rows), layout="constrained")
    FigureCanvasAgg(canvas)
    shared = shares_x(figure)
    grid = canvas.subplots(rows, columns, squeeze=False, sharex=shared)
    for index, axes in enumerate(grid.flat):
        if index < len(figure.panels):
            _draw_panel(axes, figure, index, label_x=not shared or index == len(figure.panels) - 1)
        else:
            axes.set_axis_off()
    _draw_legend(canvas, grid)
    _lay_out(canvas)
    return canvas


def _lay_out(canvas: Canvas) -> None:
    """Place panels, legend and labels once: saving would do it twice, each time with a drawing of its own."""
    engine = canvas.get_layout_engine()
    if engine is not None:
        engine.execute(canvas)
    canvas.set_layout_engine(None)


def _draw_legend(canvas: Canvas, grid: Any) -> None:
    entries: dict[str, Any] = {}
    for axes in grid.flat:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if entries:
        columns = min(len(entries), 4)
        canvas.legend(
            entries.values(), entries.keys(), loc="outside upper left", ncols=columns, borderaxespad=0.2
        )


def _draw_panel(axes: Axes, figure: Figure, index: int, *, label_x: bool) -> None:
    panel = figure.panels[index]
    for order, series in enumerate(panel.series):
        artist = _draw_series(axes, series)
        artist.set_gid(series_key(figure, index, order))
    if panel.title:
        axes.set_title(panel.title)
    _draw_axis(axes, "x", panel.x, label=label_x)
    _draw_axis(axes, "y", panel.y, label=True)
    if panel.equal:
        axes.locator_params(nbins=5)
        axes.set_aspect("equal", adjustable="box" if _has_limits(panel) else "datalim")


def _has_limits(panel: Panel) -> bool:
    return panel.x.limits is not None and panel.y.limits is not None


def _draw_axis(axes: Axes, which: str, axis: Axis, *, label: bool) -> None:
    if axis.log:
        axes.set(**{f"{which}scale": "log"})
    if axis.limits is not None:
        axes.set(**{f"{which}lim": axis.limits})
    if axis.dates:
        _write_dates(axes)
    if label:
        axes.set(**{f"{which}label": axis.label})


def _write_dates(axes: Axes) -> None:
    """Ticks of the x axis as dates, each whole: ``2024-03``, ``2024-03-05`` or ``2024-03-05 12:00``."""
    dates: Any = import_module("matplotlib.dates")
    if dates.get_epoch() != "1970-01-01T00:00:00":
        raise PigaError(
            f"Matplotlib counts dates from {dates.get_epoch()}",
            remedy="leave its setting date.epoch as it is delivered",
        )
    locator = dates.AutoDateLocator(minticks=3, maxticks=7, tz="UTC")
    formatter = dates.ConciseDateFormatter(locator, tz="UTC", show_offset=False)
    formatter.formats = formatter.zero_formats = list(_DATES)
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(formatter)


_DATES = ("%Y", "%Y-%m", "%Y-%m-%d", *("%Y-%m-%d %H:%M",) * 2, "%H:%M:%S")
"""Forms of a date by the finest part in which the ticks differ: year, month, day, hour, minute, second."""


def _draw_series(axes: Axes, series: Series) -> Any:
    x, y = series.arrays()
    rows = envelope_rows(y, PRINTED)
    x, y = x[rows], y[rows]
    colour, name = LIGHT[series.role], series.name or None
    dashes = (0, (4, 2)) if series.dashed else "-"
    if series.mark == "bars":
        step = float(np.min(np.diff(np.sort(x)))) if x.size > 1 else 1.0
        bars = axes.bar(x, y, width=0.8 * step, color=colour, label=name)
        return bars.patches[0] if bars.patches else axes.plot([], [])[0]
    if series.mark == "band":
        upper = np.asarray(series.upper, dtype=float)[rows]
        return axes.fill_between(x, y, upper, color=colour, alpha=0.18, linewidth=0.0, label=name)
    if series.error is not None:
        error = np.asarray(series.error, dtype=float)[rows]
        axes.errorbar(x, y, yerr=error, fmt="none", ecolor=colour, elinewidth=0.8, capsize=1.8)
    if series.mark == "points":
        return axes.plot(x, y, "o", color=colour, markeredgewidth=0.0, label=name)[0]
    style = "steps-mid" if series.mark == "steps" else "default"
    marker = "o" if series.mark == "line+points" else ""
    thin = series.role == "muted"
    width = 0.6 if thin else 1.1
    (line,) = axes.plot(x, y, color=colour, ls=dashes, marker=marker, lw=width, drawstyle=style, label=name)
    return line


def _for_page(text: str, figure: Figure) -> str:
    """Only the ``svg`` element: scalable, coloured by CSS variables, ids unique in the page."""
    svg = text[text.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>\s*", "", svg, flags=re.DOTALL)
    svg = re.sub(r'<svg [^>]*?viewBox="([^"]*)"[^>]*>', _SVG_TAG, svg, count=1)
    referenced = set(re.findall(r'(?:url\(#|href="#)([^)"]+)', svg))
    keep = referenced | {series_key(figure, p, s) for p, s in _all_series(figure)}
    svg = re.sub(r' id="([^"]*)"', lambda m: m.group(0) if m.group(1) in keep else "", svg)
    for name in sorted(referenced):
        svg = svg.replace(f'"{name}"', f'"{figure.key}-{name}"').replace(f"#{name}", f"#{figure.key}-{name}")
    for colour, variable in css_names().items():
        svg = svg.replace(colour, f"var({variable})")
    return _compact(svg)


def _compact(svg: str) -> str:
    """Coordinates to a hundredth of a point, no empty space, no style that would leak into the page."""
    svg = re.sub(r"<style.*?</style>", "", svg, flags=re.DOTALL)
    svg = svg.replace("; font-family: 'DejaVu Sans'", "")
    svg = re.sub(r' (?:d|x|y|transform|viewBox)="[^"]*"', _short_coordinates, svg)
    svg = re.sub(r"\s*\n(?=[MLCQzZ\"])", "", svg)
    return re.sub(r">\s+<", "><", svg).strip()


def _short_coordinates(attribute: re.Match[str]) -> str:
    return re.sub(r"(\.\d\d)\d+", r"\1", attribute.group(0))


_SVG_TAG = r'<svg viewBox="\1" xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink">'


def _all_series(figure: Figure) -> Iterator[tuple[int, int]]:
    for index, panel in enumerate(figure.panels):
        for order in range(len(panel.series)):
            yield index, order
