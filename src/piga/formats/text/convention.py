"""Format of a text file (separator, decimal mark, header, units row, encoding), and its bytes as complete lines of UTF-8.

Nothing is guessed but the encoding, and the guess is in the result. If two readings are possible and would give different
numbers, the file is refused, and the message names the run-file key that decides.
An error further on in the file (bytes that are not text, a damaged ``.gz``) is raised when that place is reached. So the
report does not depend on the size of the pieces.
"""

from __future__ import annotations

import codecs
import gzip
import re
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice, zip_longest
from pathlib import Path
from typing import Any

from piga.errors import Fix, UnitError
from piga.formats.columns import REMEDIES, column_letter, no_column, refusal
from piga.formats.text.time_stamp import TimeStamp, forms_of, time_stamp
from piga.text_files import open_regular
from piga.units import parse_unit

_SNIFF_BYTES = 1 << 16
SEPARATORS = ";\t,|"
_MOST_SEARCHED = 200
"""Rows among which the names are looked for."""
COMMENT = re.compile(r"^ *[#%]+ *")
"""Mark of a comment before the column names."""
_NUMBER_POINT = re.compile(r"^\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\s*$")
_NUMBER_COMMA = re.compile(r"^\s*[-+]?\d+,\d+([eE][-+]?\d+)?\s*$")
_THOUSANDS = re.compile(r"^[-+]?[1-9]\d{0,2},\d{3}$")
MISSING = ("", "nan", "NaN", "NAN", "na", "NA", "N/A", "n/a", "#N/A", "null", "NULL", "-", "--", "---")
"""Cells that mean a missing value. They are masked and counted, never used."""
INFINITE = ("inf", "Inf", "INF", "-inf", "-Inf", "-INF", "+inf", "OVER", "OVL", "overflow")
"""Cells that mean out of range. They are masked and counted."""


@dataclass(frozen=True)
class TextFormat:
    """Format of a text file. ``skip`` is the number of lines before the first data line.

    ``stamps``: form of the time stamps of a column.
    """

    encoding: str
    separator: str
    decimal: str
    names: tuple[str, ...]
    skip: int
    units: dict[str, str]
    header: int = 1
    stamps: dict[str, TimeStamp] = field(default_factory=dict)

    @property
    def blanks(self) -> bytes:
        """What a blank line may hold. Tabs are empty cells where they separate."""
        return b" \r" if self.separator == "\t" else b" \t\r"


@dataclass(frozen=True)
class TextOptions:
    """What the run file says about a text file. None: detected from the file.

    Rows are counted from 1. ``skip``: lines before the header. ``header``: row of the column names, or the two rows over which
    they stand. ``units``: row of the units. False: there is none. ``stamp``: name and form of a number column that holds time
    stamps. ``missing``: further words that mean a missing value. ``mask_damaged``: leave damaged rows out and count them by
    kind, instead of refusing the file. ``sheet``: name of the sheet of a spreadsheet.
    """

    skip: int = 0
    header: int | bool | tuple[int, ...] | None = None
    units: int | bool | None = None
    separator: str | None = None
    decimal: str | None = None
    encoding: str | None = None
    stamp: tuple[str, str] | None = None
    missing: tuple[str, ...] = ()
    mask_damaged: bool = False
    sheet: str | None = None

    @property
    def names(self) -> int | bool | None:
        """The row of the column names; of two rows the lower one."""
        return self.header[1] if isinstance(self.header, tuple) else self.header


