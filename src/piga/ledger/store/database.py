"""The database of a store: its tables, and a SQLite file or PostgreSQL by URL that holds them.

SQLite: one file, rollback journal, ``synchronous=EXTRA`` (FULL, and the directory too). ``BEGIN IMMEDIATE`` lets one
writer work at a time. PostgreSQL: an advisory lock lets one writer work at a time; readers see one snapshot.
Each file is stored once, under its SHA-256, in parts of a megabyte.
"""

from __future__ import annotations

import hashlib
import os
import sqlite3
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy import BigInteger, CheckConstraint, Column, ForeignKey, Integer, LargeBinary, Table, Text
from sqlalchemy.exc import ArgumentError, DBAPIError, MultipleResultsFound, NoResultFound
from sqlalchemy.pool import NullPool, StaticPool

from piga.errors import StoreError, install_command
from piga.ledger.store.documents import PART, Entry, Head, RecordDocument, new_identity, sha256
from piga.output import write_whole
from piga.records.limits import open_regular

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
_MAGIC = b"SQLite format 3\x00"
_DAMAGED = "run piga records verify, then restore a backup"
_WORDS = (
    ("disk is full", "no space is left", "free some space"),
    ("no space left", "no space is left", "free some space"),
    ("index row size", "a serial is too long for PostgreSQL", "restore into a SQLite file"),
    ("readonly", "it cannot be written to", "check the rights of the file and its folder"),
    ("locked", "another program holds it", "try again when that has ended"),
    ("disk i/o", "the disk reported an error", "check the disk; piga records verify shows what is stored"),
    ("malformed", "the file is damaged", _DAMAGED),
    ("not a database", "the file is damaged", _DAMAGED),
    ("could not decode", "the file is damaged", _DAMAGED),
)


class Database:
    """Connections to one store, with the transactions :meth:`reading` and :meth:`writing`."""

    def __init__(self, name: str, engine: sa.Engine, path: Path | None) -> None:
        self.name, self.engine, self.path = name, engine, path

    @contextmanager
    def reading(self) -> Iterator[Rows]:
        """A read-only transaction on one snapshot."""
        with explained(self.name), self.engine.connect() as connection:
            if self.path is None:
                connection.execution_options(isolation_level="REPEATABLE READ", postgresql_readonly=True)
            with connection.begin():
                if self.path is not None:
                    connection.exec_driver_sql("PRAGMA query_only=ON")
                yield Rows(connection)

    @contextmanager
    def writing(self) -> Iterator[Rows]:
        """The transaction of the only writer. At its end it is committed and on disk; on any error it is rolled back."""
        with explained(self.name), self.engine.connect() as connection:
            connection.execution_options(piga_writing=True)
            with connection.begin():
                if self.path is None:
                    connection.exec_driver_sql("SET LOCAL synchronous_commit = on")
                    connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_ADVISORY_LOCK)))
                yield Rows(connection)


@contextmanager
def explained(name: str) -> Iterator[None]:
    """Turn a database error into one clear message."""
    try:
        yield
    except UnicodeDecodeError as error:
        raise StoreError(f"{name}: the file is damaged ({error})", remedy=_DAMAGED) from None
    except (
        DBAPIError,
        ArgumentError,
        NoResultFound,
        MultipleResultsFound,
        OverflowError,
        sqlite3.Error,
    ) as error:
        cause = getattr(error, "orig", None) or error
        text = " ".join(str(cause).split())
        for word, what, remedy in _WORDS:
            if word in text.lower():
                raise StoreError(f"{name}: {what} ({text})", remedy=remedy) from None
        raise StoreError(
            f"{name}: the database refused ({text})", remedy="check the name, the server and the rights"
        ) from None


def is_url(where: str | Path) -> bool:
    """True for the URL of a PostgreSQL database."""
    return str(where).startswith(("postgresql://", "postgres://", "postgresql+psycopg://"))


