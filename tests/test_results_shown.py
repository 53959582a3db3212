"""What a result shows by itself: lines, a table in a notebook, figures with labelled axes, summary and page."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from html import unescape

import matplotlib.figure
import numpy as np
import pytest

import piga


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


FIGURES = ("residuals", "orders", "ripple", "segments", "allan", "whiteness")


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
    with pytest.raises(piga.ArgumentError, match="pass 1 axes of Matplotlib"):
        cal.plot.allan(ax=["not axes"])


def test_a_figure_without_data_is_refused(cal, alone):
    with pytest.raises(piga.CalibrationError, match="no data for the figure"):
        alone.plot.residuals()
    with pytest.raises(piga.CalibrationError, match="no data for the figure"):
        cal.plot.creep()
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
    for name in ("segments", "residuals"):
        with pytest.raises(piga.CalibrationError, match="calibrate a record"):
            getattr(given.plot, name)()


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