def find_format(
    text: str, path: Path, encoding: str, options: TextOptions, wanted: Iterable[str] = ()
) -> TextFormat:
    """Detect separator, decimal mark, header names, units row and number of lines to skip, from the head of a file.

    The header is the first row with all names ``wanted``, or two rows over which these stand; else the first row that is
    neither empty nor a comment.
    """
    lines, rows = lines_of(text), options
    if rows.header is None:
        rows = replace(rows, header=_row_of(wanted, lines, rows.skip, rows.separator))
    header_at = _header_at(lines, rows, path)
    named = rows.header is not False
    skip = header_at + named
    sample = list(islice((line for line in lines[skip:] if line.strip()), 50))
    separator = rows.separator or _find_separator(lines[header_at], sample)
    if named:
        names, units = _named_columns(lines, header_at, sample, separator, rows, path)
    else:  # A, B, C, as in a spreadsheet
        names, units = tuple(map(column_letter, range(len(split_line(lines[header_at], separator))))), {}
    filled = ((i, line) for i, line in enumerate(lines[skip:], start=skip) if line.strip())
    body = list(islice(filled, 50 + int(rows.units or 0)))
    units_at = _units_at(body, separator, rows, path) if named else None
    if units_at is not None:
        row_units = [unit_text(cell) for cell in split_line(lines[units_at], separator)]
        units.update({n: u for n, u in zip(names, row_units, strict=False) if u not in NO_UNIT})
        skip, body = units_at + 1, [(i, line) for i, line in body if i > units_at]
    if not body:
        raise refusal(path, "a header but no data", "check that the logger wrote data")
    cells = [split_line(line, separator) for _, line in body[:50]]
    mark = _decimal_mark(cells, separator, rows.decimal, path, body[0][0] + 1)
    stamps = {} if rows.stamp is None else {rows.stamp[0]: time_stamp(rows.stamp[1])}
    return TextFormat(encoding, separator, mark, names, skip, units, header_at + 1, stamps)


def _row_of(
    wanted: Iterable[str], lines: list[str], skip: int, separator: str | None
) -> int | tuple[int, int] | None:
    """The first row that holds all wanted names, or the two rows over which these stand; None without one.

    A row that is no comment goes before one that is.
    """
    found: list[int | tuple[int, int]] = []
    for one in [separator] if separator else f"{SEPARATORS} ":
        above: tuple[str, ...] = ()
        for number, line in enumerate(lines[:_MOST_SEARCHED], start=1):
            bare = COMMENT.sub("", line)
            names = _head_cells(bare, one)
            for heads in (names, joined_names(above, names)):
                if number > skip and wanted and {*wanted} <= {*heads, *units_in_names(heads)[0]}:
                    row = number if heads is names else (number - 1, number)
                    if bare == line:
                        return row
                    found.append(row)
            above = names
    return found[0] if found else None


def lines_of(text: str) -> list[str]:
    """The lines of a text, whatever their ends."""
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def _named_columns(
    lines: list[str], at: int, sample: list[str], separator: str, rows: TextOptions, path: Path
) -> tuple[tuple[str, ...], dict[str, str]]:
    names = _head_cells(lines[at] if rows.header is None else COMMENT.sub("", lines[at]), separator)
    if isinstance(rows.header, tuple):
        names = joined_names(_head_cells(COMMENT.sub("", lines[rows.header[0] - 1]), separator), names)
    if all(_NUMBER_POINT.match(name) for name in names):
        remedy = (
            "if the file has no column names, add [data] header_row = false: the columns are then A, B, C; "
            "if the names stand in another row, add [data] header_row = N"
        )
        fixes = [Fix("data", "header_row", False), Fix("data", "header_row")]
        raise refusal(path, "the first row holds numbers, not column names", remedy, row=at + 1, fixes=fixes)
    return units_in_names(_single_names(_as_wide_as_data(names, sample, separator)))


def _head_cells(line: str, separator: str) -> tuple[str, ...]:
    return tuple(cell.strip().strip('"').strip() for cell in split_line(line, separator))


def joined_names(upper: tuple[str, ...], lower: tuple[str, ...]) -> tuple[str, ...]:
    """Names that stand over two rows: ``Force`` over ``X``, ``Y``, ``Z``. An empty upper cell belongs to the one on its left."""
    names, group = [], ""
    for above, name in zip_longest(upper, lower, fillvalue=""):
        group = above or group
        names.append(f"{group} {name}".strip())
    return tuple(names)


def split_line(line: str, separator: str) -> list[str]:
    """Cells of a line of the head. With a blank as separator any number of blanks is one."""
    return line.split() if separator == " " else line.split(separator)


def _header_at(lines: list[str], rows: TextOptions, path: Path) -> int:
    """Index of the line with the column names: as named, else the first that is neither empty nor a comment."""
    at = rows.names
    if isinstance(at, int) and not isinstance(at, bool):
        if at > len(lines) or not lines[at - 1].strip():
            words, remedy = (
                "[data] header_row names an empty row",
                "name that of the column names, counted from 1",
            )
            raise refusal(path, words, remedy, row=at, fixes=[Fix("data", "header_row")])
        return at - 1
    for index, line in enumerate(lines):
        if index >= rows.skip and line.strip() and not line.lstrip().startswith("#"):
            return index
    if rows.skip:
        words = f"no row of column names after the {rows.skip} rows of [data] skip_rows"
        raise refusal(path, words, "name a smaller number of rows", fixes=[Fix("data", "skip_rows")])
    raise refusal(path, "the file is empty", "check that the logger wrote data")


