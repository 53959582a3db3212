"""Verification: check every byte that a record is read from, and name every fault."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import sqlalchemy as sa

from piga.errors import CancelledError, PigaError, StoreError
from piga.ledger.store.database import APPLICATION_ID, SCHEMA, is_url, open_database, schema_version
from piga.ledger.store.documents import (
    IDENTITY,
    LINK,
    RECORD,
    Entry,
    Head,
    Identity,
    Link,
    RecordDocument,
    TakenOver,
    decode,
    is_digest,
    sha256,
)
from piga.ledger.store.export import Export, is_export
from piga.ledger.store.rows import (
    BLOB,
    CHUNK,
    ENTRY,
    HEAD,
    ROWS,
    STORE,
    VERSION,
    check_blobs,
    read_blob,
    read_entries,
    read_head,
    read_identity,
)
from piga.ledger.store.store import Store
from piga.progress import Progress, report

_MAX_PROBLEMS = 100


class VerifiedSource(Protocol):
    """The source of a chain: a store or an export."""

    def identity(self) -> bytes:
        """The identity document."""

    def entries(self) -> Iterator[Entry]:
        """The chain in order."""

    def file_names(self) -> set[str]:
        """SHA-256 of every file there is."""

    def file(self, name: str) -> Iterator[bytes]:
        """The parts of a file."""

    def check_files(self, wanted: Iterable[tuple[str, int]]) -> Iterator[tuple[str, StoreError | None]]:
        """What is wrong with each file (name, size), None where it is what it was."""


@dataclass(eq=False)
class Verification:
    """Result of a verification: numbers of records and files checked, the head, the known heads, and problems in words."""

    name: str
    records: int = 0
    files: int = 0
    head: str = ""
    known: dict[str, int | None] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    @property
    def sound(self) -> bool:
        """True if there is no problem."""
        return not self.problems

    def problem(self, text: str) -> None:
        """Add a problem. Only the first hundred are kept."""
        if len(self.problems) < _MAX_PROBLEMS:
            self.problems.append(text)


class StoreSource:
    """The rows of a store, on one snapshot."""

    def __init__(self, connection: sa.Connection) -> None:
        self.connection = connection

    def identity(self) -> bytes:
        """The identity document."""
        return read_identity(self.connection)

    def entries(self) -> Iterator[Entry]:
        """The chain in order."""
        return read_entries(self.connection)

    def file_names(self) -> set[str]:
        """SHA-256 of every stored file."""
        return set(self.connection.execute(sa.select(BLOB.c.sha256)).scalars())

    def file(self, name: str) -> Iterator[bytes]:
        """The parts of a stored file."""
        return read_blob(self.connection, name)

    def check_files(self, wanted: Iterable[tuple[str, int]]) -> Iterator[tuple[str, StoreError | None]]:
        """The fault of each stored file."""
        return check_blobs(self.connection, wanted)


def verify(where: str | Path, heads: Iterable[str] = (), progress: Progress | None = None) -> Verification:
    """Check a store or an export from end to end.

    Parameters
    ----------
    where:
        Store (file or URL) or export.
    heads:
        Heads noted earlier, for example on reports. Each must be a head of the chain.
    progress:
        Called with the number of files checked, and the number of all files (:mod:`piga.progress`).

    Raises
    ------
    CancelledError
        If ``progress`` stops it.
    """
    result = Verification(str(where))
    try:
        if not is_url(where) and is_export(Path(where)):
            with Export(Path(where)) as export:
                check_chain(result, export, heads, progress)
        else:
            _verify_store(result, where, heads, progress)
    except CancelledError:
        raise
    except PigaError as error:
        result.problem(error.message)
    except (TypeError, ValueError, OverflowError) as error:
        result.problem(f"something in it cannot be read at all ({error})")
    return result


def _verify_store(
    result: Verification, where: str | Path, heads: Iterable[str], progress: Progress | None
) -> None:
    with Store(open_database(where)) as store:
        result.name = store.name
        with store.database.reading() as connection:
            if connection.dialect.name == "sqlite":
                _check_sqlite(result, connection)
            check_chain(result, StoreSource(connection), heads, progress)
            _check_columns(result, connection)


def check_chain(
    result: Verification, source: VerifiedSource, heads: Iterable[str] = (), progress: Progress | None = None
) -> None:
    """Check links, records and files of a chain. Problems are added to ``result``."""
    identity = source.identity()
    store = decode(identity, Identity, IDENTITY, "identity", strict=True).store
    head, expected = sha256(identity), 1
    seen: dict[str, int] = {head: 0}
    names: set[str] = set()
    wanted: dict[str, int] = {}
    for entry in source.entries():
        try:
            link = decode(entry.link, Link, LINK, f"link {entry.number}", strict=True)
            if entry.number != expected or link.number != expected:
                result.problem(f"record {expected} is missing: {entry.number} follows")
            if link.previous != head:
                result.problem(f"record {entry.number}: its link does not follow the one before it")
            if entry.document is not None:
                _check_document(result, entry, link, store, names, wanted)
        except StoreError as error:
            result.problem(error.message)
        head, expected = sha256(entry.link), entry.number + 1
        seen[head] = entry.number
        result.records += entry.document is not None
    _check_files(result, source, wanted, progress)
    result.head = head
    for known in heads:
        result.known[known] = seen.get(known.lower())
        if result.known[known] is None:
            result.problem(
                f"head {known}: is not in this chain: it was altered, cut short, or is another store's"
            )


def _check_document(
    result: Verification, entry: Entry, link: Link, store: str, names: set[str], wanted: dict[str, int]
) -> None:
    raw = entry.document or b""
    if sha256(raw) != link.record:
        result.problem(f"record {entry.number}: was altered (its SHA-256 is not the one in its link)")
    document = decode(raw, RecordDocument, RECORD, f"record {entry.number}", strict=True)
    place = (store, link.number, link.previous)
    if link.taken_over is not None:
        place = _place_of_origin(link.taken_over, link.record)
    if (document.store, document.number, document.after) != place:
        result.problem(f"record {entry.number}: was not written for this place")
    if document.id in names:
        result.problem(f"record {entry.number}: has the name of another ({document.id})")
    names.add(document.id)
    for file in document.files:
        if not is_digest(file.sha256) or wanted.setdefault(file.sha256, file.size) != file.size:
            result.problem(f"record {entry.number}: file '{file.name}' has no valid digest or size")


def _place_of_origin(taken_over: TakenOver, record: str) -> tuple[str, int, str]:
    """For an imported record: its original store, its number there and the head before it."""
    identity = decode(taken_over.identity.encode(), Identity, IDENTITY, "identity of the origin", strict=True)
    link = decode(taken_over.link.encode(), Link, LINK, "link of the origin", strict=True)
    return (identity.store, link.number, link.previous) if link.record == record else ("", 0, "")


def _check_files(
    result: Verification, source: VerifiedSource, wanted: dict[str, int], progress: Progress | None
) -> None:
    there = source.file_names()
    for name in sorted(wanted.keys() - there):
        result.problem(f"file {name[:12]}: is missing")
    for name in sorted(there - wanted.keys()):
        result.problem(f"file {str(name)[:12]}: belongs to no record")
    both = sorted(wanted.keys() & there)
    for _, error in source.check_files((name, wanted[name]) for name in both):
        if error is not None:
            result.problem(error.message)
        result.files += 1
        report(progress, result.files, len(both), "checking")


def _check_columns(result: Verification, connection: sa.Connection) -> None:
    """Check that the look-up columns agree with the documents and that there are no surplus rows."""
    last = Head(0, sha256(read_identity(connection)))
    entries = connection.execute(
        sa.select(ENTRY).order_by(ENTRY.c.number), execution_options={"yield_per": ROWS}
    )
    for row in entries:
        document = decode(row.document, RecordDocument, RECORD, f"record {row.number}")
        if (row.head, row.id, row.serial) != (sha256(row.link), document.id, document.serial):
            result.problem(f"record {row.number}: the table's columns do not fit the record")
        last = Head(row.number, sha256(row.link))
    if read_head(connection) != last:
        result.problem(f"the chain was cut short, or its end altered: {last.number} records are there")
    for table in (STORE, HEAD, VERSION):
        if connection.execute(sa.select(sa.func.count()).select_from(table)).scalar_one() != 1:
            result.problem(f"table {table.name}: one row is needed")
    if (
        schema_version(connection) != SCHEMA
        or connection.execute(sa.select(VERSION.c.version_num)).scalar() != f"{SCHEMA:04d}"
    ):
        result.problem("the version of the tables was altered")
    _check_parts(result, connection)


def _check_parts(result: Verification, connection: sa.Connection) -> None:
    """Check that the parts are numbered from 0 without gaps and that each belongs to a file."""
    grouped = sa.select(
        CHUNK.c.sha256, sa.func.count().label("rows"), sa.func.min(CHUNK.c.part), sa.func.max(CHUNK.c.part)
    ).group_by(CHUNK.c.sha256)
    names = set(connection.execute(sa.select(BLOB.c.sha256)).scalars())
    for name, rows, first, last in connection.execute(grouped):
        if name not in names or first != 0 or last != rows - 1:
            result.problem(f"file {str(name)[:12]}: its parts are not complete, or too many")


def _check_sqlite(result: Verification, connection: sa.Connection) -> None:
    for pragma, sound in (
        ("integrity_check", "ok"),
        ("application_id", APPLICATION_ID),
        ("user_version", SCHEMA),
        ("journal_mode", "delete"),
        ("encoding", "UTF-8"),
    ):
        rows = connection.exec_driver_sql(f"PRAGMA {pragma}").scalars().all()
        if rows != [sound]:
            result.problem(f"SQLite {pragma}: {'; '.join(str(row) for row in rows[:3])}")
    if connection.exec_driver_sql("PRAGMA foreign_key_check").first() is not None:
        result.problem("a part of a file belongs to no file")
