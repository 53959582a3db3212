import json
import math
import subprocess
import sys

import numpy as np
import pytest

from piga.errors import ArgumentError
from piga.reports.render.axes import draw, figure_svg, write_figure
from piga.reports.render.figure import LIGHT, Axis, Figure, Panel, Plot, Series, named_axis
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


def test_names_stand_on_the_axis():
    figure = Plot("share", "Share.", named_axis("coefficient", ("k0", "k2")), "share [%]").points(
        [1, 2], [3, 4]
    )
    figure = figure.caption("Good: small.")
    axis = figure_spec(figure)["layout"]["xaxis"]
    assert axis["tickvals"] == [1, 2]
    assert axis["ticktext"] == ["k0", "k2"]
    assert figure_spec(figure)["data"][0]["text"] == ["k0", "k2"]
    assert [label.get_text() for label in draw(figure).axes[0].get_xticklabels()] == ["k0", "k2"]


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


def test_pictures_leave_no_global_style(tmp_path):
    import matplotlib as mpl

    before = dict(mpl.rcParams)
    write_figure(every_mark(), tmp_path / "a.png", dpi=50)
    assert dict(mpl.rcParams) == before


def test_a_picture_shows_the_colours_of_the_figure(tmp_path):
    from matplotlib.image import imread

    bars = Series(np.arange(4.0), np.array([1.0, 2.0, 3.0, 4.0]), mark="bars", role="before")
    figure = Figure("bars", "Bars.", (Panel(Axis("number", "1"), Axis("size", "1"), (bars,)),))
    picture = imread(write_figure(figure, tmp_path / "a.png", dpi=144))
    assert picture.shape[1] == pytest.approx(7.2 * 144, abs=1.0)
    colour = [int(LIGHT["before"][i : i + 2], 16) / 255.0 for i in (1, 3, 5)]
    here = np.abs(picture[:, :, :3] - colour).max(axis=2) < 0.01
    columns = here.sum(axis=0)
    heights = np.unique(columns[columns > 20])
    assert heights.max() / heights.min() == pytest.approx(4.0, rel=0.03)
    assert np.argmax(columns == heights.max()) > np.argmax(columns == heights.min())


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


def test_a_page_loads_no_matplotlib():
    code = (
        "import sys; from piga.reports import Axis, Figure, FigureBlock, Page, Panel, Section, Series, page_html;"
        "figure = Figure('a', 'A.', (Panel(Axis('t', 's'), Axis('y', 'm'), (Series([0, 1], [1, 2]),)),));"
        "page_html(Page('Marks', sections=(Section('Marks', 'part', (FigureBlock(figure),)),)));"
        "assert not {name for name in sys.modules if name.startswith('matplotlib')}"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_other_file_types_are_refused(tmp_path):
    with pytest.raises(ArgumentError, match=r"\.svg, \.pdf or \.png"):
        write_figure(every_mark(), tmp_path / "a.bmp")
