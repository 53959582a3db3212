"""What was changed in the folder, so that it can be undone; and what a page saw of a file before it changed it.

What is replaced or removed is moved to ``.piga-ui/trash``. The list of changes is that of this server.
"""

from __future__ import annotations

import difflib
import hashlib
import secrets
import threading
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

from piga.errors import ArgumentError
from piga.workbench.folder import Folder

_MOST_STEPS = 100
_MOST_TEXTS = 300
"""Texts that are remembered to say what changed meanwhile."""


class ChangedError(ArgumentError):
    """A file is no longer what the page had seen."""

    def __init__(self, name: str, lines: list[str], now: str) -> None:
        super().__init__(f"{name} was changed meanwhile, by another tab or program", remedy="see what changed")
        self.lines, self.now = lines, now


@dataclass(frozen=True)
class Change:
    """One change in words, and its steps: a path, and where its former content lies (None: there was none)."""

    words: str
    steps: tuple[tuple[Path, Path | None], ...]


class History:
    """Undo for one folder. Steps are taken back in the reverse order."""

    def __init__(self, folder: Folder) -> None:
        self._folder = folder
        self._changes: list[Change] = []
        self._texts: OrderedDict[str, str] = OrderedDict()
        self.lock = threading.RLock()

    @property
    def last(self) -> str:
        """What Undo takes back, in words; "" if there is nothing."""
        return self._changes[-1].words if self._changes else ""

    def note(self, words: str, *steps: tuple[Path, Path | None]) -> None:
        """A change was made."""
        self._changes = [*self._changes[-_MOST_STEPS + 1 :], Change(words, steps)]

    def put_away(self, path: Path) -> Path | None:
        """Move a file or folder to the trash; None if there is none."""
        path = self._folder.path(self._folder.name(path))
        if not path.exists():
            return None
        place = self._folder.state_room("trash") / f"{secrets.token_hex(6)}-{path.name[-80:]}"
        path.rename(place)
        return place

    def copy_away(self, path: Path) -> Path | None:
        """Copy a small file to the trash; None if there is none."""
        if not path.exists():
            return None
        place = self._folder.state_room("trash") / f"{secrets.token_hex(6)}-{path.name[-80:]}"
        place.write_bytes(self._folder.read(path))
        return place

    def undo(self) -> str:
        """Take the last change back; what it was, in words."""
        with self.lock:
            if not self._changes:
                raise ArgumentError("there is nothing to undo", remedy="reload the page")
            change = self._changes.pop()
            for path, former in reversed(change.steps):
                if former is not None and former.is_file() and path.is_file():
                    self.copy_away(path)
                    former.replace(path)  # at once: an open page may ask for it at any time
                    continue
                self.put_away(path)
                if former is not None and former.exists():
                    former.rename(path)
            return change.words

    # --- two tabs ---------------------------------------------------------------------------------

    def seen(self, text: str) -> str:
        """The mark of a text that a page shows."""
        mark = hashlib.sha256(text.encode()).hexdigest()[:24]
        self._texts[mark] = text
        self._texts.move_to_end(mark)
        while len(self._texts) > _MOST_TEXTS:
            self._texts.popitem(last=False)
        return mark

    def write(self, name: str, seen: str, text: str, words: str, kind: str = "run") -> None:
        """Write a TOML file of the folder if it is what the page had seen. An empty ``seen`` is that of a new file."""
        with self.lock:
            path = self._folder.path(name)
            before = self._folder.text(name) if path.exists() else ""
            now = self.seen(before) if path.exists() else ""
            if now != seen:
                former = self._texts.get(seen, "").splitlines()
                lines = [
                    line
                    for line in difflib.unified_diff(former, before.splitlines(), lineterm="", n=0)
                    if line[:1] in "+-" and line[:3] not in ("+++", "---")
                ]
                raise ChangedError(name, lines[:40], now)
            if text.replace("\r\n", "\n") == before:
                return
            former_copy = self.copy_away(path)
            self._folder.write_toml(path, text, kind=kind, new=former_copy is None)
            self.note(words, (path, former_copy))
