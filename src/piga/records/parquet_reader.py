"""Parquet data: the named columns, with units from the field metadata where it holds them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from piga.errors import DataError
from piga.records.calibration import Event
from piga.records.table import RawTable
from piga.records.text_reader import encode_labels


def read_parquet(path: Path, numeric: tuple[str, ...], label: str | None) -> RawTable:
    """Read the named columns of a Parquet file.

    Raises
    ------
    DataError
        If the file is no Parquet, lacks a column, or a column holds no numbers.
    """
    import pyarrow as pa
    from pyarrow import parquet

    wanted = list(dict.fromkeys([*numeric, *([label] if label else [])]))
    try:
        with parquet.ParquetFile(path, memory_map=True) as source:
            schema = source.schema_arrow
            _check_columns(path, schema, wanted, numeric)
            table = source.read(columns=wanted)
    except FileNotFoundError:
        raise DataError(f"{path}: no such file", remedy="[data] file is relative to the run file") from None
    except (pa.ArrowException, OSError) as error:
        message = str(error).splitlines()[0]
        raise DataError(f"{path}: not a readable Parquet file ({message})", remedy="export it again") from None
    if table.num_rows == 0:
        raise DataError(f"{path}: no data row", remedy="check that the logger wrote data")
    events: list[Event] = []
    numbers: dict[str, Any] = {}
    for name in dict.fromkeys(numeric):
        numbers[name] = _column(table.column(name), name, events)
    labels = {label: encode_labels(table.column(label))} if label else {}
    return RawTable(path, numbers, labels, table.num_rows, 1, _units(schema, numeric), tuple(events))


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


def _column(column: Any, name: str, events: list[Event]) -> Any:
    import pyarrow as pa

    if column.null_count:
        mask = column.is_null().to_numpy(zero_copy_only=False)
        events.append(Event("missing-value", column.null_count, int(np.argmax(mask)) + 1, f"column '{name}'"))
    if pa.types.is_integer(column.type) and not column.null_count:
        return column.to_numpy().astype(np.int64, copy=False)
    return column.to_numpy(zero_copy_only=False).astype(np.float64, copy=False)


def _units(schema: Any, numeric: tuple[str, ...]) -> dict[str, str]:
    metadata = {name: schema.field(name).metadata or {} for name in numeric}
    return {name: found[b"unit"].decode() for name, found in metadata.items() if b"unit" in found}