def _units_at(body: list[tuple[int, str]], separator: str, rows: TextOptions, path: Path) -> int | None:
    """Index of the units row: as named, else the first row after the header if it is one."""
    if rows.units is False or not body:
        return None
    if isinstance(rows.units, int) and rows.units is not True:
        if rows.units - 1 not in (index for index, _ in body):
            words = f"[data] units_row {rows.units} is not a row below the column names"
            remedy = "name the row of the units, counted from 1, or false if there is none"
            fixes = [Fix("data", "units_row", False), Fix("data", "units_row")]
            raise refusal(path, words, remedy, row=rows.units, fixes=fixes)
        return rows.units - 1
    following = split_line(body[1][1], separator) if len(body) > 1 else None
    return body[0][0] if rows.units or is_units_row(split_line(body[0][1], separator), following) else None


def _as_wide_as_data(names: tuple[str, ...], sample: list[str], separator: str) -> tuple[str, ...]:
    """The names, adapted to the data rows if these all have one cell more or less at the end.

    Some programs end every data row with a separator. LabVIEW names a last column ``Comment`` that has no cells.
    """
    widths = {len(split_line(line, separator)) for line in sample[:-1] if '"' not in line}
    if widths == {len(names) - 1} and names[-1] in ("", "Comment"):
        return names[:-1]
    if widths == {len(names) + 1} and all(line.endswith(separator) for line in sample[:-1]):
        return (*names, "")
    return names


def _find_separator(header: str, sample: list[str]) -> str:
    present = [one for one in SEPARATORS if one in header]
    same = [one for one in present if all(line.count(one) == header.count(one) for line in sample[:-1])]
    return max(same, key=header.count) if same else next(iter(present), ",")


def _single_names(names: tuple[str, ...]) -> tuple[str, ...]:
    """The names, those that stand more than once with their number: ``fx#1`` and ``fx#2``."""
    total, seen = Counter(names), Counter[str]()
    numbered = []
    for name in names:
        seen[name] += 1
        numbered.append(f"{name}#{seen[name]}" if name and total[name] > 1 else name)
    return tuple(numbered)


def check_present(
    path: Path,
    row: int,
    wanted: Iterable[str],
    names: tuple[str, ...],
    remedy: str = REMEDIES[0],
    fixes: Sequence[Fix] = (),
) -> None:
    """Refuse a header in which a wanted name is absent or stands more than once."""
    missing = [name for name in dict.fromkeys(wanted) if name not in names]
    for name in missing:
        same = [one for one in names if re.fullmatch(rf"{re.escape(name)}#\d+", one)]
        if len(same) > 1:
            choice = f"name one of them in [data]: {', '.join(repr(one) for one in same[:6])}"
            raise refusal(path, f"duplicate column name '{name}'", choice, name, row=row)
    if missing:
        raise no_column(path, missing, [name for name in names if name], row, remedy, fixes)


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
    filled = [name for name in plain if name]
    return (tuple(plain), units) if len(set(filled)) == len(filled) else (names, {})


def _is_unit(text: str) -> bool:
    try:
        parse_unit(text)
    except UnitError:
        return False
    return True


NO_UNIT = ("", "-", "--", "---", "–", "—")
"""Cells of a units row for a column without a unit."""


def unit_text(cell: str) -> str:
    """A cell of a units row without quotes and brackets."""
    return cell.strip().strip('"').strip("[]()（） ")


def is_units_row(cells: list[str], following: list[str] | None = None) -> bool:
    """True for a units row below the header: at least one cell is a unit, and none is a number or a name with its unit.

    A dash or ``1`` is allowed for a column without a unit. Then the ``following`` row must show that a unit stands above
    a number, since a data row may have such cells too.
    """
    if any(units_in_names((cell,))[1] for cell in cells):
        return False
    bare = [unit_text(cell) for cell in cells]
    below = [cell.strip().strip('"').strip() for cell in following or ()]
    loose = {*NO_UNIT[1:], "1"}
    if any(cell not in loose and (_is_number(cell) or cell in MISSING[1:]) for cell in bare):
        return False
    named = [k for k, cell in enumerate(bare) if cell not in ("", *loose) and _is_unit(cell)]
    if not loose & {*bare}:
        return bool(named)
    return any(k < len(below) and (_is_number(below[k]) or forms_of([below[k]])) for k in named)


