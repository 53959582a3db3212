"""A run as clean Parquet: SI columns with their units, what was found, and where it came from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from piga.formats.arrow_columns import label_column, number_column
from piga.records.run import Run
from piga.records.spool import trim

GROUP_ROWS = 1 << 20
"""Rows written at a time, as a row group."""


def write_run_parquet(run: Run, path: Path) -> None:
    """Write the used samples of a run.

    Every column's field has ``unit``; the schema holds ``serial``, ``source``, ``input_sha256`` and
    ``quality`` (everything that was found and repaired, as JSON).
    """
    import pyarrow as pa
    from pyarrow import parquet

    fields = [
        pa.field(name, array.type, metadata={"unit": unit})
        for name, (array, unit) in _columns(run, slice(0, 0)).items()
    ]
    metadata = {
        "serial": run.serial,
        "source": Path(run.source).name,
        "input_sha256": json.dumps(run.input_sha256),
        "quality": json.dumps(msgspec.to_builtins(run.quality)),
    }
    schema = pa.schema(fields, metadata=metadata)
    with parquet.ParquetWriter(path, schema, compression="zstd") as out:
        for start in range(0, run.size, GROUP_ROWS):
            trim()
            found = _columns(run, slice(start, start + GROUP_ROWS))
            out.write_table(pa.Table.from_arrays([array for array, _ in found.values()], schema=schema))


def _columns(run: Run, part: slice) -> dict[str, tuple[Any, str]]:
    """Arrow arrays of a slice of rows with their units, by name."""
    columns: dict[str, tuple[Any, str]] = {
        "t": (number_column(run.t[part]), "s"),
        "output": (number_column(run.output[part]), output_unit(run)),
    }
    columns |= {f"f{axis}": (number_column(run.f[part, i]), "m/s^2") for i, axis in enumerate("xyz")}
    if run.base_rate is not None:
        columns |= {
            f"w{axis}": (number_column(run.base_rate[part, i]), "rad/s") for i, axis in enumerate("xyz")
        }
    if run.temperature is not None:
        columns["temperature"] = (number_column(run.temperature[part]), "K")
    columns["segment"] = (label_column(run.segment[part].astype(np.int32), run.labels), "1")
    return columns | {"row": (number_column(run.row[part]), "1")}


def output_unit(run: Run) -> str:
    """Unit of the output column: rad, or rad/s for a rate log."""
    return "rad/s" if run.kind == "rate" else "rad"


def data_table(run: Run, file: str) -> str:
    """The ``[data]`` table of a run file that reads the Parquet back."""
    lines = [
        "[data]",
        f"file = {json.dumps(file, ensure_ascii=False)}",
        'time = { column = "t", unit = "s" }',
        f'output = {{ column = "output", kind = "{run.kind}", unit = "{output_unit(run)}" }}',
        'reference = { columns = ["fx", "fy", "fz"], unit = "m/s^2" }',
    ]
    if run.base_rate is not None:
        lines.append('base_rate = { columns = ["wx", "wy", "wz"], unit = "rad/s" }')
    if run.temperature is not None:
        lines.append('temperature = { column = "temperature", unit = "K" }')
    return "\n".join([*lines, 'segment = "segment"'])
