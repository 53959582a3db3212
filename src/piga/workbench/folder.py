"""The opened folder: which files it has, what they are, and which paths may be used.

Only regular files below the folder are used. Links that lead out of it, devices and hidden files are refused, also
when a run file names them.
"""

from __future__ import annotations

import os
import re
import secrets
import stat
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from piga.errors import ArgumentError, PigaError
from piga.formats.container import CONTAINERS
from piga.output import write_whole
from piga.reading.columns import TEXT_SUFFIXES, file_kind
from piga.records.run_file import read_run_file
from piga.records.text_files import MAX_NAME, files_named_in, texts_of, toml_document

LOG_SUFFIXES = (*TEXT_SUFFIXES, *CONTAINERS, ".parquet", ".pq")
STATE_FOLDER = ".piga-ui"
"""Folder below the opened one, in which jobs and envelopes are kept."""
MOST_FILES = 5000
"""Most files that are listed. A folder with more is not a folder of records."""
DEPTH = 4
"""Levels of folders that are listed."""
MOST_TOML = 1 << 20
"""Largest TOML file [bytes] that is listed and edited."""
_UPLOAD_NAME = re.compile(r"[^\w.-]+")

State = Literal["not described", "faulty", "ready", "calibrated"]


class OutsideError(ArgumentError):
    """A path that may not be used."""


@dataclass(frozen=True)
class FolderEntry:
    """A record in the folder: a run file, or a log that no run file describes.

    Attributes
    ----------
    name:
        Path below the folder, with ``/``.
    state:
        ``not described``: a log without run file. ``faulty``: the run file or its data file cannot be used, see
        ``message``. ``ready``: can be calibrated. ``calibrated``: results lie beside it.
    serial, log, size:
        Serial number, name of the data file, and its size [bytes].
    result:
        Folder of the results, or "".
    """

    name: str
    state: State
    serial: str = ""
    log: str = ""
    size: int = 0
    message: str = ""
    result: str = ""


