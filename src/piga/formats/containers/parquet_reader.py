"""Read named columns of a Parquet file, with units from the field metadata if it holds them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.errors import DataError
from piga.formats.columns import (
    CHUNK_ROWS,
    FileChunk,
    LabelCodes,
    MissingCount,
    RawTable,
    nulls_of,
    numbers_of,
    plain_values,
)
from piga.records.calibration import Event
from piga.records.limits import MAX_SEGMENTS, MOST_NAME_LETTERS, first_line, open_regular

_PER_SECOND = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}


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
        _check_columns(path, schema, self._numeric, label, remedies)
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
        self._missed = MissingCount()

    def _numbers(self, batch: Any, rows: NDArray[np.int64]) -> dict[str, NDArray[np.float64]]:
        """The number columns of some rows. Missing values are counted."""
        numbers = {}
        for name in self._numeric:
            column = batch.column(name)
            self._missed.see(name, column, rows)
            numbers[name] = self._clocks[name].seconds(column) if name in self._clocks else numbers_of(column)
        return numbers

    def events(self) -> list[Event]:
        """Faults and omissions; complete after the last chunk."""
        return self._missed.events(self._numeric)


class ParquetStream(ArrowStream):
    """The named columns of a Parquet file.

    Raises
    ------
    DataError
        If the file is not Parquet, lacks a column, or a column does not hold numbers.
    """

    def __init__(self, path: Path, numeric: tuple[str, ...], label: str | None) -> None:
        with _open(path) as source:
            super().__init__(path, source.schema_arrow, numeric, label)
            self.expected_rows = source.metadata.num_rows

    def chunks(self) -> Iterator[FileChunk]:
        """The rows in order."""
        if self.expected_rows == 0:
            raise DataError(f"{self._path}: no data row", remedy="check that the logger wrote data")
        codes = self._labels() if self._label else None
        row = 1
        with _open(self._path) as source:
            for batch in self._batches(source):
                rows = np.arange(row, row + batch.num_rows, dtype=np.int64)
                row += batch.num_rows
                part = None if codes is None else np.array(codes[rows[0] - 1 : row - 1])
                yield FileChunk(self._numbers(batch, rows), part, rows)

    def _batches(self, source: Any) -> Iterator[Any]:
        """Batches of the number columns. Without number columns: empty batches that only count rows."""
        import pyarrow as pa

        if self._numeric:
            yield from source.iter_batches(CHUNK_ROWS, columns=list(self._numeric))
            return
        for start in range(0, self.expected_rows, CHUNK_ROWS):
            count = min(CHUNK_ROWS, self.expected_rows - start)
            yield pa.record_batch({"": pa.nulls(count)})

    def _labels(self) -> NDArray[np.int32]:
        """Codes of the segment column. A separate process reads it, because labels of a few bytes can unpack to gigabytes."""
        from piga.formats.containers.container import read_container

        label = str(self._label)
        codes, names = read_container(self._path, ".parquet", (), label).labels[label]
        if codes.size != self.expected_rows:
            raise DataError(
                f"{self._path}: {codes.size} labels for {self.expected_rows} rows", remedy="export it again"
            )
        self.label_names.extend(names)
        return codes


def read_labels(path: Path, _numeric: tuple[str, ...], label: str) -> RawTable:
    """Read only the segment column. Runs in the process that reads containers.

    Raises
    ------
    DataError
        If the file is not Parquet, has too many segments or a label is too long.
    """
    names: list[str] = []
    codes, parts = LabelCodes(names), []
    with _open(path, [label]) as source:
        for batch in source.iter_batches(CHUNK_ROWS, columns=[label]):
            parts.append(codes.of(batch.column(0)))
            if len(names) > MAX_SEGMENTS:
                raise DataError(
                    f"{path}: column '{label}' has more than {MAX_SEGMENTS} different segments",
                    remedy="name the column that numbers the positions",
                )
    long = next((name for name in names if len(name) > MOST_NAME_LETTERS), None)
    if long is not None:
        raise DataError(
            f"{path}: column '{label}': the label '{long[:40]}...' has {len(long)} characters",
            remedy=f"use {MOST_NAME_LETTERS} or fewer",
        )
    whole = np.concatenate(parts) if parts else np.zeros(0, np.int32)
    return RawTable(path, {}, {label: (whole, tuple(names))}, whole.size)


@contextmanager
def _open(path: Path, labels: Sequence[str] = ()) -> Iterator[Any]:
    import pyarrow as pa
    from pyarrow import parquet

    try:
        with (
            open_regular(path, wanted="the data file in [data] file") as stream,
            parquet.ParquetFile(
                stream, pre_buffer=False, buffer_size=1 << 18, read_dictionary=list(labels)
            ) as source,
        ):
            yield source
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise DataError(
            f"{path}: not a readable Parquet file ({first_line(error)})", remedy="export it again"
        ) from None


def _check_columns(
    path: Path, schema: Any, numeric: tuple[str, ...], label: str | None, remedies: tuple[str, str]
) -> None:
    """Refuse a schema without a wanted column, or with a number column of another type."""
    import pyarrow as pa

    for name in (*numeric, *([label] if label else [])):
        if name not in schema.names:
            raise DataError(
                f"{path}: no column '{name}'; the columns are: {', '.join(schema.names)}",
                remedy=remedies[0],
            )
        if schema.names.count(name) > 1:
            raise DataError(f"{path}: duplicate column name '{name}'", remedy="rename one of them")
        kind = schema.field(name).type
        if name in numeric and not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or is_time(kind)):
            raise DataError(f"{path}: column '{name}' holds {kind}, not numbers", remedy=remedies[1])
