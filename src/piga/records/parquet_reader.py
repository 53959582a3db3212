"""Parquet data: the named columns, with units from the field metadata where it holds them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from piga.errors import DataError
from piga.records.calibration import Event
from piga.records.limits import first_line
from piga.records.stream import CHUNK_ROWS, Chunk, LabelCodes, MissingCount, nulls_of, numbers_of


class ParquetStream:
    """The named columns of a Parquet file, chunk by chunk; see :class:`piga.records.stream.RecordStream`.

    Raises
    ------
    DataError
        If the file is no Parquet, lacks a column, or a column holds no numbers.
    """

    def __init__(
        self, path: Path, numeric: tuple[str, ...], label: str | None, chunk_rows: int = CHUNK_ROWS
    ) -> None:
        self._path, self._numeric, self._label = path, tuple(dict.fromkeys(numeric)), label
        self._chunk_rows = chunk_rows
        with _open(path) as source:
            schema = source.schema_arrow
            _check_columns(path, schema, [*self._numeric, *([label] if label else [])], numeric)
            self.expected_rows = source.metadata.num_rows
        self.units = _units(schema, self._numeric)
        self.label_names: list[str] = []
        self._codes, self._missed = LabelCodes(self.label_names), MissingCount()

    def chunks(self) -> Iterator[Chunk]:
        """The rows in order."""
        if self.expected_rows == 0:
            raise DataError(f"{self._path}: no data row", remedy="check that the logger wrote data")
        wanted = list(dict.fromkeys([*self._numeric, *([self._label] if self._label else [])]))
        row = 1
        with _open(self._path) as source:
            for batch in source.iter_batches(self._chunk_rows, columns=wanted):
                rows = np.arange(row, row + batch.num_rows, dtype=np.int64)
                row += batch.num_rows
                numbers = {name: self._column(batch.column(name), name, rows) for name in self._numeric}
                codes = self._codes.of(batch.column(self._label)) if self._label else None
                yield Chunk(numbers, codes, rows)

    def events(self) -> list[Event]:
        """What was found, after the last chunk."""
        return self._missed.events(self._numeric)

    def _column(self, column: Any, name: str, rows: Any) -> Any:
        if column.null_count:
            self._missed.add(name, nulls_of(column), rows)
        return numbers_of(column)


@contextmanager
def _open(path: Path) -> Iterator[Any]:
    import pyarrow as pa
    from pyarrow import parquet

    try:
        with parquet.ParquetFile(path, pre_buffer=False, buffer_size=1 << 18) as source:
            yield source
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise DataError(
            f"{path}: not a readable Parquet file ({first_line(error)})", remedy="export it again"
        ) from None


def _check_columns(path: Path, schema: Any, wanted: list[str], numeric: tuple[str, ...]) -> None:
    import pyarrow as pa

    for name in wanted:
        if name not in schema.names:
            raise DataError(
                f"{path}: no column '{name}'; the columns are: {', '.join(schema.names)}",
                remedy="correct the column name in [data]",
            )
        if schema.names.count(name) > 1:
            raise DataError(
                f"{path}: the column name '{name}' stands more than once", remedy="rename one of them"
            )
        kind = schema.field(name).type
        if name in numeric and not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
            raise DataError(
                f"{path}: column '{name}' holds {kind}, not numbers", remedy="store it as double or integer"
            )


def _units(schema: Any, numeric: tuple[str, ...]) -> dict[str, str]:
    metadata = {name: schema.field(name).metadata or {} for name in numeric}
    return {
        name: found[b"unit"].decode("utf-8", errors="replace")
        for name, found in metadata.items()
        if b"unit" in found
    }
