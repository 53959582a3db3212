"""Detect the format of a text file: encoding, separator, decimal mark, header, units row.

Nothing is guessed. If two readings are possible and would give different numbers, the file is refused, and the
message names the run-file key that decides.
"""

from __future__ import annotations

import codecs
import re
from dataclasses import dataclass
from pathlib import Path

from piga.errors import DataError, UnitError
from piga.units import parse_unit

SNIFF_BYTES = 1 << 16
MAX_COLUMNS = 4096
SEPARATORS = ";\t,|"
LINE_END = re.compile(r"\r\n|\n|\r")
_NUMBER_POINT = re.compile(r"^\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\s*$")
_NUMBER_COMMA = re.compile(r"^\s*[-+]?\d+,\d+([eE][-+]?\d+)?\s*$")
_THOUSANDS = re.compile(r"^[-+]?[1-9]\d{0,2},\d{3}$")
MISSING = ("", "nan", "NaN", "NAN", "na", "NA", "N/A", "n/a", "#N/A", "null", "NULL", "-", "--", "---")
"""Cells that mean a missing value. They are masked and counted, never used."""
INFINITE = ("inf", "Inf", "INF", "-inf", "-Inf", "-INF", "+inf", "OVER", "OVL", "overflow")
"""Cells that mean out of range. They are masked and counted."""


@dataclass(frozen=True)
class TextFormat:
    """Format of a text file. ``skip`` is the number of lines before the first data line."""

    encoding: str
    separator: str
    decimal: str
    names: tuple[str, ...]
    skip: int
    units: dict[str, str]


ENCODINGS = (
    "utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-32-le", "utf-32-be", "ascii",
    "gb18030", "gbk", "gb2312", "hz", "big5", "big5hkscs", "cp950", "shift_jis", "cp932", "euc_jp", "euc_kr", "cp949",
    "iso8859-1", "iso8859-2", "iso8859-5", "iso8859-7", "iso8859-9", "iso8859-15", "koi8-r", "koi8-u", "mac-roman",
    "cp437", "cp850", "cp852", "cp855", "cp866", "cp1250", "cp1251", "cp1252", "cp1253", "cp1254", "cp1257",
)  # fmt: skip
"""Allowed encodings, by their Python names. (Python also has codecs that are not text encodings.)"""


def find_encoding(head: bytes, path: Path, declared: str | None) -> str:
    """Detect the encoding: by byte-order mark, else strict UTF-8, else GB18030, else as declared."""
    if declared is not None:
        try:
            name = codecs.lookup(declared).name
        except (LookupError, ValueError):
            name = ""
        if name in ENCODINGS:
            return name
        raise DataError(
            f"{path}: [data] encoding '{declared[:40]}' is not one that text files are read in",
            remedy=f"one of: {', '.join(ENCODINGS)}",
        )
    for mark, name in (
        (codecs.BOM_UTF8, "utf-8-sig"),
        (codecs.BOM_UTF16_LE, "utf-16"),
        (codecs.BOM_UTF16_BE, "utf-16"),
    ):
        if head.startswith(mark):
            return name
    for name in ("utf-8", "gb18030"):
        try:
            codecs.getincrementaldecoder(name)().decode(head)
        except UnicodeDecodeError:
            continue
        return name
    raise DataError(f"{path}: neither UTF-8 nor GB18030 text", remedy="add [data] encoding = '...'")


