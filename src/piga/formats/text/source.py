"""The bytes of a text file of any length and encoding, as complete lines of UTF-8, piece by piece.

The encoding is detected; the guess is named in the result's quality section. An error further on in the file (bytes that are
not text, a damaged ``.gz``) is raised when that place is reached. So the report does not depend on the size of the pieces.
"""

from __future__ import annotations

import codecs
import gzip
import os
import re
import zlib
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO, TypeVar, cast

import numpy as np

from piga.errors import DataError
from piga.formats.text.convention import SNIFF_BYTES
from piga.records.limits import open_regular

ENCODINGS = (
    "utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-32-le", "utf-32-be", "ascii",
    "gb18030", "gbk", "gb2312", "hz", "big5", "big5hkscs", "cp950", "shift_jis", "cp932", "euc_jp", "euc_kr", "cp949",
    "iso8859-1", "iso8859-2", "iso8859-5", "iso8859-7", "iso8859-9", "iso8859-15", "koi8-r", "koi8-u", "mac-roman",
    "cp437", "cp850", "cp852", "cp855", "cp866", "cp1250", "cp1251", "cp1252", "cp1253", "cp1254", "cp1257",
)  # fmt: skip
"""Allowed encodings, by their Python names. (Python also has codecs that are not text encodings.)"""

GUESSED = ("gb18030", "cp1252")
"""Encodings tried for a text that is not UTF-8: Chinese Windows, Western Windows."""
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_HIGH = re.compile(rb"[\x80-\xff]+")


def find_encoding(head: bytes, path: Path, declared: str | None, wanted: Iterable[str] = ()) -> str:
    """Detect the encoding of a file from its first bytes.

    The order is: as declared; byte-order mark; strict UTF-8; else GB18030 or cp1252, whichever shows more of the
    ``wanted`` column names. If both show the same, the bytes decide: see :func:`looks_western`.

    Raises
    ------
    DataError
        If the declared encoding is not one of :data:`ENCODINGS`, or the bytes are text in none of the tried ones.
    """
    if declared is not None:
        return _declared(declared, path)
    for mark, name in _MARKS:
        if head.startswith(mark):
            return name
    if _decodes(head, "utf-8"):
        return "utf-8"
    possible = [name for name in GUESSED if _decodes(head, name)]
    if not possible:
        raise DataError(
            f"{path}: neither UTF-8 nor GB18030 nor cp1252 text", remedy="add [data] encoding = '...'"
        )
    names = [name for name in wanted if not name.isascii()]
    shown = {one: _shown(head, one, names) for one in possible}
    best = [one for one in possible if shown[one] == max(shown.values())]
    if len(best) == 1:
        return best[0]
    return "cp1252" if looks_western(head) else "gb18030"


def looks_western(head: bytes) -> bool:
    """True if most accented letters stand alone, as in ``Zähler``. Chinese characters are pairs of such bytes."""
    lengths = [len(run) for run in _HIGH.findall(head)]
    return 2 * sum(length % 2 for length in lengths) >= len(lengths)


def _declared(declared: str, path: Path) -> str:
    try:
        name = codecs.lookup(declared).name
    except (LookupError, ValueError):
        name = ""
    if name in ENCODINGS:
        return name
    raise DataError(
        f"{path}: [data] encoding '{declared[:40]}' is not supported",
        remedy=f"one of: {', '.join(ENCODINGS)}",
    )


def _decodes(head: bytes, encoding: str) -> bool:
    if encoding == "cp1252" and b"\xff" in head:  # the byte of damaged files, and a letter of no log
        return False
    try:
        codecs.getincrementaldecoder(encoding)().decode(head)
    except UnicodeDecodeError:
        return False
    return True


def _shown(head: bytes, encoding: str, names: list[str]) -> int:
    """Number of names that the text holds in this encoding."""
    text = codecs.getincrementaldecoder(encoding)().decode(head)
    return sum(name in text for name in names)


MAX_EXPANSION = 200
"""Largest ratio of unpacked to packed size accepted for .gz files."""
GZIP_FIRST = 16 << 20
"""Bytes that are unpacked at first, to examine the content."""
PIECE_BYTES = 16 << 20
"""Bytes read at a time."""
MAX_LINE = 16 << 20
"""Longest line [bytes]."""
MAX_HEAD = 1 << 20
"""Bytes within which header, units and first data row must lie."""
FIRST_ROWS = 3
"""Number of lines for header, units and first data row."""
LINE_FEED = ord("\n")
LINE_END = re.compile(rb"\r\n|\n|\r")

T = TypeVar("T")
Bytes = bytes | bytearray


def ahead(items: Iterator[T]) -> Iterator[T]:
    """The same items. Another thread makes the next item while the caller works on one."""
    with ThreadPoolExecutor(1) as pool:
        end = object()
        pending = pool.submit(next, items, end)
        while (item := pending.result()) is not end:
            pending = pool.submit(next, items, end)
            yield cast("T", item)


