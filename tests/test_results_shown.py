"""What a result shows by itself: lines, a table in a notebook, figures with labelled axes, summary and page."""

from __future__ import annotations

import copy
import subprocess
import sys
import types
from dataclasses import replace
from html import unescape

import matplotlib.figure
import numpy as np
import pytest

import piga
from piga import doors
from piga.reports import Axis, Figure, Panel, Series
from piga.reports.render.axes import draw
from piga.results import in_words
from tests.short_record import a_run


@pytest.mark.parametrize("name", [name for name in vars(doors) if not name.startswith("_")])
def test_every_door_leads_to_a_module(name):
    door = getattr(doors, name)
    if name.startswith("shown_"):
        assert all(callable(getattr(door(), part)) for part in ("page", "brief", "figures"))
    elif isinstance(door, types.FunctionType):
        assert isinstance(door(), types.ModuleType)


def test_repr_of_a_calibration_has_ten_lines_at_most(cal):
    assert len(cal.verdict.doubts) >= 1
    assert len(repr(cal).splitlines()) <= 10
    many = tuple(replace(cal.coefficients[0], segment=str(i)) for i in range(40))
    noted = replace(cal, coefficients=many, notes=tuple(f"note {i} {'x' * 300}" for i in range(30)))
    lines = repr(noted).splitlines()
    assert len(lines) == 10
    assert "and 36 more" in lines[5]
    assert "more: summary()" in lines[-1]
    assert len(repr(noted)) < 3000


def test_repr_of_a_run_says_what_it_is(run):
    shown = repr(run)
    assert len(shown.splitlines()) <= 10
    assert "samples: 800 of 800 rows; output is the angle" in shown
    assert "2: 0, 1" in shown


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (np.zeros((4, 3)), "array 4 x 3"),
        (np.array([1.0, 2.5]), "array 2, 1 to 2.5"),
        (np.zeros(0), "array 0"),
        (np.array(["a"]), "array 1"),
        (1.23456789, "1.23457"),
        ((1, 2), "1, 2"),
        (tuple(range(11)), "11 items"),
        ({"a": 1}, "1 entries: a"),
        (None, "None"),
        (Axis("t", "s"), "Axis"),
    ],
)
def test_values_in_words(value, words):
    assert in_words(value) == words


@pytest.fixture
def alone(cal, tmp_path):
    """The calibration without its residuals, as it is read from its file."""
    cal.to_json(tmp_path / "calibration.json")
    return piga.Calibration.from_json(tmp_path / "calibration.json")


def test_the_card_of_a_calibration_is_the_report_s_table(cal, alone):
    html = cal._repr_html_()
    for c in cal.values():
        assert f'class="text ">{c.key}</th>' in html
    assert cal.verdict.headline in unescape(html)
    assert "<svg" in html
    assert len(html) < 100_000
    assert "<svg" not in alone._repr_html_()
    assert "<script" not in html


def test_a_serial_cannot_become_markup(cal):
    assert "<b>" not in replace(cal, serial="<b>x")._repr_html_()


