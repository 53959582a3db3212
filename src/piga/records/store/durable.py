"""Files that are whole or not there: temporary file, fsync, rename, fsync of the directory.

A killed run leaves its temporary file behind; the next run that writes the same target removes it. A lock on
the temporary file tells a run that is still at work from one that is gone.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from piga.errors import StoreError

_MARK, _JOURNAL = ".piga-part", "-journal"
_WINDOWS = os.name == "nt"
"""There a renamed file must not be open, an open file is its own lock, and renames last by themselves."""


def write_durably(target: Path, write: Callable[[Path], object], *, replace: bool) -> None:
    """Let ``write`` fill a temporary file, make it last, and give it its name.

    Parameters
    ----------
    target:
        File to be.
    write:
        Fills the file whose path it gets.
    replace:
        False: an existing ``target`` is never touched.

    Raises
    ------
    StoreError
        If the file cannot be written; ``target`` is as it was.
    """
    try:
        remove_leftovers(target)
        handle, name = tempfile.mkstemp(prefix=f".{target.name}.", suffix=_MARK, dir=target.parent)
    except OSError as error:
        raise _unwritable(target, error) from None
    temporary = Path(name)
    try:
        if _WINDOWS:
            os.close(handle)
        else:
            _lock(handle)
        write(temporary)
        _sync(temporary)
        temporary.chmod(0o644)
        _rename(temporary, target, replace=replace)
        sync_directory(target.parent)
    except FileExistsError:
        raise StoreError(f"{target}: exists already", remedy="choose another name") from None
    except OSError as error:
        raise _unwritable(target, error) from None
    finally:
        _remove(temporary)
        if not _WINDOWS:
            os.close(handle)


def remove_leftovers(target: Path) -> None:
    """Remove temporary files of runs that were killed while they wrote ``target``."""
    pattern = f".{_escaped(target.name)}.*{_MARK}"
    for path in target.parent.glob(pattern):
        with suppress(OSError), path.open("rb") as stream:
            _lock(stream.fileno())
            _remove(path)
    for path in target.parent.glob(f"{pattern}{_JOURNAL}"):
        if not path.with_name(path.name.removesuffix(_JOURNAL)).exists():
            with suppress(OSError):
                path.unlink()


def _remove(temporary: Path) -> None:
    """Remove a temporary file, and the journal that SQLite keeps beside one that becomes a store."""
    for path in (temporary, temporary.with_name(temporary.name + _JOURNAL)):
        with suppress(OSError):
            path.unlink(missing_ok=True)


def sync_directory(folder: Path) -> None:
    """Make renames in a directory last."""
    if _WINDOWS:
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _sync(path: Path) -> None:
    with path.open("rb+") as stream:
        os.fsync(stream.fileno())


def _rename(temporary: Path, target: Path, *, replace: bool) -> None:
    if replace or _WINDOWS:
        (temporary.replace if replace else temporary.rename)(target)
        return
    os.link(temporary, target)


def _lock(handle: int) -> None:
    """Lock a file, or raise OSError when another process holds it."""
    if not _WINDOWS:
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _escaped(name: str) -> str:
    return "".join(f"[{letter}]" if letter in "*?[" else letter for letter in name)


def _unwritable(target: Path, error: OSError) -> StoreError:
    return StoreError(
        f"{target}: cannot be written ({error.strerror or error})",
        remedy="check space and rights",
    )
