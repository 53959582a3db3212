"""Reports: figures as data, tables, self-contained pages.

A report is built in three steps. First, figures: a :class:`Figure` of :class:`Panel` and :class:`Series`, with
quantity and unit on every axis. Second, a :class:`Page` of sections and blocks. Both are plain data. Third,
:func:`write_page` writes the file. :mod:`piga.reports.render.numbers` formats numbers.

>>> from piga.reports import Axis, Figure, FigureBlock, Page, Panel, Section, Series, Text, page_html
>>> curve = Series([0.0, 1.0, 2.0], [0.0, 1.0, 4.0], name="measured", role="data")
>>> figure = Figure("drift", "Drift.", (Panel(Axis("time", "s"), Axis("angle", "arcsec"), (curve,)),))
>>> page = Page("A test", sections=(Section("Drift", "part", (Text("It grows."), FigureBlock(figure))),))
>>> page_html(page).startswith("<!DOCTYPE html>")
True
"""

from piga.reports.render.figure import Axis, Figure, Panel, Series
from piga.reports.render.page import (
    Cell,
    FigureBlock,
    Notice,
    Page,
    Section,
    Table,
    TableColumn,
    Text,
    Tile,
    page_html,
    write_page,
)
from piga.reports.render.static import figure_svg, write_figure

__all__ = [
    "Axis",
    "Cell",
    "Figure",
    "FigureBlock",
    "Notice",
    "Page",
    "Panel",
    "Section",
    "Series",
    "Table",
    "TableColumn",
    "Text",
    "Tile",
    "figure_svg",
    "page_html",
    "write_figure",
    "write_page",
]