def open_database(where: str | Path, *, create: bool = False, identity: bytes | None = None) -> Database:
    """Open the database of a store: a SQLite file, or PostgreSQL by URL. A hot journal is rolled back.

    ``create``: make the store if there is none, with this ``identity`` (for restore) or a random one.
    """
    if is_url(where):
        return _open_postgresql(str(where), create, identity)
    return _open_sqlite(Path(where), create, identity)


def _open_sqlite(path: Path, create: bool, identity: bytes | None) -> Database:
    writable = _writable(path)
    if not _exists(path) and create:
        try:
            write_whole(
                path, lambda part: part.write_bytes(new_sqlite(identity)), replace=False, kind=StoreError
            )
        except StoreError:
            if not _exists(path):
                raise
        writable = True
    _check_file(path)
    mode = "rw" if writable else "ro"
    uri = f"{path.resolve().as_uri()}?mode={mode}"
    database = Database(str(path), _sqlite_engine(lambda: connect_sqlite(uri), NullPool), path)
    if writable and path.with_name(f"{path.name}-journal").exists():
        _roll_back(uri)
    _check_version(database)
    return database


def _writable(path: Path) -> bool:
    return os.access(path if _exists(path) else path.parent, os.W_OK) and os.access(path.parent, os.W_OK)


def _exists(path: Path) -> bool:
    """True if the file exists; False also for an impossible file name."""
    try:
        return path.exists()
    except OSError:
        return False


def _check_file(path: Path) -> None:
    """Check that the file is a SQLite database with piga's application id."""
    try:
        if not path.is_file():
            raise StoreError(
                f"{path}: there is no such store", remedy="check --store; piga records add makes a new store"
            )
        with open_regular(path, error=StoreError) as stream:
            header = stream.read(100)
    except OSError as error:
        raise StoreError(f"{path}: cannot be read ({error.strerror})", remedy="check its rights") from None
    if header[:16] != _MAGIC or len(header) < 100:
        raise StoreError(
            f"{path}: is not a store of records (not an SQLite database)",
            remedy="check --store, or restore a backup",
        )
    if int.from_bytes(header[68:72], "big") != APPLICATION_ID:
        raise StoreError(f"{path}: a SQLite database of another program", remedy="check --store")


def connect_sqlite(uri: str) -> sqlite3.Connection:
    """A SQLite connection with the settings of a store."""
    connection = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=_BUSY, check_same_thread=False)
    for setting in ("foreign_keys=ON", "synchronous=EXTRA", "trusted_schema=OFF", "cell_size_check=ON"):
        connection.execute(f"PRAGMA {setting}")
    return connection


def _sqlite_engine(connect: Callable[[], sqlite3.Connection], pool: Any) -> sa.Engine:
    engine = sa.create_engine("sqlite://", creator=connect, poolclass=pool)

    @sa.event.listens_for(engine, "begin")
    def _begin(connection: sa.Connection) -> None:
        writing = connection.get_execution_options().get("piga_writing", False)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writing else "BEGIN")

    return engine


def new_sqlite(identity: bytes | None) -> bytes:
    """The bytes of an empty store, created in memory."""
    with closing(sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)) as memory:
        database = Database("new store", _sqlite_engine(lambda: memory, StaticPool), Path(":memory:"))
        with database.writing() as rows:
            rows.connection.exec_driver_sql(f"PRAGMA application_id={APPLICATION_ID}")
            rows.connection.exec_driver_sql(f"PRAGMA user_version={SCHEMA}")
            rows.create(identity)
        return memory.serialize()


def _roll_back(uri: str) -> None:
    """Let SQLite roll back the transaction of a killed writer, and remove an empty journal.

    The journal of a running writer is locked. It is not touched.
    """
    with closing(connect_sqlite(uri)) as connection, suppress(sqlite3.Error):
        connection.execute("PRAGMA busy_timeout=0")
        connection.execute("BEGIN IMMEDIATE")
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        connection.execute(f"PRAGMA user_version={int(version)}")
        connection.execute("COMMIT")


