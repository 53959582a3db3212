"""Files of a record under their own names: which names are safe anywhere, and writing them out."""

from __future__ import annotations

from collections.abc import Iterator
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
    """Write a file that must not be there yet.

    Raises
    ------
    StoreError
        If it is, or cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("xb") as stream:
            for part in parts:
                stream.write(part)
    except FileExistsError:
        raise StoreError(f"{path}: exists already", remedy="extract into an empty folder") from None
    except OSError as error:
        raise StoreError(
            f"{path}: cannot be written ({error.strerror})", remedy="choose another folder"
        ) from None
