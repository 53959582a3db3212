"""Write results to disk. A file is complete or absent, an input is never overwritten, and files of two runs do not mix unseen.

Everything is written in a hidden folder beside its place, synchronised to disk, and renamed. A new folder of results
appears by one rename. Into a folder that exists the files are moved one by one, between two marks:
``.piga-moving-COMMAND`` while they are moved, ``.piga-results-COMMAND.json`` with their sizes and times last. A reader that
sees the first mark says that the folder holds results of two runs. A killed run leaves its hidden folder behind; a run that
writes there a day later removes it.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any

from piga.errors import ArgumentError, PigaError

HIDDEN = ".piga-stage-"
"""Start of the name of a hidden folder, in which results are not in place yet."""
_MARK, _MOVING = ".piga-results-", ".piga-moving-"
_LEFT = 86400.0
"""Age above which a hidden folder is that of a killed run [s]."""
CALIBRATION_RESULTS = ("calibration.json", "residuals.parquet", "report.html", "summary-*.json")
"""Names of the result files of a calibration."""


# --- one file ----------------------------------------------------------------------------------------


def write_whole(
    target: Path,
    write: Callable[[Path], object],
    *,
    replace: bool = True,
    remedy: str = "check space and rights",
    kind: type[PigaError] = PigaError,
) -> Path:
    """Let ``write`` make a file of the same name in a hidden folder, sync it to disk, and rename it to ``target``.

    ``replace=False``: an existing ``target`` is never replaced. ``remedy`` and ``kind`` are those of the error.
    On an error ``target`` is unchanged.
    """
    try:
        with _hidden_folder(target.parent) as hidden:
            write(hidden / target.name)
            put_in_place(hidden / target.name, target, replace=replace)
    except FileExistsError:
        raise kind(f"{target}: exists already", remedy="choose another name") from None
    except OSError as error:
        raise kind(f"{target}: cannot be written ({error.strerror or error})", remedy=remedy) from None
    return target


def put_in_place(part: Path, target: Path, *, replace: bool = True) -> None:
    """Sync a complete file to disk, and rename it to ``target`` on the same file system."""
    _sync(part)
    if not replace:
        target.touch(exist_ok=False)
    part.replace(target)
    _sync(target.parent)


@contextmanager
def _hidden_folder(home: Path) -> Iterator[Path]:
    """A hidden folder in ``home``, removed at the end; those that killed runs left there, too."""
    for left in home.glob(f"{HIDDEN}*"):
        with suppress(OSError):
            if time.time() - left.stat().st_mtime > _LEFT:
                shutil.rmtree(left)
    with tempfile.TemporaryDirectory(prefix=HIDDEN, dir=home, ignore_cleanup_errors=True) as hidden:
        yield Path(hidden)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock a folder against other runs, where the system has locks of folders."""
    if os.name == "nt":
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


def _sync(path: Path) -> None:
    """Bring a file, or the names in a folder, to the disk. Windows has no call for either on a read handle."""
    if os.name == "nt":
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


# --- what may be replaced ----------------------------------------------------------------------------


def _free_folder(
    folder: Path, command: str, key: str, names: Sequence[str], inputs: Sequence[Path], *, force: bool
) -> tuple[Path, str]:
    """``folder``, or the first of ``folder/2``, ``folder/3`` ... that is free, and what ``folder`` then holds.

    A folder is free if it holds none of the ``names``, or only unchanged results of the same command, options and inputs, or
    with ``force``. An input is recognised under any name, and never replaced.
    """
    sources, why = [path for path in inputs if path.exists()], ""
    for place in (folder if number == 1 else folder / str(number) for number in count(1)):
        if place.exists() and not place.is_dir():
            raise ArgumentError(f"{place}: is a file", remedy="choose another folder")
        there = _matching(place, names)
        for path in there:
            if path.is_dir() and not path.is_symlink():
                raise _folder_in_the_way(path)
        same = [(one, read) for one in there if one.exists() for read in sources if one.samefile(read)]
        if force and same:
            raise ArgumentError(
                f"{same[0][0]}: is the input {same[0][1]}: it would be replaced by the result",
                remedy="choose another name or folder, or leave --force out",
            )
        mark = _read_mark(place / f"{_MARK}{command}.json")
        files = mark.get("files", {}) if mark.get("key") == key else {}
        ours = (files.get(path.relative_to(place).as_posix()) == _state(path) for path in there)
        if force or (not same and not any(map(Path.is_symlink, there)) and all(ours)):
            break
        if not why:
            changed = (
                "results that were changed since"
                if files
                else "files of such names that this command did not write"
            )
            why = "results of other options or inputs" if mark and not files else changed
    return place, why