def find_format(text: str, path: Path, encoding: str, separator: str | None, decimal: str | None) -> TextFormat:
    """Detect separator, decimal mark, header names, units row and number of lines to skip, from the head of a file.

    Raises
    ------
    DataError
        If there is no header or no data, a column name is repeated, or two readings are possible.
    """
    lines = LINE_END.split(text)
    header_at = next(
        (i for i, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")), None
    )
    if header_at is None:
        raise DataError(f"{path}: the file is empty", remedy="check that the logger wrote data")
    sample = [line for line in lines[header_at + 1 :] if line.strip()][:50]
    separator = separator or _find_separator(lines[header_at], sample)
    names = tuple(cell.strip().strip('"').strip() for cell in lines[header_at].split(separator))
    if all(_NUMBER_POINT.match(name) for name in names):
        raise DataError(
            f"{path}: row {header_at + 1}: the first row holds numbers, not column names",
            remedy="add a header row with the column names",
        )
    check_names(names, path, header_at + 1)
    names, units = units_in_names(names)
    skip = header_at + 1
    body = [(i, line) for i, line in enumerate(lines[skip:], start=skip) if line.strip()]
    if body and is_units_row(body[0][1].split(separator)):
        row_units = [cell.strip().strip('"').strip("[]()（） ") for cell in body[0][1].split(separator)]
        units.update({n: u for n, u in zip(names, row_units, strict=False) if u})
        skip, body = body[0][0] + 1, body[1:]
    if not body:
        raise DataError(f"{path}: a header but no data", remedy="check that the logger wrote data")
    cells = [line.split(separator) for _, line in body[:50]]
    return TextFormat(
        encoding, separator, _decimal_mark(cells, separator, decimal, path, body[0][0] + 1), names, skip, units
    )


def _find_separator(header: str, sample: list[str]) -> str:
    """The character that splits header and data into the same number of cells."""
    best, best_count = ",", 0
    for candidate in SEPARATORS:
        count = header.count(candidate)
        same = all(line.count(candidate) == count for line in sample[:-1])
        if count > best_count and same:
            best, best_count = candidate, count
    if best_count:
        return best
    present = [candidate for candidate in SEPARATORS if candidate in header]
    return present[0] if present else ","


def check_names(names: tuple[str, ...], path: Path, row: int) -> None:
    """Refuse too many columns and duplicate column names."""
    if len(names) > MAX_COLUMNS:
        raise DataError(
            f"{path}: {len(names)} columns, at most {MAX_COLUMNS} are read", remedy="export fewer columns"
        )
    repeated = sorted({name for name in names if name and names.count(name) > 1})
    if repeated:
        raise DataError(
            f"{path}: row {row}: duplicate column name '{repeated[0]}'",
            remedy="rename one of them",
        )


_NAME_WITH_UNIT = re.compile(r"^(.*\S)\s*[\[(（]\s*([^\])）]+?)\s*[\])）]$")


def units_in_names(names: tuple[str, ...]) -> tuple[tuple[str, ...], dict[str, str]]:
    """Split ``fx [g]`` into name and unit, if the bracket holds a known unit."""
    plain, units = [], {}
    for name in names:
        match = _NAME_WITH_UNIT.match(name)
        if match and _is_unit(match.group(2)):
            plain.append(match.group(1))
            units[match.group(1)] = match.group(2)
        else:
            plain.append(name)
    return (tuple(plain), units) if len(set(plain)) == len(plain) else (names, {})


def _is_unit(text: str) -> bool:
    try:
        parse_unit(text)
    except UnitError:
        return False
    return True


def is_units_row(cells: list[str]) -> bool:
    """True for a units row below the header: no cell is a number, and at least one is a unit."""
    stripped = [cell.strip().strip('"').strip() for cell in cells]
    if any(_NUMBER_POINT.match(cell) or _NUMBER_COMMA.match(cell) or cell in MISSING[1:] for cell in stripped):
        return False
    return any(cell and _is_unit(cell.strip("[]()（） ")) for cell in stripped)


def _decimal_mark(cells: list[list[str]], separator: str, declared: str | None, path: Path, row: int) -> str:
    """Detect the decimal mark from the data. Mixed marks and thousands separators are refused."""
    if declared is not None:
        return declared
    if separator == ",":
        return "."
    flat = [cell.strip().strip('"') for line in cells for cell in line]
    comma = [cell for cell in flat if _NUMBER_COMMA.match(cell)]
    point = [cell for cell in flat if "." in cell and _NUMBER_POINT.match(cell)]
    if comma and point:
        raise DataError(
            f"{path}: from row {row}: both '{comma[0]}' and '{point[0]}' occur, the decimal mark is ambiguous",
            remedy="add [data] decimal = ',' or decimal = '.'",
        )
    if comma and all(_THOUSANDS.match(cell) for cell in comma):
        raise DataError(
            f"{path}: from row {row}: '{comma[0]}' can be a decimal comma or a thousands separator",
            remedy="add [data] decimal = ',', or decimal = '.' and remove the thousands separators",
        )
    return "," if comma else "."
