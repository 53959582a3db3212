"""Figures drawn with Matplotlib, for notebooks, papers and files: the same description as on pages.

This is the only module that imports Matplotlib when it is loaded.
"""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from piga.errors import ArgumentError, missing_package

try:
    import matplotlib as mpl
except ModuleNotFoundError:
    raise missing_package("matplotlib") from None
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import MaxNLocator

from piga.reports.render.figure import LIGHT, Figure, Panel, Series

WIDTH = 7.2
"""Width of a figure [inch]: two columns of a journal."""
SMALL = 8.5
"""Size of letters [point]."""
_LETTERS = 16.0
"""Letters of a label in an inch."""
STYLE: dict[str, Any] = {
    "font.family": ["DejaVu Sans"],
    "text.usetex": False,
    "axes.formatter.use_mathtext": True,
    "svg.fonttype": "none",
    "svg.hashsalt": "piga",
    "pdf.fonttype": 42,
}
"""Settings of a file: text stays text, and the same figure gives the same bytes."""
_NO_METADATA: dict[str, dict[str, None]] = {
    "svg": {"Date": None, "Creator": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
    "png": {"Software": None},
}


class Drawing(Canvas):
    """A Matplotlib figure that a notebook shows without ``pyplot``. ``caption`` says what a good result is."""

    caption = ""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        FigureCanvasAgg(self).print_png(buffer)  # type: ignore[no-untyped-call]
        return buffer.getvalue()


def draw(figure: Figure, ax: Axes | Sequence[Axes] | None = None) -> Canvas:
    """Draw a figure with Matplotlib. ``ax``: the axes to draw on, one for each panel; None: a new figure.

    Raises
    ------
    ArgumentError
        If the number of axes is not the number of panels.
    """
    if ax is None:
        drawing = _new(figure)
        drawing.suptitle(_words(figure.title, WIDTH * _LETTERS), fontsize=SMALL + 1.5, color=LIGHT["ink"])
        return drawing
    chosen = [ax] if isinstance(ax, Axes) else list(np.ravel(np.asarray(ax, dtype=object)))
    needed = len(figure.panels)
    if len(chosen) != needed or not all(isinstance(item, Axes) for item in chosen):
        panels = f"{needed} panel{'s' * (needed > 1)}"
        raise ArgumentError(
            f"ax: the figure '{figure.key}' has {panels}, ax has {len(chosen)}",
            remedy=f"pass {needed} axes of Matplotlib, e.g. those of plt.subplots({needed})",
        )
    for panel, axes in zip(figure.panels, chosen, strict=True):
        _panel(panel, axes)
        if sum(1 for series in panel.series if series.name) > 1:
            axes.legend(fontsize=SMALL - 1.0, frameon=False)
    parent = chosen[0].get_figure(root=True)
    assert isinstance(parent, Canvas)  # noqa: S101 - the root is no part of another figure
    return parent


def write_figure(figure: Figure, path: Path, *, width: float = WIDTH, dpi: int = 300) -> Path:
    """Write a figure as ``.svg``, ``.pdf`` or ``.png``, ``width`` [inch] wide. The same figure gives the same bytes.

    ``dpi``: dots per inch of a ``.png``.

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
    path.write_bytes(_saved(figure, kind, width, dpi))
    return path


def figure_svg(figure: Figure, *, width: float = WIDTH) -> str:
    """The figure as an SVG element on white paper, ``width`` [inch]."""
    text = _saved(figure, "svg", width, 300).decode("utf-8")
    return text[text.index("<svg") :]


def _saved(figure: Figure, kind: str, width: float, dpi: int) -> bytes:
    buffer = io.BytesIO()
    with mpl.rc_context(STYLE):  # type: ignore[arg-type]
        _new(figure, width).savefig(buffer, format=kind, dpi=dpi, metadata=_NO_METADATA[kind])
    return buffer.getvalue()


def _new(figure: Figure, width: float = WIDTH) -> Drawing:
    """A new figure with a panel in each cell of its grid, and one legend below them."""
    rows, columns = figure.grid
    drawing = Drawing(figsize=(width, rows * (figure.height + 0.2)), layout="constrained")
    drawing.caption = figure.caption
    first: Axes | None = None
    named: dict[str, Any] = {}
    for number, panel in enumerate(figure.panels, start=1):
        axes = drawing.add_subplot(rows, columns, number, sharex=first if figure.shares_x else None)
        first = first or axes
        inside = figure.shares_x and number < len(figure.panels)
        _panel(panel, axes, inside=inside, letters=(width / columns * _LETTERS, figure.height * _LETTERS))
        handles, names = axes.get_legend_handles_labels()
        drawn = dict(zip(names, handles, strict=True))
        order = [_words(series.name) for series in panel.series if series.name]
        named |= {name: drawn[name] for name in order if name not in named}
    if named:
        drawing.set_figheight(drawing.get_figheight() + 0.18)
        letters = max(len(name) for name in named) + 3
        across = max(1, min(len(named), int(width * _LETTERS / letters)))
        drawing.legend(
            list(named.values()),
            list(named),
            loc="outside lower left",
            ncols=across,
            fontsize=SMALL - 0.5,
            frameon=False,
        )
    return drawing


def _panel(
    panel: Panel, axes: Axes, *, inside: bool = False, letters: tuple[float, float] = (60.0, 40.0)
) -> None:
    """Draw the curves of a panel and dress its axes; ``letters`` is how many fit along x and y."""
    for series in panel.series:
        _series(series, axes)
    axes.set_xlabel(_words(panel.x.label, letters[0]), fontsize=SMALL, color=LIGHT["ink"])
    axes.xaxis.label.set_visible(not inside)
    axes.set_ylabel(_words(panel.y.label, letters[1]), fontsize=SMALL, color=LIGHT["ink"])
    if panel.title:
        axes.set_title(
            _words(panel.title, letters[0]), fontsize=SMALL, fontweight="bold", loc="left", color=LIGHT["ink"]
        )
    axes.tick_params(labelsize=SMALL - 0.5, labelbottom=not inside)
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
    if panel.x.names:
        axes.set_xticks(np.arange(1, len(panel.x.names) + 1), list(map(_words, panel.x.names)))
        if sum(map(len, panel.x.names)) > 0.8 * letters[0]:
            axes.tick_params(axis="x", labelrotation=30.0)
    if panel.x.dates:  # days since 1970-01-01: Matplotlib's own count of days
        locator = AutoDateLocator()  # type: ignore[no-untyped-call]
        axes.xaxis.set_major_locator(locator)
        axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]


def _words(text: str, letters: float = math.inf) -> str:
    """Text in lines of so many letters; a dollar sign begins no formula."""
    text = text.replace("$", r"\$")
    return text if len(text) <= letters else textwrap.fill(text, int(letters))


def _series(series: Series, axes: Axes) -> None:
    x, y = series.arrays()
    look: dict[str, Any] = {"color": LIGHT[series.role], "label": _words(series.name) or "_"}
    if series.mark == "bars":
        axes.bar(x, y, width=0.8 * min(np.diff(np.unique(x)), default=1.0), **look)
        return
    if series.mark == "band":
        axes.fill_between(x, y, np.asarray(series.upper, dtype=float), alpha=0.18, linewidth=0.0, **look)
        return
    style = "none" if series.mark == "points" else "--" if series.dashed else "-"
    error = None if series.error is None else np.asarray(series.error, dtype=float)
    axes.errorbar(
        x,
        y,
        yerr=error,
        linestyle=style,
        linewidth=0.7 if series.role == "muted" else 1.1,
        marker="o" if series.mark in ("points", "line+points") else "",
        markersize=3.5,
        capsize=2.0 if error is not None else 0.0,
        drawstyle="steps-mid" if series.mark == "steps" else "default",
        **look,
    )
