"""The store of records: append-only and chained, in one SQLite file or a PostgreSQL database. Here: its documents.

They are JSON: identity of the store, records and links; their bytes are hashed.
``sha256(link)`` is the head after that link. A link names the head before it and the SHA-256 of its record. A
record names the SHA-256 of every file it holds. The head before the first link is the SHA-256 of the identity.
So one head proves everything before it, and ``sha256sum`` is enough to check a chain by hand.
"""

from __future__ import annotations

import hashlib
import json
import re
import secrets
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from piga.errors import ArgumentError, StoreError, needed
from piga.results import Result
from piga.text_files import JsonError, check_label, converted, json_object, open_regular

if TYPE_CHECKING:
    from piga.ledger.store.store import Store

_RESERVED = r"(?!(?:CON|PRN|AUX|NUL|(?:COM|LPT)[1-9])(?:[./]|$))"
_PART_OF_NAME = rf'{_RESERVED}[^\\/:*?"<>|\x00-\x1f]*[^\\/:*?"<>|\x00-\x1f. ]'
_NAME = re.compile(rf"{_PART_OF_NAME}(?:/{_PART_OF_NAME})*", re.IGNORECASE)
"""A path of names that every system can store, below some folder."""


def safe_name(name: str) -> PurePosixPath:
    """A file name of a record as a path below some folder."""
    if len(name) > 500 or not _NAME.fullmatch(name):
        raise StoreError(
            f"file name '{name}' cannot be stored",
            remedy="use letters, digits and plain folders, relative to the run",
        )
    return PurePosixPath(name)


_MAX_TEXT = 2000
"""Most characters of a text of a record."""
PART = 1 << 20
"""Bytes of a file in one row."""
_ALPHABET = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"
_ID = re.compile(rf"[{_ALPHABET}]{{5}}-[{_ALPHABET}]{{5}}")
DIGEST = re.compile(r"[0-9a-f]{64}")
"""A SHA-256 as text."""
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")
_STRING = re.compile(r'"((?:[^"\\]|\\.)*)"')
_ESCAPED = re.compile(r'\\[^"\\]|[\x7f-\x9f]')
"""A text of a JSON document, and a control character in it."""

T = TypeVar("T", bound=msgspec.Struct)


class Identity(msgspec.Struct, frozen=True, tag_field="schema", tag="piga.store/1"):
    """Identity of a store: a random name and the time it was made."""

    store: str
    created: str


class StoredFile(msgspec.Struct, frozen=True):
    """A file of a record: its role, its name relative to the other files, its digest and its size [bytes]."""

    role: str
    name: str
    sha256: str
    size: int


class RecordDocument(msgspec.Struct, frozen=True, tag_field="schema", tag="piga.record/1"):
    """A record. It is written once and never changed.

    ``store``, ``number`` and ``after`` state where it was first written: as record ``number`` of that store, after the
    head ``after``. ``measured`` is the time of the test, if given.
    """

    id: str
    store: str
    number: int
    after: str
    created: str
    operator: str
    reason: str
    serial: str
    files: tuple[StoredFile, ...]
    request: dict[str, Any]
    software: dict[str, str]
    measured: str | None = None
    supersedes: str | None = None


class TakenOver(msgspec.Struct, frozen=True):
    """Origin of an imported record: identity of its store and its link there, as text; who imported it and why."""

    identity: str
    link: str
    operator: str
    reason: str


class Link(msgspec.Struct, frozen=True, tag_field="schema", tag="piga.link/1"):
    """One link of the chain."""

    number: int
    previous: str
    record: str
    added: str
    taken_over: TakenOver | None = None


def sha256(data: bytes) -> str:
    """SHA-256 in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def digest_of(parts: Iterable[bytes]) -> tuple[str, int]:
    """SHA-256 and size [bytes] of a file given in parts."""
    digest, size = hashlib.sha256(), 0
    for part in parts:
        digest.update(part)
        size += len(part)
    return digest.hexdigest(), size


def encode(document: msgspec.Struct) -> bytes:
    """The document as JSON: keys sorted, no spaces, UTF-8."""
    plain = msgspec.to_builtins(document)
    return json.dumps(
        plain, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    ).encode()


def decode(raw: bytes, kind: type[T], what: str, *, strict: bool = False) -> T:
    """Read a document of a kind. ``strict`` also refuses duplicate keys, as for all JSON from outside."""
    try:
        return converted(json_object(raw) if strict else msgspec.json.decode(raw, type=dict[str, Any]), kind)
    except (msgspec.MsgspecError, JsonError, UnicodeDecodeError, RecursionError) as error:
        raise StoreError(
            f"{what}: is damaged, or made by a newer piga ({error})",
            remedy="update piga; or run piga records verify, and restore a backup",
        ) from None


def new_id() -> str:
    """Name of a new record: ten characters that are hard to confuse (50 random bits)."""
    letters = "".join(secrets.choice(_ALPHABET) for _ in range(10))
    return f"{letters[:5]}-{letters[5:]}"


def is_id(text: str) -> bool:
    """True if the text has the form of a record's name."""
    return _ID.fullmatch(text) is not None


def now() -> str:
    """UTC with microseconds, e.g. ``2026-11-21T09:30:00.000000Z``."""
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def moment(text: str) -> datetime:
    """A time as written in a document; UTC if no zone is given."""
    time = datetime.fromisoformat(text)
    return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)


