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
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from piga.errors import Fix
from piga.formats.columns import refusal
from piga.formats.text.convention import SNIFF_BYTES
from piga.records.text_files import open_regular

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
"""Largest ratio of unpacked to packed size accepted for .gz files."""
PIECE_BYTES = 4 << 20
"""Bytes read at a time."""
MAX_LINE = 16 << 20
"""Longest line [bytes]."""
MAX_HEAD = 1 << 20
"""Bytes within which header, units and first data row must lie."""
_PLAIN = ("utf-8", "utf-8-sig", "ascii")
"""Encodings that need no conversion."""


class TextSource:
    """Lines of a text file.

    ``head`` holds the complete lines within the first :data:`MAX_HEAD` bytes, as UTF-8. ``cut`` is True, after the last piece,
    if the last line had no line end and was left out.
    """

    def __init__(
        self, path: Path, encoding: str | None, *, wanted: Iterable[str] = (), first_rows: int = 0
    ) -> None:
        self.path, self.cut = path, False
        first = next(self._blocks(MAX_HEAD + 1), b"")
        if not first or (len(first) <= MAX_HEAD and first.isspace()):
            raise refusal(path, "the file is empty", "check that the logger wrote data")
        self.encoding = _find_encoding(first[:SNIFF_BYTES], path, encoding, wanted)
        text = b"".join(self._as_utf8(iter([first[:MAX_HEAD]])))
        self._refuse_utf16(text[:256])
        self._only_cr = b"\n" not in text
        text = text.replace(b"\r", b"\n") if self._only_cr else text
        whole = len(first) <= MAX_HEAD
        end = max(text.rfind(b"\n"), text.rfind(b"\r")) + 1
        self.head = text if whole and not end else text[:end]
        lines = self.head.splitlines()
        filled = (line for line in lines if line.strip() and not line.lstrip().startswith(b"#"))
        needed = 3 + first_rows  # header, units and first data row, and rows that the run file names
        if not whole and len(list(islice(filled, needed))) < needed:
            words = "a line too long, or too many comments: header, units and first data row must lie within the first"
            raise refusal(path, f"{words} {MAX_HEAD >> 20} MiB", _EXPORT, row=len(lines) + 1)

    def pieces(self, skip: int) -> Iterator[bytes]:
        """Complete lines in order, without the first ``skip``."""
        header, rest = sum(map(len, self.head.splitlines(keepends=True)[:skip])), b""
        for block in self._as_utf8(self._blocks(PIECE_BYTES)):
            data = rest + (block.replace(b"\r", b"\n") if self._only_cr else block)
            dropped = min(header, len(data))
            header -= dropped
            end = max(data.rfind(b"\n") + 1, dropped)
            rest = data[end:]
            if len(rest) > MAX_LINE:
                raise refusal(self.path, f"a line is longer than {MAX_LINE >> 20} MiB", _EXPORT)
            if end > dropped:
                yield data[dropped:end]
        end = rest.rfind(b"\r") + 1
        self.cut = end < len(rest)
        if end:
            yield rest[:end]

    def _blocks(self, size: int) -> Iterator[bytes]:
        """The unpacked bytes of the file, ``size`` at a time. An error becomes one clear message."""
        packed, total = self.path.suffix.lower() == ".gz", 0
        try:
            with open_regular(self.path, wanted="the file; [data] file is relative to the run file") as file:
                limit = os.fstat(file.fileno()).st_size * _MAX_EXPANSION
                stream: Any = gzip.GzipFile(fileobj=file) if packed else file
                while block := stream.read(size):
                    total += len(block)
                    if packed and total > limit:
                        words = f"unpacks to more than {_MAX_EXPANSION} times its size"
                        raise refusal(self.path, words, "unpack it by hand")
                    yield block
        except (OSError, EOFError, zlib.error) as error:
            raise refusal(self.path, f"cannot be read ({error})", "check the file") from None

    def _as_utf8(self, blocks: Iterator[bytes]) -> Iterator[bytes]:
        """The blocks as UTF-8 without byte-order mark. Valid text before a byte that is no text is given first."""
        if self.encoding in _PLAIN:
            yield next(blocks, b"").removeprefix(codecs.BOM_UTF8)
            yield from blocks
            return
        decoder = codecs.getincrementaldecoder(self.encoding)()
        offset = lines = 0
        for block in blocks:
            kept, state = decoder.getstate()
            try:
                text = decoder.decode(block)
            except UnicodeError as error:  # without a place: UTF-16 or UTF-32 without a byte-order mark
                start = error.start if isinstance(error, UnicodeDecodeError) else 0
                good = max(start - len(kept), 0)
                decoder.setstate((kept, state))
                yield decoder.decode(block[:good]).encode("utf-8", errors="surrogatepass")
                row = lines + block[:good].count(b"\n") + 1
                words = f"byte {offset - len(kept) + start} is not {self.encoding} text"
                raise refusal(self.path, words, _DECLARE, row=row, fixes=_ENCODING) from None
            yield text.removeprefix("\ufeff" if offset == 0 else "").encode("utf-8", errors="surrogatepass")
            offset += len(block)
            lines += block.count(b"\n")

    def _refuse_utf16(self, head: bytes) -> None:
        """Refuse text with a NUL in every second byte: it is UTF-16 without byte-order mark."""
        if 0.8 * len(head) < 2 * max(head[::2].count(0), head[1::2].count(0)) and len(head) > 8:
            words = f"{head.count(0)} NUL bytes in the first {len(head)}: UTF-16 without a byte-order mark?"
            remedy = "add [data] encoding = 'utf-16-le' (or 'utf-16-be'), or export again"
            fixes = [Fix("data", "encoding", name) for name in ("utf-16-le", "utf-16-be")]
            raise refusal(self.path, words, remedy, row=1, fixes=fixes)
