"""Reports: figures as data, tables, self-contained pages.

A report is built in three steps. First, figures: a :class:`Figure`, made curve by curve with :class:`Plot`; each axis has
quantity and unit. Second, a :class:`Page` of sections and blocks. Both are plain data. Third, :func:`write_page` writes
the file, and :func:`page_text` the lines for a terminal. :mod:`piga.reports.render.numbers` formats numbers.

>>> from piga.reports import FigureBlock, Page, Plot, Section, Text, page_html
>>> plot = Plot("drift", "Drift.", "time [s]", "angle [arcsec]")
>>> figure = plot.line([0.0, 1.0, 2.0], [0.0, 1.0, 4.0], "measured").caption("Good: a level line.")
>>> page = Page("A test", sections=(Section("Drift", "part", (Text("It grows."), FigureBlock(figure))),))
>>> page_html(page).startswith("<!DOCTYPE html>")
True
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from piga.reports.render.figure import Axis, Figure, Panel, Plot, Series
from piga.reports.render.page import (
    Cell,
    FigureBlock,
    Notice,
    Page,
    Section,
    Table,
    TableColumn,
    TableOf,
    Text,
    Tile,
    page_html,
    page_text,
    write_page,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

__all__ = [
    "Axis",
    "Cell",
    "Figure",
    "FigureBlock",
    "Notice",
    "Page",
    "Panel",
    "Plot",
    "Section",
    "Series",
    "Table",
    "TableColumn",
    "TableOf",
    "Text",
    "Tile",
    "draw",
    "page_html",
    "page_text",
    "write_figure",
    "write_page",
]


def draw(figure: Figure, ax: Axes | Sequence[Axes] | None = None) -> Canvas:
    """Draw a figure with Matplotlib. ``ax``: the axes to draw on, one for each panel; None: a new figure.

    Raises
    ------
    ArgumentError
        If the number of axes is not the number of panels.
    MissingPackageError
        If Matplotlib is not installed.
    """
    from piga.reports.render import axes

    return axes.draw(figure, ax)


def write_figure(figure: Figure, path: Path, *, width: float = 7.2, dpi: int = 300) -> Path:
    """Write a figure as ``.svg``, ``.pdf`` or ``.png``, ``width`` [inch] wide. The same figure gives the same bytes.

    ``dpi``: dots per inch of a ``.png``.

    Raises
    ------
    ArgumentError
        If the file name ends otherwise.
    MissingPackageError
        If Matplotlib is not installed.
    """
    from piga.reports.render import axes

    return axes.write_figure(figure, path, width=width, dpi=dpi)