def checked_text(name: str, text: str) -> str:
    """Check a line of text about a record, and return it without spaces at its ends."""
    text = text.strip()
    if not text or len(text) > _MAX_TEXT or _CONTROL.search(text):
        raise ArgumentError(
            f"{name}: is empty, longer than {_MAX_TEXT} letters, or holds a control character",
            remedy=f"say in words, on one line: {name} = '...'",
        )
    return text


def check_record(document: RecordDocument) -> None:
    """Refuse a record that a command could not show. The same check applies to added and imported records."""
    for name, text in (("id", document.id), ("supersedes", document.supersedes)):
        if text is not None and not is_id(text):
            raise ArgumentError(f"{name}: '{text[:40]}' is not the name of a record", remedy="e.g. 7K3QP-9XW2M")
    check_label(document.serial, "the serial")
    for name, text in (("created", document.created), ("measured", document.measured)):
        if text is not None:
            _check_moment(name, text)
    for name, text in (("operator", document.operator), ("reason", document.reason)):
        if checked_text(name, text) != text:
            raise ArgumentError(f"{name}: begins or ends with a space", remedy="leave it out")
    for text in _STRING.findall(encode(document).decode()):
        if len(text) > _MAX_TEXT or _ESCAPED.search(text.replace(r"\\", "")):
            raise ArgumentError(
                f"a text is longer than {_MAX_TEXT} letters or holds a control character: {text[:40]}",
                remedy="write a shorter text on one line",
            )
    for file in document.files:
        safe_name(file.name)
        check_label(file.role, "the role of a file")
    if len({file.name for file in document.files}) != len(document.files):
        raise ArgumentError("files: two have the same name", remedy="give each file a name of its own")


def check_measured(text: str) -> None:
    """Refuse a time of the test that is not a date, or that is to come. In other zones a day begins earlier."""
    _check_moment("measured", text)
    if moment(text) > datetime.now(UTC) + timedelta(days=1):
        raise ArgumentError(f"measured: '{text}' is in the future", remedy="give the date of the test")


def _check_moment(name: str, text: str) -> None:
    """Check a date or time in ISO form, of a year in which somebody may have measured."""
    with suppress(ValueError, OverflowError):
        if 1900 <= moment(text).year < 2200:
            return
    raise ArgumentError(
        f"{name}: '{text[:40]}' is not a date of the years 1900 to 2199",
        remedy="write 2026-11-20 or 2026-11-20T09:30:00+01:00",
    )


@dataclass(frozen=True)
class Head:
    """The head of a chain: number of records, and the hash that proves all of them."""

    number: int
    sha256: str


@dataclass(frozen=True)
class DraftFile:
    """A file to store: its role (run, data, calibration, report, ...), its name, and its bytes or their place.

    ``sha256`` is the expected digest, if known. A file that changed since it was read is refused.
    """

    role: str
    name: str
    source: Path | bytes
    sha256: str | None = None

    def parts(self) -> Iterator[bytes]:
        """The bytes of the file, in parts."""
        if isinstance(self.source, bytes):
            yield from (self.source[at : at + PART] for at in range(0, len(self.source), PART))
            return
        with open_regular(self.source, error=StoreError) as stream:
            while part := stream.read(PART):
                yield part


@dataclass(frozen=True, eq=False, repr=False)
class Draft(Result):
    """A record before it is written: :meth:`Store.append` writes it.

    ``measured`` is the time of the test, in ISO form. ``report`` makes a last file that shows the record.
    """

    serial: str
    operator: str
    reason: str
    files: tuple[DraftFile, ...]
    request: dict[str, Any] = field(default_factory=dict)
    software: dict[str, str] = field(default_factory=dict)
    measured: str | None = None
    supersedes: str | None = None
    report: Callable[[RecordDocument], DraftFile] | None = None


@dataclass(frozen=True)
class Record:
    """A record of a chain, by the bytes of its link and of its document, which are hashed.

    ``raw`` is None if an export leaves the record out. ``columns`` are head, id and serial, as the table of a store repeats them.
    """

    number: int
    raw_link: bytes = field(repr=False)
    raw: bytes | None = field(repr=False)
    columns: tuple[str, str, str] | None = None

    @cached_property
    def head(self) -> str:
        """The head of the chain after this record."""
        return sha256(self.raw_link)

    @cached_property
    def link(self) -> Link:
        """Its place in the chain."""
        return decode(self.raw_link, Link, f"link {self.number}")

    @cached_property
    def document(self) -> RecordDocument:
        """Its content."""
        return decode(self.raw or b"", RecordDocument, f"record {self.number}")

    @property
    def id(self) -> str:
        """Name of the record. It is the same in every store."""
        return self.document.id

    @property
    def measured(self) -> datetime:
        """Time of the test. If it was not given or is not a date: the time at which the record was made or added.

        Imports of piga 0.1 could contain times that are not dates.
        """
        for text in (self.document.measured, self.document.created):
            with suppress(ValueError, OverflowError):
                if text is not None:
                    return moment(text)
        return moment(self.link.added)

    def file(self, role: str) -> StoredFile | None:
        """The first file with this role."""
        return next((stored for stored in self.document.files if stored.role == role), None)


def open_store(where: str | Path, *, create: bool = False) -> Store:
    """Open the store in a SQLite file, or in a PostgreSQL database by URL.

    Parameters
    ----------
    where:
        ``lab.sqlite`` or ``postgresql://user@server/database``.
    create:
        Create a new store if there is none.

    Raises
    ------
    StoreError
        If there is no store, it is damaged, not a piga store or made by a newer piga.
    MissingPackageError
        If the extra ``records`` is not installed.
    """
    needed("sqlalchemy")
    from piga.ledger.store.store import Store

    return Store(where, create=create)
