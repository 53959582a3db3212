"""Compensate a stream through a pipe: lines of text or Arrow record batches in, the same kind out.

Input columns are in SI: ``t, output, fx, fy, fz`` and optionally ``wx, wy, wz, temperature, angle, vibration``
(see :meth:`piga.Compensator.push`). Output columns are ``t, ax, dv, u_ax, flags``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from typing import IO, Any

import numpy as np

from piga.compensation.compensator import Compensator
from piga.compensation.result import Compensated, schema_of
from piga.errors import ArgumentError, DataError
from piga.formats.columns import numbers_of
from piga.tables import number_column
from piga.text_files import first_line

FORCE = ("fx", "fy", "fz")
RATE = ("wx", "wy", "wz")
NEEDED = ("t", "output", *FORCE)
MAX_LINE = 1 << 16
"""Longest line [characters]; a row of eleven numbers has about 250."""
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
KNOWN = (*NEEDED, *RATE, "temperature", "angle", "vibration")


def _chunk_of(columns: Mapping[str, Any]) -> dict[str, Any]:
    """Chunk for :meth:`piga.Compensator.push` from named columns."""
    chunk: dict[str, Any] = {"t": columns["t"], "output": columns["output"]}
    chunk["f"] = np.stack([np.asarray(columns[name]) for name in FORCE], axis=-1)
    if all(name in columns for name in RATE):
        chunk["base_rate"] = np.stack([np.asarray(columns[name]) for name in RATE], axis=-1)
    return chunk | {name: columns[name] for name in ("temperature", "angle", "vibration") if name in columns}


def compensate_lines(source: IO[str], sink: IO[str], stream: Compensator) -> int:
    """Compensate comma-separated lines. The first line names the columns; every other line is answered at once.

    A number consists of the digits 0 to 9, a point and an exponent. Other notations are refused.

    Returns
    -------
    rows:
        Lines compensated.
    """
    header = [name.strip() for name in _line(source, 1).split(",")]
    _check_names(header)
    rows, number = 0, 1
    while line := _line(source, number := number + 1):
        if not line.strip():
            continue
        columns = _pushed(stream, _row(line, header, number), f"line {number}").columns()
        if rows == 0:
            sink.write(",".join(columns) + "\n")
        sink.write(",".join(repr(column[0].item()) for column in columns.values()) + "\n")
        sink.flush()
        rows += 1
    return rows


def _line(source: IO[str], number: int) -> str:
    """The next line; empty at the end."""
    line = source.readline(MAX_LINE)
    if line and not line.endswith("\n"):
        long = len(line) >= MAX_LINE
        what = f"is longer than {MAX_LINE} characters" if long else "has no end: the stream was cut off"
        raise DataError(f"standard input: line {number} {what}", remedy="end every line with a line feed")
    return line


def _row(line: str, header: list[str], number: int) -> dict[str, float]:
    cells = [cell.strip() for cell in line.split(",")]
    values = [float(cell) if _NUMBER.fullmatch(cell) else math.nan for cell in cells]
    if len(cells) != len(header) or not all(map(math.isfinite, values)):
        raise DataError(
            f"standard input: line {number}: '{line.strip()[:60]}' is not a row of {len(header)} numbers",
            remedy="send finite numbers separated by commas",
        )
    return dict(zip(header, values, strict=True))


def _pushed(stream: Compensator, columns: Mapping[str, Any], where: str) -> Compensated:
    try:
        return stream.push(_chunk_of(columns))
    except ArgumentError as error:
        raise DataError(f"standard input: {where}: {error.message}", remedy=error.remedy) from None


def compensate_arrow(source: IO[bytes], sink: IO[bytes], stream: Compensator) -> int:
    """Compensate an Arrow IPC stream, batch by batch.

    Returns
    -------
    rows:
        Rows compensated.
    """
    import pyarrow as pa

    rows, writer = 0, None
    for number, batch in enumerate(_batches(source), start=1):
        columns = {name: np.array(numbers_of(batch.column(name))) for name in batch.schema.names}
        compensated = _pushed(stream, columns, f"batch {number}").columns()
        schema = schema_of(compensated, notes=stream.notes)
        writer = writer or pa.ipc.new_stream(sink, schema)
        arrays = [number_column(column) for column in compensated.values()]
        writer.write_batch(pa.RecordBatch.from_arrays(arrays, schema=schema))
        sink.flush()
        rows += batch.num_rows
    if writer is not None:
        writer.close()
    return rows


def _batches(source: IO[bytes]) -> Iterator[Any]:
    """The batches of a stream, each checked. Every error of the library on a damaged batch becomes one message."""
    import pyarrow as pa

    try:
        messages = iter(pa.ipc.MessageReader.open_stream(source))
        first = next(messages, None)
        if first is None or first.type != "schema":  # the library reads whatever lies there as a schema
            raise ValueError("it does not begin with a schema")
        schema = pa.ipc.read_schema(first)
        _check_names(schema.names)
        for field in schema:
            if not (pa.types.is_integer(field.type) or pa.types.is_floating(field.type)):
                raise DataError(
                    f"standard input: column '{field.name}' holds {str(field.type)[:60]}, not numbers",
                    remedy="send doubles or integers",
                )
        for message in messages:
            batch = pa.ipc.read_record_batch(message, schema)
            batch.validate(full=True)
            yield batch
    except (pa.ArrowException, OSError, EOFError, ValueError, MemoryError) as error:
        raise DataError(
            f"standard input: no Arrow stream, or one that is cut off or damaged ({first_line(error)[:200]})",
            remedy="send an Arrow IPC stream",
        ) from None


def _check_names(names: list[str]) -> None:
    missing = [name for name in NEEDED if name not in names]
    unknown = [name for name in names if name not in KNOWN]
    twice = [name for name in names if names.count(name) > 1]
    rates = [name for name in RATE if name not in names]
    what = ""
    if missing:
        what = f"no column '{missing[0]}'"
    elif unknown:
        what = f"the unknown column '{unknown[0][:60]}'"
    elif twice:
        what = f"the column '{twice[0]}' occurs twice"
    elif 0 < len(rates) < len(RATE):
        what = f"no column '{rates[0]}', but the other base rates are there"
    if what:
        raise DataError(f"standard input: {what}", remedy=f"columns in SI: {', '.join(KNOWN)}")