class TextSource:
    """Lines of a text file.

    Attributes
    ----------
    encoding:
        Encoding of the file; see :func:`piga.formats.text.source.find_encoding`.
    head:
        The first complete lines as UTF-8: at most :data:`~piga.formats.text.convention.SNIFF_BYTES` bytes, or
        :data:`MAX_HEAD` if the first three lines need more.
    cut:
        True, after the last piece, if the last line had no line end and was left out.

    Raises
    ------
    DataError
        If the file is missing, empty, damaged or not text in its encoding, or its first lines are too long.
    """

    def __init__(
        self,
        path: Path,
        encoding: str | None,
        see: Callable[[Bytes], object],
        piece: int | None = None,
        *,
        wanted: Iterable[str] = (),
        first_rows: int = FIRST_ROWS,
    ) -> None:
        self.path, self.cut, self._see = path, False, see
        self._piece = piece or PIECE_BYTES
        packed = path.suffix.lower() == ".gz"
        self._blocks = self._packed() if packed else self._plain()
        first = _gather(self._blocks, GZIP_FIRST if packed else SNIFF_BYTES)
        if not first or (len(first) < SNIFF_BYTES and first.isspace()):
            raise DataError(f"{path}: the file is empty", remedy="check that the logger wrote data")
        self.encoding = find_encoding(first[:SNIFF_BYTES], path, encoding, wanted)
        self._blocks = _sliced(first, self._blocks, self._piece)
        if self.encoding not in ("utf-8", "utf-8-sig", "ascii"):
            self._blocks = self._decoded(self._blocks)
        self._first = _gather(self._blocks, SNIFF_BYTES).removeprefix(b"\xef\xbb\xbf")
        self._refuse_utf16()
        self.head = self._complete_lines(SNIFF_BYTES)
        if len(self._first) >= SNIFF_BYTES and _rows(self.head) < first_rows:
            self._first += _gather(self._blocks, MAX_HEAD + 1 - len(self._first))
            self.head = self._complete_lines(MAX_HEAD)
            self._refuse_long_head(first_rows)

    def pieces(self, skip: int) -> Iterator[tuple[Bytes, int]]:
        """Complete lines in order, without the first ``skip``, and their number. Another thread reads ahead."""
        counted = ((piece, _line_feeds(piece)) for piece in self._pieces(skip))
        return counted if self.path.stat().st_size < self._piece else ahead(counted)

    def _complete_lines(self, most: int) -> bytes:
        """The complete lines of the first ``most`` bytes. All bytes, if the file is shorter and has no line end."""
        head = self._first[:most]
        self._only_cr = b"\n" not in head
        if self._only_cr:
            head = head.replace(b"\r", b"\n")
        end = max(head.rfind(b"\n"), head.rfind(b"\r")) + 1
        return head[:end] if end or len(self._first) > most else head

    def _refuse_long_head(self, first_rows: int) -> None:
        if len(self._first) > MAX_HEAD and _rows(self.head) < first_rows:
            row = sum(1 for _ in LINE_END.finditer(self.head)) + 1
            raise DataError(
                f"{self.path}: row {row}: a line too long, or too many comments: header, units and first data row must lie "
                f"within the first {MAX_HEAD >> 20} MiB",
                remedy="check that this is the log; export it again",
            )

    def header_bytes(self, skip: int) -> int:
        """Size of the first ``skip`` lines [bytes]."""
        ends = [match.end() for _, match in zip(range(skip), LINE_END.finditer(self.head), strict=False)]
        return 0 if skip == 0 else ends[-1] if len(ends) == skip else len(self.head)

    def _pieces(self, skip: int) -> Iterator[Bytes]:
        rest = b""
        for block in _without(self.header_bytes(skip), _sliced(self._first, self._blocks, self._piece)):
            data = bytearray(block.replace(b"\r", b"\n")) if self._only_cr else _shortable(block)
            first = data.find(b"\n") + 1
            if not first:
                rest += data
                self._check_line(rest)
                continue
            if rest:
                yield rest + data[:first]
                del data[:first]
            end = data.rfind(b"\n") + 1
            rest = bytes(data[end:])
            del data[end:]
            if data:
                yield data
        if rest:
            end = rest.rfind(b"\r") + 1
            self.cut = end < len(rest)
            if end:
                yield rest[:end]

    def _check_line(self, line: bytes) -> None:
        if len(line) > MAX_LINE:
            raise DataError(
                f"{self.path}: a line is longer than {MAX_LINE >> 20} MiB",
                remedy="check that this is the log; export it again",
            )

    @contextmanager
    def _opened(self) -> Iterator[BufferedReader]:
        """The file. An error while it is read becomes one clear message."""
        try:
            with open_regular(self.path, wanted="the data file in [data] file") as stream:
                yield stream
        except FileNotFoundError:
            raise DataError(
                f"{self.path}: no such file", remedy="[data] file is relative to the run file"
            ) from None
        except (OSError, EOFError, zlib.error) as error:
            raise DataError(f"{self.path}: cannot be read ({error})", remedy="check the file") from None

    def _plain(self) -> Iterator[Bytes]:
        with self._opened() as stream:
            size = SNIFF_BYTES
            while count := stream.readinto(block := bytearray(size)):
                del block[count:]
                self._see(block)
                yield block
                size = self._piece

    def _packed(self) -> Iterator[Bytes]:
        total = 0
        with self._opened() as packed:
            limit = os.fstat(packed.fileno()).st_size * MAX_EXPANSION
            seen = cast("BinaryIO", _Seen(packed, self._see))
            with gzip.GzipFile(fileobj=seen, mode="rb") as stream:
                while block := stream.read1(1 << 18):
                    total += len(block)
                    if total > limit:
                        raise DataError(
                            f"{self.path}: unpacks to more than {MAX_EXPANSION} times its size",
                            remedy="unpack it by hand",
                        )
                    yield block

    def _decoded(self, blocks: Iterator[Bytes]) -> Iterator[Bytes]:
        """Convert text in another encoding to UTF-8. Valid text before a bad byte is given first."""
        decoder = codecs.getincrementaldecoder(self.encoding)()
        offset = lines = 0
        for block, last in _marked(blocks):
            held, state = decoder.getstate()
            try:
                yield decoder.decode(block, last).encode("utf-8", errors="surrogatepass")
            except UnicodeDecodeError as error:
                decoder.setstate((held, state))
                yield decoder.decode(block[: max(error.start - len(held), 0)]).encode("utf-8")
                row = lines + block[: max(error.start - len(held), 0)].count(b"\n") + 1
                raise DataError(
                    f"{self.path}: row {row}: byte {offset - len(held) + error.start} is not {self.encoding} text",
                    remedy="add [data] encoding = '...'",
                ) from None
            offset += len(block)
            lines += block.count(b"\n")

    def _refuse_utf16(self) -> None:
        """Refuse text with a NUL in every second byte: it is UTF-16 without byte-order mark."""
        head = self._first[:256]
        if 0.8 * len(head) < 2 * max(head[::2].count(0), head[1::2].count(0)) and len(head) > 8:
            raise DataError(
                f"{self.path}: row 1: {head.count(0)} NUL bytes in the first {len(head)}: UTF-16 without a "
                "byte-order mark?",
                remedy="add [data] encoding = 'utf-16-le' (or 'utf-16-be'), or export again",
            )


