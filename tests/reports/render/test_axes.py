"""Figures drawn by Matplotlib."""

import pytest

from piga.reports.render.axes import draw
from piga.reports.render.figure import Axis, Figure, Panel, Series


@pytest.mark.parametrize("panels", [1, 2])
def test_title_and_legend_of_a_figure_in_a_notebook_lie_apart(panels: int) -> None:
    names = ("candidate", "excluded", "chosen", "dwell")
    series = tuple(Series([0.0, 1.0], [k, k + 1.0], name) for k, name in enumerate(names))
    panel = Panel(Axis("time", "s"), Axis("force", "g"), series, title="Positions")
    drawing = draw(Figure("positions", "Chosen positions and the time in each.", (panel,) * panels))
    drawing.canvas.draw()
    assert drawing._suptitle is not None
    (legend,) = drawing.legends
    assert not drawing._suptitle.get_window_extent().overlaps(legend.get_window_extent())
