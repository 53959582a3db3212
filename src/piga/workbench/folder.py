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
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec

from piga.errors import ArgumentError, PigaError
from piga.formats.container import CONTAINERS
from piga.output import write_whole
from piga.reading.columns import TEXT_SUFFIXES, file_kind
from piga.records.run_file import read_run_file
from piga.records.text_files import MAX_NAME, files_named_in, texts_of, toml_document

_LOG_SUFFIXES = (*TEXT_SUFFIXES, *CONTAINERS, ".parquet", ".pq")
STATE_FOLDER = ".piga-ui"
_MOST_FILES = 5000
"""Most files that are listed. A folder with more is not a folder of records."""
_DEPTH = 4
"""Levels of folders that are listed."""
_MOST_TOML = 1 << 20
"""Largest TOML file [bytes] that is listed and edited."""
_MOST_RESULT = 200 << 20
"""Largest result file [bytes] that is read."""
_LONGEST_NAME = 100
"""Most bytes of the name of a dropped file. The names of its results are longer; a file system takes 255."""
CALIBRATION = "calibration.json"
_VERSION = re.compile(r"(.+?)(?:-v(\d{1,6}))?", re.DOTALL)
"""Folder of a kept calibration, and the number of an older version."""
_UPLOAD_NAME = re.compile(r"[^\w.-]+")
_MOST_STEPS, _MOST_TEXTS = 100, 300
"""Changes that can be undone, and texts that are remembered to say what changed meanwhile."""


class OutsideError(ArgumentError):
    """A path that may not be used."""


class _Coefficient(msgspec.Struct):
    name: str
    value: float
    std: float
    unit: str


class _KeptFile(msgspec.Struct):
    """The parts of ``calibration.json`` that a list shows."""

    instrument: dict[str, Any]
    coefficients: list[_Coefficient]
    provenance: dict[str, Any]


@dataclass(frozen=True)
class Kept:
    """A kept calibration: its folder, serial number, when it was made, and K with its standard uncertainty."""

    name: str
    serial: str
    created: str
    K: float
    u: float
    unit: str
    nominal: float

    @property
    def record(self) -> str:
        """Folder of the newest calibration of the same record."""
        return _VERSION.fullmatch(self.name)[1]  # type: ignore[index]

    @property
    def version(self) -> int:
        """0 for the newest of a record; older ones count down."""
        return -int(_VERSION.fullmatch(self.name)[2] or 0)  # type: ignore[index]

    @property
    def ppm(self) -> float:
        """Difference of K from the nominal value [ppm]."""
        return 1e6 * (self.K / self.nominal - 1.0)

    @property
    def u_ppm(self) -> float:
        """Standard uncertainty of K, as a part of the nominal value [ppm]."""
        return 1e6 * self.u / self.nominal


