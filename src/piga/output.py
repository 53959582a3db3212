"""Write results to disk. A file is complete or absent, an input is never overwritten, and files of two runs do not mix unseen.

A single file is written under a hidden name beside its target (mode 0600), synchronised to disk, and renamed. The files of
one run are written in a hidden folder. A new folder of results appears by one rename. Into a folder that exists the files
are moved one by one, between two marks: ``.piga-moving-COMMAND`` while they are moved, ``.piga-results-COMMAND.json`` with
their sizes and times last. A reader that sees the first mark says that the folder holds results of two runs. A killed run
leaves its hidden file or folder behind; the next run that writes there removes it. Everything obeys the umask.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from piga.errors import ArgumentError, PigaError

_PART, _JOURNAL, _STAGE = ".piga-part", "-journal", ".piga-stage-"
_MARK, _MOVING = ".piga-results-", ".piga-moving-"
CALIBRATION_RESULTS = ("calibration.json", "residuals.parquet", "report.html", "summary-*.json")
"""Names of the result files of a calibration."""
MOST_NAME = 100
"""Most bytes of a file's name, and of its ending, that are used in the name of its temporary file. The limit of file
systems is 255 in all."""
_WINDOWS = os.name == "nt"
"""On Windows a file must be closed before it is renamed, an open file is its own lock, and renames need no sync."""


# --- one file ----------------------------------------------------------------------------------------


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
        prefix, suffix = f".{_short(target.name)}.", f"{_PART}{_short(target.suffix)}"
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
        temporary.chmod(allowed(0o666))
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


def allowed(mode: int) -> int:
    """The bits of a mode that the umask allows. While it is read, it is the strictest."""
    umask = os.umask(0o077)
    os.umask(umask)
    return mode & ~umask


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
    pattern = f".{_escaped(_short(target.name))}.*{_PART}*"
    for path in target.parent.glob(pattern):
        if not path.name.endswith(_JOURNAL):
            with suppress(OSError), path.open("rb") as stream:
                _lock(stream.fileno())
                _remove(path)
    for path in target.parent.glob(f"{pattern}{_JOURNAL}"):
        if not path.with_name(path.name.removesuffix(_JOURNAL)).exists():
            with suppress(OSError):
                path.unlink()


# --- what may be replaced ----------------------------------------------------------------------------


def check_outputs(outputs: Iterable[Path], inputs: Iterable[Path], *, force: bool) -> None:
    """Refuse to overwrite inputs and, unless ``force``, existing files.

    Inputs are recognised under any name. An input is never replaced.

    Raises
    ------
    ArgumentError
        Naming the file.
    """
    there = [path for path in outputs if path.exists() or path.is_symlink()]
    same = _same_file(there, inputs)
    if same is not None:
        raise ArgumentError(
            f"{same[0]}: is the input {same[1]}: it would be replaced by the result",
            remedy="choose another --out",
        )
    if there and not force:
        named = ", ".join(map(str, there[:5])) + (f" and {len(there) - 5} more" if len(there) > 5 else "")
        raise ArgumentError(f"{named}: there already", remedy="choose another --out, or replace with --force")


def _same_file(outputs: Iterable[Path], inputs: Iterable[Path]) -> tuple[Path, Path] | None:
    """An output that is an input under the same or another name, and that input."""
    read = {_identity(path): path for path in inputs if path.exists()}
    for path in outputs:
        if path.exists() and _identity(path) in read:
            return path, read[_identity(path)]
    return None


def results_folder(
    folder: Path,
    command: str,
    names: Sequence[str],
    inputs: Sequence[Path],
    *,
    force: bool,
    option: str = "--out",
) -> Path:
    """The folder in which results will appear: ``folder``, or the first of ``folder/2``, ``folder/3`` ... that is free.

    A folder is free if it holds none of the ``names`` (patterns), or only unchanged results of the same command and the same
    inputs, or with ``force``. An input is never replaced.

    Raises
    ------
    ArgumentError
        If ``folder`` or a result is the name of something else, or ``force`` would replace an input.
    """
    folder = Path(os.path.abspath(folder))  # noqa: PTH100 - symbolic links stay as they are named
    number, place = 1, folder
    while True:
        if place.exists() and not place.is_dir():
            raise ArgumentError(f"{place}: is a file", remedy=f"choose another {option}")
        there = _matching(place, names)
        folders = [
            path for name in names for path in place.glob(name) if path.is_dir() and not path.is_symlink()
        ]
        if folders:
            raise ArgumentError(
                f"{folders[0]}: is a folder where a result goes",
                remedy=f"move it away, or choose another {option}",
            )
        same = _same_file(there, inputs)
        if force and same is not None:
            raise ArgumentError(
                f"{same[0]}: is the input {same[1]}: it would be replaced by the result",
                remedy=f"choose another {option}, or leave --force out",
            )
        mark = _read_mark(place / f"{_MARK}{command}.json", _key(command, inputs))
        if force or (same is None and all(_is_unchanged(path, place, mark) for path in there)):
            return place
        number, place = number + 1, folder / str(number + 1)


# --- the results of one run --------------------------------------------------------------------------


@contextmanager
def results(
    folder: Path,
    command: str,
    names: Sequence[str],
    inputs: Sequence[Path],
    *,
    force: bool = False,
    option: str = "--out",
) -> Iterator[Path]:
    """A hidden folder to fill with the results of one run. At the end they appear in ``folder``, or nothing does.

    Parameters
    ----------
    folder:
        Folder of the results, from :func:`results_folder`; created if it does not exist.
    command:
        Name of the command, in a form that fits into a file name.
    names:
        Patterns of the names of all results of the command. Older files with such names are removed.
    inputs:
        Files that the command reads.
    force:
        True: existing results may be replaced. Else :func:`results_folder` has chosen a folder without them.
    option:
        The option that names ``folder``.

    Raises
    ------
    PigaError
        If the folder cannot be written.
    """
    folder = results_folder(folder, command, names, inputs, force=force, option=option)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        home = folder if folder.is_dir() else folder.parent
        for place in {home, folder.parent}:
            _remove_stages(place)
        with _staged(home) as stage:
            yield stage
            mark = _finish_stage(stage, command, _key(command, inputs))
            stage.chmod(allowed(0o777))
            if home == folder or not _renamed(stage, folder):
                _move(stage, folder, command, names, mark)
    except KeyboardInterrupt as stop:
        stop.add_note(_after_stop(folder))
        raise
    except OSError as error:
        raise PigaError(
            f"{option} {folder}: cannot be written ({error.strerror or error})",
            remedy="name a directory you may write to, with room",
        ) from None


def _after_stop(folder: Path) -> str:
    """What a folder of results holds after a stop, in words."""
    if any(folder.glob(f"{_MOVING}*")):
        return f"{folder}: results of two runs; run the command again with --force"
    return f"{folder}: {'as before' if folder.is_dir() else 'not made'}; nothing of this run was kept"


def check_results(folder: Path) -> None:
    """Refuse a folder in which the results of a run are only partly in place.

    Raises
    ------
    PigaError
        Naming the command that must be run again.
    """
    for mark in folder.glob(f"{_MOVING}*"):
        command = mark.name.removeprefix(_MOVING)
        raise PigaError(
            f"{folder}: holds results of two runs of 'piga {command}'; the second was stopped",
            remedy="run that command again with --force",
        )


def is_staged(folder: Path) -> bool:
    """True for the hidden folder of results that are not in place yet."""
    return folder.name.startswith(_STAGE)


@contextmanager
def _staged(home: Path) -> Iterator[Path]:
    """A hidden folder of this process. It is removed at the end unless it was renamed."""
    stage = Path(tempfile.mkdtemp(prefix=_STAGE, dir=home))
    handle = None if _WINDOWS else os.open(stage, os.O_RDONLY)
    try:
        if handle is not None:
            _lock(handle)
        yield stage
    finally:
        if handle is not None:
            os.close(handle)
        shutil.rmtree(stage, ignore_errors=True)


def _remove_stages(home: Path) -> None:
    """Remove the hidden folders of processes that ended."""
    for stage in [] if _WINDOWS else home.glob(f"{_STAGE}*"):
        with suppress(OSError):
            handle = os.open(stage, os.O_RDONLY)
            try:
                _lock(handle)
                shutil.rmtree(stage, ignore_errors=True)
            finally:
                os.close(handle)


def _finish_stage(stage: Path, command: str, key: str) -> Path:
    """Sync the files of a hidden folder to disk, and write the mark with their sizes and times."""
    files = {}
    for path in sorted(stage.rglob("*")):
        if path.is_file():
            _sync(path)
            files[path.relative_to(stage).as_posix()] = _state(path)
    mark = stage / f"{_MARK}{command}.json"
    mark.write_text(json.dumps({"key": key, "files": files}), encoding="utf-8")
    _sync(mark)
    sync_directory(stage)
    return mark


def _renamed(stage: Path, folder: Path) -> bool:
    """Make the hidden folder the folder of results; False if there is one by now."""
    try:
        stage.rename(folder)
    except OSError:
        folder.mkdir(exist_ok=True)
        return False
    sync_directory(folder.parent)
    return True


def _move(stage: Path, folder: Path, command: str, names: Sequence[str], mark: Path) -> None:
    """Move results into a folder that exists, in place of older ones, between two marks."""
    staged = {
        path: folder / path.relative_to(stage) for path in stage.rglob("*") if path.is_file() and path != mark
    }
    for target in staged.values():
        if target.is_dir() or target.parent.is_symlink():
            raise ArgumentError(
                f"{target}: is a folder where a result goes", remedy="move it away, or choose another --out"
            )
    moving = folder / f"{_MOVING}{command}"
    with _locked(folder):
        moving.touch()
        sync_directory(folder)
        for path, target in staged.items():
            target.parent.mkdir(parents=True, exist_ok=True)
            path.replace(target)
        for path in set(_matching(folder, names)) - set(staged.values()):
            path.unlink()
        mark.replace(folder / mark.name)
        sync_directory(folder)
        moving.unlink()


def _matching(folder: Path, names: Sequence[str]) -> list[Path]:
    """Files with these names (patterns) in a folder. Files behind a link to another folder are not of the folder."""
    home = folder.resolve()
    found = {path for name in names for path in folder.glob(name) if not path.is_dir() or path.is_symlink()}
    return sorted(path for path in found if path.parent.resolve().is_relative_to(home))


def _key(command: str, inputs: Sequence[Path]) -> str:
    return " ".join([command, *sorted({os.path.realpath(path) for path in inputs})])


def _read_mark(path: Path, key: str) -> dict[str, Any]:
    """Size and time, by name, of the results from an earlier run with the same command and inputs."""
    try:
        mark = json.loads(path.read_text(encoding="utf-8"))
        return dict(mark["files"]) if mark["key"] == key else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _is_unchanged(path: Path, folder: Path, mark: dict[str, Any]) -> bool:
    return not path.is_symlink() and mark.get(path.relative_to(folder).as_posix()) == _state(path)


def _state(path: Path) -> list[int]:
    status = path.stat()
    return [status.st_size, status.st_mtime_ns]


def _identity(path: Path) -> tuple[int, int] | str:
    status = path.stat()
    return (status.st_dev, status.st_ino) if status.st_ino else os.path.realpath(path)


# --- the file system ---------------------------------------------------------------------------------


def hold(path: Path) -> Callable[[], None]:
    """Lock a file for this process; create it if it does not exist. Returns the function that unlocks it.

    Raises
    ------
    OSError
        If another process holds the lock, or the file system has no locks.
    """
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
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


def _lock(handle: int) -> None:
    """Lock a file; raise OSError if another process holds it."""
    if not _WINDOWS:
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _remove(temporary: Path) -> None:
    """Remove a temporary file, and its SQLite journal if it is a store."""
    for path in (temporary, temporary.with_name(temporary.name + _JOURNAL)):
        with suppress(OSError):
            path.unlink(missing_ok=True)


def _short(name: str) -> str:
    return name.encode()[:MOST_NAME].decode(errors="ignore")


def _escaped(name: str) -> str:
    return "".join(f"[{letter}]" if letter in "*?[" else letter for letter in name)


def _unwritable(target: Path, error: OSError, remedy: str, kind: type[PigaError]) -> PigaError:
    return kind(f"{target}: cannot be written ({error.strerror or error})", remedy=remedy)