def _is_number(cell: str) -> bool:
    return bool(_NUMBER_POINT.match(cell) or _NUMBER_COMMA.match(cell))


def _decimal_mark(cells: list[list[str]], separator: str, declared: str | None, path: Path, row: int) -> str:
    """Detect the decimal mark from the data. Mixed marks and thousands separators are refused."""
    if declared is not None:
        return declared
    if separator == ",":
        return "."
    flat = [cell.strip().strip('"') for line in cells for cell in line]
    comma = [cell for cell in flat if _NUMBER_COMMA.match(cell)]
    point = [cell for cell in flat if "." in cell and _NUMBER_POINT.match(cell)]
    marks = [Fix("data", "decimal", ","), Fix("data", "decimal", ".")]
    if comma and point:
        words = f"both '{comma[0]}' and '{point[0]}' occur from there on, the decimal mark is ambiguous"
        raise refusal(path, words, "add [data] decimal = ',' or decimal = '.'", row=row, fixes=marks)
    if comma and all(_THOUSANDS.match(cell) for cell in comma):
        words = f"'{comma[0]}' can be a decimal comma or a thousands separator"
        remedy = "add [data] decimal = ',', or decimal = '.' and remove the thousands separators"
        raise refusal(path, words, remedy, row=row, fixes=marks[:1])
    return "," if comma else "."


# -- bytes -----------------------------------------------------------------------------------------------

GUESSED = ("gb18030", "cp1252")
"""Encodings tried for a text that is not UTF-8: Chinese Windows, Western Windows."""
_MARKS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))
_DECLARE, _ENCODING = "add [data] encoding = '...'", (Fix("data", "encoding"),)
"""What helps where the encoding is not known: in words, and as a key of the run file."""
_EXPORT = "check that this is the log; export it again"
_HIGH = re.compile(rb"[\x80-\xff]+")


def _find_encoding(head: bytes, path: Path, declared: str | None, wanted: Iterable[str] = ()) -> str:
    """Detect the encoding of a file from its first bytes.

    The order is: as declared; byte-order mark; strict UTF-8; else GB18030 or cp1252, whichever shows more of the
    ``wanted`` column names. If both show the same, the bytes decide: most accented letters stand alone, as in ``Zähler``;
    Chinese characters are pairs of such bytes.
    """
    if declared is not None:
        try:
            "".encode(declared)  # Python also has codecs that are not text encodings
            return codecs.lookup(declared).name
        except (LookupError, ValueError):
            words = f"[data] encoding '{declared[:40]}' is not supported"
            remedy = (
                "give the name that Python has for it, such as 'cp1252', 'gb18030', 'shift_jis' or 'utf-16'"
            )
            raise refusal(path, words, remedy, fixes=_ENCODING) from None
    marked = next((name for mark, name in _MARKS if head.startswith(mark)), None)
    if marked is not None:
        return marked
    texts = {name: text for name in ("utf-8", *GUESSED) if (text := _decoded(head, name)) is not None}
    if "utf-8" in texts:
        return "utf-8"
    if not texts:
        raise refusal(path, "neither UTF-8 nor GB18030 nor cp1252 text", _DECLARE, fixes=_ENCODING)
    names = [name for name in wanted if not name.isascii()]
    shown = {one: sum(name in text for name in names) for one, text in texts.items()}
    best = [one for one in texts if shown[one] == max(shown.values())]
    if len(best) == 1:
        return best[0]
    lengths = [len(run) for run in _HIGH.findall(head)]
    return "cp1252" if 2 * sum(length % 2 for length in lengths) >= len(lengths) else "gb18030"


def _decoded(head: bytes, encoding: str) -> str | None:
    if encoding == "cp1252" and b"\xff" in head:  # the byte of damaged files, and a letter of no log
        return None
    try:
        return codecs.getincrementaldecoder(encoding)().decode(head)
    except UnicodeDecodeError:
        return None


_MAX_EXPANSION = 200
"""Largest ratio of unpacked to packed size of a .gz file, once 128 KiB of it are read."""
PIECE_BYTES = 4 << 20
"""Bytes read at a time."""
_MAX_LINE = 16 << 20
"""Longest line [bytes]."""
_MAX_HEAD = 1 << 20
"""Bytes within which header, units and first data row must lie."""
_PLAIN = ("utf-8", "utf-8-sig", "ascii")
"""Encodings that need no conversion."""


