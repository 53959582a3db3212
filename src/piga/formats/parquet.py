"""Parquet and Arrow: read named columns, with units from the field metadata; write runs, residuals and tables.

What piga writes has a checksum for each page. A checksum that a file has is compared when the page is read.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from piga.errors import CalibrationError, DataError, Where
from piga.formats.columns import CHUNK_ROWS, FileChunk, RecordStream
from piga.records.calibration import Calibration
from piga.records.limits import first_line, open_regular
from piga.records.run import Run
from piga.results import arrow_table

if TYPE_CHECKING:
    import pyarrow as pa

GROUP_ROWS = 1 << 20
"""Rows of a row group that is written."""


# -- in ------------------------------------------------------------------------------------------------


class ParquetStream(RecordStream):
    """The named columns of a Parquet file.

    Raises
    ------
    DataError
        If the file is not Parquet, lacks a column, or a column does not hold numbers. While chunks are taken also if a
        page does not match its checksum.
    """

    def __init__(self, path: Path, numeric: tuple[str, ...], label: str | None) -> None:
        super().__init__(path, numeric, label)
        with _open(path) as source:
            self.take_schema(source.schema_arrow)
            if source.metadata.num_rows == 0:
                raise DataError(f"{path}: no data row", remedy="check that the logger wrote data")

    def chunks(self) -> Iterator[FileChunk]:
        """The rows in order."""
        row = 1
        with _open(self.path, [name for name in self.wanted if name not in self.numeric]) as source:
            for batch in source.iter_batches(CHUNK_ROWS, columns=self.wanted):
                yield self.chunk(batch, np.arange(row, row + batch.num_rows, dtype=np.int64))
                row += batch.num_rows


@contextmanager
def _open(path: Path, labels: Sequence[str] = ()) -> Iterator[Any]:
    import pyarrow as pa
    from pyarrow import parquet

    try:
        with (
            open_regular(path, wanted="the data file in [data] file") as stream,
            parquet.ParquetFile(
                stream,
                pre_buffer=False,
                buffer_size=1 << 18,
                read_dictionary=list(labels),
                page_checksum_verification=True,
            ) as source,
        ):
            yield source
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise DataError(
            f"{path}: not a readable Parquet file ({first_line(error)})",
            remedy="the file is damaged or was altered: export it again",
            where=Where(path),
        ) from None


# -- out -----------------------------------------------------------------------------------------------


def write_run_parquet(run: Run, path: Path) -> None:
    """Write the used samples of a run.

    The field of every column has ``unit``. The schema holds ``serial``, ``source``, ``input_sha256`` and
    ``quality`` (all detected and repaired faults, as JSON).
    """
    metadata = {
        "serial": run.serial,
        "source": Path(run.source).name,
        "input_sha256": json.dumps(run.input_sha256),
        "quality": json.dumps(msgspec.to_builtins(run.quality)),
    }
    schema = arrow_table(run.table_columns(slice(0, 0)), metadata).schema
    with _parquet_writer(path, schema) as out:
        for start in range(0, run.size, GROUP_ROWS):
            out.write_table(arrow_table(run.table_columns(slice(start, start + GROUP_ROWS)), metadata))


def _parquet_writer(path: Any, schema: pa.Schema, **options: Any) -> Any:
    """The ``pyarrow.parquet.ParquetWriter`` of every Parquet file of piga: packed, with a checksum for each page.

    Only texts repeat few values: a dictionary of measured numbers would take time and space.
    """
    import pyarrow as pa
    from pyarrow import parquet

    texts = [f.name for f in schema if not (pa.types.is_floating(f.type) or pa.types.is_integer(f.type))]
    settings = {"compression": "zstd", "use_dictionary": texts, "write_page_checksum": True} | options
    return parquet.ParquetWriter(path, schema, **settings)


def data_table(run: Run, file: str) -> str:
    """The ``[data]`` table of a run file that reads the Parquet back."""
    unit = "" if run.quantity == "count" else f', unit = "{run.output_unit}"'
    lines = [
        "[data]",
        f"file = {json.dumps(file, ensure_ascii=False)}",
        'time = { column = "t", unit = "s" }',
        f'output = {{ column = "output", kind = "{run.quantity.replace("count", "counts")}"{unit} }}',
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
    with _parquet_writer(path, table.schema) as out:
        out.write_table(table)
