"""Figures as Matplotlib figures, for notebooks and papers: the same description as pages and SVG files.

This is the only module that imports Matplotlib when it is loaded.
"""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import MaxNLocator

from piga.errors import ArgumentError
from piga.reports.render.figure import INK, LIGHT, Figure, Panel, Series
from piga.reports.render.scene import bar_width, drawn_rows, rows_and_columns
from piga.reports.render.static import WIDTH

SMALL = 8.5
"""Size of letters [point]."""
ROOM = 0.5
"""Height [inch] that title and labels of a row of panels take."""


class Drawing(Canvas):
    """A Matplotlib figure that a notebook shows without ``pyplot``. ``caption`` says what a good result is."""

    caption = ""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        FigureCanvasAgg(self).print_png(buffer)  # type: ignore[no-untyped-call]
        return buffer.getvalue()


def draw(figure: Figure, ax: Axes | Sequence[Axes] | None = None) -> Canvas:
    """Draw a figure. ``ax``: the axes to draw on, one for each panel; None: a new figure.

    Raises
    ------
    ArgumentError
        If the number of axes is not the number of panels.
    """
    if ax is None:
        return _new(figure)
    chosen = [ax] if isinstance(ax, Axes) else list(np.ravel(np.asarray(ax, dtype=object)))
    needed = len(figure.panels)
    remedy = f"pass {needed} axes, e.g. those of plt.subplots({needed})" if needed > 1 else "pass one axes"
    for item in chosen:
        if not isinstance(item, Axes):
            raise ArgumentError(f"ax: a {type(item).__name__} is not an axes of Matplotlib", remedy=remedy)
    if len(chosen) != needed:
        raise ArgumentError(
            f"ax: the figure '{figure.key}' has {needed} panel{'s' * (needed > 1)}, ax has {len(chosen)}",
            remedy=remedy,
        )
    for panel, axes in zip(figure.panels, chosen, strict=True):
        _panel(panel, axes)
    parent = chosen[0].get_figure(root=True)
    assert isinstance(parent, Canvas)  # noqa: S101 - the root is no part of another figure
    return parent


def _new(figure: Figure) -> Drawing:
    rows, columns = rows_and_columns(figure)
    drawing = Drawing(figsize=(WIDTH, rows * (figure.height + ROOM)), layout="constrained")
    drawing.caption = figure.caption
    drawing.suptitle(figure.title, fontsize=SMALL + 1.5, color=INK)
    for number, panel in enumerate(figure.panels, start=1):
        _panel(panel, drawing.add_subplot(rows, columns, number))
    return drawing


def _panel(panel: Panel, axes: Axes) -> None:
    for series in panel.series:
        _series(series, axes, dates=panel.x.dates)
    axes.set_xlabel(panel.x.label, fontsize=SMALL)
    axes.set_ylabel(panel.y.label, fontsize=SMALL)
    if panel.title:
        axes.set_title(panel.title, fontsize=SMALL)
    axes.tick_params(labelsize=SMALL - 0.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.3, linewidth=0.5)
    if panel.x.log:
        axes.set_xscale("log")
    if panel.y.log:
        axes.set_yscale("log", nonpositive="mask")
    if panel.x.limits is not None:
        axes.set_xlim(*panel.x.limits)
    if panel.y.limits is not None:
        axes.set_ylim(*panel.y.limits)
    if panel.equal:
        axes.set_aspect("equal", adjustable="box")
    if any(series.mark == "bars" for series in panel.series):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if panel.x.dates:
        locator = AutoDateLocator()  # type: ignore[no-untyped-call]
        axes.xaxis.set_major_locator(locator)
        axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]
    if sum(1 for series in panel.series if series.name) > 1:
        axes.legend(fontsize=SMALL - 1.0, frameon=False)


def _series(series: Series, axes: Axes, *, dates: bool) -> None:
    """One curve; of a long one its outline, as on the page."""
    x, y = series.arrays()
    rows = drawn_rows(series)
    x, y, colour = x[rows], y[rows], LIGHT[series.role]
    name = series.name or "_"
    if dates:
        x = x.astype(float)  # days since 1970-01-01: Matplotlib's own count of days
    if series.mark == "bars":
        axes.bar(x, y, width=bar_width(x), color=colour, label=name)
        return
    if series.mark == "band":
        upper = np.asarray(series.upper, dtype=float)[rows]
        axes.fill_between(x, y, upper, color=colour, alpha=0.18, linewidth=0.0, label=name)
        return
    style = "none" if series.mark == "points" else "--" if series.dashed else "-"
    points = series.mark in ("points", "line+points")
    error = None if series.error is None else np.asarray(series.error, dtype=float)[rows]
    axes.errorbar(
        x,
        y,
        yerr=error,
        color=colour,
        linestyle=style,
        linewidth=0.7 if series.role == "muted" else 1.1,
        marker="o" if points else "",
        markersize=3.5,
        capsize=2.0 if error is not None else 0.0,
        drawstyle="steps-mid" if series.mark == "steps" else "default",
        label=name,
    )
