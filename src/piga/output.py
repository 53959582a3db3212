"""Write results to disk. They are complete or absent, never overwrite an input, and never mix the files of two runs.

A single file is written under a hidden name, synchronised to disk, and renamed. The files of one run are written in a
hidden folder. When all are complete, that folder is renamed to the folder of results. If the folder of results exists,
the files are moved into it one by one; meanwhile the hidden folder ends in ``.whole``. After a stop, the next reader or
writer moves the rest (:func:`settle`). A killed run leaves its hidden file or folder behind; the next run that writes
there removes it. A lock distinguishes a running process from one that ended.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from piga.errors import ArgumentError, PigaError

_MARK, _JOURNAL = ".piga-part", "-journal"
CALIBRATION_RESULTS = ("calibration.json", "residuals.parquet", "report.html", "summary-*.json")
"""Names of the result files of a calibration."""
MOST_NAME = 100
"""Most bytes of a file's name, and of its ending, that are used in the name of its temporary file. The limit of file
systems is 255 in all."""
_STAGE, _WHOLE = ".piga-stage-", ".whole"
_WINDOWS = os.name == "nt"
"""On Windows a file must be closed before it is renamed, an open file is its own lock, and renames need no sync."""


def write_whole(
    target: Path,
    write: Callable[[Path], object],
    *,
    replace: bool = True,
    remedy: str = "check space and rights",
    kind: type[PigaError] = PigaError,
) -> Path:
    """Let ``write`` fill a temporary file, sync it to disk, and rename it to ``target``.

    Parameters
    ----------
    target:
        The final file.
    write:
        Function that writes the file at the path it gets. The path has the same ending as ``target``.
    replace:
        False: an existing ``target`` is never replaced.
    remedy, kind:
        Remedy and class of the error if the file cannot be written.

    Raises
    ------
    PigaError
        If the file cannot be written. ``target`` is then unchanged.
    """
    try:
        remove_leftovers(target)
        prefix, suffix = f".{_short(target.name)}.", f"{_MARK}{_short(target.suffix)}"
        handle, name = tempfile.mkstemp(prefix=prefix, suffix=suffix, dir=target.parent)
    except OSError as error:
        raise _unwritable(target, error, remedy, kind) from None
    temporary = Path(name)
    try:
        if _WINDOWS:
            os.close(handle)
        else:
            _lock(handle)
        write(temporary)
        temporary.chmod(0o644)
        put_in_place(temporary, target, replace=replace)
    except FileExistsError:
        raise kind(f"{target}: exists already", remedy="choose another name") from None
    except OSError as error:
        raise _unwritable(target, error, remedy, kind) from None
    except KeyboardInterrupt as stop:
        stop.add_note(f"{target}: not written")
        raise
    finally:
        _remove(temporary)
        if not _WINDOWS:
            os.close(handle)
    return target


def put_in_place(part: Path, target: Path, *, replace: bool = True) -> None:
    """Sync a complete file beside ``target`` to disk, and rename it to ``target``.

    Raises
    ------
    OSError
        If it fails; FileExistsError if ``target`` exists and must not be replaced.
    """
    _sync(part)
    if replace or _WINDOWS:
        (part.replace if replace else part.rename)(target)
    else:
        try:
            os.link(part, target)
        except FileExistsError:
            raise
        except OSError:  # a file system without hard links
            if target.exists():
                raise FileExistsError(17, "exists", str(target)) from None
            part.rename(target)
    sync_directory(target.parent)


def remove_leftovers(target: Path) -> None:
    """Remove the temporary files of runs that were killed while writing ``target``."""
    pattern = f".{_escaped(_short(target.name))}.*{_MARK}*"
    for path in target.parent.glob(pattern):
        if not path.name.endswith(_JOURNAL):
            with suppress(OSError), path.open("rb") as stream:
                _lock(stream.fileno())
                _remove(path)
    for path in target.parent.glob(f"{pattern}{_JOURNAL}"):
        if not path.with_name(path.name.removesuffix(_JOURNAL)).exists():
            with suppress(OSError):
                path.unlink()


def check_outputs(
    outputs: Iterable[Path], inputs: Iterable[Path], *, force: bool, ours: Callable[[Path], bool] | None = None
) -> None:
    """Refuse to overwrite inputs and, unless ``force``, existing files. At a terminal the user is asked.

    Parameters
    ----------
    outputs:
        Files to be written.
    inputs:
        Files that the command reads. They are recognised under any name.
    force:
        True: existing files may be replaced. An input is never replaced.
    ours:
        Function that is True for a file that may be replaced in any case.

    Raises
    ------
    ArgumentError
        Naming the file.
    """
    outputs = [path for path in outputs if path.exists() or path.is_symlink()]
    known = {_identity(path): path for path in inputs if path.exists()}
    for path in outputs:
        same = known.get(_identity(path)) if path.exists() else None
        if same is not None:
            raise ArgumentError(
                f"{path}: is the input {same}: it would be replaced by the result",
                remedy="choose another --out",
            )
    there = [path for path in outputs if ours is None or not ours(path)]
    if force or not there:
        return
    named = ", ".join(str(path) for path in there[:5]) + (
        f" and {len(there) - 5} more" if len(there) > 5 else ""
    )
    if sys.stdin is not None and sys.stdin.isatty() and sys.stderr.isatty():
        sys.stderr.write(f"{named}: there already. Replace? [y/N] ")
        sys.stderr.flush()
        if sys.stdin.readline().strip().lower() in ("y", "yes"):
            return
        raise ArgumentError(f"{named}: not replaced", remedy="choose another --out")
    raise ArgumentError(f"{named}: there already", remedy="choose another --out, or replace with --force")


@contextmanager
def results(
    folder: Path,
    command: str,
    names: Sequence[str],
    inputs: Sequence[Path],
    *,
    force: bool,
    option: str = "--out",
) -> Iterator[Path]:
    """A folder to fill with the results of one run. They appear in ``folder`` together, or not at all.

    Parameters
    ----------
    folder:
        Folder of the results; created if it does not exist.
    command:
        Name of the command, in a form that fits into a file name.
    names:
        Patterns of the names of all results of the command. Older files with such names are removed.
    inputs:
        Files that the command reads. Unchanged results of the same command and the same inputs are replaced without a
        question. For other files see :func:`check_outputs`.
    force:
        True: existing files may be replaced.
    option:
        The option that names ``folder``.

    Raises
    ------
    PigaError
        If the folder cannot be written, a result would replace an input, or the folder holds other results.
    """
    folder = Path(os.path.abspath(folder))  # noqa: PTH100 - symbolic links stay as they are named
    key = _key(command, inputs)
    try:
        there = folder.is_dir()
        if there:
            settle(folder)
            _check_places(path for name in names for path in folder.glob(name))
            marks = _read_marks(folder / _mark_name(command), key)
            check_outputs(
                _matching(folder, names), inputs, force=force, ours=lambda path: _is_ours(path, marks)
            )
        elif folder.exists():
            raise NotADirectoryError(20, "is a file")
        else:
            folder.parent.mkdir(parents=True, exist_ok=True)
        _clear(folder.parent, f".{_escaped(folder.name)}{_STAGE}*")
        home, prefix = (folder, "") if there else (folder.parent, f".{folder.name}")
        with _staged(home, prefix) as stage:
            yield stage
            _finish_stage(stage, command, key, names)
            if not folder.exists():
                with suppress(OSError):
                    stage.rename(folder)
                    sync_directory(folder.parent)
                    return
                folder.mkdir(exist_ok=True)
            staged = [path.relative_to(stage) for path in stage.rglob("*") if path.is_file()]
            _check_places(folder / path for path in staged)
            whole = folder / f"{_STAGE}{secrets.token_hex(4)}{_WHOLE}"
            stage.rename(whole)
            sync_directory(folder)
            settle(folder)
    except KeyboardInterrupt as stop:
        stop.add_note(_what_is_there(folder))
        raise
    except OSError as error:
        raise PigaError(
            f"{option} {folder}: cannot be written ({error.strerror or error})",
            remedy="name a directory you may write to, with room",
        ) from None


def _what_is_there(folder: Path) -> str:
    """What a folder of results holds after a stop, in words."""
    if any(path.name.endswith(_WHOLE) for path in folder.glob(f"{_STAGE}*")):
        return f"{folder}: the results are complete; the next command there puts the last of them in place"
    if folder.is_dir():
        return f"{folder}: as before; nothing of this run was kept"
    return f"{folder}: not made; nothing of this run was kept"


def _check_places(paths: Iterable[Path]) -> None:
    """Refuse a folder that has the name of a result file, before any file is moved: it could not be replaced.

    Raises
    ------
    ArgumentError
        Naming the folder.
    """
    for path in paths:
        if path.is_dir() and not path.is_symlink():
            raise ArgumentError(
                f"{path}: is a folder where a result goes", remedy="move it away, or choose another --out"
            )


def settle(folder: Path) -> None:
    """Finish moving the results of a stopped run that were complete, and remove unfinished ones.

    Raises
    ------
    PigaError
        If the folder cannot be written. It then holds the files of two runs.
    """
    waiting = sorted(folder.glob(f"{_STAGE}*"))
    if not waiting:
        return
    with _locked(folder):
        for stage in waiting:
            if stage.name.endswith(_WHOLE) and stage.is_dir():
                try:
                    _put_in_place(stage, folder)
                except OSError as error:
                    raise PigaError(
                        f"{folder}: holds files of two runs ({error.strerror or error})",
                        remedy="run a piga command there as a user who may write to it",
                    ) from None
    _clear(folder, f"{_STAGE}*")


def is_staged(folder: Path) -> bool:
    """True for the hidden folder of results that are not moved yet."""
    return _STAGE in folder.name


def _put_in_place(stage: Path, folder: Path) -> None:
    """Move the results of a complete hidden folder into the folder and remove those they replace. The mark file comes last."""
    marks = [path for path in stage.iterdir() if path.name.startswith(".piga-results-")]
    if marks:
        staged = [path for path in stage.rglob("*") if path.is_file() and path != marks[0]]
        targets = [folder / path.relative_to(stage) for path in staged]
        _check_stage(stage, folder, targets)
        replaced = _replaced(marks[0], stage, folder)
        for path, target in zip(staged, targets, strict=True):
            target.parent.mkdir(parents=True, exist_ok=True)
            path.replace(target)
        for path in replaced:
            path.unlink()
        marks[0].replace(folder / marks[0].name)
    shutil.rmtree(stage)
    sync_directory(folder)


def _replaced(mark: Path, stage: Path, folder: Path) -> list[Path]:
    """Older results that the results of a complete hidden folder replace without being of the same name."""
    try:
        document = json.loads(mark.read_text(encoding="utf-8"))
        matching, kept = _matching(folder, document["names"]), set(document["files"])
    except (ValueError, KeyError, TypeError, AttributeError, NotImplementedError):
        raise _not_ours(stage) from None
    _check_stage(stage, folder, matching)
    return [path for path in matching if path.relative_to(folder).as_posix() not in kept]


def _check_stage(stage: Path, folder: Path, paths: Iterable[Path]) -> None:
    """Refuse a hidden folder that would change a file outside of the folder of results. It is not one of piga's.

    Raises
    ------
    PigaError
        Naming it.
    """
    home = folder.resolve()
    if stage.is_symlink() or not all(path.parent.resolve().is_relative_to(home) for path in paths):
        raise _not_ours(stage)


def _not_ours(stage: Path) -> PigaError:
    return PigaError(f"{stage}: does not hold results of a stopped run", remedy="remove it")


def _finish_stage(stage: Path, command: str, key: str, names: Sequence[str]) -> None:
    """Sync the files of a hidden folder to disk, and write their sizes and times into the mark file."""
    files = {}
    for path in sorted(stage.rglob("*")):
        if path.is_file():
            _sync(path)
            files[path.relative_to(stage).as_posix()] = _state(path)
    mark = stage / _mark_name(command)
    mark.write_text(json.dumps({"key": key, "names": list(names), "files": files}), encoding="utf-8")
    _sync(mark)
    sync_directory(stage)


@contextmanager
def _staged(home: Path, prefix: str) -> Iterator[Path]:
    """A hidden folder of this process. It is removed at the end unless it was renamed."""
    stage = home / f"{prefix}{_STAGE}{secrets.token_hex(4)}"
    stage.mkdir()
    handle = None if _WINDOWS else os.open(stage, os.O_RDONLY)
    try:
        if handle is not None:
            _lock(handle)
        yield stage
    finally:
        if handle is not None:
            os.close(handle)
        shutil.rmtree(stage, ignore_errors=True)


def _clear(home: Path, pattern: str) -> None:
    """Remove the hidden folders of processes that ended."""
    if _WINDOWS:
        return
    for stage in home.glob(pattern):
        if stage.name.endswith(_WHOLE):
            continue
        with suppress(OSError):
            handle = os.open(stage, os.O_RDONLY)
            try:
                _lock(handle)
                shutil.rmtree(stage, ignore_errors=True)
            finally:
                os.close(handle)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Let one process work at a time; the others wait. Without effect on Windows and on a file system without locks."""
    if _WINDOWS:
        yield
        return
    import fcntl

    handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def hold(path: Path) -> Callable[[], None]:
    """Lock a file for this process; create it if it does not exist. Returns the function that unlocks it.

    Raises
    ------
    OSError
        If another process holds the lock, or the file system has no locks.
    """
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        if _WINDOWS:
            import msvcrt

            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
        else:
            _lock(handle)
    except OSError:
        os.close(handle)
        raise
    return lambda: os.close(handle)


