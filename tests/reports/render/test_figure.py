"""Figures on pages and in files show the same numbers; a long curve keeps its extremes and gaps."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from piga.errors import ArgumentError
from piga.reports.render.axes import draw, write_figure
from piga.reports.render.figure import Axis, Figure, Panel, Series, envelope_rows, figure_document
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
    from piga.reports.calibration.page import calibration_figures

    for figure in (*calibration_figures(cal).values(), every_mark()):
        panels = figure_document(figure)["panels"]
        drawn = draw(figure)
        assert len(drawn.axes) == len(figure.panels)
        for panel, axes in zip(figure.panels, drawn.axes, strict=True):
            bands = sum(series.mark == "band" for series in panel.series)
            assert len(axes.containers) + bands == len(panel.series)
            assert axes.get_ylabel().replace("\n", " ") == panel.y.label
        assert [len(panel["series"]) for panel in panels] == [len(panel.series) for panel in figure.panels]


def test_numbers_of_a_page_are_those_of_the_figure():
    figure = every_mark()
    drawn = figure_document(figure)["panels"][0]["series"]
    for shown, series in zip(drawn, figure.panels[0].series, strict=True):
        x, y = series.arrays()
        assert shown["x"] == pytest.approx(x, abs=1e-5 * 10)
        assert shown["y"] == pytest.approx(y, abs=1e-5 * 10)


def test_gaps_are_null_and_json_is_strict():
    y = np.array([1.0, math.nan, math.inf, 4.0])
    figure = Figure(
        "gap", "Gap.", (Panel(Axis("time", "s"), Axis("angle", "rad"), (Series(np.arange(4), y),)),)
    )
    document = json.loads(json_island(figure_document(figure)))
    assert document["panels"][0]["series"][0]["y"] == [1.0, None, None, 4.0]


def test_text_for_plotly_holds_no_markup_of_the_data():
    names = [series["name"] for series in figure_document(every_mark())["panels"][0]["series"]]
    assert "error &lt;b&gt;" in names


@pytest.mark.parametrize("ending", ["svg", "png", "pdf"])
def test_figure_files_are_written_and_repeat(tmp_path, ending):
    first = write_figure(every_mark(), tmp_path / f"a.{ending}").read_bytes()
    assert first == write_figure(every_mark(), tmp_path / f"b.{ending}").read_bytes()
    assert len(first) > 5000


def test_other_file_types_are_refused(tmp_path):
    with pytest.raises(ArgumentError, match=r"\.svg, \.pdf or \.png"):
        write_figure(every_mark(), tmp_path / "a.bmp")


CURVES = arrays(
    float, st.integers(1, 400), elements=st.one_of(st.floats(-1e6, 1e6), st.sampled_from([np.nan, np.inf]))
)


@given(CURVES, st.integers(8, 60))
def test_extremes_and_ends_stay_and_the_limit_holds(y, limit):
    rows = envelope_rows(y, limit)
    assert rows.size <= max(limit, min(y.size, limit))
    assert np.all(np.diff(rows) > 0)
    assert rows[0] == 0
    assert rows[-1] == y.size - 1
    finite = y[np.isfinite(y)]
    kept = y[rows][np.isfinite(y[rows])]
    if finite.size:
        assert kept.min() == finite.min()
        assert kept.max() == finite.max()


def test_every_bucket_with_a_gap_keeps_a_gap():
    y = np.sin(np.linspace(0, 50, 100_000))
    holes = [20_000, 20_001, 71_234]
    y[holes] = np.nan
    rows = envelope_rows(y)
    assert np.isnan(y[rows]).sum() == 2
    between = rows[(rows > 20_001) & (rows < 71_234)]
    assert between.size > 500
