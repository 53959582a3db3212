"""A run from a table in memory: the same reading, checks and stands as for a file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np

from piga.data import EXAMPLE, copy_example
from piga.errors import ArgumentError, RunFileError, UnitError
from piga.formats.tables import WHERE, TableStream, as_arrow, stated_units, with_seconds
from piga.reading.read_run import read_stream
from piga.records.run import Run
from piga.records.run_file import ModelTable, RunFile, check_run_file
from piga.stand.run_reference import read_run, stand_reference
from piga.stand.simulate import SimulatedTest

SI = {
    "time": "s",
    "angle": "rad",
    "rate": "rad/s",
    "reference": "m/s^2",
    "base_rate": "rad/s",
    "temperature": "K",
}
"""Unit of a column for which neither the caller nor the table states one."""


def run_from_table(
    table: object, columns: dict[str, Any], tables: dict[str, Any], units: dict[str, str]
) -> Run:
    """A run from a table: :meth:`piga.Run.from_dataframe`.

    ``columns`` names the columns by their role, ``tables`` holds the other tables of a run file.

    Raises
    ------
    ArgumentError
        If the description is not valid. The message names the table and key of the run file.
    DataError
        If the columns do not hold what the description says.
    """
    _check_names(columns)
    own = stated_units(table)
    arrow, timed = with_seconds(as_arrow(table), columns["time"])
    unknown = [name for name in units if name not in arrow.schema.names]
    if unknown:
        raise ArgumentError(
            f"units: there is no column '{unknown[0]}'",
            remedy=f"the columns are: {', '.join(arrow.schema.names)}",
        )
    if timed and units.get(columns["time"], "s") != "s":
        raise ArgumentError(
            f"units: column '{columns['time']}' holds dates or durations", remedy="leave its unit out"
        )
    units = own | units | ({columns["time"]: "s"} if timed else {})
    try:
        run_file = msgspec.convert(tables | {"data": _data(columns, units)}, RunFile)
        check_run_file(run_file)
        stream = TableStream(arrow, run_file.data.number_columns(), run_file.data.segment)
        stream.units |= {name: unit for name, unit in units.items() if name in stream.units}
        return read_stream(WHERE, run_file, stream, stand_reference)
    except msgspec.ValidationError as error:
        raise ArgumentError(f"{WHERE}: {error}", remedy="the arguments are those of a run file") from None
    except (RunFileError, UnitError) as error:
        raise ArgumentError(f"{WHERE}: {error.message}", remedy=error.remedy) from None


def _check_names(columns: dict[str, Any]) -> None:
    """Refuse column names that are not text, and a reference or base rate that is not three columns."""
    for role in ("time", "output", "temperature", "segment"):
        name = columns[role]
        if name is not None and not isinstance(name, str):
            raise ArgumentError(f"{role}: {name!r} is not the name of a column", remedy="names are text")
    for role in ("reference", "base_rate"):
        names = columns[role]
        if names is None:
            continue
        if isinstance(names, str) or len(names) != 3 or not all(isinstance(name, str) for name in names):
            raise ArgumentError(
                f"{role}: {names!r} is not three names of columns", remedy="those along X0, Y0 and Z0, in order"
            )


def _data(columns: dict[str, Any], units: dict[str, str]) -> dict[str, Any]:
    """The ``[data]`` table of a run file."""
    kind = columns["kind"]
    output: dict[str, Any] = {"column": columns["output"], "kind": kind}
    if kind != "counts":
        output["unit"] = units.get(columns["output"], SI.get(kind, "rad"))
    if columns["wraps_at"] is not None:
        output["wraps_at"] = columns["wraps_at"]
    data: dict[str, Any] = {"file": str(WHERE), "output": output}
    for name in ("time", "temperature"):
        column = columns[name]
        if column is not None:
            data[name] = {"column": column, "unit": units.get(column, SI[name])}
    for name in ("reference", "base_rate"):
        group = columns[name]
        if group is not None:
            named = {units.get(column, SI[name]) for column in group}
            if len(named) > 1:
                raise ArgumentError(
                    f"{name}: its columns have several units: {', '.join(sorted(named))}", remedy="use one unit"
                )
            data[name] = {"columns": list(group), "unit": named.pop()}
    for name in ("sample_rate", "segment"):
        if columns[name] is not None:
            data[name] = columns[name]
    return data


def run_of_test(test: SimulatedTest, serial: str, model: ModelTable | dict[str, object] | None) -> Run:
    """The log of a simulated test as a run: :meth:`piga.stand.SimulatedTest.to_run`."""
    log, kind = test.log, test.electronics.kind
    columns: dict[str, np.ndarray] = {"t": log.t, "output": log.output, "temperature": log.temperature}
    columns |= {f"f{axis}": log.reference[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"w{axis}": log.base_rate[:, i] for i, axis in enumerate("xyz")}
    columns["segment"] = np.array(log.labels, dtype=object)[log.segment]
    counts = kind == "counts"
    return Run.from_dataframe(
        columns,
        scale_factor=test.specimen.instrument.scale_factor,
        output="output",
        kind=kind,
        base_rate=("wx", "wy", "wz"),
        temperature="temperature",
        segment="segment",
        serial=serial,
        counts_per_revolution=test.electronics.counts_per_revolution if counts else None,
        counter_bits=test.electronics.counter_bits if counts else None,
        model=model,
    )


def example_run() -> Run:
    """The shipped record: a dividing-head test of 24 positions, with its run file. ``piga demo`` calibrates it.

    Examples
    --------
    >>> import piga
    >>> run = piga.example_run()
    >>> run.serial, run.size, len(run.labels)
    ('tumble-a', 28824, 24)
    """
    with TemporaryDirectory() as folder:
        run = read_run(copy_example(Path(folder)))
    return replace(run, source=f"{EXAMPLE}.toml")
