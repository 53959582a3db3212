"""Transfer between stores: import (onto another chain), backup and restore (the same chain)."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import sqlalchemy as sa

from piga.errors import PigaError, StoreError
from piga.ledger.store.database import (
    connect_sqlite,
    create_tables,
    explained,
    is_url,
    new_sqlite,
    open_database,
    postgresql_database,
    schema_version,
)
from piga.ledger.store.documents import (
    LINK,
    RECORD,
    Entry,
    Link,
    RecordDocument,
    TakenOver,
    checked_text,
    decode,
    encode,
    sha256,
)
from piga.ledger.store.export import Export, is_export, write_members
from piga.ledger.store.rows import ENTRY, insert_blob
from piga.ledger.store.store import Store
from piga.ledger.store.verify import (
    StoreSource,
    Verification,
    VerifiedSource,
    check_chain,
    verify,
)
from piga.output import write_whole
from piga.progress import Progress, report


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
        _refuse_unsound(_checked(export), export.name)
        identity = export.identity().decode()
        added = []
        with store.database.writing() as connection:
            for entry in export.entries():
                if entry.document is None or _has(connection, entry.document):
                    continue
                link = decode(entry.link, Link, LINK, f"link {entry.number}")
                origin = link.taken_over or TakenOver(identity, entry.link.decode(), "", "")
                taken_over = TakenOver(origin.identity, origin.link, operator, reason)
                document = _copy_files(store, connection, export, entry.document)
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
    with ExitStack() as stack:
        if is_export(source):
            origin: VerifiedSource = stack.enter_context(Export(source))
        else:
            old = stack.enter_context(Store(open_database(source)))
            origin = StoreSource(stack.enter_context(old.database.reading()))
        result = _checked(origin)
        _refuse_unsound(result, str(source))
        if is_url(target):
            _restore_postgresql(origin, str(target))
        else:
            write_whole(
                Path(target), lambda part: _restore_sqlite(origin, part), replace=False, kind=StoreError
            )
    restored = verify(target)
    _refuse_unsound(restored, restored.name)
    if restored.head != result.head:
        raise StoreError(f"{target}: it ended with another head than {source}", remedy="restore again")
    return restored


def _restore_sqlite(origin: VerifiedSource, part: Path) -> None:
    part.write_bytes(new_sqlite(origin.identity()))
    with Store(open_database(part)) as store, store.database.writing() as connection:
        _copy_chain(store, connection, origin)


def _restore_postgresql(origin: VerifiedSource, url: str) -> None:
    with Store(postgresql_database(url)) as store, store.database.writing() as connection:
        if schema_version(connection) != 0:
            raise StoreError(f"{store.name}: there is a store already", remedy="restore into an empty database")
        create_tables(connection, origin.identity())
        _copy_chain(store, connection, origin)


def _copy_chain(store: Store, connection: sa.Connection, origin: VerifiedSource) -> None:
    for entry in origin.entries():
        document = _whole(entry)
        _copy_files(store, connection, origin, document)
        store.insert(connection, document, entry.link)


def _whole(entry: Entry) -> bytes:
    if entry.document is None:
        raise StoreError(
            f"the export lacks record {entry.number}",
            remedy="restore from a backup, or import what is there",
        )
    return entry.document


def _copy_files(store: Store, connection: sa.Connection, origin: VerifiedSource, raw: bytes) -> RecordDocument:
    document = decode(raw, RecordDocument, RECORD, "record")
    for file in document.files:
        parts: Iterator[bytes] = origin.file(file.sha256)
        insert_blob(connection, file.sha256, file.size, parts, store.compress_above)
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


def _checked(source: VerifiedSource) -> Verification:
    result = Verification("the source")
    check_chain(result, source)
    return result


def _refuse_unsound(result: Verification, name: str) -> None:
    if not result.sound:
        raise StoreError(
            f"{name}: {result.problems[0]} ({len(result.problems)} problems in all)",
            remedy="piga records verify lists them; use another copy",
        )