def _check_version(database: Database) -> None:
    """Read the version of the tables before anything is written."""
    with database.reading() as rows:
        version = rows.version()
    if version > SCHEMA:
        raise StoreError(
            f"{database.name}: made by a newer piga (schema {version}, this piga knows up to {SCHEMA})",
            remedy="update piga; the store was not touched",
        )
    if version != SCHEMA:
        raise StoreError(f"{database.name}: the version of its tables is missing", remedy=_DAMAGED)


def postgresql_database(where: str) -> Database:
    """Connections to a PostgreSQL database. Its content is not checked."""
    try:
        import psycopg  # noqa: F401 - only whether it is there
    except ImportError:
        raise StoreError(
            "a PostgreSQL store needs the extra 'postgres', which is not installed",
            remedy=f"install it with: {install_command('postgres')}",
        ) from None
    try:
        url = sa.make_url(where).set(drivername="postgresql+psycopg")
    except (ArgumentError, ValueError):
        raise StoreError(
            "the URL of the store is not valid", remedy="e.g. postgresql://user@server/database"
        ) from None
    engine = sa.create_engine(url, poolclass=NullPool)
    return Database(url.render_as_string(hide_password=True), engine, None)


def _open_postgresql(where: str, create: bool, identity: bytes | None) -> Database:
    database = postgresql_database(where)
    with database.reading() as rows:
        version = rows.version()
    if version == 0 and not create:
        raise StoreError(
            f"{database.name}: holds no store yet", remedy="piga records add makes a store in an empty database"
        )
    if version == 0:
        with database.writing() as rows:
            if rows.version() == 0:
                rows.create(identity)
    _check_version(database)
    return database


# -- rows ----------------------------------------------------------------------------------------------

_ROWS, _PARTS = 500, 16
"""Entries, and parts of a file, fetched at a time."""