@dataclass(frozen=True)
class Entry:
    """A record of the folder.

    Attributes
    ----------
    name:
        Path of the run file below the folder; that of the log if no run file describes it.
    state:
        ``log``: no run file describes it. ``faulty``: the run file cannot be used, see ``message``. ``ready``, ``kept``.
    serial, log, size, changed:
        Serial number, name, size [bytes] and time of the last change [s since 1970] of the data file.
    kept:
        Its kept calibrations, the newest first.
    """

    name: str
    state: str
    serial: str = ""
    log: str = ""
    size: int = 0
    changed: float = 0.0
    message: str = ""
    kept: tuple[Kept, ...] = ()

    @property
    def day(self) -> str:
        """Day of the last change of the data file."""
        with suppress(OSError, OverflowError, ValueError):
            return time.strftime("%Y-%m-%d", time.localtime(self.changed))
        return ""


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

    # --- paths ------------------------------------------------------------------------------------

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
        """All bytes of a regular file below the folder. No part of its path may be a link, now or meanwhile."""
        if ".." in path.parts or self.root not in path.parents:
            raise OutsideError(f"{path.name}: is not a file of this folder", remedy="choose a listed file")
        try:
            with open(path, "rb", opener=lambda *_: self._opened(path)) as stream:
                status = os.fstat(stream.fileno())
                if not stat.S_ISREG(status.st_mode) or status.st_size > most:
                    raise OutsideError(
                        f"{path.name}: is no regular file, or too large", remedy="choose another"
                    )
                return stream.read(most + 1)
        except OSError as error:
            words = f"{path.name}: cannot be read ({error.strerror})"
            raise OutsideError(words, remedy="choose a listed file") from None

    def _opened(self, path: Path) -> int:
        """Number of an opened file below the folder. Each part of its path is opened in the one before, links are not."""
        flags = os.O_RDONLY
        for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_BINARY"):
            flags |= getattr(os, name, 0)
        if os.open not in os.supports_dir_fd:
            return os.open(self._checked(path), flags)
        number = os.open(self.root, flags)
        for part in path.relative_to(self.root).parts:
            parent = number
            try:
                number = os.open(part, flags, dir_fd=parent)
            finally:
                os.close(parent)
        return number

    # --- TOML files -------------------------------------------------------------------------------

    def text(self, name: str) -> str:
        """The text of a TOML file of the folder."""
        return self.read(self.file(name), _MOST_TOML).decode("utf-8", "replace")

    def toml(self, name: str) -> Path:
        """The path of a TOML file all of whose named files lie in this folder."""
        path = self.file(name)
        if path.suffix != ".toml" or path.stat().st_size > _MOST_TOML:
            words = f"{name}: is no TOML file of at most {_MOST_TOML >> 20} MiB"
            raise OutsideError(words, remedy="choose a run file")
        self._check_named(path, [*files_named_in(path), *_data_file(path, _toml_or_nothing(path))])
        return path

    def write_toml(self, path: Path, text: str, *, kind: str = "run", new: bool = False) -> None:
        """Write a complete TOML file if it is valid. Every file that it names must be in this folder."""
        raw = text.replace("\r\n", "\n").encode("utf-8")
        if len(raw) > _MOST_TOML:
            raise OutsideError(f"{path.name}: is larger than {_MOST_TOML >> 20} MiB", remedy="shorten it")
        document = toml_document(path, raw)
        if kind == "run":
            read_run_file(path, raw)
        words = [word for word in texts_of(document) if word and len(word) < MAX_NAME and "\0" not in word]
        self._check_named(path, [path.parent / word for word in words if os.path.lexists(path.parent / word)])
        write_whole(path, lambda part: part.write_bytes(raw), replace=not new)

    def _check_named(self, path: Path, files: list[Path]) -> None:
        for named in files:
            try:
                self._checked(Path(os.path.normpath(named)))
            except OutsideError as error:
                words = f"{path.name} names {named.name[:80]}: {error.message}"
                raise OutsideError(words, remedy=error.remedy) from None

    # --- what is in it ----------------------------------------------------------------------------

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

    def listed(self, *endings: str) -> list[str]:
        """The files with these endings."""
        return [self.name(path) for path in self.files() if path.name.lower().endswith(endings)]

    def entries(self) -> list[Entry]:
        """All records, the newest first: those with a run file, and logs without one."""
        files = list(self.files())
        results = {path.parent for path in files if path.name == CALIBRATION}
        kept: dict[str, list[Kept]] = {}
        for one in filter(None, map(self.kept, sorted(results))):
            kept.setdefault(one.record, []).append(one)
        files = [path for path in files if path.parent not in results]
        described: set[Path] = set()
        entries = []
        for path in (path for path in files if path.suffix == ".toml"):
            document = self._once([path], _toml_or_nothing, path)
            if document is None or "data" in document:
                data = _data_file(path, document)
                described.update(data)
                entry = self._once([path, *data], self._run_entry, path, data)
                mine = kept.get(self.name(results_of(path)), [])
                mine.sort(key=lambda one: (one.version != 0, one.version))
                state = "kept" if mine and entry.state == "ready" else entry.state
                entries.append(replace(entry, kept=tuple(mine), state=state))
        for path in files:
            if file_kind(path) in _LOG_SUFFIXES and path not in described:
                status = path.stat()
                entries.append(Entry(self.name(path), "log", "", path.name, status.st_size, status.st_mtime))
        return sorted(entries, key=lambda entry: (-entry.changed, entry.name))

    def entry(self, name: str) -> Entry:
        """One record."""
        entry = next((entry for entry in self.entries() if entry.name == name), None)
        if entry is None:
            raise OutsideError(f"{name[:200]}: is not a record of this folder", remedy="choose a listed record")
        return entry

    def _run_entry(self, path: Path, data: list[Path]) -> Entry:
        name, serial, log = self.name(path), "", ""
        try:
            self.toml(name)
            run_file = read_run_file(path)
            serial, log = run_file.instrument.serial, run_file.data.file
            if not data or not _is_regular(data[0]):
                raise ArgumentError(f"{log}: there is no such file beside the run file", remedy="copy it there")
        except (PigaError, OSError) as error:
            return Entry(name, "faulty", serial, log, changed=path.stat().st_mtime, message=str(error))
        status = data[0].stat()
        return Entry(name, "ready", serial, log, status.st_size, status.st_mtime)

    def kept(self, folder: Path) -> Kept | None:
        """The kept calibration of a folder; None if it cannot be read."""
        kept: Kept | None = self._once([folder / CALIBRATION], self._read_kept, folder)
        return kept

    def _read_kept(self, folder: Path) -> Kept | None:
        try:
            document = msgspec.json.decode(self.read(folder / CALIBRATION), type=_KeptFile)
            nominal = float(document.instrument["scale_factor_nominal"]["value"])
            values = {one.name: one for one in document.coefficients}
            K = values.get("scale_factor")
            if K is None:  # the calibration has the relative term k1 instead
                k1 = values["k1"]
                K = _Coefficient("", nominal * (1.0 + k1.value), nominal * k1.std, "rad/s/g")
            serial, made = str(document.instrument["serial"]), str(document.provenance.get("created", ""))
            return Kept(self.name(folder), serial, made[:19], K.value, K.std, K.unit, nominal)
        except (PigaError, msgspec.MsgspecError, KeyError, TypeError, ValueError, ZeroDivisionError):
            return None

    def _once(self, paths: list[Path], read: Callable[..., Any], *arguments: Any) -> Any:
        """What was read from files, read again only if one of them has changed."""
        key, states = (read.__name__, *paths), [_state(path) for path in paths]
        if self._seen.get(key, (None,))[0] != states:
            self._seen[key] = (states, read(*arguments))
        return self._seen[key][1]

    def free_name(self, wanted: str) -> Path:
        """A path in the folder for an uploaded file: the letters and digits of its name, and no existing file's."""
        plain = _UPLOAD_NAME.sub("-", PurePosixPath(wanted.replace("\\", "/")).name).strip(".-")
        kind = file_kind(Path(plain or "x"))
        if kind not in (*_LOG_SUFFIXES, ".toml"):
            words = f"{wanted[:200]!r}: files of this kind are not accepted"
            raise OutsideError(words, remedy=f"use one of these kinds: {', '.join(_LOG_SUFFIXES)}")
        stem = plain[: -len(kind)].encode()[:_LONGEST_NAME].decode("utf-8", "ignore") or "log"
        path = self.root / f"{stem}{kind}"
        while os.path.lexists(path):
            path = self.root / f"{stem}-{secrets.token_hex(2)}{kind}"
        return path


