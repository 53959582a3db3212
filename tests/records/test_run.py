"""Runs made from tables and arrays, and cut, without a file."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import polars as pl
import pyarrow as pa
import pytest

import piga
from piga.records import Run
from piga.units import G0
from tests.short_record import SCALE, TERMS, a_run

COLUMNS = {"output": "output", "reference": ["fx", "fy", "fz"], "segment": "segment"}


def a_table(run: piga.Run) -> dict[str, np.ndarray]:
    """The record in the units of a lab: milliseconds, degrees, g."""
    degrees = np.degrees(run.output)
    columns = {"ms": 1e3 * run.t, "psi": degrees} | {f"f{a}": run.f[:, i] / G0 for i, a in enumerate("xyz")}
    return columns | {"position": np.array([f"P{i}" for i in run.segment_index], dtype=object)}


UNITS = {"ms": "ms", "psi": "deg", "fx": "g", "fy": "g", "fz": "g"}


LAB = {"time": "ms", "units": UNITS, "segment": "position", "scale_factor": SCALE, "serial": "T-1"}


@pytest.mark.parametrize("kind", [dict, pd.DataFrame, pl.DataFrame, pa.table])
def test_any_table_gives_the_record(run, cal, kind):
    made = piga.Run.from_dataframe(kind(a_table(run)), **LAB)
    assert made.labels == ("P0", "P1")
    assert np.allclose(made.output, run.output, rtol=0, atol=1e-12)
    assert np.allclose(made.f, run.f, rtol=1e-15, atol=1e-15)
    assert made.quality.used == 800
    calibration = piga.calibrate(made, TERMS)
    assert calibration["tan_beta"].value == pytest.approx(cal["tan_beta"].value, rel=1e-6)


@pytest.mark.parametrize("leave", ["to_arrow", "to_dataframe"])
def test_a_run_that_left_as_a_table_comes_back(leave):
    """Units travel with the table."""
    run = a_run(temperature=np.linspace(290.0, 300.0, 800), base_rate=np.full((800, 3), 1e-5))
    again = piga.Run.from_dataframe(
        getattr(run, leave)(), **COLUMNS, scale_factor=SCALE, serial="T-1", temperature="temperature",
        base_rate=["wx", "wy", "wz"],
    )  # fmt: skip
    for name in ("t", "output", "f", "base_rate", "temperature", "segment_index", "labels", "begins"):
        assert np.array_equal(getattr(run, name), getattr(again, name)), name


def test_rows_are_repaired_and_counted_as_those_of_a_file(run):
    table = pd.DataFrame(a_table(run))
    table.loc[10, "psi"] = np.nan
    table = table.drop(index=[50, 51, 52])
    made = piga.Run.from_dataframe(table, **LAB)
    kinds = {event.kind: event for event in made.quality.events}
    assert kinds["missing-value"].first_row == 11
    assert made.size == 796
    assert made.begins.sum() == 4


def test_counts_that_wrap_are_a_run_without_a_file(run):
    counts = np.floor(run.output * 72000 / (2 * np.pi)).astype(np.int64)
    table = a_table(run) | {"psi": counts % 4096}
    made = piga.Run.from_dataframe(
        table, **{**LAB, "units": {k: v for k, v in UNITS.items() if k != "psi"}, "segment": None}, kind="counts",
        counts_per_revolution=72000, counter_bits=12,
    )  # fmt: skip
    turned = made.output - made.output[0]
    assert np.abs(turned - (run.output - run.output[0])).max() < 2 * 2 * np.pi / 72000
    assert made.resolution == pytest.approx(2 * np.pi / 72000)


@pytest.mark.parametrize("zone", [None, "Europe/Berlin"])
@pytest.mark.parametrize("resolution", ["ns", "ms"])
def test_a_time_of_dates_counts_from_the_first_midnight(run, zone, resolution):
    """Naive dates as they are, those with a zone in UTC; a row without a date is left out."""
    clock = pd.Timestamp("2026-03-29 01:59:40", tz=zone) + pd.to_timedelta(run.t, unit="s")
    table = pd.DataFrame(a_table(run) | {"ms": clock.as_unit(resolution)})
    table.loc[10, "ms"] = pd.NaT
    units = {name: unit for name, unit in UNITS.items() if name != "ms"}
    made = piga.Run.from_dataframe(table, **(LAB | {"units": units}))
    start = 3580.0 if zone else 7180.0
    assert np.allclose(made.t, np.delete(run.t, 10) + start, rtol=0, atol=1e-9)
    assert np.flatnonzero(made.begins).tolist() == [0, 10, 399]
    with pytest.raises(
        piga.ArgumentError, match="column 'ms' holds dates or durations\n  remedy: leave its unit out"
    ):
        piga.Run.from_dataframe(table, **LAB)


@pytest.mark.parametrize(("kind", "per_second"), [(pl.Duration("us"), 1e6), (pl.Time, 1e9)])
def test_a_time_of_durations_or_times_of_day_is_in_seconds(run, kind, per_second):
    ticks = pl.Series((run.t * per_second).round()).cast(pl.Int64)
    table = pl.DataFrame(a_table(run)).with_columns(ms=ticks.cast(kind))
    units = {name: unit for name, unit in UNITS.items() if name != "ms"}
    made = piga.Run.from_dataframe(table, **(LAB | {"units": units}))
    assert np.allclose(made.t, run.t, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"output": "nothing"}, "no column 'nothing'"),
        ({"scale_factor": "0.9 rad"}, "a quantity in 'rad/s/g' is needed"),
        ({"scale_factor": -1.0}, "scale_factor: -1.0 has no unit"),
        ({"scale_factor": "-1 rad/s/g"}, "must be positive"),
        ({"units": UNITS | {"fx": "mg"}}, "reference: its columns have several units"),
        ({"units": UNITS | {"psi": "K"}}, "does not measure the same quantity"),
        ({"kind": "counts"}, "counts_per_revolution is missing"),
        ({"reference": None}, "reference is missing"),
        ({"model": {"terms": ["k99"]}}, "unknown term 'k99'"),
        ({"model": {"term": ["k0"]}}, r"\[model\] has the unknown key 'term'"),
        ({"kind": "angles"}, "'angles' is not one of the allowed"),
        ({"time": None}, "needs either time or sample_rate"),
        ({"units": UNITS | {"Psi": "deg"}}, r"there is no column 'Psi'\n  remedy: the columns are: ms, psi"),
        ({"reference": "fx"}, r"reference.columns\]: expected a list"),
        ({"reference": ["fx", "fy"]}, "of length 3, got 2"),
        ({"time": 0}, "expected text, got a whole number"),
    ],
)
def test_a_wrong_description_is_refused(run, changes, said):
    with pytest.raises(piga.PigaError, match=said):
        piga.Run.from_dataframe(a_table(run), **(LAB | changes))


def test_something_else_is_no_table():
    with pytest.raises(piga.ArgumentError, match="a int does not give Arrow columns"):
        piga.Run.from_dataframe(3, scale_factor=SCALE)


def test_arrays_take_what_a_run_file_takes():
    gaps = np.zeros(800, bool)
    gaps[[100, 500]] = True
    run = a_run(
        segment=np.repeat(["up", "down"], 400),
        gaps=gaps,
        temperature=np.full(800, 293.0),
        uncertainty={"reference_scale": "10 ppm"},
        model={"terms": ["scale_factor", "tan_beta"]},
        estimation={"method": "rate"},
    )
    assert run.labels == ("up", "down")
    assert np.flatnonzero(run.begins).tolist() == [0, 100, 400, 500]
    calibration = piga.calibrate(run)
    assert calibration.terms == ("scale_factor", "tan_beta")
    assert calibration.method == "rate"
    assert any(row.source == "reference_scale" for row in calibration.budget)


def test_a_stand_gives_the_reference_of_a_table():
    stand = {
        "kind": "dividing-head", "latitude": "40 deg", "gravity": "9.80166 m/s^2",
        "positions": {"up": "0 deg", "level": "90 deg"}, "dwell": "20 s",
    }  # fmt: skip
    t = np.arange(800) * 0.05
    table = {"t": t, "psi": 0.8 * t, "at": ["up"] * 400 + ["level"] * 400}
    run = piga.Run.from_dataframe(
        table, scale_factor=SCALE, segment="at", reference=None, stand=stand, units="SI"
    )
    assert np.linalg.norm(run.f[0]) == pytest.approx(9.80166, rel=1e-9)
    assert abs(abs(run.f[0, 0]) - abs(run.f[-1, 0])) > 9.0
    assert run.base_rate is not None


def test_a_run_is_cut_by_time(run):
    part = run.between(5.0, "0.5 min")
    assert (part.t[0], part.t[-1]) == (5.0, 30.0)
    assert part.labels == ("0", "1")
    assert part.begins[0]
    assert part.begins.sum() == 2
    assert part.row[0] == run.row[100]
    assert (part.quality.used, part.quality.masked) == (part.size, 800 - part.size)
    assert part.quality.events[-1].detail == "between 5 and 30 s"
    assert run.between(0, 1e9).quality == run.quality
    assert piga.calibrate(part, TERMS)["scale_factor"].value == pytest.approx(0.8884, abs=2e-3)
    with pytest.raises(piga.ArgumentError, match="0 of 800 samples are left"):
        run.between(100.0, 200.0)


def test_a_run_is_cut_by_segment(run):
    part = run.segment("1")
    assert part.labels == ("1",)
    assert part.size == 400
    assert set(part.segment_index.tolist()) == {0}
    assert run.segment("0", "1") == replace(run)
    with pytest.raises(piga.ArgumentError, match=r"no segment '7'\n  remedy: segments: '0', '1'"):
        run.segment("7")
    with pytest.raises(piga.ArgumentError, match=r"no segment 1\n  remedy: segments: '0', '1'"):
        run.segment(1)
    with pytest.raises(piga.ArgumentError, match="no name is given"):
        run.segment()


def test_rows_are_left_out_and_no_increment_crosses_them(run):
    part = run.without([11, 12, 401])
    assert part.size == 797
    assert not np.isin([11, 12, 401], part.row).any()
    assert np.flatnonzero(part.begins).tolist() == [0, 10, 398]
    assert part == run.without(np.isin(run.row, [11, 12, 401]))
    assert np.array_equal(run.without(11).row, np.delete(run.row, 10))
    with pytest.raises(piga.ArgumentError, match="row 9000 is not in the record"):
        run.without([9000])
    with pytest.raises(piga.ArgumentError, match="3 truth values for 800 samples"):
        run.without(np.zeros(3, bool))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "counts"}, "neither 'angle' nor 'rate'"),
        ({"t": [0.0], "output": [0.0], "f": [[1.0, 0, 0]]}, "at least two samples"),
        ({"output": [0.0, 1.0]}, r"output: shape \(2,\), but t has 3 samples(?s:.*)give shape \(3,\)"),
        ({"base_rate": [[0.0] * 3] * 2}, r"base_rate: shape \(2, 3\)"),
        ({"gaps": [False]}, r"gaps: shape \(1,\)"),
        ({"estimation": {"method": "best"}}, r"\[estimation.method\]: 'best'"),
        ({"output": [0.0, math.nan, 1.0]}, r"output\[1\] is not finite"),
        ({"t": [0.0, 1.0, 1.0]}, r"t\[2\] = .*is not after t\[1\]"),
    ],
)
def test_arrays_that_do_not_fit(change: dict[str, object], message: str) -> None:
    given = {"t": [0.0, 1.0, 2.0], "output": [0.0, 1.0, 2.0], "f": [[1.0, 0.0, 0.0]] * 3}
    with pytest.raises(piga.ArgumentError, match=message):
        Run.from_arrays(scale_factor="0.8884 rad/s/g", **(given | change), units="SI")


def test_units_of_arrays_are_stated(run):
    """Without a unit of the force, or of the scale factor, nothing is taken; the record in the units of a lab is the same."""
    arrays = {"t": 1e3 * run.t, "output": np.degrees(run.output), "f": run.f / G0}
    told = {"t": "ms", "output": "deg", "f": "g"}
    for scale, units, said in (
        (SCALE, None, r"f: its unit is not stated\n  remedy: units='SI' if it is in m/s\^2"),
        (0.8884, told, r'scale_factor: 0.8884 has no unit\n  remedy: .*"0.8884 rad/s/g"'),
        (SCALE, {"f": "g", "force": "g"}, "units: there is no argument 'force'"),
        (SCALE, told | {"f": "deg"}, "units: f: unit 'deg' does not measure"),
    ):
        with pytest.raises(piga.PigaError, match=said):
            piga.Run.from_arrays(**arrays, scale_factor=scale, units=units)
    arrays |= {"temperature": np.full(run.size, 20.0)}
    made = piga.Run.from_arrays(**arrays, scale_factor=SCALE, units=told | {"temperature": "degC"})
    assert made.temperature is not None
    assert made.temperature[0] == 293.15
    for name in ("t", "output", "f"):
        assert np.allclose(getattr(made, name), getattr(run, name), rtol=1e-13, atol=1e-12), name
    plain = piga.Run.from_arrays(run.t, run.output, run.f, scale_factor=run.scale_factor, units="SI")
    assert plain.scale_factor == run.scale_factor


def test_units_of_a_table_are_stated(run):
    table = {name: column for name, column in a_table(run).items() if name != "position"}
    for name in ("psi", "fy"):
        units = {key: unit for key, unit in UNITS.items() if key != name}
        with pytest.raises(piga.PigaError, match=f"units: that of column '{name}' is not stated"):
            piga.Run.from_dataframe(table, time="ms", units=units, scale_factor=SCALE)