class Folder:
    """The folder that ``piga ui`` opened."""

    def __init__(self, root: Path) -> None:
        if not root.is_dir():
            raise ArgumentError(f"{root}: is not a folder", remedy="name a folder that holds records")
        self.root = root.resolve()

    @property
    def state(self) -> Path:
        """The hidden folder of jobs and envelopes; it is made when it is first needed."""
        path = self.root / STATE_FOLDER
        path.mkdir(exist_ok=True)
        if path.is_symlink() or not path.is_dir():
            raise OutsideError(f"{STATE_FOLDER} is not a folder", remedy="remove it")
        return path

    def state_room(self, name: str) -> Path:
        """A folder of :attr:`state`; it is made when it is first needed.

        Raises
        ------
        OutsideError
            If something else has its name, such as a link to another place.
        """
        path = self.state / name
        if path.is_symlink() or (path.exists() and not path.is_dir()):
            raise OutsideError(f"{STATE_FOLDER}/{name} is not a folder", remedy=f"remove {STATE_FOLDER}")
        path.mkdir(exist_ok=True)
        return path

    def path(self, name: str) -> Path:
        """The path of the file or folder ``name`` below this folder. It need not exist.

        Raises
        ------
        OutsideError
            If it is hidden, begins as an option does, leads out of the folder, or is neither a regular file nor a folder.
        """
        if not is_plain(name):
            remedy = "rename it" if PurePosixPath(name).name.startswith("-") else "choose a listed file"
            raise OutsideError(f"{name!r}: is not a file of this folder that can be opened", remedy=remedy)
        path = self.root / PurePosixPath(name)
        self._check(path, name)
        return path

    def file(self, name: str) -> Path:
        """The path of an existing regular file."""
        path = self.path(name)
        if not path.is_file():
            raise OutsideError(f"{name}: there is no such file", remedy="choose a listed file")
        return path

    def name(self, path: Path) -> str:
        """The path below the folder, with ``/``."""
        return path.relative_to(self.root).as_posix()

    def listed(self, *patterns: str) -> list[str]:
        """The files that a page may offer, in the order of patterns and names: those that can be opened, and no links."""
        return [
            self.name(path)
            for pattern in patterns
            for path in sorted(self.root.glob(pattern))
            if is_plain(self.name(path)) and path.is_file() and not path.is_symlink()
        ]

    def toml(self, name: str) -> Path:
        """The path of a TOML file all of whose named files lie in this folder."""
        path = self.file(name)
        if path.suffix != ".toml":
            raise OutsideError(f"{name}: is not a TOML file", remedy="choose a run file")
        self.check_named(path)
        return path

    def check_named(self, path: Path) -> None:
        """Refuse a TOML file that names a file outside of this folder, or a device.

        Raises
        ------
        OutsideError
            Naming the file.
        """
        if path.stat().st_size > MOST_TOML:
            raise OutsideError(f"{path.name}: is larger than {MOST_TOML >> 20} MiB", remedy="shorten it")
        for named in [*files_named_in(path), *_data_files(path)]:
            self._check(named, f"{path.name} names {named.name}, which")

    def _check(self, path: Path, name: str) -> None:
        try:
            real = path.resolve()
            mode = path.stat().st_mode if path.exists() else stat.S_IFREG
        except (OSError, RuntimeError) as error:
            raise OutsideError(f"{name}: cannot be read ({error})", remedy="choose another file") from None
        if not real.is_relative_to(self.root) or not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise OutsideError(
                f"{name} is not a regular file of this folder", remedy="copy the file into the opened folder"
            )

    def write_toml(
        self, path: Path, text: str, check: Callable[[Path, bytes], object], *, new: bool = False
    ) -> None:
        """Write a complete TOML file after ``check`` of its path and bytes.

        Every file that it names must be in this folder.

        Raises
        ------
        PigaError
            If the text is refused. The file is then unchanged.
        """
        raw = text.replace("\r\n", "\n").encode("utf-8")
        check(path, raw)
        if len(raw) > MOST_TOML:
            raise OutsideError(f"{path.name}: is larger than {MOST_TOML >> 20} MiB", remedy="shorten it")
        for word in texts_of(toml_document(path, raw)):
            if word and len(word) < MAX_NAME and "\0" not in word and (path.parent / word).exists():
                self._check(path.parent / word, f"{path.name} names {word[:80]}, which")
        if new or not path.is_file() or path.read_bytes() != raw:
            write_whole(path, lambda part: part.write_bytes(raw), replace=not new)

    def entries(self) -> list[FolderEntry]:
        """All records: those with a run file first, then logs without one."""
        files = list(self._files())
        described: set[Path] = set()
        runs = [path for path in files if path.suffix == ".toml" and _is_run_file(path)]
        entries = [self._run_entry(path, described) for path in runs]
        logs = [path for path in files if file_kind(path) in LOG_SUFFIXES and path not in described]
        entries += [
            FolderEntry(self.name(path), "not described", log=path.name, size=path.stat().st_size)
            for path in logs
        ]
        return entries

    def _walk(self) -> Iterator[tuple[Path, list[str], list[str]]]:
        """Each folder with its folders and files. Hidden folders are named and not entered."""
        for folder, folders, names in os.walk(self.root):
            here = Path(folder)
            yield here, folders, names
            level = len(here.relative_to(self.root).parts)
            folders[:] = sorted(n for n in folders if not n.startswith(".")) if level < DEPTH else []

    def _files(self) -> Iterator[Path]:
        count = 0
        for here, folders, names in self._walk():
            if "calibration.json" in names:
                folders[:] = []
                continue
            for name in sorted(names):
                path = here / name
                if name.startswith(".") or not path.is_file() or not path.resolve().is_relative_to(self.root):
                    continue
                count += 1
                if count > MOST_FILES:
                    return
                yield path

    def _run_entry(self, path: Path, described: set[Path]) -> FolderEntry:
        name, serial, log = self.name(path), "", ""
        described.update(_data_files(path))
        try:
            self.check_named(path)
            run_file = read_run_file(path)
            serial, log = run_file.instrument.serial, run_file.data.file
            data = path.parent / log
            if not data.is_file():
                raise ArgumentError(f"{log}: there is no such file beside the run file", remedy="copy it there")
        except (PigaError, OSError) as error:
            return FolderEntry(name, "faulty", serial, log, message=str(error))
        result = results_of(path)
        done = (result / "calibration.json").is_file()
        state: State = "calibrated" if done else "ready"
        return FolderEntry(
            name, state, serial, log, data.stat().st_size, result=self.name(result) if done else ""
        )

    def free_name(self, wanted: str) -> Path:
        """A path in the folder for an uploaded file: the letters and digits of its name, and no existing file's.

        Raises
        ------
        OutsideError
            If the ending is not that of a log or a TOML file.
        """
        plain = _UPLOAD_NAME.sub("-", Path(wanted.replace("\\", "/")).name).strip(".-")
        path = self.root / (plain[-100:] or "log")
        if file_kind(path) not in (*LOG_SUFFIXES, ".toml"):
            raise OutsideError(
                f"{wanted!r}: files of this kind are not accepted",
                remedy=f"use one of these kinds: {', '.join(LOG_SUFFIXES)}",
            )
        while path.exists() or path.is_symlink():
            path = path.with_name(f"{secrets.token_hex(2)}-{path.name}"[-110:])
        return path


def results_of(run: Path) -> Path:
    """The folder in which ``piga calibrate`` writes the results of a run file."""
    return run.with_name(f"{run.stem}-calibration")


def is_plain(name: str) -> bool:
    """True for a path below the folder that is not hidden and does not begin as an option does."""
    pure = PurePosixPath(name)
    wrong = "\\" in name or "\0" in name or pure.is_absolute() or not pure.parts
    return not wrong and not any(part.startswith((".", "-")) for part in pure.parts)


def _is_run_file(path: Path) -> bool:
    """True if the TOML file has a data table, or cannot be read at all."""
    if path.stat().st_size > MOST_TOML:
        return False
    try:
        document = toml_document(path)
    except PigaError:
        return True
    return "data" in document


def _data_files(path: Path) -> list[Path]:
    """The data file that a run file names, whether it exists or not."""
    try:
        document: Any = toml_document(path)
    except PigaError:
        return []
    table = document.get("data")
    name = table.get("file") if isinstance(table, dict) else None
    return [path.parent / name] if isinstance(name, str) and name and "\0" not in name else []
