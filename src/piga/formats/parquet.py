"""Parquet and Arrow: read named columns, with units from the field metadata; write runs, residuals and tables.

What piga writes has a checksum for each page. A checksum that a file has is compared when the page is read.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from piga.errors import CalibrationError, DataError, Where
from piga.formats.columns import (
    CHUNK_ROWS,
    FileChunk,
    LabelCodes,
    MissingCount,
    no_column,
    nulls_of,
    numbers_of,
    plain_values,
)
from piga.records.calibration import Calibration, Event
from piga.records.limits import first_line, open_regular
from piga.records.run import Run
from piga.results import Column

if TYPE_CHECKING:
    import pyarrow as pa

_PER_SECOND = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
GROUP_ROWS = 1 << 20
"""Rows of a row group that is written."""


# -- in ------------------------------------------------------------------------------------------------


def is_time(kind: Any) -> bool:
    """True for the Arrow types of time stamps, times of day and durations. They are read as seconds."""
    import pyarrow as pa

    return bool(pa.types.is_timestamp(kind) or pa.types.is_time(kind) or pa.types.is_duration(kind))


@dataclass
class TypedClock:
    """Turns the time stamps of a column into seconds since the first midnight, piece by piece."""

    _first_day: int | None = None

    def seconds(self, column: Any) -> NDArray[np.float64]:
        """The seconds of an Arrow array (n,). Null entries are nan."""
        import pyarrow as pa

        per_second = _PER_SECOND[column.type.unit]
        ticks = plain_values(column, np.int32 if column.type.bit_width == 32 else np.int64).astype(np.int64)
        empty = nulls_of(column)
        if pa.types.is_timestamp(column.type):
            if self._first_day is None and not empty.all():
                self._first_day = int(ticks[~empty][0] // (86400 * per_second))
            ticks = ticks - (self._first_day or 0) * 86400 * per_second
        seconds: NDArray[np.float64] = ticks / per_second
        seconds[empty] = np.nan
        return seconds


class ArrowStream:
    """The named columns of an Arrow table, chunk by chunk: base of record streams (:class:`piga.formats.columns.RecordStream`).

    Parameters
    ----------
    path:
        Name of the table in messages.
    schema:
        Its Arrow schema. Units are those that its fields state, and seconds for times.
    numeric, label:
        Names of the number columns, and of the segment column.
    remedies:
        Remedies for a column that is not there, and for one that holds no numbers.

    Raises
    ------
    DataError
        If a column is missing or holds no numbers.
    """

    def __init__(
        self,
        path: Path,
        schema: Any,
        numeric: Sequence[str],
        label: str | None,
        remedies: tuple[str, str] = ("correct the column name in [data]", "store it as double or integer"),
    ) -> None:
        self._path, self._numeric, self._label = path, tuple(dict.fromkeys(numeric)), label
        self._wanted = list(dict.fromkeys([*self._numeric, *([label] if label else [])]))
        _check_columns(path, schema, self._wanted, self._numeric, remedies)
        metadata = {name: schema.field(name).metadata or {} for name in self._numeric}
        self.units = {
            name: entries[b"unit"].decode("utf-8", errors="replace")
            for name, entries in metadata.items()
            if b"unit" in entries
        }
        times = [name for name in self._numeric if is_time(schema.field(name).type)]
        self.units |= dict.fromkeys(times, "s")
        self._clocks = {name: TypedClock() for name in times}
        self.label_names: list[str] = []
        self._codes = LabelCodes(self.label_names)
        self._missed = MissingCount()

    def _converted(self, batches: Iterator[Any]) -> Iterator[FileChunk]:
        """Record batches as chunks. Missing values are counted."""
        row = 1
        for batch in batches:
            rows = np.arange(row, row + batch.num_rows, dtype=np.int64)
            row += batch.num_rows
            numbers = {}
            for name in self._numeric:
                column = batch.column(name)
                self._missed.see(name, column, rows)
                numbers[name] = (
                    self._clocks[name].seconds(column) if name in self._clocks else numbers_of(column)
                )
            yield FileChunk(numbers, self._codes.of(batch.column(self._label)) if self._label else None, rows)

    def events(self) -> list[Event]:
        """Faults and omissions; complete after the last chunk."""
        return self._missed.events(self._numeric)


class ParquetStream(ArrowStream):
    """The named columns of a Parquet file.

    Raises
    ------
    DataError
        If the file is not Parquet, lacks a column, or a column does not hold numbers. While chunks are taken also if a
        page does not match its checksum.
    """

    def __init__(self, path: Path, numeric: tuple[str, ...], label: str | None) -> None:
        with _open(path) as source:
            super().__init__(path, source.schema_arrow, numeric, label)
            self._rows = source.metadata.num_rows

    def chunks(self) -> Iterator[FileChunk]:
        """The rows in order."""
        if self._rows == 0:
            raise DataError(f"{self._path}: no data row", remedy="check that the logger wrote data")
        words = [self._label] if self._label and self._label not in self._numeric else []
        with _open(self._path, words) as source:
            yield from self._converted(source.iter_batches(CHUNK_ROWS, columns=self._wanted))


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


def _check_columns(
    path: Path, schema: Any, wanted: Sequence[str], numeric: tuple[str, ...], remedies: tuple[str, str]
) -> None:
    """Refuse a schema without a wanted column, or with a number column of another type."""
    import pyarrow as pa

    for name in wanted:
        if name not in schema.names:
            raise no_column(path, name, schema.names, remedy=remedies[0])
        where = Where(path, columns=(name,))
        if schema.names.count(name) > 1:
            raise DataError(f"{path}: duplicate column name '{name}'", remedy="rename one of them", where=where)
        kind = schema.field(name).type
        if name in numeric and not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or is_time(kind)):
            raise DataError(
                f"{path}: column '{name}' holds {kind}, not numbers", remedy=remedies[1], where=where
            )


# -- out -----------------------------------------------------------------------------------------------


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
    with parquet_writer(path, schema) as out:
        for start in range(0, run.size, GROUP_ROWS):
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


def parquet_writer(path: Any, schema: pa.Schema, **options: Any) -> Any:
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
    with parquet_writer(path, table.schema) as out:
        out.write_table(table)
