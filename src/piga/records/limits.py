"""Limits for files from outside, and the checks that apply them."""

from __future__ import annotations

import os
import stat
from io import BufferedReader
from pathlib import Path

from piga.errors import DataError, PigaError, Where

_MAX_UNPACKED = 2 << 30
"""Largest unpacked size of the wanted part of a container [bytes]."""
LARGEST_SAMPLE = 1e30
"""Largest absolute value of a sample in any unit. A larger value is damage. Squares of smaller values stay finite."""
MAX_SEGMENTS = 100_000
"""Largest number of different labels in the segment column of a record."""
MOST_NAME_LETTERS = 200
"""Most characters of a name. A file name may have 255 bytes."""


def open_regular(
    path: Path, wanted: str = "the file itself", error: type[PigaError] = DataError
) -> BufferedReader:
    """Open a file for reading. Every file from outside is opened here.

    A device, a pipe or a folder is refused before anything is read from it: reading it might never end. ``wanted`` and
    ``error`` are for the message: the file that the user should name instead, and the class of the error.
    """
    remedy = f"check the file name: name {wanted}"
    try:
        mode = path.stat().st_mode
        if stat.S_ISREG(mode):
            return path.open("rb")
    except OSError as reason:
        raise error(f"{path}: cannot be read ({reason.strerror})", remedy=remedy, where=Where(path)) from None
    except ValueError:
        raise error(f"{str(path)!r}: is not a file name", remedy=remedy) from None
    kind = "a folder" if stat.S_ISDIR(mode) else "a pipe or a device"
    raise error(f"{path}: is not a regular file, but {kind}", remedy=remedy, where=Where(path))


def read_whole(path: Path, most: int, wanted: str, error: type[PigaError] = DataError) -> bytes:
    """All bytes of a file of at most ``most`` bytes; arguments and errors as for :func:`open_regular`."""
    with open_regular(path, wanted, error) as stream:
        size = os.fstat(stream.fileno()).st_size
        data = stream.read(most + 1) if size <= most else b""
    if max(size, len(data)) > most:
        raise error(f"{path}: larger than {most} bytes", remedy=f"name {wanted}", where=Where(path))
    return data


def check_label(text: str, what: str) -> None:
    """Refuse a name of an instrument, run or segment that does not fit into a list, a file name and a page."""
    if not text.strip():
        raise DataError(f"{what} is empty", remedy="give it a name")
    if len(text) > MOST_NAME_LETTERS:
        raise DataError(f"{what} has {len(text)} characters", remedy=f"use {MOST_NAME_LETTERS} or fewer")
    odd = next((letter for letter in text if not letter.isprintable() and letter != "\u3000"), None)
    if odd is not None:
        raise DataError(
            f"{what} {text[:40]!r} holds the control character {odd!r}", remedy="use letters, digits and signs"
        )


def first_line(error: BaseException) -> str:
    """First line of a library's error message; the class of the error if the message is empty."""
    text = str(error)
    return text.splitlines()[0] if text else type(error).__name__


def check_unpacked(path: Path, unpacked: int) -> None:
    """Refuse a container whose unpacked size is too large, with a :class:`DataError` that states the limit."""
    if unpacked > _MAX_UNPACKED:
        raise DataError(
            f"{path}: unpacks to more than {_MAX_UNPACKED >> 20} MiB", remedy="export as Parquet, or in parts"
        )
