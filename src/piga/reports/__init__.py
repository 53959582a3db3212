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

from typing import TYPE_CHECKING, Any

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
    from piga.reports.render.axes import draw, write_figure

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


def __getattr__(name: str) -> Any:
    """The functions that draw load Matplotlib, so they are imported when they are used."""
    if name not in ("draw", "write_figure"):
        raise AttributeError(name)
    from piga.reports.render import axes

    return getattr(axes, name)