def results_of(run: Path) -> Path:
    """The folder in which ``piga calibrate`` writes the results of a run file."""
    return run.with_name(f"{run.stem}-calibration")


def _is_plain(name: str) -> bool:
    """True for a path below the folder that is not hidden and does not begin as an option does."""
    pure = PurePosixPath(name)
    wrong = "\\" in name or "\0" in name or len(name) > 4 * MAX_NAME or pure.is_absolute() or not pure.parts
    return not wrong and not any(part.startswith((".", "-")) for part in pure.parts)


def _state(path: Path) -> tuple[int, int]:
    with suppress(OSError):
        status = os.lstat(path)
        return (status.st_mtime_ns, status.st_size)
    return (0, 0)


def _is_regular(path: Path) -> bool:
    with suppress(OSError):
        return stat.S_ISREG(os.lstat(path).st_mode)
    return False


def _toml_or_nothing(path: Path) -> dict[str, Any] | None:
    """The tables of a TOML file; None if it cannot be read."""
    if path.stat().st_size > _MOST_TOML:
        return {}
    with suppress(PigaError):
        return toml_document(path)
    return None


def _data_file(path: Path, document: dict[str, Any] | None) -> list[Path]:
    """The data file that a run file names, whether it exists or not."""
    table = (document or {}).get("data")
    name = table.get("file") if isinstance(table, dict) else None
    good = isinstance(name, str) and name and "\0" not in name and len(name) < MAX_NAME
    return [path.parent / str(name)] if good else []