def test_a_card_needs_no_matplotlib():
    code = (
        "import sys, piga; c = piga.Calibration.from_coefficients({'scale_factor': 0.9}); assert c._repr_html_()\n"
        "assert 'matplotlib' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


GIVEN = "import piga\nc = piga.Calibration.from_coefficients({'scale_factor': (0.9, 1e-6)})\n"


def without(package: str, code: str) -> str:
    """What Python prints on stderr for this code when a package is not installed."""
    hidden = f"import sys; sys.modules['{package}'] = None\n"
    done = subprocess.run(
        [sys.executable, "-c", hidden + GIVEN + code], capture_output=True, text=True, check=False
    )
    return done.stderr


@pytest.mark.long
def test_without_its_package_a_method_names_the_extra():
    assert without("jinja2", "assert c._repr_html_() is None") == ""
    assert "pip install 'piga[report]'" in without("matplotlib", "piga.example_run().plot()")
    assert "pip install 'piga[notebook]'" in without("pandas", "c.to_dataframe()")
    assert "pip install 'piga[notebook]'" in without("xarray", "c.to_xarray()")
    assert "pip install 'piga[lab]'" in without("pyarrow", "c.to_arrow()")


FIGURES = ("residuals", "orders", "ripple", "segments", "budget", "allan", "whiteness")


def labelled(figure) -> bool:
    return all(axes.get_xlabel() and axes.get_ylabel() for axes in figure.axes)


@pytest.mark.parametrize("name", FIGURES)
def test_figures_of_a_calibration(cal, name):
    figure = getattr(cal.plot, name)()
    assert isinstance(figure, matplotlib.figure.Figure)
    assert figure.axes
    assert labelled(figure)
    assert figure._repr_png_().startswith(b"\x89PNG")


def test_the_plot_draws_what_the_page_draws(cal):
    """The same numbers, in the units of the page."""
    from piga.reports.calibration.figures import segment_figure

    drawn = cal.plot.segments().axes[0]
    panel = segment_figure(cal).panels[0]
    assert drawn.get_xlabel() == panel.x.label
    assert drawn.get_yscale() == "log"
    for line, series in zip(drawn.lines[:2], panel.series, strict=True):
        assert np.array_equal(line.get_ydata(), series.y)
        assert np.array_equal(line.get_xdata(), series.x)


def test_a_figure_is_drawn_on_given_axes(cal, run):
    canvas = matplotlib.figure.Figure()
    axes = canvas.subplots(2)
    assert cal.plot.residuals(ax=axes) is canvas
    assert axes[0].get_title(loc="left") == "Before"
    single = matplotlib.figure.Figure().subplots()
    assert cal.plot.allan(ax=single) is single.figure
    with pytest.raises(piga.ArgumentError, match="has 2 panels, ax has 1"):
        cal.plot.residuals(ax=single)
    with pytest.raises(
        piga.ArgumentError, match="ax: a str is not an axes of Matplotlib\n  remedy: pass one axes"
    ):
        cal.plot.allan(ax=["not axes"])


def test_a_figure_without_data_is_refused(cal, alone):
    with pytest.raises(piga.CalibrationError, match="no data for the figure"):
        alone.plot.residuals()
    with pytest.raises(piga.CalibrationError, match="no data for the figure"):
        cal.plot.convergence()
    assert labelled(alone.plot.segments())


def test_given_coefficients_say_nothing_of_residuals(tmp_path):
    """There is no record, so there are no residuals, segments and methods to tell of."""
    given = piga.Calibration.from_coefficients({"scale_factor": (0.8884, 1e-6), "k0": 1e-4})
    assert "The coefficients were given, not estimated from a record." in given.summary()
    assert "by given coefficients" in repr(given)
    page = given.report(tmp_path / "given.html").read_text(encoding="utf-8")
    for words in ("residual", "segment", "method information", "0 of 0"):
        assert words not in given.summary()
    assert "The coefficients were given, not estimated from a record." in page
    assert "esidual angle, rms" not in page
    for name, remedy in {"budget": "read a calibration.json that has a budget", "segments": "have no segments",
                         "residuals": "calibrate a record", "convergence": "method='recursive'"}.items():  # fmt: skip
        with pytest.raises(piga.CalibrationError, match=remedy):
            getattr(given.plot, name)()


def test_a_coefficient_shows_itself(cal):
    html = cal["k0"]._repr_html_()
    assert "95 % interval" in html
    assert "bias" in html


def test_runs_and_compensations_plot(run, cal):
    assert labelled(run.plot())
    assert len(run.plot().axes) == 3
    result = piga.compensate(run, cal)
    assert len(result.plot().axes) == 3
    assert labelled(result.plot())
    alone = replace(result, made_from=None)
    assert labelled(alone.plot())
    assert copy.copy(result).made_from is not None
    assert labelled(cal.residuals.plot())
    assert "rows: 800" in repr(result)
    assert "<svg" in result._repr_html_()


@pytest.mark.long
def test_every_mark_is_drawn():
    x, y = np.arange(1.0, 6.0), np.array([1.0, 2.0, np.nan, 4.0, 3.0])
    marks = ("line", "points", "line+points", "bars", "steps")
    series = [Series(x, y, mark, mark) for mark in marks]
    series += [Series(x, y, "band", "band", upper=y + 1.0), Series(x, y, "bar", "points", error=0.1 * x)]
    panels = tuple(
        Panel(Axis("x", "s", log=True, limits=(0.5, 9.0)), Axis("y", "1"), (s,), s.name) for s in series
    )
    figure = Figure(
        "marks", "Marks.", (*panels, Panel(Axis("date", "", dates=True), Axis("y", "m"), (series[0],)))
    )
    drawn = draw(figure)
    assert len(drawn.axes) == len(series) + 1
    assert drawn.axes[0].get_xlim() == (0.5, 9.0)
    assert drawn.axes[3].patches
    assert drawn.axes[5].collections
    assert drawn._repr_png_().startswith(b"\x89PNG")
    assert "<svg" in figure._repr_html_()


def test_summary_and_report(run, cal, tmp_path):
    assert all(c.key in cal.summary() for c in cal.values())
    assert "Segments: 2" in run.summary()
    result = piga.compensate(run, cal)
    assert "velocity" in result.summary()
    for number, shown in enumerate((cal, run, result)):
        path = shown.report(tmp_path / f"{number}.html")
        assert path.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    with pytest.raises(piga.ArgumentError, match=r"must end in \.html"):
        cal.report(tmp_path / "report.pdf")
    with pytest.raises(piga.PigaError, match="missing"):
        cal.report(tmp_path / "missing" / "r.html")
    with pytest.raises(piga.CalibrationError, match="without its record"):
        replace(result, made_from=None).report(tmp_path / "x.html")


def test_a_rate_record_shows_itself_too():
    from tests.records.calibration.test_verdict import rate_log

    run = rate_log()
    assert labelled(run.plot())
    assert "output is the rate" in repr(run)
    assert a_run(temperature=np.full(800, 293.0)).in_brief()[5] == ("beside force", "temperature")
