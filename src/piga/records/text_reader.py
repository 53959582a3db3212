"""CSV and other separated text, through PyArrow's tokenizer, with errors that name row and column."""

from __future__ import annotations

import gzip
import re
from pathlib import Path
from typing import Any

import numpy as np

from piga.errors import DataError
from piga.records.calibration import Event
from piga.records.table import RawTable
from piga.records.text_faults import Faults, find_faults
from piga.records.text_format import INFINITE, MISSING, SNIFF_BYTES, TextFormat, find_encoding, find_format

MAX_EXPANSION = 200
"""Largest ratio of unpacked to packed size accepted for .gz files."""
_SPACES_ONLY = re.compile(rb"^[ \t]+\r?\n", re.MULTILINE)


def read_text(
    path: Path,
    numeric: tuple[str, ...],
    label: str | None,
    *,
    separator: str | None = None,
    decimal: str | None = None,
    encoding: str | None = None,
    missing: tuple[str, ...] = (),
    mask_damaged: bool = False,
) -> RawTable:
    """Read the named columns of a text file.

    Parameters
    ----------
    path:
        ``.csv`` (``.txt``, ``.tsv``), plain or ``.gz``.
    numeric, label:
        Names of the number columns and of the segment column.
    separator, decimal, encoding:
        From the run file; None means found from the file.
    missing:
        Words that stand for a missing value, besides the usual ones.
    mask_damaged:
        Leave damaged rows out and count them by kind, instead of refusing the file.

    Raises
    ------
    DataError
        With file, row, column, the offending text and the remedy.
    """
    raw = _read_bytes(path)
    if not raw or raw.isspace():
        raise DataError(f"{path}: the file is empty", remedy="check that the logger wrote data")
    events: list[Event] = []
    encoding = find_encoding(raw[:SNIFF_BYTES], path, encoding)
    if encoding not in ("utf-8", "utf-8-sig", "ascii"):
        raw = _decode(raw, encoding, path).encode("utf-8")
    raw = raw.removeprefix(b"\xef\xbb\xbf")
    if encoding != "utf-8":
        events.append(Event("encoding", 1, 1, f"read as {encoding}"))
    _refuse_utf16(raw, path)
    if b"\n" not in raw:
        raw = raw.replace(b"\r", b"\n")
    raw, cut = _without_partial_line(raw)
    head = raw[:SNIFF_BYTES].decode("utf-8", errors="replace")
    if len(raw) > SNIFF_BYTES:
        head = head[: head.rfind("\n") + 1]
    form = find_format(head, path, encoding, separator, decimal)
    if cut:
        last = raw.count(b"\n") + 1
        events.append(Event("truncated-last-line", 1, last, f"row {last} has no line end: not used"))
    _check_columns(form, numeric, label, path)
    raw, table = _parse_or_mask(raw, form, numeric, label, path, missing, mask_damaged, events)
    rows = table.num_rows
    if rows == 0:
        raise DataError(f"{path}: a header but no complete data row", remedy="check that the logger wrote data")
    row_numbers = _row_numbers(raw, form, rows, events)
    file_rows = np.arange(form.skip + 1, form.skip + rows + 1) if row_numbers is None else row_numbers
    numbers, labels, found = _to_numpy(table, numeric, label, file_rows)
    units = {name: unit for name, unit in form.units.items() if name in numeric}
    return RawTable(path, numbers, labels, rows, form.skip + 1, units, (*events, *found), row_numbers)


def _row_numbers(raw: bytes, form: TextFormat, read: int, events: list[Event]) -> np.ndarray | None:
    """File rows of the data rows when blank lines stand between them; None when there are none."""
    if raw.count(b"\n") == form.skip + read:
        return None
    lines = raw.split(b"\n")
    filled = (row for row, line in enumerate(lines, start=1) if row > form.skip and line.strip())
    rows = np.fromiter(filled, dtype=np.int64)
    left_out = sum(event.count for event in events if event.detail == "the row is not used")
    blank = int(rows[-1] - form.skip - rows.size - left_out) if rows.size else 0
    if blank:
        events.append(Event("blank-line", blank, None, "skipped"))
    return rows


def _read_bytes(path: Path) -> bytes:
    try:
        if path.suffix != ".gz":
            return path.read_bytes()
        packed = path.stat().st_size
        with gzip.open(path, "rb") as stream:
            raw = stream.read(packed * MAX_EXPANSION + 1)
    except FileNotFoundError:
        raise DataError(f"{path}: no such file", remedy="[data] file is relative to the run file") from None
    except (OSError, EOFError, gzip.BadGzipFile) as error:
        raise DataError(f"{path}: cannot be read ({error})", remedy="check the file") from None
    if len(raw) > packed * MAX_EXPANSION:
        raise DataError(
            f"{path}: unpacks to more than {MAX_EXPANSION} times its size", remedy="unpack it by hand"
        )
    return raw


def _decode(raw: bytes, encoding: str, path: Path) -> str:
    try:
        return raw.decode(encoding)
    except UnicodeDecodeError as error:
        row = raw[: error.start].count(b"\n") + 1
        raise DataError(
            f"{path}: row {row}: byte {error.start} is not {encoding} text",
            remedy="add [data] encoding = '...'",
        ) from None


