"""Results: equality; what they show by themselves; how they leave as Arrow, pandas and polars."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import dataclass, field, replace
from html import unescape

import matplotlib.figure
import numpy as np
import pandas as pd
import polars as pl
import pyarrow as pa
import pytest

import piga
from piga.results import ByValue, same
from piga.units import G0


@dataclass(frozen=True, eq=False)
class Held(ByValue):
    name: str
    values: np.ndarray
    table: dict[str, np.ndarray] = field(default_factory=dict)
    size: float = math.nan
    more: tuple[object, ...] = ()
    ignored: object = field(default=None, compare=False)


def held(**changes) -> Held:
    return replace(Held("a", np.array([1.0, math.nan, -0.0]), {"x": np.arange(3)}), **changes)


def test_equal_means_equal_values():
    assert held() == held()
    assert held() == held(values=np.array([1, math.nan, 0.0]))
    assert held() == held(ignored=1)


@pytest.mark.parametrize(
    "changes",
    [
        {"name": "b"},
        {"values": np.array([1.0, math.nan, 1.0])},
        {"values": np.array([1.0, math.nan])},
        {"values": np.array([[1.0, math.nan, -0.0]])},
        {"table": {"x": np.array([0, 1, 3])}},
        {"table": {"y": np.arange(3)}},
        {"table": {}},
        {"size": 1.0},
        {"more": (np.arange(2),)},
    ],
)
def test_a_single_difference_is_seen(changes):
    assert held() != held(**changes)
    assert not held() == held(**changes)  # noqa: SIM201 - the other operator


def test_other_kinds_are_not_equal_and_nothing_raises():
    assert held() != "a"
    assert not same(np.arange(3), (0, 1, 2))
    assert same([np.arange(2)], [np.arange(2)])


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


CALLS = {
    "matplotlib": ("report", "piga.example_run().plot"),
    "pandas": ("notebook", "c.to_dataframe"),
    "pyarrow": ("lab", "c.to_arrow"),
}


@pytest.mark.long
def test_without_its_package_a_method_names_the_extra():
    code = f"""
import sys, piga
c = piga.Calibration.from_coefficients({{"scale_factor": (0.9, 1e-6)}})
calls = [{", ".join(f"({package!r}, {call})" for package, (_, call) in CALLS.items())}]
sys.modules["jinja2"] = None
assert c._repr_html_() is None
for package, call in calls:
    kept, sys.modules[package] = sys.modules.get(package), None
    try:
        call()
    except ImportError as error:
        print(str(error).replace(chr(10), " "))
    if kept is None: del sys.modules[package]
    else: sys.modules[package] = kept
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    said = done.stdout.splitlines()
    for line, (package, (extra, _)) in zip(said, CALLS.items(), strict=True):
        assert f"needs the package {package}" in line
        assert f"pip install 'piga[{extra}]'" in line


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


@pytest.fixture(scope="module")
def results(run, cal):
    budgeted = replace(cal, budget=(*cal.budget, *cal.budget))
    return {
        "run": run,
        "cal": cal,
        "residuals": cal.residuals,
        "budget": budgeted.budget,
        "compensated": piga.compensate(run, cal),
    }


NAMES = ("run", "cal", "residuals", "budget", "compensated")


@pytest.mark.parametrize("name", NAMES)
def test_every_table_is_the_same_by_every_door(results, name):
    table = results[name]
    columns = table.table_columns()
    arrow = table.to_arrow()
    assert arrow.column_names == list(columns)
    assert {field.name: field.metadata[b"unit"].decode() for field in arrow.schema} == {
        key: column.unit for key, column in columns.items()
    }
    streamed = pa.RecordBatchReader.from_stream(table).read_all()
    assert streamed.schema.equals(arrow.schema, check_metadata=True)
    assert pa.table(table).shape == arrow.shape
    taken = (
        arrow if name == "cal" else table
    )  # polars takes a mapping for something else before it asks for Arrow
    polars, pandas, frame = pl.DataFrame(taken), table.to_dataframe(), pd.DataFrame.from_arrow(taken)
    assert list(pandas.columns) == list(columns) == polars.columns == list(frame.columns)
    for key, column in columns.items():
        wanted = column.values if column.labels is None else np.array(column.labels)[column.values]
        for made in (polars[key].to_list(), pandas[key].to_list(), frame[key].to_list()):
            assert len(made) == len(wanted)
            if column.values.dtype.kind == "f":
                assert np.array_equal(np.array(made, dtype=float), wanted, equal_nan=True)
            else:
                assert made == wanted.tolist()
    assert pandas.attrs["units"] == {key: column.unit for key, column in columns.items()}


def test_the_table_of_a_calibration(cal):
    frame = cal.to_dataframe().set_index("coefficient")
    assert frame.loc["k0", "value"] == cal["k0"].value
    assert frame.loc["k0", "unit"] == "g"
    assert frame.loc["k0", "value_si"] == cal["k0"].value * G0
    assert frame.loc["k0", "unit_si"] == "m/s^2"
    assert (frame.loc["k0", "low"], frame.loc["k0", "high"]) == cal["k0"].limits
    assert cal.table_notes()
    assert b"the reference's uncertainty was not given" in cal.to_arrow().schema.metadata[b"piga.notes"]
