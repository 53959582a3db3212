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
from numpy.typing import NDArray

from piga.errors import CalibrationError
from piga.formats.columns import CHUNK_ROWS, RecordStream, refusal
from piga.records.calibration.calibration import Calibration
from piga.records.run import Run
from piga.records.text_files import first_line, open_regular, toml_text
from piga.results import arrow_table

if TYPE_CHECKING:
    import pyarrow as pa

GROUP_ROWS = 1 << 20
"""Rows of a row group that is written."""


# -- in ------------------------------------------------------------------------------------------------


class ParquetStream(RecordStream):
    """The named columns of a Parquet file."""

    def __init__(self, path: Path, numeric: tuple[str, ...], label: str | None) -> None:
        super().__init__(path, numeric, label)
        with _open(path) as source:
            self.take_schema(source.schema_arrow)
            if source.metadata.num_rows == 0:
                raise refusal(path, "no data row", "check that the logger wrote data")

    def batches(self) -> Iterator[tuple[Any, NDArray[np.int64]]]:
        """Record batches, and the file rows of each."""
        row = 1
        with _open(self.path, [name for name in self.wanted if name not in self.numeric]) as source:
            for batch in source.iter_batches(CHUNK_ROWS, columns=self.wanted):
                yield batch, np.arange(row, row + batch.num_rows)
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
        words = f"not a readable Parquet file ({first_line(error)})"
        raise refusal(path, words, "the file is damaged or was altered: export it again") from None


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
    _write(arrow_table(run.table_columns(), metadata), path)


def _write(table: pa.Table, path: Path) -> None:
    """Write a table, packed, with a checksum for each page. A dictionary of measured numbers would take time and space."""
    import pyarrow as pa
    from pyarrow import parquet

    texts = [f.name for f in table.schema if not (pa.types.is_floating(f.type) or pa.types.is_integer(f.type))]
    options: dict[str, Any] = {"compression": "zstd", "use_dictionary": texts, "write_page_checksum": True}
    parquet.write_table(table, path, GROUP_ROWS, **options)


def data_table(run: Run, file: str) -> str:
    """The ``[data]`` table of a run file that reads the Parquet back."""
    output = {"column": "output", "kind": run.quantity.replace("count", "counts")}
    data = {
        "file": file,
        "time": {"column": "t", "unit": "s"},
        "output": output if run.quantity == "count" else output | {"unit": run.output_unit},
        "reference": {"columns": ["fx", "fy", "fz"], "unit": "m/s^2"},
        "base_rate": {"columns": ["wx", "wy", "wz"], "unit": "rad/s"},
        "temperature": {"column": "temperature", "unit": "K"},
        "segment": "segment",
    }
    without = {name for name in ("base_rate", "temperature") if getattr(run, name) is None}
    return toml_text({"data": {key: value for key, value in data.items() if key not in without}}).rstrip("\n")


def write_residuals(calibration: Calibration, path: Path) -> None:
    """Write the residuals of a fresh calibration: the columns of :class:`piga.Residuals`."""
    residuals = calibration.residuals
    if residuals is None:
        words = "this calibration was read from a file and holds no residuals"
        raise CalibrationError(words, remedy="calibrate again")
    columns = residuals.table_columns()
    columns["segment"] = columns["segment"]._replace(labels=[one.label for one in calibration.segments])
    if "run" in columns:
        columns["run"] = columns["run"]._replace(labels=[run.name for run in calibration.runs])
    metadata = {"serial": calibration.serial, "software": calibration.provenance.software}
    _write(arrow_table(columns, metadata), path)