# --- what was changed -----------------------------------------------------------------------------


class ChangedError(ArgumentError):
    """A file is no longer what the page had seen."""

    def __init__(self, name: str, lines: list[str]) -> None:
        super().__init__(f"{name} was changed meanwhile, by another tab or program", remedy="see what changed")
        self.lines = lines


class History:
    """Undo for one folder, and what a page saw of a file before it changed it.

    Each change is its words and its steps: a path, and where its former content lies in ``.piga-ui/trash``. The list of changes
    is that of this server.
    """

    def __init__(self, folder: Folder) -> None:
        self._folder = folder
        self._changes: deque[tuple[str, tuple[tuple[Path, Path | None], ...]]] = deque(maxlen=_MOST_STEPS)
        self._texts: dict[str, str] = {}
        self.lock = threading.RLock()

    @property
    def last(self) -> str:
        """What Undo takes back, in words; "" if there is nothing."""
        return self._changes[-1][0] if self._changes else ""

    def note(self, words: str, *steps: tuple[Path, Path | None]) -> None:
        """A change was made."""
        self._changes.append((words, steps))

    def put_away(self, path: Path) -> Path | None:
        """Move a file or folder to the trash; None if there is none."""
        path = self._folder.path(self._folder.name(path))
        return path.rename(self._place_for(path)) if path.exists() else None

    def _place_for(self, path: Path) -> Path:
        return self._folder.state_room("trash") / f"{secrets.token_hex(6)}-{path.name[-80:]}"

    def undo(self) -> str:
        """Take the last change back, its steps in the reverse order; what it was, in words."""
        with self.lock:
            if not self._changes:
                raise ArgumentError("there is nothing to undo", remedy="reload the page")
            words, steps = self._changes.pop()
            for path, former in reversed(steps):
                # a file is replaced at once: a page may ask for it at any time
                if former is None or not former.is_file():
                    self.put_away(path)
                if former is not None:
                    former.replace(path)
            return words

    def seen(self, text: str) -> str:
        """The mark of a text that a page shows."""
        mark = hashlib.sha256(text.encode()).hexdigest()[:24]
        self._texts.pop(mark, None)
        self._texts[mark] = text
        for old in list(self._texts)[:-_MOST_TEXTS]:
            self._texts.pop(old, None)
        return mark

    def write(self, name: str, seen: str, text: str, words: str, kind: str = "run") -> None:
        """Write a TOML file of the folder if it is what the page had seen. An empty ``seen`` is that of a new file."""
        with self.lock:
            path, former = self._folder.path(name), None
            before = self._folder.text(name) if path.exists() else ""
            if seen != (self.seen(before) if path.exists() else ""):
                saw = self._texts.get(seen, "").splitlines()
                lines = list(difflib.unified_diff(saw, before.splitlines(), lineterm="", n=0))[2:42]
                raise ChangedError(name, [line for line in lines if line[:1] in "+-"])
            if text.replace("\r\n", "\n") == before:
                return
            if path.exists():
                former = self._place_for(path)
                former.write_bytes(self._folder.read(path))
            self._folder.write_toml(path, text, kind=kind, new=former is None)
            self.note(words, (path, former))
