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

from typing import TYPE_CHECKING

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
from piga.results import lazy

if TYPE_CHECKING:
    from piga.reports.calibration.page import calibration_page, write_calibration_report
    from piga.reports.check import write_check
    from piga.reports.planning import write_plan_report
    from piga.reports.render.axes import draw, figure_svg, write_figure
    from piga.reports.trend import write_trend_report


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
    "calibration_page",
    "draw",
    "figure_svg",
    "page_html",
    "write_calibration_report",
    "write_check",
    "write_figure",
    "write_page",
    "write_plan_report",
    "write_trend_report",
]

__getattr__ = lazy(
    "piga.reports",
    {
        "calibration.page": "calibration_page write_calibration_report",
        "check": "write_check",
        "planning": "write_plan_report",
        "render.axes": "draw figure_svg write_figure",
        "trend": "write_trend_report",
    },
)
"""Pages of the subjects, and Matplotlib, are imported when they are used."""
