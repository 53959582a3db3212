"""Verify a store or an export, and transfer records: export, import (onto another chain), backup and restore (the same chain).

Verification checks every byte that a record is read from, and names every fault.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterable
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path

import sqlalchemy as sa

from piga.errors import CancelledError, PigaError, StoreError
from piga.ledger.store.database import (
    ENTRY,
    HEAD,
    SCHEMA,
    STORE,
    VERSION,
    Rows,
    connect_sqlite,
    entry_of,
    explained,
    is_url,
    new_sqlite,
    open_database,
    postgresql_database,
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
    digest_of,
    encode,
    is_digest,
    sha256,
)
from piga.ledger.store.export import Export, is_export, write_members
from piga.ledger.store.store import Store
from piga.output import write_whole
from piga.progress import Progress, report

_Source = Rows | Export
"""What holds a chain: a store, or an export of one."""
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
        with store.database.reading() as rows:
            if rows.connection.dialect.name == "sqlite":
                _check_sqlite(result, rows.connection)
            check_chain(result, rows, heads, progress)
            _check_columns(result, rows)


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
    for name in both:
        try:
            if digest_of(source.file(name)) != (name, wanted[name]):
                result.problem(f"file {name[:12]}: was altered")
        except StoreError as error:
            result.problem(error.message)
        result.files += 1
        report(progress, result.files, len(both), "checking")


def _check_columns(result: Verification, rows: Rows) -> None:
    """Check that the look-up columns agree with the documents and that there are no surplus rows."""
    last = Head(0, sha256(rows.identity()))
    for row in rows.chain():
        document = decode(row.document, RecordDocument, RECORD, f"record {row.number}")
        if (row.head, row.id, row.serial) != (sha256(row.link), document.id, document.serial):
            result.problem(f"record {row.number}: the table's columns do not fit the record")
        last = Head(row.number, sha256(row.link))
    if rows.head() != last:
        result.problem(f"the chain was cut short, or its end altered: {last.number} records are there")
    for table in (STORE, HEAD, VERSION):
        if rows.connection.execute(sa.select(sa.func.count()).select_from(table)).scalar_one() != 1:
            result.problem(f"table {table.name}: one row is needed")
    stated = rows.connection.execute(sa.select(VERSION.c.version_num)).scalar()
    if (rows.version(), stated) != (SCHEMA, f"{SCHEMA:04d}"):
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
    number of all files. If the store is damaged, no file is left.
    """
    numbers = None if chosen is None else {store.record(name).number for name in chosen}

    def write(part: Path) -> None:
        with store.database.reading() as rows:
            write_members(rows, part, numbers, lambda done, of, what: report(progress, done, 2 * of, what))

    return _read_back(
        store, target, write, replace, lambda done, of, what: report(progress, of + done, 2 * of, what)
    )


def backup(
    store: Store, target: Path, *, replace: bool = False, progress: Progress | None = None
) -> Verification:
    """Write a verified copy: a database for a SQLite store, an export for a PostgreSQL store.

    If the store is damaged, no file is left.
    """
    path = store.database.path
    if path is None:
        return export_records(store, target, replace=replace, progress=progress)

    def copy(part: Path) -> None:
        uri = f"{path.resolve().as_uri()}?mode=ro"
        with (
            explained(str(target)),
            closing(connect_sqlite(uri)) as source,
            closing(sqlite3.connect(part)) as copied,
        ):
            copied.execute("PRAGMA journal_mode=OFF")
            source.backup(copied)

    return _read_back(store, target, copy, replace, progress)


def _read_back(
    store: Store, target: Path, write: Callable[[Path], None], replace: bool, progress: Progress | None
) -> Verification:
    """Write a file, and verify it before it gets its name."""
    result = Verification("")

    def written(part: Path) -> None:
        nonlocal result
        write(part)
        result = verify(part, progress=progress)
        _refuse_unsound(result, store.name)

    write_whole(target, written, replace=replace, kind=StoreError)
    result.name = str(target)
    return result


