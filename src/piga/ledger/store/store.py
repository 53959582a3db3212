"""The store. Records are appended, listed and read. Nothing is ever changed or deleted."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import sqlalchemy as sa

from piga.errors import ArgumentError, CalibrationError, PigaWarning, StoreError
from piga.ledger.store.database import (
    ENTRY,
    HEAD,
    Database,
    as_bytes,
    insert_blob,
    read_blob,
    read_blobs,
    read_head,
    read_identity,
)
from piga.ledger.store.documents import (
    IDENTITY,
    LINK,
    RECORD,
    Draft,
    Entry,
    Head,
    Identity,
    Link,
    Position,
    Record,
    RecordDocument,
    StoredFile,
    check_record,
    decode,
    digest_of,
    encode,
    is_id,
    new_id,
    now,
    safe_name,
    sha256,
    write_new,
)
from piga.records.calibration import Calibration
from piga.records.calibration.document import MOST_BYTES, calibration_from_bytes

ROWS, _FILES = 500, 200
"""Records, and calibrations, fetched in one query."""

_INPUT_ROLES = ("run", "data", "sidecar", "stand")
"""Roles of the files that a calibration is computed from."""


class Store:
    """A store of records, opened by :func:`piga.open_store`. Use it in a ``with`` block or close it.

    ``database`` is from :func:`piga.ledger.store.database.open_database`.
    """

    def __init__(self, database: Database) -> None:
        self.database = database

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self.database.engine.dispose()

    @property
    def name(self) -> str:
        """File or URL, without a password."""
        return self.database.name

    def identity(self) -> Identity:
        """Identity document of the store."""
        with self.database.reading() as connection:
            return decode(read_identity(connection), Identity, IDENTITY, f"{self.name}: identity")

    def head(self) -> Head:
        """The current head of the chain."""
        with self.database.reading() as connection:
            return read_head(connection)

    def records(self, serial: str | None = None) -> tuple[Record, ...]:
        """All records in order, or those of one instrument."""
        return tuple(self.each(serial))

    def each(self, serial: str | None = None) -> Iterator[Record]:
        """As :meth:`records`, but one by one, for stores whose records do not fit into memory."""
        with self.database.reading() as connection:
            yield from self._each(connection, serial)

    def superseded(self, serial: str | None = None) -> set[str]:
        """Names of the records that later records amend."""
        return {r.document.supersedes for r in self.each(serial) if r.document.supersedes is not None}

    def _each(self, connection: sa.Connection, serial: str | None) -> Iterator[Record]:
        wanted = sa.select(ENTRY).order_by(ENTRY.c.number)
        if serial is not None:
            wanted = wanted.where(ENTRY.c.serial == serial)
        for row in connection.execute(wanted, execution_options={"yield_per": ROWS}):
            yield self._record(row)

    def record(self, name: str | int) -> Record:
        """One record, by its name or by its number in this store.

        Raises
        ------
        StoreError
            If there is no such record.
        """
        with self.database.reading() as connection:
            return self._find(connection, str(name))

    def read(self, name: str | int, role: str) -> bytes:
        """The first file with this role (run, data, calibration, report, ...) in a record.

        Raises
        ------
        StoreError
            If there is no such record or file, or it is damaged.
        """
        with self.database.reading() as connection:
            record = self._find(connection, str(name))
            file = record.file(role)
            if file is None:
                roles = ", ".join(sorted({stored.role for stored in record.document.files}))
                raise StoreError(f"record {record.id} has no file '{role}'", remedy=f"it has: {roles}")
            return b"".join(read_blob(connection, file.sha256))

    def calibration(self, name: str | int) -> Calibration:
        """The calibration of a record (without residuals)."""
        return calibration_from_bytes(self.read(name, "calibration"), Path(f"record {name}"))

    def history(self, serial: str) -> list[tuple[str, datetime, Calibration]]:
        """Calibrations of one instrument in the order of the tests: record, time, calibration.

        Superseded records are left out, because their successors replace them. A calibration that cannot be read is left
        out, and a :class:`piga.PigaWarning` names it.
        """
        calibrations = []
        with self.database.reading() as connection:
            old: set[str | None] = set()
            kept = []
            for record in self._each(connection, serial):
                old.add(record.document.supersedes)
                if (file := record.file("calibration")) is not None:
                    kept.append((record.measured, record.number, record.id, file.sha256))
            kept = sorted(entry for entry in kept if entry[2] not in old)
            for first in range(0, len(kept), _FILES):
                files = read_blobs(connection, {entry[3] for entry in kept[first : first + _FILES]})
                for measured, _, name, digest in kept[first : first + _FILES]:
                    try:
                        calibration = calibration_from_bytes(files[digest], Path(f"record {name}"))
                    except CalibrationError as error:
                        warnings.warn(f"{self.name}: left out: {error}", PigaWarning, stacklevel=2)
                        continue
                    calibrations.append((name, measured, calibration))
        return calibrations

    def extract(self, name: str | int, folder: Path, *, inputs_only: bool = False) -> Path:
        """Write the files of a record below ``folder`` under their own names. Returns the path of the run file.

        Raises
        ------
        StoreError
            If a name would lead out of the folder, or a file exists already.
        """
        record = self.record(name)
        kept = [file for file in record.document.files if not inputs_only or file.role in _INPUT_ROLES]
        run = folder
        with self.database.reading() as connection:
            for file in kept:
                path = folder / safe_name(file.name)
                run = path if file.role == "run" else run
                write_new(path, read_blob(connection, file.sha256))
        return run

    def append(self, make: Callable[[Position], Draft]) -> Record:
        """Append one record. When this returns, it is on disk.

        Parameters
        ----------
        make:
            Function that makes the record for its place. It is called while no one else can write.

        Raises
        ------
        StoreError, ArgumentError
            If the record is refused; the store is unchanged.
        """
        with self.database.writing() as connection:
            head = read_head(connection)
            identity = decode(read_identity(connection), Identity, IDENTITY, f"{self.name}: identity")
            place = Position(new_id(), head.number + 1, identity.store, head.sha256)
            draft = make(place)
            document = self._document(connection, place, draft)
            entry = self.insert(connection, encode(document), None)
            return Record(entry.number, sha256(entry.link), decode(entry.link, Link, LINK, "link"), document)

    def insert(
        self, connection: sa.Connection, document: bytes, link: bytes | None, **taken_over: Any
    ) -> Entry:
        """Append a record document whose files are stored: with a new link, or with the given link unchanged."""
        head = read_head(connection)
        if link is None:
            self._check_clock(connection, head)
            made = Link(LINK, head.number + 1, head.sha256, sha256(document), now(), **taken_over)
            link = encode(made)
        record = decode(document, RecordDocument, RECORD, "record")
        entry = Entry(head.number + 1, link, document)
        connection.execute(
            ENTRY.insert().values(
                number=entry.number,
                head=sha256(link),
                id=record.id,
                serial=record.serial,
                link=link,
                document=document,
            )
        )
        connection.execute(HEAD.update().values(number=entry.number, head=sha256(link)))
        return entry

    def _document(self, connection: sa.Connection, place: Position, draft: Draft) -> RecordDocument:
        files = []
        for file in draft.files:
            safe_name(file.name)
            digest, size = digest_of(file.parts())
            if file.sha256 not in (None, digest):
                raise StoreError(
                    f"{file.name}: changed after it was read (its SHA-256 differs)",
                    remedy="calibrate again, with the files as they are now",
                )
            insert_blob(connection, digest, size, file.parts())
            files.append(StoredFile(file.role, file.name, digest, size))
        document = RecordDocument(
            schema=RECORD,
            id=place.id,
            store=place.store,
            number=place.number,
            after=place.after,
            created=now(),
            operator=draft.operator.strip(),
            reason=draft.reason.strip(),
            serial=draft.serial,
            files=tuple(files),
            request=draft.request,
            software=draft.software,
            measured=draft.measured,
            supersedes=None if draft.supersedes is None else self._find(connection, draft.supersedes).id,
        )
        self.check(connection, document)
        return document

    def check(self, connection: sa.Connection, document: RecordDocument) -> None:
        """Refuse a record that must not be added or imported. Its files are stored already."""
        check_record(document)
        self._check_calibration(connection, document)
        if document.supersedes is not None:
            self._check_superseded(connection, document, document.supersedes)

    def _check_calibration(self, connection: sa.Connection, document: RecordDocument) -> None:
        for file in document.files:
            if file.role != "calibration":
                continue
            if file.size > MOST_BYTES:
                raise StoreError(
                    f"{file.name}: larger than {MOST_BYTES} bytes",
                    remedy="a calibration is never so large; check the file",
                )
            raw = b"".join(read_blob(connection, file.sha256))
            serial = calibration_from_bytes(raw, Path(file.name)).serial
            if serial != document.serial:
                raise StoreError(
                    f"{file.name}: is of instrument '{serial[:60]}', the record of '{document.serial}'",
                    remedy="keep each calibration under its own instrument",
                )

    def amendable(self, name: str, serial: str) -> str:
        """Name of a record that a new record of this instrument may supersede; ``name`` may be its number."""
        with self.database.reading() as connection:
            old = self._find(connection, name)
            self._check_amended(connection, old.id, serial, old)
            return old.id

    def _check_superseded(self, connection: sa.Connection, document: RecordDocument, name: str) -> None:
        row = connection.execute(sa.select(ENTRY).where(ENTRY.c.id == name)).one_or_none()
        old = None if row is None else self._record(row)  # an export may leave out a record that another amends
        self._check_amended(connection, name, document.serial, old)
        if old and old.document.store != document.store and not self._is_own(connection, document):
            raise ArgumentError(
                f"supersedes: record {old.id} is not of the store that the record comes from",
                remedy="a record is amended where it was written, or by this store",
            )

    def _check_amended(self, connection: sa.Connection, name: str, serial: str, old: Record | None) -> None:
        if old is not None and old.document.serial != serial:
            raise ArgumentError(
                f"supersedes: record {name} is of instrument '{old.document.serial}', not '{serial}'",
                remedy="name a record of the same instrument: piga records list",
            )
        for other in self._each(connection, serial):
            if other.document.supersedes == name:
                raise ArgumentError(
                    f"supersedes: record {name} is superseded already, by {other.id}",
                    remedy=f"supersede {other.id}",
                )

    def _is_own(self, connection: sa.Connection, document: RecordDocument) -> bool:
        """True if this store itself wrote the record, not an import."""
        identity = decode(read_identity(connection), Identity, IDENTITY, f"{self.name}: identity")
        return document.store == identity.store

    def _check_clock(self, connection: sa.Connection, head: Head) -> None:
        if head.number == 0:
            return
        last = connection.execute(sa.select(ENTRY.c.link).where(ENTRY.c.number == head.number)).scalar_one()
        added = decode(as_bytes(last, "the last link"), Link, LINK, "link").added
        if now() < added:
            warnings.warn(
                f"{self.name}: the clock is behind the last record ({added}); the order of the chain holds",
                PigaWarning,
                stacklevel=4,
            )

    def _find(self, connection: sa.Connection, name: str) -> Record:
        text = name.strip().upper()
        if is_id(text):
            condition = ENTRY.c.id == text
        elif text.isascii() and text.isdigit() and len(text) < 10:
            condition = ENTRY.c.number == int(text)
        else:
            raise StoreError(f"'{name}' is not a record", remedy="give a number, or a name like 7K3QP-9XW2M")
        row = connection.execute(sa.select(ENTRY).where(condition)).one_or_none()
        if row is None:
            raise StoreError(f"{self.name}: no record {name}", remedy="piga records list shows them")
        return self._record(row)

    def _record(self, row: sa.Row) -> Record:
        what = f"{self.name}: record {row.number}"
        link = decode(as_bytes(row.link, what), Link, LINK, what)
        document = decode(as_bytes(row.document, what), RecordDocument, RECORD, what)
        return Record(row.number, row.head, link, document)