class TextSource:
    """Lines of a text file.

    ``head`` holds the complete lines within the first :data:`_MAX_HEAD` bytes, as UTF-8. ``cut`` is True, after the last piece,
    if the last line had no line end and was left out.
    """

    def __init__(self, path: Path, encoding: str | None, *, wanted: Iterable[str] = ()) -> None:
        self.path, self.cut = path, False
        first = next(self._blocks(_MAX_HEAD + 1), b"")
        if not first or (len(first) <= _MAX_HEAD and first.isspace()):
            raise refusal(path, "the file is empty", "check that the logger wrote data")
        self.encoding = _find_encoding(first[:_SNIFF_BYTES], path, encoding, wanted)
        text = b"".join(self._as_utf8(iter([first[:_MAX_HEAD]])))
        self._refuse_utf16(text[:256])
        self._only_cr = b"\n" not in text
        text = text.replace(b"\r", b"\n") if self._only_cr else text
        whole = len(first) <= _MAX_HEAD
        end = max(text.rfind(b"\n"), text.rfind(b"\r")) + 1
        self.head = text if whole and not end else text[:end]

    def pieces(self, skip: int) -> Iterator[bytes]:
        """Complete lines in order, without the first ``skip``."""
        header, rest = sum(map(len, self.head.splitlines(keepends=True)[:skip])), b""
        for block in self._as_utf8(self._blocks(PIECE_BYTES)):
            data = rest + (block.replace(b"\r", b"\n") if self._only_cr else block)
            dropped = min(header, len(data))
            header -= dropped
            end = max(data.rfind(b"\n") + 1, dropped)
            rest = data[end:]
            if len(rest) > _MAX_LINE:
                raise refusal(self.path, f"a line is longer than {_MAX_LINE >> 20} MiB", _EXPORT)
            if end > dropped:
                yield data[dropped:end]
        end = rest.rfind(b"\r") + 1
        self.cut = end < len(rest)
        if end:
            yield rest[:end]

    def _blocks(self, size: int) -> Iterator[bytes]:
        """The unpacked bytes of the file, ``size`` at a time. An error becomes one clear message."""
        packed = self.path.suffix.lower() == ".gz"
        try:
            with open_regular(self.path, wanted="the file; [data] file is relative to the run file") as file:
                stream: Any = gzip.GzipFile(fileobj=file) if packed else file
                while block := stream.read(size):
                    if packed and stream.tell() > _MAX_EXPANSION * max(file.tell(), 1 << 17):
                        words = f"unpacks to more than {_MAX_EXPANSION} times its size"
                        raise refusal(self.path, words, "unpack it by hand")
                    yield block
        except (OSError, EOFError, zlib.error) as error:
            raise refusal(self.path, f"cannot be read ({error})", "check the file") from None

    def _as_utf8(self, blocks: Iterator[bytes]) -> Iterator[bytes]:
        """The blocks as UTF-8 without byte-order mark. A byte that is no text becomes one that is not UTF-8: damage of its row."""
        if self.encoding in _PLAIN:
            yield next(blocks, b"").removeprefix(codecs.BOM_UTF8)
            yield from blocks
            return
        decoder = codecs.getincrementaldecoder(self.encoding)("surrogateescape")
        for number, block in enumerate(blocks):
            try:
                text = decoder.decode(block)
            except UnicodeError:  # UTF-16 or UTF-32 without a byte-order mark
                words = f"it is not {self.encoding} text"
                raise refusal(self.path, words, _DECLARE, fixes=_ENCODING) from None
            yield text.removeprefix("\ufeff" if number == 0 else "").encode("utf-8", errors="surrogatepass")

    def _refuse_utf16(self, head: bytes) -> None:
        """Refuse text with a NUL in every second byte: it is UTF-16 without byte-order mark."""
        if 0.8 * len(head) < 2 * max(head[::2].count(0), head[1::2].count(0)) and len(head) > 8:
            words = f"{head.count(0)} NUL bytes in the first {len(head)}: UTF-16 without a byte-order mark?"
            remedy = "add [data] encoding = 'utf-16-le' (or 'utf-16-be'), or export again"
            fixes = [Fix("data", "encoding", name) for name in ("utf-16-le", "utf-16-be")]
            raise refusal(self.path, words, remedy, row=1, fixes=fixes)
