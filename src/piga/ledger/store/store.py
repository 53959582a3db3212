"""The store: its tables in a SQLite file or in PostgreSQL, and what is appended and read. Nothing is changed or deleted.

SQLite: one file, rollback journal, ``synchronous=EXTRA`` (FULL, and the directory too). ``BEGIN IMMEDIATE`` lets one
writer work at a time. PostgreSQL: an advisory lock lets one writer work at a time; readers see one snapshot.
Each file is stored once, under its SHA-256, in parts of a megabyte.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import sqlite3
import warnings
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Self

import msgspec
import sqlalchemy as sa
from sqlalchemy import BigInteger, CheckConstraint, Column, ForeignKey, Integer, LargeBinary, Table, Text, exc
from sqlalchemy.pool import NullPool

from piga.errors import ArgumentError, CalibrationError, PigaWarning, StoreError, needed
from piga.ledger.store import (
    PART,
    Draft,
    DraftFile,
    Head,
    Identity,
    Link,
    Record,
    RecordDocument,
    StoredFile,
    TakenOver,
    check_record,
    decode,
    digest_of,
    encode,
    is_id,
    new_id,
    now,
    safe_name,
    sha256,
)
from piga.output import write_whole
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.document import MOST_BYTES, calibration_from_bytes
from piga.text_files import open_regular

metadata = sa.MetaData()

STORE = Table("piga_store", metadata, Column("document", LargeBinary, primary_key=True))
"""Table with one row: the identity."""

ENTRY = Table(
    "piga_entry",
    metadata,
    Column("number", Integer, CheckConstraint("number > 0"), primary_key=True, autoincrement=False),
    Column("head", Text, nullable=False, unique=True),
    Column("id", Text, nullable=False, unique=True),
    Column("serial", Text, nullable=False, index=True),
    Column("link", LargeBinary, nullable=False),
    Column("document", LargeBinary, nullable=False),
)
"""The chain: link and record document. Head, id and serial are copied from them for look-ups."""

BLOB = Table(
    "piga_blob",
    metadata,
    Column("sha256", Text, primary_key=True),
    Column("size", BigInteger, CheckConstraint("size >= 0"), nullable=False),
)
"""Files, named by their SHA-256."""

CHUNK = Table(
    "piga_chunk",
    metadata,
    Column("sha256", Text, ForeignKey("piga_blob.sha256"), primary_key=True),
    Column("part", Integer, primary_key=True),
    Column("codec", Text, nullable=False),
    Column("digest", Text, nullable=False),
    Column("data", LargeBinary, nullable=False),
)
"""Parts of files in order: ``plain`` or ``zlib``, with the SHA-256 of the stored bytes."""

HEAD = Table(
    "piga_head",
    metadata,
    Column("one", Integer, CheckConstraint("one = 1"), primary_key=True, autoincrement=False),
    Column("number", Integer, nullable=False),
    Column("head", Text, nullable=False),
)
"""Table with one row: number and head of the last entry. It shows whether the chain was cut short."""

VERSION = Table("piga_schema_version", metadata, Column("version_num", Text, primary_key=True))
"""Table with one row: the version of the tables."""

COMPRESS_ABOVE = 1 << 16
"""Files larger than this are stored compressed [bytes]."""

APPLICATION_ID = 0x70696761
"""The letters ``piga`` in the header of the SQLite file."""
SCHEMA = 1
"""Version of the tables that this piga reads and writes."""
_BUSY = 60.0
"""Longest time that a writer waits for another writer [s]."""
_ADVISORY_LOCK = 0x7069676172656300


def is_url(where: str | Path) -> bool:
    """True for the URL of a PostgreSQL database."""
    return str(where).startswith(("postgresql://", "postgres://", "postgresql+psycopg://"))


def _connect(uri: str) -> sqlite3.Connection:
    """A SQLite connection with the settings of a store."""
    connection = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=_BUSY, check_same_thread=False)
    for setting in ("foreign_keys=ON", "synchronous=EXTRA", "trusted_schema=OFF", "cell_size_check=ON"):
        connection.execute(f"PRAGMA {setting}")
    return connection


def _begin(connection: sa.Connection) -> None:
    writing = connection.get_execution_options().get("piga_writing", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writing else "BEGIN")


def _postgresql(where: str) -> tuple[str, sa.Engine]:
    """Name of a database without its password, and its engine."""
    needed("psycopg")
    try:
        url = sa.make_url(where).set(drivername="postgresql+psycopg")
    except (exc.ArgumentError, ValueError):
        raise StoreError(
            "the URL of the store is not valid", remedy="e.g. postgresql://user@server/database"
        ) from None
    return url.render_as_string(hide_password=True), sa.create_engine(url, poolclass=NullPool)


@contextmanager
def explained(name: str) -> Iterator[None]:
    """Turn a database error into one clear message."""
    try:
        yield
    except (exc.DBAPIError, exc.InvalidRequestError, OverflowError, UnicodeDecodeError, sqlite3.Error) as error:
        text = " ".join(str(getattr(error, "orig", None) or error).split())
        raise StoreError(
            f"{name}: the database refused: {text}",
            remedy="check --store, the rights, and the space on the disk; for a damaged file: piga records verify, or a backup",
        ) from None


# -- rows ----------------------------------------------------------------------------------------------

_ROWS, _PARTS = 500, 16
"""Entries, and parts of a file, fetched at a time."""


class Rows:
    """What a store holds, read and written within one transaction."""

    def __init__(self, connection: sa.Connection) -> None:
        self.connection = connection

    def create(self, identity: bytes) -> None:
        """Create the tables of a new store, with its identity, its head and the version of the tables."""
        if self.connection.dialect.name == "sqlite":
            self.connection.exec_driver_sql(f"PRAGMA application_id={APPLICATION_ID}")
            self.connection.exec_driver_sql(f"PRAGMA user_version={SCHEMA}")
        metadata.create_all(self.connection)
        self.connection.execute(VERSION.insert().values(version_num=f"{SCHEMA:04d}"))
        self.connection.execute(STORE.insert().values(document=identity))
        self.connection.execute(HEAD.insert().values(one=1, number=0, head=sha256(identity)))

    def exists(self) -> bool:
        """True if there are the tables of a store."""
        tables = sa.inspect(self.connection).get_table_names()
        if tables and VERSION.name not in tables and self.connection.dialect.name == "sqlite":
            raise StoreError("it is a SQLite database of another program", remedy="check --store")
        return VERSION.name in tables

    def versions(self) -> list[str]:
        """Versions of the tables: one, if nothing was changed."""
        return list(self.connection.execute(sa.select(VERSION.c.version_num)).scalars())

    def damage(self) -> list[str]:
        """What SQLite itself finds damaged."""
        if self.connection.dialect.name != "sqlite":
            return []
        rows = self.connection.exec_driver_sql("PRAGMA integrity_check").scalars().all()
        stray = self.connection.exec_driver_sql("PRAGMA foreign_key_check").first()
        problems = [f"SQLite integrity_check: {row}" for row in rows[:3] if row != "ok"]
        return problems + ([] if stray is None else ["a part of a file belongs to no file"])

    def identity(self) -> bytes:
        """The identity document."""
        return _as_bytes(self.connection.execute(sa.select(STORE.c.document)).scalar_one(), "the identity")

    def head(self) -> Head:
        """Number and hash of the last entry."""
        row = self.connection.execute(sa.select(HEAD)).one()
        if not isinstance(row.number, int) or not isinstance(row.head, str):
            raise StoreError("the head is damaged in the store", remedy="restore a backup")
        return Head(row.number, row.head)

    def records(self, *conditions: sa.ColumnElement[bool]) -> Iterator[Record]:
        """The chain in order, or its records for which the conditions hold. Only a few are in memory at a time."""
        wanted = sa.select(ENTRY).where(sa.true(), *conditions).order_by(ENTRY.c.number)
        with self.connection.execute(wanted, execution_options={"yield_per": _ROWS}) as rows:
            for row in rows:
                what = f"record {row.number}"
                link, document = _as_bytes(row.link, what), _as_bytes(row.document, what)
                yield Record(row.number, link, document, (row.head, row.id, row.serial))

    def find(self, name: str) -> Record | None:
        """The record with this name; None if there is none."""
        return next(self.records(ENTRY.c.id == name), None)

    def add(self, record: Record) -> None:
        """Append a record, and make it the head."""
        place = {"number": record.number, "head": record.head}
        names = {"id": record.document.id, "serial": record.document.serial}
        self.connection.execute(
            ENTRY.insert().values(place | names | {"link": record.raw_link, "document": record.raw})
        )
        self.connection.execute(HEAD.update().values(place))

    def sizes(self) -> dict[str, int]:
        """Size of every stored file [bytes] by its SHA-256."""
        return {row.sha256: row.size for row in self.connection.execute(sa.select(BLOB))}

    def file(self, name: str) -> Iterator[bytes]:
        """The bytes of a stored file. Each part is checked, and the whole file at the end."""
        return whole_file(self._parts(name), name, "is damaged in the store", "restore a backup")

    def _parts(self, name: str) -> Iterator[bytes]:
        wanted = sa.select(CHUNK).where(CHUNK.c.sha256 == name).order_by(CHUNK.c.part)
        with self.connection.execute(wanted, execution_options={"yield_per": _PARTS}) as stored:
            for number, row in enumerate(stored):
                part = _as_bytes(row.data, f"file {name[:12]}")
                if (row.part, row.digest) != (number, sha256(part)) or row.codec not in ("plain", "zlib"):
                    return  # then the digest of the whole is another
                if row.codec == "zlib":
                    with suppress(zlib.error):
                        part = zlib.decompressobj().decompress(part, PART)
                yield part

    def add_file(self, name: str, size: int, parts: Iterable[bytes]) -> None:
        """Store a file under its announced digest and size. A file that the store already has is not stored again."""
        if self.connection.execute(sa.select(BLOB.c.size).where(BLOB.c.sha256 == name)).first() is not None:
            return
        self.connection.execute(BLOB.insert().values(sha256=name, size=size))
        fault = "changed while it was stored", "stop the program that writes it, try again"
        for number, part in enumerate(whole_file(parts, name, *fault)):
            codec, data = ("zlib", zlib.compress(part, 6)) if size > COMPRESS_ABOVE else ("plain", part)
            self.connection.execute(
                CHUNK.insert().values(sha256=name, part=number, codec=codec, digest=sha256(data), data=data)
            )


def whole_file(parts: Iterable[bytes], name: str, fault: str, remedy: str) -> Iterator[bytes]:
    """The parts of a file. At their end it is refused if its digest is not its name."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
        yield part
    if digest.hexdigest() != name:
        raise StoreError(f"file {name[:12]}: {fault}", remedy=remedy)


