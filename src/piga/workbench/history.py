"""What was changed in the folder, so that it can be undone; and what a page saw of a file before it changed it.

What is replaced or removed is moved to ``.piga-ui/trash``. The list of changes is that of this server.
"""

from __future__ import annotations

import difflib
import hashlib
import secrets
import threading
from collections import deque
from pathlib import Path

from piga.errors import ArgumentError
from piga.workbench.folder import Folder

_MOST_STEPS = 100
_MOST_TEXTS = 300
"""Texts that are remembered to say what changed meanwhile."""


class ChangedError(ArgumentError):
    """A file is no longer what the page had seen."""

    def __init__(self, name: str, lines: list[str]) -> None:
        super().__init__(f"{name} was changed meanwhile, by another tab or program", remedy="see what changed")
        self.lines = lines


class History:
    """Undo for one folder. Each change is its words and its steps: a path, and where its former content lies."""

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

    def _copy_away(self, path: Path) -> Path | None:
        """Copy a small file to the trash; None if there is none."""
        if not path.exists():
            return None
        place = self._place_for(path)
        place.write_bytes(self._folder.read(path))
        return place

    def _place_for(self, path: Path) -> Path:
        return self._folder.state_room("trash") / f"{secrets.token_hex(6)}-{path.name[-80:]}"

    def undo(self) -> str:
        """Take the last change back, its steps in the reverse order; what it was, in words."""
        with self.lock:
            if not self._changes:
                raise ArgumentError("there is nothing to undo", remedy="reload the page")
            words, steps = self._changes.pop()
            for path, former in reversed(steps):
                if former is not None and former.is_file() and path.is_file():
                    self._copy_away(path)
                    former.replace(path)  # at once: an open page may ask for it at any time
                    continue
                self.put_away(path)
                if former is not None and former.exists():
                    former.rename(path)
            return words

    # --- two tabs ---------------------------------------------------------------------------------

    def seen(self, text: str) -> str:
        """The mark of a text that a page shows."""
        mark = hashlib.sha256(text.encode()).hexdigest()[:24]
        self._texts = {key: self._texts[key] for key in list(self._texts)[1 - _MOST_TEXTS :] if key != mark} | {
            mark: text
        }
        return mark

    def write(self, name: str, seen: str, text: str, words: str, kind: str = "run") -> None:
        """Write a TOML file of the folder if it is what the page had seen. An empty ``seen`` is that of a new file."""
        with self.lock:
            path = self._folder.path(name)
            before = self._folder.text(name) if path.exists() else ""
            if seen != (self.seen(before) if path.exists() else ""):
                former = self._texts.get(seen, "").splitlines()
                lines = list(difflib.unified_diff(former, before.splitlines(), lineterm="", n=0))[2:42]
                raise ChangedError(name, [line for line in lines if line[:1] in "+-"])
            if text.replace("\r\n", "\n") == before:
                return
            former_copy = self._copy_away(path)
            self._folder.write_toml(path, text, kind=kind, new=former_copy is None)
            self.note(words, (path, former_copy))
