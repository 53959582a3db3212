"""The opened folder: its records and calibrations, which paths may be used, and what was changed in it.

Only regular files below the folder are read, and no part of a path may be a link. Hidden files are refused. The hidden
folder ``.piga-ui`` belongs to the workbench: results that are not kept yet, pictures of records, what was removed.
"""

from __future__ import annotations

import difflib
import hashlib
import os
import re
import secrets
import stat
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from piga.errors import ArgumentError, PigaError
from piga.formats.container import CONTAINERS, TEXT_SUFFIXES, file_kind
from piga.output import write_whole
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.diagnostics import scale_over_nominal
from piga.records.calibration.document import calibration_from_bytes
from piga.records.run_file import read_run_file
from piga.text_files import MAX_NAME, files_named_in, texts_of, toml_document
from piga.units import G0

_LOG_SUFFIXES = (*TEXT_SUFFIXES, *CONTAINERS, ".parquet", ".pq")
STATE_FOLDER = ".piga-ui"
TRIALS = f"{STATE_FOLDER}/trials/"
"""Begin of the names of answers that are not kept."""
_MOST_FILES, _DEPTH = 5000, 4
"""Files and levels of folders that are listed, at most. A folder with more is not a folder of records."""
_MOST_TOML, _MOST_RESULT = 1 << 20, 200 << 20
"""Largest TOML file and largest result file [bytes] that are read."""
_LONGEST_NAME = 100
"""Most bytes of the stem of a new file. The names of its results are longer; a file system takes 255."""
CALIBRATION = "calibration.json"
_VERSION = re.compile(r"(.+?)(?:-v(\d{1,6}))?", re.DOTALL)
"""Folder of a kept calibration, and the number of an older version."""


class OutsideError(ArgumentError):
    """A path that may not be used."""

    status_code = 404


@dataclass(frozen=True)
class Kept:
    """A calibration of the folder ``name``: when it was made, and K with its standard uncertainty ``u`` in ``unit``.

    ``ppm`` and ``u_ppm`` are the difference of K from its nominal value and its standard uncertainty, in parts of that. ``record``
    is the folder of the newest calibration of the same record; ``version`` is 0 for it, and counts down for older ones.
    """

    name: str
    calibration: Calibration
    created: str
    K: float
    u: float
    unit: str
    ppm: float
    u_ppm: float
    record: str
    version: int


@dataclass(frozen=True)
class Entry:
    """A record: the name of its run file below the folder, or that of a log that no run file describes (state ``log``).

    Other states are ``faulty`` (the run file cannot be used, see ``message``) and ``ready``. ``log`` is its data file,
    ``changed`` [s since 1970] the time of that. ``kept`` are its calibrations, the newest first.
    """

    name: str
    state: str
    serial: str = ""
    log: str = ""
    changed: float = 0.0
    message: str = ""
    kept: tuple[Kept, ...] = ()


