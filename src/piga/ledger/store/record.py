"""A record before it is written (a draft), its place in the chain, and the record as it is read back."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from piga.ledger.store import blobs
from piga.ledger.store.documents import Link, RecordDocument, StoredFile, moment


@dataclass(frozen=True)
class Head:
    """Where a chain stands: number of records, and the hash that vouches for all of them."""

    number: int
    sha256: str


@dataclass(frozen=True)
class Position:
    """The place that a new record takes: its name, number, store, and the head before it."""

    id: str
    number: int
    store: str
    after: str


@dataclass(frozen=True)
class DraftFile:
    """A file to store: its role (run, data, calibration, report, ...), name, and where its bytes are.

    ``sha256`` is what it must be, where that is known: a file that changed since it was read is refused.
    """

    role: str
    name: str
    source: Path | bytes
    sha256: str | None = None

    def parts(self) -> Iterator[bytes]:
        """The bytes in parts."""
        return iter((self.source,)) if isinstance(self.source, bytes) else blobs.parts_of(self.source)


@dataclass(frozen=True)
class Draft:
    """A record before it is written; ``measured`` is the time of the test, in ISO form."""

    serial: str
    operator: str
    reason: str
    files: tuple[DraftFile, ...]
    request: dict[str, Any] = field(default_factory=dict)
    software: dict[str, str] = field(default_factory=dict)
    measured: str | None = None
    supersedes: str | None = None


@dataclass(frozen=True)
class Entry:
    """A link with its record as the bytes that are hashed; ``document`` is None in an export without it."""

    number: int
    link: bytes
    document: bytes | None


@dataclass(frozen=True)
class Record:
    """A record of the store: its place in the chain and what was written."""

    number: int
    head: str
    link: Link
    document: RecordDocument

    @property
    def id(self) -> str:
        """Name of the record; the same in every store."""
        return self.document.id

    @property
    def measured(self) -> datetime:
        """When the test was made; when that was not said or is not a date, when the record was made or added.

        Piga 0.1 let an import bring in times that are not dates.
        """
        for text in (self.document.measured, self.document.created):
            with suppress(ValueError, OverflowError):
                if text is not None:
                    return moment(text)
        return moment(self.link.added)

    def file(self, role: str) -> StoredFile | None:
        """The first file of a role."""
        return next((found for found in self.document.files if found.role == role), None)
