import json
import math
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from piga.errors import ArgumentError, PigaError
from piga.reports.render.figure import LIGHT, Axis, Figure, Panel, Series
from piga.reports.render.interactive import figure_spec
from piga.reports.render.page import FigureBlock, Page, Section, json_island, page_html
from piga.reports.render.scene import POINT, figure_scene, series_key
from piga.reports.render.static import figure_svg, write_figure

SVG = "{http://www.w3.org/2000/svg}"


def every_mark():
    x = np.linspace(0.0, 10.0, 30)
    marks = ("line", "points", "line+points", "bars", "steps")
    series = [Series(x, np.sin(x) + i, name=mark, mark=mark, role="data") for i, mark in enumerate(marks)]
    series.append(Series(x, x * 0.1, name="band", mark="band", upper=x * 0.1 + 1, role="model"))
    series.append(Series(x, x * 0.2, name="error <b>", error=x * 0 + 0.1, role="x", dashed=True))
    log = Panel(Axis("frequency", "Hz", log=True), Axis("density", "1"), (Series(x + 1, x, role="muted"),))
    panel = Panel(Axis("time", "s"), Axis("angle", "arcsec"), tuple(series), title="All marks")
    return Figure("marks", "Every mark.", (panel, log), columns=2, caption="All of them.")


def test_static_and_interactive_show_the_same_series(cal):
    from piga.reports.calibration.figures import calibration_figures

    for figure in (*calibration_figures(cal), every_mark()):
        keys = {
            series_key(figure, p, s) for p, panel in enumerate(figure.panels) for s in range(len(panel.series))
        }
        drawn = ET.fromstring(figure_svg(figure))  # noqa: S314
        assert keys == {node.get("id") for node in drawn.iter() if node.get("id") in keys}
        traces = figure_spec(figure)["data"]
        assert keys == {trace["uid"] for trace in traces if not trace["uid"].endswith("-lower")}


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
    figure = Figure("big", "Big.", (Panel(Axis("t", "s"), Axis("y", "rad"), (Series(np.arange(y.size), y),)),))
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


def test_palette_tells_before_from_after_in_grey_print():
    def grey(colour):
        red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
        return 0.2126 * red + 0.7152 * green + 0.0722 * blue

    assert abs(grey(LIGHT["before"]) - grey(LIGHT["after"])) > 40
    assert len(set(LIGHT.values())) == len(LIGHT)


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


def test_a_picture_shows_what_the_svg_shows(tmp_path):
    """Pixels of a PNG have the colours of the scene at its places, the right way up."""
    from matplotlib.image import imread

    bars = Series(np.arange(4.0), np.array([1.0, 2.0, 3.0, 4.0]), mark="bars", role="before")
    figure = Figure("bars", "Bars.", (Panel(Axis("number", "1"), Axis("size", "1"), (bars,)),))
    picture = imread(write_figure(figure, tmp_path / "a.png", dpi=144))
    scene = figure_scene(figure, 7.2 / POINT)
    assert picture.shape[:2] == pytest.approx((2 * scene.height, 2 * scene.width), abs=1.0)
    (shape,) = next(group.shapes for group in scene.groups if group.key == "bars-p0-s0")
    colour = [int(LIGHT["before"][i : i + 2], 16) / 255.0 for i in (1, 3, 5)]
    for outline in shape.paths:
        (x, y), top = outline.mean(axis=0), outline[:, 1].min()
        assert picture[round(2 * y), round(2 * x), :3] == pytest.approx(colour, abs=0.01)
        assert picture[round(2 * top) + 3, round(2 * x), :3] == pytest.approx(colour, abs=0.01)
        assert picture[round(2 * top) - 3, round(2 * x), :3] != pytest.approx(colour, abs=0.3)


def test_only_pictures_need_matplotlib(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    for ending in ("png", "pdf"):
        with pytest.raises(PigaError, match="need Matplotlib") as caught:
            write_figure(every_mark(), tmp_path / f"a.{ending}")
        assert "piga[report]" in (caught.value.remedy or "")
        assert not (tmp_path / f"a.{ending}").exists()
    assert write_figure(every_mark(), tmp_path / "a.svg").exists()
    page = Page("Marks", sections=(Section("Marks", "part", (FigureBlock(every_mark()),)),))
    assert "<svg" in page_html(page)


def test_a_page_and_an_svg_load_no_matplotlib(tmp_path):
    code = (
        "import sys; from pathlib import Path; from tests.reports.render.test_static import every_mark;"
        "from piga.reports import FigureBlock, Page, Section, page_html, write_figure;"
        "page_html(Page('Marks', sections=(Section('Marks', 'part', (FigureBlock(every_mark()),)),)));"
        f"write_figure(every_mark(), Path({str(tmp_path / 'a.svg')!r}));"
        "assert not {name for name in sys.modules if name.startswith('matplotlib')}"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120, cwd=Path(__file__).parents[3])


def test_other_file_types_are_refused(tmp_path):
    with pytest.raises(ArgumentError, match=r"\.svg, \.pdf or \.png"):
        write_figure(every_mark(), tmp_path / "a.bmp")
