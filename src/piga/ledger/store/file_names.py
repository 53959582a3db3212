"""Files of a record under their own names: which names are safe anywhere, and writing them out."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path, PurePosixPath

from piga.errors import StoreError

_RESERVED = {"CON", "PRN", "AUX", "NUL", *(f"{port}{n}" for port in ("COM", "LPT") for n in range(1, 10))}


def safe_name(name: str) -> PurePosixPath:
    """A file name of a record as a path below some folder.

    Raises
    ------
    StoreError
        If it is absolute, leads upwards, or holds what some file system takes for more than a name.
    """
    parts = name.split("/")
    bad = any(
        part in ("", ".", "..")
        or part.endswith((".", " "))
        or any(c in '\\:*?"<>|' or ord(c) < 32 for c in part)
        for part in parts
    )
    if bad or len(name) > 500 or any(part.split(".")[0].upper() in _RESERVED for part in parts):
        raise StoreError(
            f"file name '{name}' cannot be stored",
            remedy="use letters, digits and plain folders, relative to the run",
        )
    return PurePosixPath(name)


def write_new(path: Path, parts: Iterator[bytes]) -> None:
    """Write a file that must not be there yet; it appears under its name when it is whole, or not at all.

    Raises
    ------
    StoreError
        If it is there, or cannot be written.
    """
    partial = path.with_name(f".{path.name[:200]}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            raise StoreError(f"{path}: exists already", remedy="extract into an empty folder")
        with partial.open("wb") as stream:
            for part in parts:
                stream.write(part)
            stream.flush()
            os.fsync(stream.fileno())
        partial.rename(path)
    except OSError as error:
        raise StoreError(
            f"{path}: cannot be written ({error.strerror})", remedy="choose another folder"
        ) from None
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
