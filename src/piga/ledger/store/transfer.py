"""Verify a store or an export, and transfer records: export, import (onto another chain), backup and restore (the same chain).

Verification checks every byte that a record is read from, and names every fault.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path

import sqlalchemy as sa

from piga.errors import CancelledError, PigaError, StoreError
from piga.ledger.store.database import (
    BLOB,
    ENTRY,
    HEAD,
    ROWS,
    SCHEMA,
    STORE,
    VERSION,
    check_blobs,
    connect_sqlite,
    create_tables,
    explained,
    insert_blob,
    is_url,
    new_sqlite,
    open_database,
    postgresql_database,
    read_blob,
    read_entries,
    read_head,
    read_identity,
    schema_version,
)
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
    checked_text,
    decode,
    encode,
    is_digest,
    sha256,
)
from piga.ledger.store.export import Export, is_export, write_members
from piga.ledger.store.store import Store
from piga.output import write_whole
from piga.progress import Progress, report

_MAX_PROBLEMS = 100


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

    def check_files(self, wanted: dict[str, int]) -> Iterator[tuple[str, StoreError | None]]:
        """The fault of each stored file, whose size is given by name."""
        return check_blobs(self.connection, wanted)


_Source = StoreSource | Export
"""The source of a chain."""


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
    result: Verification, source: _Source, heads: Iterable[str] = (), progress: Progress | None = None
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
    result: Verification, source: _Source, wanted: dict[str, int], progress: Progress | None
) -> None:
    there = source.file_names()
    for name in sorted(wanted.keys() - there):
        result.problem(f"file {name[:12]}: is missing")
    for name in sorted(there - wanted.keys()):
        result.problem(f"file {str(name)[:12]}: belongs to no record")
    both = sorted(wanted.keys() & there)
    for _, error in source.check_files({name: wanted[name] for name in both}):
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


def _check_sqlite(result: Verification, connection: sa.Connection) -> None:
    rows = connection.exec_driver_sql("PRAGMA integrity_check").scalars().all()
    if rows != ["ok"]:
        result.problem(f"SQLite integrity_check: {'; '.join(str(row) for row in rows[:3])}")
    if connection.exec_driver_sql("PRAGMA foreign_key_check").first() is not None:
        result.problem("a part of a file belongs to no file")


# -- transfer ------------------------------------------------------------------------------------------


def export_records(
    store: Store,
    target: Path,
    chosen: Iterable[str] | None = None,
    *,
    replace: bool = False,
    progress: Progress | None = None,
) -> Verification:
    """Write all records of a store, or the chosen ones, with all links of its chain.

    The file is read back before it gets its name. ``progress`` gets the number of files written or read back, and the
    number of all files.

    Raises
    ------
    StoreError
        If the store is damaged or the file cannot be written. No file is left then.
    """
    numbers = None if chosen is None else {store.record(name).number for name in chosen}

    result = Verification("")

    def write(part: Path) -> None:
        nonlocal result
        write_members(store, part, numbers, lambda done, of, what: report(progress, done, 2 * of, what))
        result = verify(part, progress=lambda done, of, what: report(progress, of + done, 2 * of, what))
        _refuse_unsound(result, store.name)

    write_whole(target, write, replace=replace, kind=StoreError)
    result.name = str(target)
    return result


def import_records(store: Store, path: Path, operator: str, reason: str) -> list[str]:
    """Append the records of an export that the store does not have yet: all of them or none.

    Each keeps its document unchanged. Its new link holds its old link, and who imported it and why.

    Returns
    -------
    list of str
        Names of the records that were added.

    Raises
    ------
    StoreError
        If the export is damaged, holds another record with a name that the store has, or a record that ``add`` would
        refuse (:meth:`Store.check`).
    """
    operator, reason = checked_text("operator", operator), checked_text("reason", reason)
    with Export(path) as export:
        checked = Verification(export.name)
        check_chain(checked, export)
        _refuse_unsound(checked, export.name)
        identity = export.identity().decode()
        added = []
        with store.database.writing() as connection:
            for entry in export.entries():
                if entry.document is None or _has(connection, entry.document):
                    continue
                link = decode(entry.link, Link, LINK, f"link {entry.number}")
                origin = link.taken_over or TakenOver(identity, entry.link.decode(), "", "")
                taken_over = TakenOver(origin.identity, origin.link, operator, reason)
                document = _copy_files(connection, export, entry.document)
                _refuse_unfit(store, connection, entry.document, document, export.name)
                store.insert(connection, entry.document, None, taken_over=taken_over)
                added.append(document.id)
        return added


def _refuse_unfit(
    store: Store, connection: sa.Connection, raw: bytes, document: RecordDocument, name: str
) -> None:
    """Refuse records that ``add`` would not have written."""
    try:
        if encode(document) != raw:
            raise StoreError(
                "it is not written as piga writes records", remedy="ask its laboratory for a new export"
            )
        store.check(connection, document)
    except PigaError as error:
        raise StoreError(
            f"{name}: record {document.id[:20]!r} (number {document.number} there) cannot be taken over: {error.message}",
            remedy="nothing was imported: ask its laboratory for an export without it (--record)",
        ) from None


def backup(
    store: Store, target: Path, *, replace: bool = False, progress: Progress | None = None
) -> Verification:
    """Write a verified copy: a database for a SQLite store, an export for a PostgreSQL store.

    Raises
    ------
    StoreError
        If the store is damaged or the copy cannot be written. No file is left then.
    """
    result = Verification("")

    def copy(part: Path) -> None:
        nonlocal result
        assert store.database.path is not None  # noqa: S101 - a PostgreSQL store is exported
        with explained(str(target)):
            source = connect_sqlite(f"{store.database.path.resolve().as_uri()}?mode=ro")
            with closing(source), closing(sqlite3.connect(part)) as copied:
                copied.execute("PRAGMA journal_mode=OFF")
                source.backup(copied)
        result = verify(part, progress=progress)
        _refuse_unsound(result, store.name)

    if store.database.path is None:
        return export_records(store, target, replace=replace, progress=progress)
    write_whole(target, copy, replace=replace, kind=StoreError)
    result.name = str(target)
    return result


def restore(source: Path, target: str | Path) -> Verification:
    """Create a store from a backup (SQLite file or complete export), with the same identity, links and head.

    Raises
    ------
    StoreError
        If the backup is damaged or not complete, or the target exists already.
    """
    result = Verification(str(source))
    with ExitStack() as stack:
        if is_export(source):
            origin: _Source = stack.enter_context(Export(source))
        else:
            old = stack.enter_context(Store(open_database(source)))
            origin = StoreSource(stack.enter_context(old.database.reading()))
        if is_url(target):
            store = stack.enter_context(Store(postgresql_database(str(target))))
            with store.database.writing() as connection:
                if schema_version(connection) != 0:
                    raise StoreError(
                        f"{store.name}: there is a store already", remedy="restore into an empty database"
                    )
                create_tables(connection, origin.identity())
                _copy_chain(store, connection, origin, result)
        else:
            write_whole(
                Path(target), lambda part: _restore_sqlite(origin, part, result), replace=False, kind=StoreError
            )
    result.name = str(target)
    return result


def _restore_sqlite(origin: _Source, part: Path, result: Verification) -> None:
    part.write_bytes(new_sqlite(origin.identity()))
    with Store(open_database(part)) as store, store.database.writing() as connection:
        _copy_chain(store, connection, origin, result)


def _copy_chain(store: Store, connection: sa.Connection, origin: _Source, result: Verification) -> None:
    """Copy a chain into an empty store, and check what was written before it is committed."""
    for entry in origin.entries():
        if entry.document is None:
            raise StoreError(
                f"the export lacks record {entry.number}",
                remedy="restore from a backup, or import what is there",
            )
        _copy_files(connection, origin, entry.document)
        store.insert(connection, entry.document, entry.link)
    check_chain(result, StoreSource(connection))
    _refuse_unsound(result, result.name)


def _copy_files(connection: sa.Connection, origin: _Source, raw: bytes) -> RecordDocument:
    document = decode(raw, RecordDocument, RECORD, "record")
    for file in document.files:
        parts: Iterator[bytes] = origin.file(file.sha256)
        insert_blob(connection, file.sha256, file.size, parts)
    return document


def _has(connection: sa.Connection, raw: bytes) -> bool:
    document = decode(raw, RecordDocument, RECORD, "record")
    there = connection.execute(
        sa.select(ENTRY.c.document).where(ENTRY.c.id == document.id)
    ).scalar_one_or_none()
    if there is not None and sha256(bytes(there)) != sha256(raw):
        raise StoreError(
            f"record {document.id} is in the store already, with other content",
            remedy="one of the two was changed: run piga records verify on both",
        )
    return there is not None


def _refuse_unsound(result: Verification, name: str) -> None:
    if not result.sound:
        raise StoreError(
            f"{name}: {result.problems[0]} ({len(result.problems)} problems in all)",
            remedy="piga records verify lists them; use another copy",
        )
