"""A stream through a pipe: lines of text or Arrow record batches in, the same kind out.

Columns are in SI and named ``t, output, fx, fy, fz`` and, if there are, ``wx, wy, wz, temperature, angle``
(see :meth:`piga.Compensator.push`); out come ``t, ax, dv, u_ax, flags``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from piga.compensation.compensator import Compensator
from piga.compensation.writers import schema_of
from piga.errors import DataError
from piga.records.arrow_columns import number_column
from piga.records.stream import numbers_of

FORCE = ("fx", "fy", "fz")
RATE = ("wx", "wy", "wz")
NEEDED = ("t", "output", *FORCE)
KNOWN = (*NEEDED, *RATE, "temperature", "angle")


def chunk_of(columns: Mapping[str, Any]) -> dict[str, Any]:
    """Columns by name to a chunk for :meth:`piga.Compensator.push`."""
    chunk: dict[str, Any] = {"t": columns["t"], "output": columns["output"]}
    chunk["f"] = np.stack([np.asarray(columns[name]) for name in FORCE], axis=-1)
    if all(name in columns for name in RATE):
        chunk["base_rate"] = np.stack([np.asarray(columns[name]) for name in RATE], axis=-1)
    return chunk | {name: columns[name] for name in ("temperature", "angle") if name in columns}


def compensate_lines(source: IO[str], sink: IO[str], stream: Compensator) -> int:
    """Compensate comma-separated lines, each answered at once; the first line names the columns.

    Returns
    -------
    rows:
        Lines compensated.

    Raises
    ------
    DataError
        With the number of the line that is wrong.
    """
    header = [name.strip() for name in source.readline().split(",")]
    _check_names(header)
    rows = 0
    for number, line in enumerate(source, start=2):
        if not line.strip():
            continue
        cells = line.split(",")
        try:
            values = dict(zip(header, map(float, cells), strict=True))
        except ValueError:
            raise DataError(
                f"standard input: line {number}: '{line.strip()[:60]}' is no row of {len(header)} numbers",
                remedy="send numbers separated by commas",
            ) from None
        found = stream.push(chunk_of(values)).columns()
        if rows == 0:
            sink.write(",".join(found) + "\n")
        sink.write(",".join(repr(column[0].item()) for column in found.values()) + "\n")
        sink.flush()
        rows += 1
    return rows


def compensate_arrow(source: IO[bytes], sink: IO[bytes], stream: Compensator) -> int:
    """Compensate an Arrow IPC stream, batch by batch.

    Raises
    ------
    DataError
        If the stream is none, or lacks a column.
    """
    import pyarrow as pa

    rows, writer = 0, None
    try:
        with pa.ipc.open_stream(source) as reader:
            _check_names(reader.schema.names)
            for batch in reader:
                columns = {name: numbers_of(batch.column(name)) for name in batch.schema.names}
                found = stream.push(chunk_of(columns)).columns()
                writer = writer or pa.ipc.new_stream(sink, schema_of(found))
                writer.write_batch(_batch(found))
                sink.flush()
                rows += batch.num_rows
    except pa.ArrowInvalid as error:
        raise DataError(
            f"standard input: no Arrow stream ({error})", remedy="send an Arrow IPC stream"
        ) from None
    if writer is not None:
        writer.close()
    return rows


def _batch(columns: Mapping[str, NDArray]) -> Any:
    import pyarrow as pa

    return pa.RecordBatch.from_arrays(
        [number_column(column) for column in columns.values()], schema=schema_of(columns)
    )


def _check_names(names: list[str]) -> None:
    missing = [name for name in NEEDED if name not in names]
    unknown = [name for name in names if name not in KNOWN]
    if missing or unknown:
        what = f"no column '{missing[0]}'" if missing else f"the unknown column '{unknown[0]}'"
        raise DataError(f"standard input: {what}", remedy=f"columns in SI: {', '.join(KNOWN)}")