def _folder_in_the_way(path: Path) -> ArgumentError:
    remedy = "move it away, or choose another name or folder"
    return ArgumentError(f"{path}: is a folder where a result goes", remedy=remedy)


def _matching(folder: Path, names: Sequence[str]) -> list[Path]:
    """What has these names (patterns) in a folder. What lies behind a link to another folder is not of the folder."""
    home, matching = folder.resolve(), {path for name in names for path in folder.glob(name)}
    return sorted(path for path in matching if path.parent.resolve().is_relative_to(home))


def _read_mark(path: Path) -> dict[str, Any]:
    """The mark of an earlier run of the same command: its key, and the sizes and times of its ``files``."""
    try:
        mark = json.loads(path.read_text(encoding="utf-8"))
        return {"key": mark["key"], "files": dict(mark["files"])}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _state(path: Path) -> list[int]:
    status = path.stat()
    return [status.st_size, status.st_mtime_ns]


# --- the results of one run --------------------------------------------------------------------------


@contextmanager
def results(
    folder: Path,
    command: str,
    names: Sequence[str],
    inputs: Sequence[Path],
    *,
    options: Sequence[str] = (),
    force: bool = False,
) -> Iterator[tuple[Path, Path, str]]:
    """A hidden folder to fill with the results of one run, and the folder in which they appear at the end, or nothing does.

    That is ``folder``, or ``folder/2``, ``folder/3`` ... where results lie that were changed or come from other ``inputs`` or
    ``options``; with ``force`` they are replaced, but never an input. Third comes what ``folder`` holds, if it is not that one.
    ``names`` are patterns of all results of the ``command``; older files with such names are removed.
    """
    key = " ".join([command, *options, *sorted({os.path.realpath(path) for path in inputs})])
    folder, why = _free_folder(folder, command, key, names, inputs, force=force)
    with ExitStack() as stack:
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            home = folder if folder.is_dir() else folder.parent
            stage = stack.enter_context(_hidden_folder(home)) / "results"
            stage.mkdir()
        except OSError as error:
            words = f"{folder}: results cannot be written there ({error.strerror})"
            raise ArgumentError(words, remedy="choose another folder") from None
        yield stage, folder, why
        mark = _finish(stage, command, key)
        if folder.is_dir():
            _move(stage, folder, command, names, mark)
        else:
            stage.rename(folder)
            _sync(folder.parent)


def check_results(folder: Path) -> None:
    """Refuse a folder in which the results of a run are only partly in place."""
    for mark in folder.glob(f"{_MOVING}*"):
        command = mark.name.removeprefix(_MOVING)
        raise PigaError(
            f"{folder}: holds results of two runs of 'piga {command}'; the second was stopped",
            remedy="run that command again with --force",
        )


def _finish(stage: Path, command: str, key: str) -> Path:
    """Sync the files of a hidden folder to disk, and write the mark with their sizes and times."""
    files = {}
    for path in sorted(stage.rglob("*")):
        if path.is_file():
            _sync(path)
            files[path.relative_to(stage).as_posix()] = _state(path)
    mark = stage / f"{_MARK}{command}.json"
    mark.write_text(json.dumps({"key": key, "files": files}), encoding="utf-8")
    _sync(mark)
    _sync(stage)
    return mark


def _move(stage: Path, folder: Path, command: str, names: Sequence[str], mark: Path) -> None:
    """Move results into a folder that exists, in place of older ones, between two marks."""
    files = [path for path in stage.rglob("*") if path.is_file() and path != mark]
    targets = [folder / path.relative_to(stage) for path in files]
    for target in targets:
        if target.is_dir() or target.parent.is_symlink():
            raise _folder_in_the_way(target)
    moving = folder / f"{_MOVING}{command}"
    try:
        with _locked(folder):
            moving.touch()
            _sync(folder)
            for path, target in zip(files, targets, strict=True):
                target.parent.mkdir(parents=True, exist_ok=True)
                path.replace(target)
            for path in set(_matching(folder, names)) - set(targets):
                path.unlink()
            mark.replace(folder / mark.name)
            _sync(folder)
            moving.unlink()
    except KeyboardInterrupt as stop:
        if moving.exists():
            stop.add_note(f"{folder}: results of two runs; run the command again with --force")
        raise