def import_records(store: Store, path: Path, operator: str, reason: str) -> list[str]:
    """Append the records of an export that the store does not have yet: all of them or none.

    Each keeps its document unchanged. Its new link holds its old link, and who imported it and why.
    Returns the names of those that were added. A record that ``add`` would refuse is refused (:meth:`Store.check`).
    """
    operator, reason = checked_text("operator", operator), checked_text("reason", reason)
    with Export(path) as export:
        checked = Verification(export.name)
        check_chain(checked, export)
        _refuse_unsound(checked, export.name)
        identity = export.identity().decode()
        added = []
        with store.database.writing() as rows:
            for entry in export.entries():
                if entry.document is None or _has(rows, entry.document):
                    continue
                link = decode(entry.link, Link, LINK, f"link {entry.number}")
                origin = link.taken_over or TakenOver(identity, entry.link.decode(), "", "")
                document = _copy_files(rows, export, entry.document)
                _refuse_unfit(store, rows, entry.document, document, export.name)
                taken_over = TakenOver(origin.identity, origin.link, operator, reason)
                store.insert(rows, entry.document, taken_over=taken_over)
                added.append(document.id)
        return added


def _refuse_unfit(store: Store, rows: Rows, raw: bytes, document: RecordDocument, name: str) -> None:
    """Refuse records that ``add`` would not have written."""
    try:
        if encode(document) != raw:
            raise StoreError(
                "it is not written as piga writes records", remedy="ask its laboratory for a new export"
            )
        store.check(rows, document)
    except PigaError as error:
        raise StoreError(
            f"{name}: record {document.id[:20]!r} (number {document.number} there) cannot be taken over: {error.message}",
            remedy="nothing was imported: ask its laboratory for an export without it (--record)",
        ) from None


def restore(source: Path, target: str | Path) -> Verification:
    """Create a store from a backup (SQLite file or complete export), with the same identity, links and head."""
    result = Verification(str(source))
    with ExitStack() as stack:
        if is_export(source):
            origin: _Source = stack.enter_context(Export(source))
        else:
            old = stack.enter_context(Store(open_database(source)))
            origin = stack.enter_context(old.database.reading())

        def fill(store: Store, create: bool) -> None:
            with store, store.database.writing() as rows:
                if create and rows.version() != 0:
                    raise StoreError(
                        f"{store.name}: there is a store already", remedy="restore into an empty database"
                    )
                if create:
                    rows.create(origin.identity())
                _copy_chain(store, rows, origin, result)

        def write(part: Path) -> None:
            part.write_bytes(new_sqlite(origin.identity()))
            fill(Store(open_database(part)), create=False)

        if is_url(target):
            fill(Store(postgresql_database(str(target))), create=True)
        else:
            write_whole(Path(target), write, replace=False, kind=StoreError)
    result.name = str(target)
    return result


def _copy_chain(store: Store, rows: Rows, origin: _Source, result: Verification) -> None:
    """Copy a chain into an empty store, and check what was written before it is committed."""
    for entry in origin.entries():
        if entry.document is None:
            raise StoreError(
                f"the export lacks record {entry.number}",
                remedy="restore from a backup, or import what is there",
            )
        _copy_files(rows, origin, entry.document)
        store.insert(rows, entry.document, entry.link)
    check_chain(result, rows)
    _refuse_unsound(result, result.name)


def _copy_files(rows: Rows, origin: _Source, raw: bytes) -> RecordDocument:
    document = decode(raw, RecordDocument, RECORD, "record")
    for file in document.files:
        rows.add_file(file.sha256, file.size, origin.file(file.sha256))
    return document


def _has(rows: Rows, raw: bytes) -> bool:
    document = decode(raw, RecordDocument, RECORD, "record")
    there = rows.find(ENTRY.c.id == document.id)
    if there is not None and entry_of(there).document != raw:
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