def _refuse_utf16(raw: bytes, path: Path) -> None:
    """Text with a NUL in every second byte is UTF-16 without its mark."""
    head = raw[:256]
    if 0.8 * len(head) < 2 * max(head[::2].count(0), head[1::2].count(0)) and len(head) > 8:
        raise DataError(
            f"{path}: row 1: {head.count(0)} NUL bytes in the first {len(head)}: UTF-16 without a byte-order mark?",
            remedy="add [data] encoding = 'utf-16-le' (or 'utf-16-be'), or export again",
        )


def _without_partial_line(raw: bytes) -> tuple[bytes, bool]:
    """Drop a last line that has no line end: it may be cut short."""
    if raw.endswith((b"\n", b"\r")):
        return raw, False
    end = max(raw.rfind(b"\n"), raw.rfind(b"\r")) + 1
    return (raw[:end], True) if end else (raw + b"\n", False)


def _check_columns(form: TextFormat, numeric: tuple[str, ...], label: str | None, path: Path) -> None:
    wanted = [*numeric, *([label] if label else [])]
    missing = list(dict.fromkeys(name for name in wanted if name not in form.names))
    if missing:
        listed = ", ".join(f"'{name}'" for name in missing)
        raise DataError(
            f"{path}: row {form.skip}: no column {listed}; the columns are: {', '.join(form.names)}",
            remedy="correct the column name in [data], or [data] delimiter if the columns are not split",
        )


def _parse_or_mask(
    raw: bytes, form: TextFormat, numeric: tuple[str, ...], label: str | None, path: Path,
    missing: tuple[str, ...], mask: bool, events: list[Event],
) -> tuple[bytes, Any]:  # fmt: skip
    """The table; when rows are damaged, the error that lists them, or the table without them."""
    if len(form.names) == 1:
        raw = _SPACES_ONLY.sub(b"\n", raw)
    table, complaint = _parse(raw, form, numeric, label, missing)
    if table is not None:
        return raw, table
    if b"\n " in raw or b"\n\t" in raw:
        raw = _SPACES_ONLY.sub(b"\n", raw)
        table, complaint = _parse(raw, form, numeric, label, missing)
        if table is not None:
            return raw, table
    faults = find_faults(raw, form, numeric, missing)
    if not faults.total:
        raise DataError(f"{path}: {complaint}", remedy="check the file's rows and separators")
    if not mask:
        raise faults.error(path)
    raw = _blanked(raw, faults)
    events += faults.events()
    table, complaint = _parse(raw, form, numeric, label, missing)
    if table is None:
        raise DataError(f"{path}: {complaint}", remedy="check the file's rows and separators")
    return raw, table


def _blanked(raw: bytes, faults: Faults) -> bytes:
    """The text with the damaged rows empty, so that the others keep their numbers."""
    lines = raw.split(b"\n")
    for row in faults.rows:
        lines[row - 1] = b""
    return b"\n".join(lines)


def _parse(
    raw: bytes, form: TextFormat, numeric: tuple[str, ...], label: str | None, missing: tuple[str, ...]
) -> tuple[Any, str]:
    """Tokenize with PyArrow: the table, or None and the complaint."""
    import pyarrow as pa
    from pyarrow import csv

    if b"\0" in raw:
        return None, "NUL bytes"
    types = dict.fromkeys(numeric, pa.float64())
    if label is not None:
        types[label] = pa.string()
    bad: list[Any] = []

    def collect(row: Any) -> str:
        bad.append(row)
        return "skip"

    try:
        table = csv.read_csv(
            pa.BufferReader(pa.py_buffer(raw)),
            read_options=csv.ReadOptions(
                column_names=list(form.names), skip_rows=form.skip, block_size=1 << 22
            ),
            parse_options=csv.ParseOptions(delimiter=form.separator, invalid_row_handler=collect),
            convert_options=csv.ConvertOptions(
                include_columns=list(types),
                column_types=types,
                null_values=[*MISSING, *INFINITE, *missing],
                decimal_point=form.decimal,
                strings_can_be_null=False,
            ),
        )
    except pa.ArrowInvalid as error:
        return None, str(error).splitlines()[0]
    if bad:
        return None, f"{len(bad)} rows do not have {len(form.names)} cells"
    return table, ""


def _to_numpy(
    table: Any, numeric: tuple[str, ...], label: str | None, rows: np.ndarray
) -> tuple[dict[str, Any], dict[str, Any], list[Event]]:
    """Columns as NumPy arrays; counts the cells that were missing or out of range."""
    events: list[Event] = []
    numbers: dict[str, Any] = {}
    for name in dict.fromkeys(numeric):
        column = table.column(name)
        if column.null_count:
            values = column.to_numpy(zero_copy_only=False)
            first = int(np.flatnonzero(np.isnan(values))[0])
            events.append(Event("missing-value", column.null_count, int(rows[first]), f"column '{name}'"))
            numbers[name] = values
        else:
            numbers[name] = column.to_numpy()
    labels: dict[str, Any] = {}
    if label is not None:
        labels[label] = encode_labels(table.column(label))
    return numbers, labels, events


def encode_labels(column: Any) -> tuple[Any, tuple[str, ...]]:
    """Codes (int32) and names of a label column, names in order of appearance."""
    import pyarrow as pa

    encoded = column.cast(pa.string()).dictionary_encode().combine_chunks()
    if isinstance(encoded, pa.ChunkedArray):
        encoded = encoded.chunk(0) if encoded.num_chunks else pa.array([], pa.string()).dictionary_encode()
    names = tuple(str(name) for name in encoded.dictionary.to_pylist())
    codes = encoded.indices.fill_null(-1).to_numpy(zero_copy_only=False).astype(np.int32)
    return codes, names
