"""The documents of the chain: identity of a store, records and links. They are JSON; their bytes are hashed.

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
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import msgspec

from piga.errors import ArgumentError, StoreError
from piga.results import Result
from piga.text_files import JsonError, check_label, converted, json_object, open_regular

_RESERVED = {"CON", "PRN", "AUX", "NUL", *(f"{port}{n}" for port in ("COM", "LPT") for n in range(1, 10))}


def safe_name(name: str) -> PurePosixPath:
    """A file name of a record as a path below some folder."""
    parts = name.split("/")
    bad = any(
        part in ("", ".", "..")
        or part.endswith((".", " "))
        or any(c in '\\:*?"<>|' or ord(c) < 32 for c in part)
        for part in parts
    )
    if bad or len(name) > 500 or any(part.split(".")[0].upper() in _RESERVED for part in parts):
        raise StoreError(
            f"file name '{name}' cannot be stored",
            remedy="use letters, digits and plain folders, relative to the run",
        )
    return PurePosixPath(name)


_MAX_TEXT = 2000
"""Most characters of operator and reason."""
_MAX_FILES = 1000
"""Most files of a record."""
PART = 1 << 20
"""Bytes of a file in one row."""
_ALPHABET = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"
_ID = re.compile(rf"[{_ALPHABET}]{{5}}-[{_ALPHABET}]{{5}}")
DIGEST = re.compile(r"[0-9a-f]{64}")
"""A SHA-256 as text."""
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")

T = TypeVar("T", bound=msgspec.Struct)


class Identity(msgspec.Struct, frozen=True):
    """Identity of a store: a random name and the time it was made."""

    schema: str
    store: str
    created: str


class StoredFile(msgspec.Struct, frozen=True):
    """A file of a record: its role, its name relative to the other files, its digest and its size [bytes]."""

    role: str
    name: str
    sha256: str
    size: int


class RecordDocument(msgspec.Struct, frozen=True):
    """A record. It is written once and never changed.

    ``store``, ``number`` and ``after`` state where it was first written: as record ``number`` of that store, after the
    head ``after``. ``measured`` is the time of the test, if given.
    """

    schema: str
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


class Link(msgspec.Struct, frozen=True):
    """One link of the chain."""

    schema: str
    number: int
    previous: str
    record: str
    added: str
    taken_over: TakenOver | None = None


SCHEMAS: dict[type[msgspec.Struct], str] = {
    Identity: "piga.store/1", RecordDocument: "piga.record/1", Link: "piga.link/1",
}  # fmt: skip
"""Schema of each kind of document."""


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
        document = json_object(raw) if strict else msgspec.json.decode(raw, type=dict[str, Any])
        written = document.get("schema")
        if written != SCHEMAS[kind]:
            raise StoreError(
                f"{what}: schema '{written}', '{SCHEMAS[kind]}' is needed",
                remedy="a newer schema needs a newer piga; anything else is damage: run piga records verify",
            )
        return converted(document, kind)
    except (msgspec.MsgspecError, JsonError, UnicodeDecodeError, RecursionError) as error:
        raise StoreError(
            f"{what}: is damaged ({error})", remedy="run piga records verify; restore a backup"
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
    """Check a line of text about a record: not empty, not too long, no control characters."""
    _check_texts(name, text.strip())
    if not text.strip():
        raise ArgumentError(f"{name}: is empty", remedy=f"say in words: {name} = '...'")
    return text.strip()


def _check_texts(name: str, value: Any, depth: int = 8) -> None:
    """Check that each text of a nested value fits into one line of a list."""
    if isinstance(value, str) and (len(value) > _MAX_TEXT or _CONTROL.search(value)):
        raise ArgumentError(
            f"{name}: a text is longer than {_MAX_TEXT} letters or holds a control character",
            remedy="write a shorter text on one line",
        )
    parts = [*value, *value.values()] if isinstance(value, dict) else value if isinstance(value, list) else []
    if parts and not depth:
        raise ArgumentError(f"{name}: nested more than eight deep", remedy="use fewer levels")
    for part in parts:
        _check_texts(name, part, depth - 1)


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
    _check_texts("request", document.request)
    _check_texts("software", document.software)
    if len(document.files) > _MAX_FILES:
        raise ArgumentError(
            f"files: {len(document.files)}, more than {_MAX_FILES}", remedy="pack them into one archive"
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
        try:
            with open_regular(self.source, error=StoreError) as stream:
                while part := stream.read(PART):
                    yield part
        except OSError as error:
            raise StoreError(f"{self.source}: cannot be read ({error.strerror})", remedy="check it") from None


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
class Entry:
    """A link and its record, as the bytes that are hashed. ``document`` is None if an export leaves the record out.

    ``columns`` are head, id and serial, as the table of a store repeats them.
    """

    number: int
    link: bytes
    document: bytes | None
    columns: tuple[str, str, str] | None = None


@dataclass(frozen=True)
class Record:
    """A record of the store: its place in the chain and its content."""

    number: int
    head: str
    link: Link
    document: RecordDocument

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
