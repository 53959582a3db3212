"""CSV and other separated text, through PyArrow's tokenizer, with errors that name row and column."""

from __future__ import annotations

import gzip
import re
from pathlib import Path
from typing import Any

import numpy as np

from piga.errors import DataError
from piga.records.calibration import Event
from piga.records.table import RawTable, column_letter
from piga.records.text_format import INFINITE, MISSING, SNIFF_BYTES, TextFormat, find_encoding, find_format

MAX_EXPANSION = 200
"""Largest ratio of unpacked to packed size accepted for .gz files."""
_SPACES_ONLY = re.compile(rb"^[ \t]+\r?\n", re.MULTILINE)

MAX_LISTED = 10
"""Bad rows listed in one message."""


def read_text(
    path: Path,
    numeric: tuple[str, ...],
    label: str | None,
    *,
    separator: str | None = None,
    decimal: str | None = None,
    encoding: str | None = None,
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

    Raises
    ------
    DataError
        With file, row, column, the offending text and the remedy.
    """
    import pyarrow as pa

    raw = _read_bytes(path)
    if not raw.strip():
        raise DataError(f"{path}: the file is empty", remedy="check that the logger wrote data")
    events: list[Event] = []
    encoding = find_encoding(raw[:SNIFF_BYTES], path, encoding)
    if encoding not in ("utf-8", "utf-8-sig", "ascii"):
        raw = _decode(raw, encoding, path).encode("utf-8")
    raw = raw.removeprefix(b"\xef\xbb\xbf")
    if encoding != "utf-8":
        events.append(Event("encoding", 1, 1, f"read as {encoding}"))
    _refuse_nul(raw, path)
    raw, cut = _without_partial_line(raw)
    raw = _SPACES_ONLY.sub(b"\n", raw)
    head = raw[:SNIFF_BYTES].decode("utf-8", errors="replace")
    if len(raw) > SNIFF_BYTES:
        head = head[: head.rfind("\n") + 1]
    form = find_format(head, path, encoding, separator, decimal)
    if cut:
        last = raw.count(b"\n") + 1
        events.append(Event("truncated-last-line", 1, last, f"row {last} has no line end: not used"))
    _check_columns(form, numeric, label, path)
    table = _parse(pa.py_buffer(raw), form, numeric, label, path, raw)
    numbers, labels, found = _to_numpy(table, numeric, label, form)
    rows = table.num_rows
    if rows == 0:
        raise DataError(f"{path}: a header but no complete data row", remedy="check that the logger wrote data")
    units = {name: unit for name, unit in form.units.items() if name in numeric}
    row_numbers = _row_numbers(raw, form, events)
    return RawTable(path, numbers, labels, rows, form.skip + 1, units, (*events, *found), row_numbers)


def _row_numbers(raw: bytes, form: TextFormat, events: list[Event]) -> np.ndarray | None:
    """File rows of the data rows when blank lines stand between them; None when there are none."""
    if b"\n\n" not in raw and b"\n\r\n" not in raw:
        return None
    rows = np.array([row for row, _ in _lines(raw, form.skip)], dtype=np.int64)
    blank = int(rows[-1] - form.skip - rows.size)
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


def _refuse_nul(raw: bytes, path: Path) -> None:
    at = raw.find(b"\0")
    if at >= 0:
        row = raw[:at].count(b"\n") + 1
        raise DataError(
            f"{path}: row {row}: {raw.count(0)} NUL bytes from byte {at} (the logger lost power?)",
            remedy="delete the damaged rows and keep the rest, or export again",
        )


def _without_partial_line(raw: bytes) -> tuple[bytes, bool]:
    """Drop a last line that has no line end: it may be cut short."""
    if raw.endswith((b"\n", b"\r")):
        return raw, False
    end = max(raw.rfind(b"\n"), raw.rfind(b"\r")) + 1
    return (raw[:end], True) if end else (raw + b"\n", False)


def _check_columns(form: TextFormat, numeric: tuple[str, ...], label: str | None, path: Path) -> None:
    wanted = [*numeric, *([label] if label else [])]
    missing = [name for name in wanted if name not in form.names]
    if missing:
        raise DataError(
            f"{path}: row {form.skip}: no column '{missing[0]}'; the columns are: {', '.join(form.names)}",
            remedy="correct the column name in [data], or [data] delimiter if the columns are not split",
        )


def _parse(
    buffer: Any, form: TextFormat, numeric: tuple[str, ...], label: str | None, path: Path, raw: bytes
) -> Any:
    """Tokenize with PyArrow; on any complaint find the exact place with :func:`_locate`."""
    import pyarrow as pa
    from pyarrow import csv

    types = dict.fromkeys(numeric, pa.float64())
    if label is not None:
        types[label] = pa.string()
    bad: list[Any] = []

    def collect(row: Any) -> str:
        bad.append(row)
        return "skip"

    try:
        table = csv.read_csv(
            pa.BufferReader(buffer),
            read_options=csv.ReadOptions(
                column_names=list(form.names), skip_rows=form.skip, block_size=1 << 22
            ),
            parse_options=csv.ParseOptions(delimiter=form.separator, invalid_row_handler=collect),
            convert_options=csv.ConvertOptions(
                include_columns=list(types),
                column_types=types,
                null_values=[*MISSING, *INFINITE],
                decimal_point=form.decimal,
                strings_can_be_null=False,
            ),
        )
    except pa.ArrowInvalid as error:
        raise _locate(raw, form, numeric, path) or DataError(
            f"{path}: {str(error).splitlines()[0]}", remedy="check the file's rows and separators"
        ) from None
    if bad:
        raise _locate(raw, form, numeric, path) or DataError(
            f"{path}: {len(bad)} rows do not have {len(form.names)} cells", remedy="repair or delete them"
        )
    return table


def _lines(raw: bytes, skip: int) -> list[tuple[int, str]]:
    text = raw.decode("utf-8", errors="replace").split("\n")
    return [(i + 1, line.rstrip("\r")) for i, line in enumerate(text) if i >= skip and line.strip()]


def _locate(raw: bytes, form: TextFormat, numeric: tuple[str, ...], path: Path) -> DataError | None:
    """First offending cells, in words: slow, used only when something is wrong already."""
    found: list[str] = []
    hint = ""
    total = 0
    for row, line in _lines(raw, form.skip):
        cells = line.split(form.separator)
        if len(cells) != len(form.names):
            total += 1
            found.append(f"row {row} has {len(cells)} cells, the header has {len(form.names)}")
            if form.separator == "," and len(cells) > len(form.names):
                hint = "; commas as decimal marks need another separator"
            continue
        for name in numeric:
            column = form.names.index(name)
            cell = cells[column].strip().strip('"').strip()
            if cell in MISSING or cell in INFINITE or _is_number(cell, form.decimal):
                continue
            total += 1
            found.append(f"row {row}, column '{name}' ({column_letter(column)}): '{cell[:40]}' is not a number")
            hint = _cell_hint(cell, form) or hint
    if not found:
        return None
    shown = "; ".join(found[:MAX_LISTED])
    more = f"; and {total - MAX_LISTED} more" if total > MAX_LISTED else ""
    return DataError(f"{path}: {shown}{more}", remedy=f"repair or delete these rows{hint}")


def _is_number(cell: str, decimal: str) -> bool:
    if not cell.isascii() or "_" in cell:
        return False
    try:
        float(cell.replace(decimal, ".") if decimal != "." else cell)
    except ValueError:
        return False
    return True


def _cell_hint(cell: str, form: TextFormat) -> str:
    if not cell.isascii() and cell.strip().replace(".", "").isdecimal():
        return "; write the digits as plain 0-9 (these are full-width)"
    if "," in cell and "," not in (form.separator, form.decimal):
        return "; is ',' a decimal mark ([data] decimal = ',') or a thousands separator (remove it)?"
    return ""


def _to_numpy(
    table: Any, numeric: tuple[str, ...], label: str | None, form: TextFormat
) -> tuple[dict[str, Any], dict[str, Any], list[Event]]:
    """Columns as NumPy arrays; counts the cells that were missing or out of range."""
    events: list[Event] = []
    numbers: dict[str, Any] = {}
    for name in dict.fromkeys(numeric):
        column = table.column(name)
        if column.null_count:
            values = column.to_numpy(zero_copy_only=False)
            first = int(np.flatnonzero(np.isnan(values))[0])
            events.append(Event("missing-value", column.null_count, first + form.skip + 1, f"column '{name}'"))
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
