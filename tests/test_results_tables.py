"""Results leave as Arrow, pandas, polars and xarray, with their units."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import polars as pl
import pyarrow as pa
import pytest

import piga
from piga.units import G0


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


TAKEN = ("cal",)
"""Polars takes a mapping for something else before it asks for Arrow: it goes through ``to_arrow``."""
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
    polars, pandas = pl.DataFrame(arrow if name in TAKEN else table), table.to_dataframe()
    frame = pd.DataFrame.from_arrow(arrow if name in TAKEN else table)
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
    assert b"Type A only" in cal.to_arrow().schema.metadata[b"piga.notes"]


def test_xarray_has_units(run, cal):
    assert list(cal.to_xarray()["value"].values) == [c.value for c in cal.values()]
    record = run.to_xarray()
    assert record["fx"].attrs["units"] == "m/s^2"
    assert record["t"].attrs["units"] == "s"
    assert np.array_equal(record["output"].values, run.output)
    assert record["segment"].values[-1] == "1"
    assert "t" in record.coords


def test_without_the_package_the_extra_is_named(cal, monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(piga.MissingPackageError, match=r"piga\[notebook\]"):
        cal.to_xarray()