class Folder:
    """The folder that ``piga ui`` opened."""

    def __init__(self, root: Path) -> None:
        if not root.is_dir():
            raise ArgumentError(f"{root}: is not a folder", remedy="name a folder that holds records")
        self.root = root.resolve()
        self._seen: dict[Any, tuple[Any, Any]] = {}

    def state_room(self, *names: str) -> Path:
        """A folder of ``.piga-ui``; it is made when it is first needed."""
        path = self.root
        for name in (STATE_FOLDER, *names):
            path /= name
            with suppress(FileExistsError):
                path.mkdir(mode=0o700)
            status = os.lstat(path)
            mine = not hasattr(os, "getuid") or status.st_uid == os.getuid()
            if not stat.S_ISDIR(status.st_mode) or not mine:
                words = f"{self.name(path)} {'is not a folder' if mine else 'belongs to another user'}"
                raise OutsideError(words, remedy=f"remove {STATE_FOLDER}, or open another folder")
        return path

    def path(self, name: str) -> Path:
        """The path of the file or folder ``name`` below this folder. It need not exist."""
        if not _is_plain(name):
            words = f"{name[:200]!r}: is not a file of this folder that can be opened"
            begins = PurePosixPath(name).name.startswith("-")
            raise OutsideError(words, remedy="rename it" if begins else "choose a listed file")
        return self._checked(self.root / PurePosixPath(name))

    def _checked(self, path: Path) -> Path:
        """The path, if it and the folders around it are no links and no devices. It need not exist."""
        try:
            inside = path.relative_to(self.root)
            if ".." in inside.parts:
                raise ValueError
            for place in (*[self.root / part for part in list(inside.parents)[:-1]], path):
                mode = os.lstat(place).st_mode
                if not (stat.S_ISDIR(mode) or (place == path and stat.S_ISREG(mode))):
                    raise ValueError
        except FileNotFoundError:
            return path
        except (OSError, ValueError):
            words = f"{path.name[:200]} is not a regular file of this folder"
            raise OutsideError(words, remedy="copy the file itself into the opened folder") from None
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

    def read(self, path: Path, most: int = _MOST_RESULT) -> bytes:
        """All bytes of a regular file below the folder. No part of its path may be a link."""
        flags = os.O_RDONLY
        for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_BINARY"):
            flags |= getattr(os, name, 0)
        try:
            with open(path, "rb", opener=lambda *_: os.open(self._checked(path), flags)) as stream:
                status = os.fstat(stream.fileno())
                if not stat.S_ISREG(status.st_mode) or status.st_size > most:
                    words = f"{path.name}: is no regular file, or larger than {most >> 20} MiB"
                    raise OutsideError(words, remedy="choose another")
                return stream.read(most + 1)
        except OSError as error:
            words = f"{path.name}: cannot be read ({error.strerror})"
            raise OutsideError(words, remedy="choose a listed file") from None

    def text(self, name: str) -> str:
        """The text of a TOML file of the folder."""
        return self.read(self.file(name), _MOST_TOML).decode("utf-8", "replace")

    def toml(self, name: str) -> Path:
        """The path of a TOML file all of whose named files lie in this folder."""
        path = self.file(name)
        if path.suffix != ".toml":
            raise OutsideError(f"{name}: is no TOML file", remedy="choose a run file")
        texts = texts_of(toml_document(path, self.read(path, _MOST_TOML)))
        named = [path.parent / text for text in texts if text and len(text) < MAX_NAME and "\0" not in text]
        named = [one for one in named if os.path.lexists(one) and not one.is_dir()]
        for one in (*files_named_in(path), *named):
            try:
                self._checked(Path(os.path.normpath(one)))
            except OutsideError as error:
                words = f"{path.name} names {one.name[:80]}: {error.message}"
                raise OutsideError(words, remedy=error.remedy) from None
        return path

    def files(self) -> Iterator[Path]:
        """The regular files of the folder and of its folders, without hidden files and links."""
        count = 0
        for folder, folders, names in os.walk(self.root):
            here = Path(folder)
            level = len(here.relative_to(self.root).parts)
            folders[:] = sorted(n for n in folders if n[0] not in ".-") if level < _DEPTH else []
            for name in sorted(names):
                count += 1
                if count > _MOST_FILES:
                    return
                if _is_plain(self.name(here / name)) and _is_regular(here / name):
                    yield here / name

    def entries(self) -> list[Entry]:
        """All records, the newest first: those with a run file, and logs without one."""
        files = list(self.files())
        results = {path.parent for path in files if path.name == CALIBRATION}
        files = [path for path in files if path.parent not in results]
        kept = [one for one in map(self.kept, sorted(results)) if one is not None]
        kept.sort(key=lambda one: (one.version != 0, one.version))
        runs = {path: self._once(self._described, path) for path in files if path.suffix == ".toml"}
        records: dict[Path, Entry] = {path: entry for path, entry in runs.items() if entry is not None}
        described = {path.parent / entry.log for path, entry in records.items()}
        logs = (path for path in files if file_kind(path) in _LOG_SUFFIXES and path not in described)
        records |= {path: Entry(self.name(path), "log", log=path.name) for path in logs}
        entries = []
        for path, entry in records.items():
            place, data, more = self.name(results_of(path)), path.parent / entry.log, dict[str, Any]()
            mine = tuple(one for one in kept if one.record == place)
            if entry.log and _is_regular(data):
                more = {"changed": data.stat().st_mtime}
            elif entry.state == "ready":
                words = f"{entry.log}: there is no such file beside the run file\n  remedy: copy it there"
                more = {"state": "faulty", "message": words}
            entries.append(replace(entry, kept=mine, **more))
        return sorted(entries, key=lambda entry: (-entry.changed, entry.name))

    def _described(self, path: Path) -> Entry | None:
        """The record of a run file, before its data file is looked at; None for another TOML file."""
        entry = Entry(self.name(path), "ready", changed=path.stat().st_mtime)
        try:
            raw = self.read(path, _MOST_TOML)
            data = toml_document(path, raw).get("data")
            if data is None:
                return None
            log = str(data.get("file", "")) if isinstance(data, dict) else ""
            entry = replace(entry, log=log if len(log) < MAX_NAME and "\0" not in log else "")
            entry = replace(entry, serial=read_run_file(path, raw).instrument.serial)
            self.toml(entry.name)
        except PigaError as error:
            return replace(entry, state="faulty", message=str(error))
        return entry

    def entry(self, name: str) -> Entry:
        """One record."""
        entry = next((entry for entry in self.entries() if entry.name == name), None)
        if entry is None:
            raise OutsideError(f"{name[:200]}: is not a record of this folder", remedy="choose a listed record")
        return entry

    def kept(self, folder: Path) -> Kept | None:
        """The calibration of a folder; None if it cannot be read."""
        kept: Kept | None = self._once(self._kept, folder / CALIBRATION)
        return kept

    def _kept(self, path: Path) -> Kept | None:
        try:
            made = calibration_from_bytes(self.read(path), path)
        except PigaError:
            return None
        stds, nominal = {one.name: one.std for one in made.coefficients}, made.scale_factor_nominal * G0
        u = stds["scale_factor"] / nominal if "scale_factor" in stds else stds.get("k1")  # both relative
        if u is None:
            return None
        name, ratio, unit = self.name(path.parent), scale_over_nominal(made), f"{made.unit}/g"
        record, number = _VERSION.fullmatch(name).groups()  # type: ignore[union-attr]
        shown = nominal * ratio, nominal * u, unit, 1e6 * (ratio - 1.0), 1e6 * u
        return Kept(name, made, made.provenance.created[:19], *shown, record, -int(number or 0))

    def _once(self, read: Callable[[Path], Any], path: Path) -> Any:
        """What was read from a file, read again only if the file has changed."""
        state: Any = None
        with suppress(OSError):
            status = os.lstat(path)
            state = (status.st_mtime_ns, status.st_size)
        if self._seen.get(path, (None,))[0] != state or state is None:
            self._seen[path] = (state, read(path))
        return self._seen[path][1]

    def free(self, place: Path, stem: str, kind: str) -> Path:
        """The path of a new file in the folder ``place``: the stem, with a number behind it if there is such a file already."""
        stem = stem.encode()[:_LONGEST_NAME].decode("utf-8", "ignore")
        paths = (place / f"{stem}{number}{kind}" for number in ("", *(f"-{one}" for one in range(2, 10000))))
        return self._checked(next(path for path in paths if not os.path.lexists(path)))

    def free_for(self, wanted: str) -> Path:
        """A path for an uploaded file: the letters and digits of its name."""
        plain = plain_name(PurePosixPath(wanted.replace("\\", "/")).name)
        kind = file_kind(Path(plain or "x"))
        if kind not in (*_LOG_SUFFIXES, ".toml"):
            words = f"{wanted[:200]!r}: files of this kind are not accepted"
            raise OutsideError(words, remedy=f"use one of these kinds: {', '.join(_LOG_SUFFIXES)}")
        return self.free(self.root, plain[: -len(kind)] or "log", kind)


