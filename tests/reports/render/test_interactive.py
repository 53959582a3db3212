import json
import math
import subprocess
import sys

import numpy as np
import pytest

from piga.errors import ArgumentError
from piga.reports.render.axes import draw, figure_svg, write_figure
from piga.reports.render.figure import Axis, Figure, Panel, Plot, Series
from piga.reports.render.interactive import figure_spec
from piga.reports.render.page import json_island


def every_mark():
    x = np.linspace(0.0, 10.0, 30)
    marks = ("line", "points", "line+points", "bars", "steps")
    series = [Series(x, np.sin(x) + i, name=mark, mark=mark, role="data") for i, mark in enumerate(marks)]
    series.append(Series(x, x * 0.1, name="band", mark="band", upper=x * 0.1 + 1, role="model"))
    series.append(Series(x, x * 0.2, name="error <b>", error=x * 0 + 0.1, role="x", dashed=True))
    log = Panel(Axis("frequency", "Hz", log=True), Axis("density", "1"), (Series(x + 1, x, role="muted"),))
    panel = Panel(Axis("time", "s"), Axis("angle", "arcsec"), tuple(series), title="All marks")
    return Figure("marks", "Every mark.", (panel, log), columns=2, caption="All of them.")


def test_a_page_and_a_file_show_the_same_series(cal):
    from piga.reports.calibration.figures import calibration_figures

    for figure in (*calibration_figures(cal).values(), every_mark()):
        traces = [trace for trace in figure_spec(figure)["data"] if not trace["uid"].endswith("-lower")]
        drawn = draw(figure)
        assert len(drawn.axes) == len(figure.panels)
        for panel, axes in zip(figure.panels, drawn.axes, strict=True):
            bands = sum(series.mark == "band" for series in panel.series)
            assert len(axes.containers) + bands == len(panel.series)
            assert axes.get_ylabel().replace("\n", " ") == panel.y.label
        assert len(traces) == sum(len(panel.series) for panel in figure.panels)


def test_interactive_numbers_are_those_of_the_figure():
    figure = every_mark()
    for trace, series in zip(figure_spec(figure)["data"][:5], figure.panels[0].series, strict=False):
        x, y = series.arrays()
        assert trace["x"] == pytest.approx(x, abs=1e-5 * 10)
        assert trace["y"] == pytest.approx(y, abs=1e-5 * 10)


def test_gaps_are_null_and_json_is_strict():
    y = np.array([1.0, math.nan, math.inf, 4.0])
    figure = Figure(
        "gap", "Gap.", (Panel(Axis("time", "s"), Axis("angle", "rad"), (Series(np.arange(4), y),)),)
    )
    spec = json.loads(json_island(figure_spec(figure)))
    assert spec["data"][0]["y"] == [1.0, None, None, 4.0]


def test_a_million_rows_stay_light_and_keep_the_spike():
    y = np.zeros(1_000_000)
    y[777_777] = 3.0
    figure = Plot("big", "Big.", "t [s]", "y [rad]").line(np.arange(y.size), y).caption("")
    trace = figure_spec(figure)["data"][0]
    assert len(trace["x"]) <= 2000
    assert trace["x"][trace["y"].index(3.0)] == 777_777
    assert len(figure_svg(figure)) < 80_000


def test_hover_and_axes_carry_units():
    spec = figure_spec(every_mark())
    assert spec["layout"]["xaxis"]["title"]["text"] == "time [s]"
    assert spec["layout"]["yaxis"]["title"]["text"] == "angle [arcsec]"
    assert "arcsec" in spec["data"][0]["hovertemplate"]
    assert " s<" in spec["data"][0]["hovertemplate"]


def test_text_for_plotly_holds_no_markup_of_the_data():
    names = [trace["name"] for trace in figure_spec(every_mark())["data"]]
    assert "error &lt;b&gt;" in names


@pytest.mark.parametrize("ending", ["svg", "png", "pdf"])
def test_figure_files_are_written_and_repeat(tmp_path, ending):
    first = write_figure(every_mark(), tmp_path / f"a.{ending}").read_bytes()
    assert first == write_figure(every_mark(), tmp_path / f"b.{ending}").read_bytes()
    assert len(first) > 5000


def test_only_files_and_notebooks_need_matplotlib(tmp_path):
    code = (
        "import sys; sys.modules['matplotlib'] = None;"
        "from piga.errors import MissingPackageError;"
        "from piga.reports import Axis, Figure, FigureBlock, Page, Panel, Section, Series, page_html;"
        "figure = Figure('a', 'A.', (Panel(Axis('t', 's'), Axis('y', 'm'), (Series([0, 1], [1, 2]),)),));"
        "from piga.reports.render.page import card_html;"
        "marks = Page('Marks', sections=(Section('Marks', 'part', (FigureBlock(figure),)),));"
        "page = page_html(marks);"
        "assert 'class=\"spec\"' in page and '<noscript>' in page;"
        "assert '<svg' not in card_html(marks);\n"
        "try:\n import piga.reports.render.axes\n"
        "except MissingPackageError as error:\n assert 'piga[report]' in error.remedy\n"
        "else:\n raise AssertionError"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_other_file_types_are_refused(tmp_path):
    with pytest.raises(ArgumentError, match=r"\.svg, \.pdf or \.png"):
        write_figure(every_mark(), tmp_path / "a.bmp")
