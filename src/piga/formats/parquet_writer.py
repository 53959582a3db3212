"""Write a run and its residuals as Parquet, and make Arrow arrays from the memory of columns."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.typing import NDArray

from piga.errors import CalibrationError
from piga.records.calibration import Calibration
from piga.records.run import Run
from piga.records.spool import trim
from piga.results import Column

if TYPE_CHECKING:
    import pyarrow as pa


def number_column(values: NDArray, empty_cells: bool = False) -> pa.Array:
    """Array that shares the memory of numbers (n,). With ``empty_cells``, nan becomes null."""
    import pyarrow as pa

    held = np.ascontiguousarray(values)
    known = pa.py_buffer(np.packbits(~np.isnan(held), bitorder="little")) if empty_cells else None
    return pa.Array.from_buffers(pa.from_numpy_dtype(held.dtype), held.size, [known, pa.py_buffer(held)])


def text_column(values: Sequence[str]) -> pa.StringArray:
    """Array of texts."""
    import pyarrow as pa

    encoded = [value.encode() for value in values]
    ends = np.cumsum([0, *(len(value) for value in encoded)], dtype=np.int32)
    return pa.StringArray.from_buffers(len(encoded), pa.py_buffer(ends), pa.py_buffer(b"".join(encoded)))


def label_column(codes: NDArray, labels: Sequence[str]) -> pa.DictionaryArray:
    """Array of texts, given by indices (n,) into ``labels``."""
    import pyarrow as pa

    return pa.DictionaryArray.from_arrays(number_column(codes), text_column(labels))


GROUP_ROWS = 1 << 20
"""Rows of a row group."""


def write_run_parquet(run: Run, path: Path) -> None:
    """Write the used samples of a run.

    The field of every column has ``unit``. The schema holds ``serial``, ``source``, ``input_sha256`` and
    ``quality`` (all detected and repaired faults, as JSON).
    """
    from pyarrow import parquet

    metadata = {
        "serial": run.serial,
        "source": Path(run.source).name,
        "input_sha256": json.dumps(run.input_sha256),
        "quality": json.dumps(msgspec.to_builtins(run.quality)),
    }
    schema = arrow_table(run.table_columns(slice(0, 0)), metadata).schema
    with parquet.ParquetWriter(path, schema, compression="zstd", use_dictionary=_texts(schema)) as out:
        for start in range(0, run.size, GROUP_ROWS):
            trim()
            out.write_table(arrow_table(run.table_columns(slice(start, start + GROUP_ROWS)), metadata))


def arrow_table(columns: dict[str, Column], metadata: dict[str, str] | None = None) -> pa.Table:
    """Columns as an Arrow table. The field of each has its ``unit``. Numbers share their memory."""
    import pyarrow as pa

    arrays = {name: _array(column) for name, column in columns.items()}
    fields = [pa.field(name, arrays[name].type, metadata={"unit": columns[name].unit}) for name in columns]
    return pa.Table.from_arrays(list(arrays.values()), schema=pa.schema(fields, metadata=metadata))


def _array(column: Column) -> pa.Array:
    if column.labels is not None:
        return label_column(column.values.astype(np.int32), column.labels)
    if column.values.dtype.kind in "OU":
        return text_column([str(value) for value in column.values])
    return number_column(column.values)


def _texts(schema: pa.Schema) -> list[str]:
    """Columns of texts. Only they repeat few values: a dictionary of measured numbers would take time and space."""
    import pyarrow as pa

    return [f.name for f in schema if not (pa.types.is_floating(f.type) or pa.types.is_integer(f.type))]


def data_table(run: Run, file: str) -> str:
    """The ``[data]`` table of a run file that reads the Parquet back."""
    lines = [
        "[data]",
        f"file = {json.dumps(file, ensure_ascii=False)}",
        'time = { column = "t", unit = "s" }',
        f'output = {{ column = "output", kind = "{run.kind}", unit = "{run.output_unit}" }}',
        'reference = { columns = ["fx", "fy", "fz"], unit = "m/s^2" }',
    ]
    if run.base_rate is not None:
        lines.append('base_rate = { columns = ["wx", "wy", "wz"], unit = "rad/s" }')
    if run.temperature is not None:
        lines.append('temperature = { column = "temperature", unit = "K" }')
    return "\n".join([*lines, 'segment = "segment"'])


def write_residuals(calibration: Calibration, path: Path) -> None:
    """Write the residuals of a fresh calibration.

    Columns: ``row`` (file row), ``segment``, ``t`` [s], ``psi``, ``a_x``, ``before``, ``after`` and
    ``innovation``; for a joint calibration also ``run``.
    """
    from pyarrow import parquet

    residuals = calibration.residuals
    if residuals is None:
        raise CalibrationError(
            "this calibration was read from a file and holds no residuals", remedy="calibrate again"
        )
    columns = residuals.table_columns()
    labels = [segment.label for segment in calibration.segments]
    columns["segment"] = columns["segment"]._replace(labels=labels)
    if "run" in columns:
        columns["run"] = columns["run"]._replace(labels=[run.name for run in calibration.runs])
    metadata = {"serial": calibration.serial, "software": calibration.provenance.software}
    table = arrow_table(columns, metadata)
    parquet.write_table(table, path, compression="zstd", use_dictionary=_texts(table.schema))
