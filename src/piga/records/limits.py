"""Limits on files that come from outside, and their words."""

from __future__ import annotations

from pathlib import Path

from piga.errors import DataError, PigaError

MAX_UNPACKED = 2 << 30
"""Bytes that the wanted part of a container may unpack to."""
MAX_RATIO = 100
"""Unpacked to packed size accepted above :data:`FREE_UNPACKED`."""
FREE_UNPACKED = 32 << 20
"""Bytes that any file may unpack to: constant columns pack very well."""
MAX_MEMBERS = 4096
"""Parts of a ZIP container."""
MEMORY_LIMIT = 6 << 30
"""Address space of the process that reads a container [bytes]."""
CPU_BASE, CPU_PER_MIB = 5.0, 4.0
"""CPU time for reading a container [s], and per MiB of file."""


MOST_LETTERS = 200
"""Characters of a name; a file name takes 255 bytes."""


def read_whole(path: Path, most: int, wanted: str, error: type[PigaError] = DataError) -> bytes:
    """All bytes of a file of at most ``most`` bytes; ``wanted`` is what to name instead of a larger one.

    Raises
    ------
    error
        If the file cannot be read or is larger.
    """
    try:
        if path.stat().st_size > most:
            raise error(f"{path}: larger than {most} bytes", remedy=f"name {wanted}")
        return path.read_bytes()
    except OSError as reason:
        raise error(f"{path}: cannot be read ({reason.strerror})", remedy="check the file name") from None


def check_label(text: str, what: str) -> None:
    """Refuse what cannot stand in a list, a file name or a page: the name of an instrument, a run, a segment.

    Raises
    ------
    DataError
        If the text is empty, longer than :data:`MOST_LETTERS`, or holds a control character or line break.
    """
    if not text.strip():
        raise DataError(f"{what} is empty", remedy="give it a name")
    if len(text) > MOST_LETTERS:
        raise DataError(f"{what} has {len(text)} characters", remedy=f"use {MOST_LETTERS} or fewer")
    odd = next((letter for letter in text if not letter.isprintable() and letter != "\u3000"), None)
    if odd is not None:
        raise DataError(
            f"{what} {text[:40]!r} holds the control character {odd!r}", remedy="use letters, digits and signs"
        )


def first_line(error: Exception) -> str:
    """What a library says of a damaged file, in one line; the kind of error where it says nothing."""
    text = str(error)
    return text.splitlines()[0] if text else type(error).__name__


def check_unpacked(path: Path, unpacked: int, packed: int) -> None:
    """Refuse a container that unpacks to too much.

    Raises
    ------
    DataError
        With the limit that was passed.
    """
    if unpacked > MAX_UNPACKED:
        raise DataError(
            f"{path}: unpacks to more than {MAX_UNPACKED >> 20} MiB", remedy="export as Parquet, or in parts"
        )
    if unpacked > FREE_UNPACKED and unpacked > MAX_RATIO * packed:
        raise DataError(
            f"{path}: unpacks to more than {MAX_RATIO} times its size",
            remedy="if the file is trusted, export it as Parquet",
        )


def extra_missing(path: Path, what: str, extra: str) -> PigaError:
    """The error for a reader whose library is not installed."""
    return DataError(
        f"{path}: reading {what} needs the extra '{extra}', which is not installed",
        remedy=f"install it with: pip install 'piga[{extra}]'",
    )