class _Seen:
    """A file that passes its bytes to ``see`` as they are read."""

    def __init__(self, stream: BinaryIO, see: Callable[[Bytes], object]) -> None:
        self._stream, self._see = stream, see

    def read(self, size: int = -1) -> bytes:
        data = self._stream.read(size)
        self._see(data)
        return data


def _shortable(block: Bytes) -> bytearray:
    """A block of bytes that may be shortened in place."""
    return block if isinstance(block, bytearray) else bytearray(block)


def _line_feeds(piece: Bytes) -> int:
    """Number of line feeds. NumPy counts them, because it lets other threads run."""
    return int(np.count_nonzero(np.frombuffer(piece, np.uint8) == LINE_FEED))


def _rows(head: bytes) -> int:
    """Number of lines that are neither empty nor comments."""
    lines = (line.strip() for line in LINE_END.split(head))
    return sum(1 for line in lines if line and not line.startswith(b"#"))


def _gather(blocks: Iterator[Bytes], least: int) -> bytes:
    """Join blocks until there are ``least`` bytes, or up to the end."""
    parts: list[Bytes] = []
    size = 0
    while size < least and (block := next(blocks, None)) is not None:
        parts.append(block)
        size += len(block)
    return b"".join(parts)


def _sliced(first: bytes, blocks: Iterator[Bytes], size: int) -> Iterator[Bytes]:
    """``first`` in parts of ``size`` bytes, then the other blocks."""
    for start in range(0, len(first), size):
        yield first[start : start + size]
    yield from blocks


def _without(count: int, blocks: Iterator[Bytes]) -> Iterator[Bytes]:
    """The blocks without their first ``count`` bytes."""
    for block in blocks:
        if count < len(block):
            yield block[count:]
        count = max(count - len(block), 0)


def _marked(blocks: Iterator[Bytes]) -> Iterator[tuple[Bytes, bool]]:
    """Each block with False, then an empty block with True as the last."""
    for block in blocks:
        yield block, False
    yield b"", True
