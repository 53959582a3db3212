"""What a notebook shows of a result that has no module of its own: names and values, and its figure."""

from __future__ import annotations

from piga.reports.render.page import Block, FigureBlock, Page, Section, named_values
from piga.results import Plotted, Shown

MOST_ROWS = 40
"""Rows of a table in a notebook."""


def brief(result: Shown) -> Page:
    """Names and values of the result, and its figure if it has one."""
    blocks: tuple[Block, ...] = (named_values("", "", result.in_brief()[:MOST_ROWS]),)
    if isinstance(result, Plotted):
        blocks += (FigureBlock(result.figure()),)
    return Page(result.heading(), sections=(Section("", "result", blocks),))