class Rows:
    """What a store holds, read and written within one transaction."""

    def __init__(self, connection: sa.Connection) -> None:
        self.connection = connection

    def create(self, identity: bytes | None) -> None:
        """Create the tables of a new store, with its identity, its head and the version of the tables."""
        metadata.create_all(self.connection)
        document = identity or new_identity()
        self.connection.execute(VERSION.insert().values(version_num=f"{SCHEMA:04d}"))
        self.connection.execute(STORE.insert().values(document=document))
        self.connection.execute(HEAD.insert().values(one=1, number=0, head=sha256(document)))

    def version(self) -> int:
        """Version of the tables; 0 if there are none yet."""
        if self.connection.dialect.name == "sqlite":
            return int(self.connection.exec_driver_sql("PRAGMA user_version").scalar_one())
        if not sa.inspect(self.connection).has_table(VERSION.name):
            return 0
        return int(self.connection.execute(sa.select(VERSION.c.version_num)).scalar_one_or_none() or 0)

    def identity(self) -> bytes:
        """The identity document."""
        return _as_bytes(self.connection.execute(sa.select(STORE.c.document)).scalar_one(), "the identity")

    def head(self) -> Head:
        """Number and hash of the last entry."""
        row = self.connection.execute(sa.select(HEAD)).one()
        if not isinstance(row.number, int) or not isinstance(row.head, str):
            raise StoreError("the head is damaged in the store", remedy="restore a backup")
        return Head(row.number, row.head)

    def chain(self, *conditions: sa.ColumnElement[bool]) -> Iterator[sa.Row]:
        """The rows of the chain in order. Only a few are in memory at a time."""
        wanted = sa.select(ENTRY).where(sa.true(), *conditions).order_by(ENTRY.c.number)
        with self.connection.execute(wanted, execution_options={"yield_per": _ROWS}) as rows:
            yield from rows

    def find(self, condition: sa.ColumnElement[bool]) -> sa.Row | None:
        """The row of the chain for which the condition holds; None if there is none."""
        return self.connection.execute(sa.select(ENTRY).where(condition)).first()

    def entries(self) -> Iterator[Entry]:
        """The chain in order."""
        return map(entry_of, self.chain())

    def add(self, entry: Entry, record: RecordDocument) -> None:
        """Append an entry, and make it the head."""
        place = {"number": entry.number, "head": sha256(entry.link)}
        texts = {"id": record.id, "serial": record.serial, "link": entry.link, "document": entry.document}
        self.connection.execute(ENTRY.insert().values(place | texts))
        self.connection.execute(HEAD.update().values(place))

    def file_names(self) -> set[str]:
        """SHA-256 of every stored file."""
        return set(self.connection.execute(sa.select(BLOB.c.sha256)).scalars())

    def file(self, name: str) -> Iterator[bytes]:
        """The bytes of a stored file. Each part is checked, and the whole file at the end."""
        wanted = sa.select(BLOB.c.size, CHUNK.c.part, CHUNK.c.codec, CHUNK.c.digest, CHUNK.c.data)
        wanted = wanted.outerjoin(CHUNK).where(BLOB.c.sha256 == name).order_by(CHUNK.c.part)
        digest, length, size = hashlib.sha256(), 0, None
        with self.connection.execute(wanted, execution_options={"yield_per": _PARTS}) as stored:
            for number, row in enumerate(stored):
                size = row.size
                if row.part is None:  # a file without content
                    break
                part = _unpacked(name, row)
                if row.part != number:
                    raise _damaged(name)
                digest.update(part)
                length += len(part)
                yield part
        if size is None:
            raise StoreError(f"file {name[:12]}: is not in the store", remedy="run piga records verify")
        if (digest.hexdigest(), length) != (name, size):
            raise _damaged(name)

    def add_file(self, name: str, size: int, parts: Iterable[bytes]) -> None:
        """Store a file under its announced digest and size. A file that the store already has is not stored again."""
        if self.connection.execute(sa.select(BLOB.c.size).where(BLOB.c.sha256 == name)).first() is not None:
            return
        self.connection.execute(BLOB.insert().values(sha256=name, size=size))
        digest, length = hashlib.sha256(), 0
        for number, part in enumerate(_evenly(parts)):
            digest.update(part)
            length += len(part)
            codec, data = ("zlib", zlib.compress(part, 6)) if size > COMPRESS_ABOVE else ("plain", part)
            self.connection.execute(
                CHUNK.insert().values(sha256=name, part=number, codec=codec, digest=sha256(data), data=data)
            )
        if (digest.hexdigest(), length) != (name, size):
            raise StoreError(
                f"file {name[:12]}: changed while it was stored",
                remedy="stop the program that writes it, try again",
            )


def entry_of(row: sa.Row) -> Entry:
    """A row of the chain as the bytes that are hashed."""
    what = f"record {row.number}"
    return Entry(row.number, _as_bytes(row.link, what), _as_bytes(row.document, what))


def _as_bytes(value: object, what: str) -> bytes:
    """The value of a column that must hold bytes."""
    if not isinstance(value, bytes | memoryview):
        raise StoreError(f"{what}: is damaged in the store", remedy="restore a backup")
    return bytes(value)


def _evenly(parts: Iterable[bytes]) -> Iterator[bytes]:
    """The same bytes in parts of exactly :data:`PART`."""
    rest = b""
    for part in parts:
        rest += part
        while len(rest) >= PART:
            yield rest[:PART]
            rest = rest[PART:]
    if rest:
        yield rest


def _unpacked(name: str, row: sa.Row) -> bytes:
    data = _as_bytes(row.data, f"file {name[:12]}")
    if sha256(data) != row.digest or row.codec not in ("plain", "zlib"):
        raise _damaged(name)
    if row.codec == "plain":
        return data
    unpacker = zlib.decompressobj()
    try:
        part = unpacker.decompress(data, PART)
    except zlib.error:
        raise _damaged(name) from None
    if not unpacker.eof or unpacker.unused_data:
        raise _damaged(name)
    return part


def _damaged(name: str) -> StoreError:
    return StoreError(f"file {name[:12]}: is damaged in the store", remedy="restore a backup")