def _as_bytes(value: object, what: str) -> bytes:
    """The value of a column that must hold bytes."""
    if not isinstance(value, bytes | memoryview):
        raise StoreError(f"{what}: is damaged in the store", remedy="restore a backup")
    return bytes(value)


# -- store ---------------------------------------------------------------------------------------------

_INPUT_ROLES = ("run", "data", "sidecar", "stand")
"""Roles of the files that a calibration is computed from."""


class Store:
    """A store of records, opened by :func:`piga.open_store`. Use it in a ``with`` block or close it.

    ``where`` is a SQLite file, or the URL of a PostgreSQL database. ``create`` makes the store if there is none, with a new
    ``identity`` unless that of a backup is given. What a killed writer left is rolled back by the database itself.
    """

    def __init__(self, where: str | Path, *, create: bool = False, identity: bytes | None = None) -> None:
        self.path = None if is_url(where) else Path(where)
        if self.path is None:
            self.name, self.engine = _postgresql(str(where))
        else:
            if os.path.exists(where) or not create:  # noqa: PTH110 - Path.exists refuses long names
                open_regular(self.path, "a store; piga records add makes a new one", StoreError).close()
            self.name, uri = str(where), f"{self.path.resolve().as_uri()}?mode={'rwc' if create else 'rw'}"
            self.engine = sa.create_engine("sqlite://", creator=lambda: _connect(uri), poolclass=NullPool)
            sa.event.listen(self.engine, "begin", _begin)
        with self.rows(writing=create) as rows:
            if create and not rows.exists():
                rows.create(identity or encode(Identity(secrets.token_hex(16), now())))
            if not rows.exists():
                raise StoreError(
                    f"{self.name}: holds no store yet",
                    remedy="check --store; piga records add makes a new store",
                )
            versions = rows.versions()
        if versions != [f"{SCHEMA:04d}"]:
            raise StoreError(
                f"{self.name}: made by a newer piga (schema {', '.join(map(str, versions))}; this piga knows {SCHEMA:04d})",
                remedy="update piga; the store was not touched",
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self.engine.dispose()

    @contextmanager
    def rows(self, *, writing: bool = False) -> Iterator[Rows]:
        """A transaction: read-only on one snapshot, or that of the only writer.

        At the end of a writer's it is committed and on disk; on any error it is rolled back.
        """
        with explained(self.name), self.engine.connect() as connection:
            connection.execution_options(piga_writing=writing)
            if self.path is None and not writing:
                connection.execution_options(isolation_level="REPEATABLE READ", postgresql_readonly=True)
            with connection.begin():
                if self.path is not None:
                    connection.exec_driver_sql(f"PRAGMA query_only={'OFF' if writing else 'ON'}")
                elif writing:
                    connection.exec_driver_sql("SET LOCAL synchronous_commit = on")
                    connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_ADVISORY_LOCK)))
                yield Rows(connection)

    def head(self) -> Head:
        """The current head of the chain."""
        with self.rows() as rows:
            return rows.head()

    def records(self, serial: str | None = None) -> tuple[Record, ...]:
        """All records in order, or those of one instrument."""
        with self.rows() as rows:
            return tuple(rows.records(*_of_instrument(serial)))

    def record(self, name: str | int) -> Record:
        """One record, by its name or by its number in this store.

        Raises
        ------
        StoreError
            If there is no such record.
        """
        with self.rows() as rows:
            return self._find(rows, str(name))

    def read(self, name: str | int, role: str) -> bytes:
        """The first file with this role (run, data, calibration, report, ...) in a record.

        Raises
        ------
        StoreError
            If there is no such record or file, or it is damaged.
        """
        with self.rows() as rows:
            record = self._find(rows, str(name))
            file = record.file(role)
            if file is None:
                roles = ", ".join(sorted({stored.role for stored in record.document.files}))
                raise StoreError(f"record {record.id} has no file '{role}'", remedy=f"it has: {roles}")
            return b"".join(rows.file(file.sha256))

    def calibration(self, name: str | int) -> Calibration:
        """The calibration of a record (without residuals)."""
        return calibration_from_bytes(self.read(name, "calibration"), Path(f"record {name}"))

    def history(self, serial: str) -> list[tuple[str, datetime, Calibration]]:
        """Calibrations of one instrument in the order of the tests: record, time, calibration.

        Superseded records are left out, because their successors replace them. A calibration that cannot be read is left
        out, and a :class:`piga.PigaWarning` names it.
        """
        calibrations = []
        with self.rows() as rows:
            kept = sorted(
                rows.records(*_of_instrument(serial)), key=lambda record: (record.measured, record.number)
            )
            old = {record.document.supersedes for record in kept}
            for record in kept:
                file = record.file("calibration")
                if file is None or record.id in old:
                    continue
                raw = b"".join(rows.file(file.sha256))
                try:
                    calibration = calibration_from_bytes(raw, Path(f"record {record.id}"))
                except CalibrationError as error:
                    warnings.warn(f"{self.name}: left out: {error}", PigaWarning, stacklevel=2)
                    continue
                calibrations.append((record.id, record.measured, calibration))
        return calibrations

    def extract(self, name: str | int, folder: Path, *, inputs_only: bool = False) -> Path:
        """Write the files of a record below ``folder`` under their own names. Returns the path of the run file.

        Raises
        ------
        StoreError
            If a name would lead out of the folder, or a file exists already.
        """
        run = folder
        with self.rows() as rows:
            for file in self._find(rows, str(name)).document.files:
                if inputs_only and file.role not in _INPUT_ROLES:
                    continue
                path = folder / safe_name(file.name)
                run = path if file.role == "run" else run
                _write_new(path, rows.file(file.sha256))
        return run

    def append(self, draft: Draft) -> Record:
        """Append one record. When this returns, it is on disk.

        Raises
        ------
        StoreError, ArgumentError
            If the record is refused; the store is unchanged.
        """
        with self.rows(writing=True) as rows:
            head = rows.head()
            document = RecordDocument(
                id=new_id(),
                store=_identity(rows).store,
                number=head.number + 1,
                after=head.sha256,
                created=now(),
                operator=draft.operator.strip(),
                reason=draft.reason.strip(),
                serial=draft.serial,
                files=tuple(_keep(rows, file) for file in draft.files),
                request=draft.request,
                software=draft.software,
                measured=draft.measured,
                supersedes=None if draft.supersedes is None else self._find(rows, draft.supersedes).id,
            )
            if draft.report is not None:
                report = _keep(rows, draft.report(document))
                document = msgspec.structs.replace(document, files=(*document.files, report))
            self.check(rows, document)
            return self.insert(rows, encode(document))

    def insert(self, rows: Rows, raw: bytes, taken_over: TakenOver | None = None) -> Record:
        """Append a record whose files are stored, with a new link. ``raw``: the bytes of the document."""
        head = rows.head()
        link = Link(head.number + 1, head.sha256, sha256(raw), now(), taken_over)
        record = Record(link.number, encode(link), raw)
        rows.add(record)
        return record

    def check(self, rows: Rows, document: RecordDocument) -> None:
        """Refuse a record that must not be added or imported. Its files are stored already."""
        check_record(document)
        for file in document.files:
            if file.role == "calibration":
                _check_calibration(rows, file, document.serial)
        if document.supersedes is None:
            return
        # an export may leave out a record that another amends
        old = self._amended(rows, document.supersedes, document.serial)
        if old and old.document.store != document.store and document.store != _identity(rows).store:
            raise ArgumentError(
                f"supersedes: record {old.id} is not of the store that the record comes from",
                remedy="a record is amended where it was written, or by this store",
            )

    def amendable(self, name: str, serial: str) -> str:
        """Name of a record that a new record of this instrument may supersede; ``name`` may be its number."""
        with self.rows() as rows:
            old = self._find(rows, name).id
            self._amended(rows, old, serial)
            return old

    def _amended(self, rows: Rows, name: str, serial: str) -> Record | None:
        """The record of this name, which a record of this instrument may supersede; None if there is none."""
        old = rows.find(name)
        if old is not None and old.document.serial != serial:
            raise ArgumentError(
                f"supersedes: record {name} is of instrument '{old.document.serial}', not '{serial}'",
                remedy="name a record of the same instrument: piga records list",
            )
        for other in rows.records(*_of_instrument(serial)):
            if other.document.supersedes == name:
                raise ArgumentError(
                    f"supersedes: record {name} is superseded already, by {other.id}",
                    remedy=f"supersede {other.id}",
                )
        return old

    def _find(self, rows: Rows, name: str) -> Record:
        text = name.strip().upper()
        number = int(text) if text.isascii() and text.isdigit() and len(text) < 10 else None
        if number is None and not is_id(text):
            raise StoreError(f"'{name}' is not a record", remedy="give a number, or a name like 7K3QP-9XW2M")
        record = next(rows.records(ENTRY.c.id == text if number is None else ENTRY.c.number == number), None)
        if record is None:
            raise StoreError(f"{self.name}: no record {name}", remedy="piga records list shows them")
        return record