def results_of(run: Path) -> Path:
    """The folder in which ``piga calibrate`` writes the results of a run file."""
    return run.with_name(f"{run.stem}-calibration")


def plain_name(text: str) -> str:
    """The letters and digits of a text, for the name of a file or folder."""
    return re.sub(r"[^\w.-]+", "-", text).strip(".-")


def _is_plain(name: str) -> bool:
    """True for a path below the folder that is not hidden and does not begin as an option does."""
    pure = PurePosixPath(name)
    wrong = "\\" in name or "\0" in name or len(name) > 4 * MAX_NAME or pure.is_absolute() or not pure.parts
    return not wrong and not any(part.startswith((".", "-")) for part in pure.parts)


def _is_regular(path: Path) -> bool:
    with suppress(OSError):
        return stat.S_ISREG(os.lstat(path).st_mode)
    return False


class ChangedError(ArgumentError):
    """A file is no longer what the page had seen."""

    status_code = 409

    def __init__(self, name: str, lines: list[str]) -> None:
        super().__init__(f"{name} was changed meanwhile, by another tab or program", remedy="see what changed")
        self.lines = lines


class History:
    """Undo for one folder, and what a page saw of a file before it changed it.

    Each change is its words, a path, and where its former content lies. The list of changes is that of this server.
    """

    def __init__(self, folder: Folder) -> None:
        self._folder = folder
        self._changes: list[tuple[str, Path, Path | None]] = []
        self._texts: dict[str, str] = {}
        self.lock = threading.RLock()

    @property
    def last(self) -> str:
        """What Undo takes back, in words; "" if there is nothing."""
        return self._changes[-1][0] if self._changes else ""

    def put(self, path: Path, part: Path | None, words: str, older: Path | None = None) -> None:
        """Put a folder in its place, or none. What is there moves to ``older``, or to the trash."""
        former = path.rename(older or self._trash(path)) if path.exists() else None
        if part is not None:
            part.rename(path)
        self._changes.append((words, path, former))

    def _trash(self, path: Path) -> Path:
        return self._folder.state_room("trash") / f"{secrets.token_hex(6)}-{path.name[-80:]}"

    def undo(self) -> None:
        """Take the last change back."""
        with self.lock:
            if not self._changes:
                raise ArgumentError("there is nothing to undo", remedy="reload the page")
            _, path, former = self._changes.pop()
            if path.exists() and (former is None or former.is_dir()):  # a file is replaced at once
                path.rename(self._trash(path))
            if former is not None:
                former.replace(path)

    def seen(self, text: str) -> str:
        """The mark of a text that a page shows."""
        mark = hashlib.sha256(text.encode()).hexdigest()[:24]
        self._texts[mark] = text
        return mark

    def write(self, name: str, seen: str, text: str, words: str) -> None:
        """Write a TOML file of the folder if it is valid, and what the page had seen. ``seen`` is empty for a new file."""
        with self.lock:
            path, raw = self._folder.path(name), text.replace("\r\n", "\n").encode()
            before = self._folder.read(path, _MOST_TOML) if path.exists() else None
            now = "" if before is None else before.decode("utf-8", "replace")
            if seen != ("" if before is None else self.seen(now)):
                saw = self._texts.get(seen, "").splitlines()
                lines = list(difflib.unified_diff(saw, now.splitlines(), lineterm="", n=0))[2:42]
                raise ChangedError(name, [line for line in lines if line[:1] in "+-"])
            if raw == before:
                return
            if len(raw) > _MOST_TOML:
                raise OutsideError(f"{path.name}: is larger than {_MOST_TOML >> 20} MiB", remedy="shorten it")
            if "data" in toml_document(path, raw):
                read_run_file(path, raw)
            former = None
            if before is not None:
                former = self._trash(path)
                former.write_bytes(before)
            write_whole(path, lambda part: part.write_bytes(raw), replace=before is not None)
            self._changes.append((words, path, former))
