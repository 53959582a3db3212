"""Detect the encoding of a text file. The guess is named in the result's quality section."""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterable
from pathlib import Path

from piga.errors import DataError

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