def _of_instrument(serial: str | None) -> tuple[sa.ColumnElement[bool], ...]:
    return () if serial is None else (ENTRY.c.serial == serial,)


def _keep(rows: Rows, file: DraftFile) -> StoredFile:
    """Store a file of a draft."""
    digest, size = digest_of(file.parts())
    if file.sha256 not in (None, digest):
        raise StoreError(
            f"{file.name}: is not the file that the calibration was computed from (its SHA-256 differs)",
            remedy="calibrate again, with the files as they are now",
        )
    rows.add_file(digest, size, file.parts())
    return StoredFile(file.role, file.name, digest, size)


def _write_new(path: Path, parts: Iterator[bytes]) -> None:
    """Write a new file. It appears under its name when it is complete, or not at all."""

    def write(part: Path) -> None:
        with part.open("wb") as stream:
            stream.writelines(parts)

    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, write, replace=False, remedy="choose another folder", kind=StoreError)


def _identity(rows: Rows) -> Identity:
    return decode(rows.identity(), Identity, "identity")


def _check_calibration(rows: Rows, file: StoredFile, serial: str) -> None:
    """Refuse a file that is no calibration, or one of another instrument."""
    if file.size > MOST_BYTES:
        raise StoreError(f"{file.name}: larger than {MOST_BYTES} bytes", remedy="check the file")
    stated = calibration_from_bytes(b"".join(rows.file(file.sha256)), Path(file.name)).serial
    if stated != serial:
        what = f"{file.name}: is of instrument '{stated[:60]}', the record of '{serial}'"
        raise StoreError(what, remedy="keep each calibration under its own instrument")