def _matching(folder: Path, names: Sequence[str]) -> list[Path]:
    return sorted({path for name in names for path in folder.glob(name) if not path.is_dir()})


def _mark_name(command: str) -> str:
    return f".piga-results-{command}.json"


def _key(command: str, inputs: Sequence[Path]) -> str:
    return " ".join([command, *sorted({os.path.realpath(path) for path in inputs})])


def _read_marks(path: Path, key: str) -> dict[str, Any]:
    """Size and time, by name, of the results from an earlier run with the same command and inputs."""
    try:
        mark = json.loads(path.read_text(encoding="utf-8"))
        return dict(mark["files"]) if mark["key"] == key else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _is_ours(path: Path, marks: dict[str, Any]) -> bool:
    return any(
        path.as_posix().endswith(f"/{name}") and not path.is_symlink() and state == _state(path)
        for name, state in marks.items()
    )


def _state(path: Path) -> list[int]:
    status = path.stat()
    return [status.st_size, status.st_mtime_ns]


def _identity(path: Path) -> tuple[int, int] | str:
    status = path.stat()
    return (status.st_dev, status.st_ino) if status.st_ino else os.path.realpath(path)


def _remove(temporary: Path) -> None:
    """Remove a temporary file, and its SQLite journal if it is a store."""
    for path in (temporary, temporary.with_name(temporary.name + _JOURNAL)):
        with suppress(OSError):
            path.unlink(missing_ok=True)


def sync_directory(folder: Path) -> None:
    """Sync a directory, so that renames in it are on disk."""
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


def _lock(handle: int) -> None:
    """Lock a file; raise OSError if another process holds it."""
    if not _WINDOWS:
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _short(name: str) -> str:
    return name.encode()[:MOST_NAME].decode(errors="ignore")


def _escaped(name: str) -> str:
    return "".join(f"[{letter}]" if letter in "*?[" else letter for letter in name)


def _unwritable(target: Path, error: OSError, remedy: str, kind: type[PigaError]) -> PigaError:
    return kind(f"{target}: cannot be written ({error.strerror or error})", remedy=remedy)
