"""Results for other tools: tables (Arrow, pandas, xarray) and correlated numbers. And tables in memory as columns of a record."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError, needed
from piga.formats.parquet import arrow_table
from piga.records.calibration import Calibration
from piga.records.terms import si_factor
from piga.results import Column, Tabular

WHERE = Path("table")
"""Name of a table in memory, in messages."""
_LIBRARIES = ("uncertainties", "GTC")
"""Packages whose numbers know what they are correlated with."""
REMEDIES = ("name a column of the table", "turn it into numbers first, e.g. with astype(float)")
"""Remedies for a column that is not there, and for one that holds no numbers."""


# -- out -----------------------------------------------------------------------------------------------


def arrow(result: Tabular) -> Any:
    """A result as a ``pyarrow.Table``: the unit of each column is in the metadata of its field."""
    needed("pyarrow")
    notes = result.table_notes()
    return arrow_table(result.table_columns(), {"piga.notes": json.dumps(notes)} if notes else None)


def dataframe(result: Tabular) -> Any:
    """A result as a pandas data frame, units in ``attrs``."""
    pd = needed("pandas")
    columns = result.table_columns()
    frame = pd.DataFrame({name: _plain(column) for name, column in columns.items()})
    for name, column in columns.items():
        if column.labels is not None:
            frame[name] = pd.Categorical.from_codes(np.asarray(column.values), list(column.labels))
    frame.attrs["units"] = {name: column.unit for name, column in columns.items()}
    if result.table_notes():
        frame.attrs["notes"] = list(result.table_notes())
    return frame


def dataset(result: Tabular) -> Any:
    """A result as an xarray data set: units in the attributes, the covariance of a calibration with labels."""
    xr = needed("xarray")
    columns = result.table_columns()
    along = "coefficient" if isinstance(result, Calibration) else "row"
    variables = {
        name: ((along,), _plain(column), {"units": column.unit})
        for name, column in columns.items()
        if name != along
    }
    if isinstance(result, Calibration):
        keys = list(result)
        units = {"units": "product of the units of both coefficients"}
        made = xr.Dataset(
            variables | {"covariance": ((along, "with_coefficient"), np.array(result.covariance), units)},
            coords={along: keys, "with_coefficient": keys},
        )
    else:
        made = xr.Dataset({name: values for name, values in variables.items() if name != "t"})
        if "t" in variables:
            made = made.assign_coords(t=variables["t"])
    return made.assign_attrs(notes=list(result.table_notes()))


def _plain(column: Column) -> NDArray[Any]:
    """Values of a column; labels as text."""
    if column.labels is None:
        return np.asarray(column.values)
    return np.array(column.labels, dtype=object)[np.asarray(column.values)]


def correlated(calibration: Calibration, library: str | None, *, si: bool) -> dict[str, Any]:
    """The coefficients by key: :meth:`piga.Calibration.correlated`."""
    if library is not None and library not in _LIBRARIES:
        raise ArgumentError(f"correlated: library '{library}'", remedy=f"one of {', '.join(_LIBRARIES)}")
    chosen = library or next((name for name in _LIBRARIES if find_spec(name) is not None), _LIBRARIES[0])
    needed(chosen)
    scale = np.array([si_factor(c.name) if si else 1.0 for c in calibration.coefficients])
    values = scale * np.array([c.value for c in calibration.coefficients])
    covariance = np.outer(scale, scale) * calibration.covariance
    made = (
        _uncertainties(calibration, values, covariance)
        if chosen == "uncertainties"
        else _gtc(calibration, values, covariance)
    )
    return dict(zip(calibration, made, strict=True))


def _uncertainties(calibration: Calibration, values: np.ndarray, covariance: np.ndarray) -> list[Any]:
    from uncertainties import correlated_values_norm

    std = np.sqrt(np.diag(covariance))
    pairs = list(zip(values.tolist(), std.tolist(), strict=True))
    return list(correlated_values_norm(pairs, correlation(covariance), tags=list(calibration)))


def _gtc(calibration: Calibration, values: np.ndarray, covariance: np.ndarray) -> list[Any]:
    """Numbers of GTC, one ensemble. It has one number of degrees of freedom: the fewest of all coefficients."""
    import GTC

    std, matrix = np.sqrt(np.diag(covariance)), correlation(covariance)
    uncertain = [i for i, u in enumerate(std) if u > 0.0]
    keys = list(calibration)
    fewest = min((calibration.coefficients[i].degrees_of_freedom for i in uncertain), default=math.inf)
    made: list[Any] = [GTC.constant(value, label=key) for value, key in zip(values.tolist(), keys, strict=True)]
    numbers = GTC.multiple_ureal(values[uncertain], std[uncertain], fewest, [keys[i] for i in uncertain])
    for i, number in zip(uncertain, numbers, strict=True):
        for j in (other for other in uncertain if other < i):
            GTC.set_correlation(float(matrix[i, j]), number, made[j])
        made[i] = number
    return made


def correlation(covariance: np.ndarray) -> np.ndarray:
    """Correlation matrix; a coefficient without uncertainty correlates with none."""
    std = np.sqrt(np.diag(covariance))
    size = np.where(std > 0.0, std, 1.0)
    matrix: np.ndarray = covariance / np.outer(size, size)
    np.fill_diagonal(matrix, 1.0)
    return matrix


# -- in ------------------------------------------------------------------------------------------------


def stated_units(table: object, arrow: Any) -> dict[str, str]:
    """Units by column: of the fields of ``arrow``, and in the ``attrs`` of a pandas data frame (:meth:`to_dataframe`)."""
    fields = {field.name: (field.metadata or {}).get(b"unit") for field in arrow.schema}
    attributes = getattr(table, "attrs", {})
    units = attributes.get("units", {}) if isinstance(attributes, dict) else {}
    attached = {str(name): str(unit) for name, unit in units.items()} if isinstance(units, dict) else {}
    return {name: unit.decode() for name, unit in fields.items() if unit} | attached


def as_arrow(table: object) -> Any:
    """Any table as a ``pyarrow.Table``."""
    pa = needed("pyarrow")
    try:
        if isinstance(table, np.ndarray) and table.dtype.names:
            table = {name: table[name] for name in table.dtype.names}
        if isinstance(table, Mapping):
            return pa.table({name: np.asarray(column) for name, column in table.items()})
        return pa.table(table)
    except (TypeError, ValueError, pa.ArrowException) as error:
        raise ArgumentError(
            f"table: a {type(table).__name__} does not give Arrow columns ({str(error).splitlines()[0]})",
            remedy="pass a table of pandas, polars (a lazy one after collect()) or pyarrow, or a dict of arrays",
        ) from None
