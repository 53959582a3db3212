"""The database of a store: its tables, and a SQLite file or PostgreSQL by URL that holds them.

SQLite: one file, rollback journal, ``synchronous=EXTRA`` (FULL, and the directory too). ``BEGIN IMMEDIATE`` lets one
writer work at a time. PostgreSQL: an advisory lock lets one writer work at a time; readers see one snapshot.
Each file is stored once, under its SHA-256, in parts of a megabyte.
"""

from __future__ import annotations

import hashlib
import sqlite3
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import sqlalchemy as sa
from sqlalchemy import BigInteger, CheckConstraint, Column, ForeignKey, Integer, LargeBinary, Table, Text
from sqlalchemy.exc import ArgumentError, DBAPIError, MultipleResultsFound, NoResultFound
from sqlalchemy.pool import NullPool

from piga.errors import StoreError, needed
from piga.ledger.store.documents import PART, Entry, Head, RecordDocument, new_identity, sha256

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
_DAMAGED = "run piga records verify, then restore a backup"
_NO_SPACE = "no space is left", "free some space"
_WORDS = {
    "disk is full": _NO_SPACE,
    "no space left": _NO_SPACE,
    "readonly": ("it cannot be written to", "check the rights of the file and its folder"),
    "unable to open": ("it cannot be opened", "check its folder, and the rights of both"),
    "locked": ("another program holds it", "try again when that has ended"),
    "malformed": ("the file is damaged", _DAMAGED),
    "decode": ("the file is damaged", _DAMAGED),
    "not a database": ("is not a store of records, or is damaged", "check --store, or restore a backup"),
}
"""What a message of a database means, and its remedy."""


class Database:
    """One SQLite file, or a PostgreSQL database by URL, with the transactions :meth:`reading` and :meth:`writing`.

    SQLite rolls back by itself what a killed writer left.
    """

    def __init__(self, where: str | Path, *, new: bool = False) -> None:
        self.path = None if is_url(where) else Path(where)
        if self.path is None:
            self.name, self.engine = _postgresql(str(where))
            return
        mode = "rwc" if new else "rw"
        self.name, uri = str(where), f"{self.path.resolve().as_uri()}?mode={mode}"
        self.engine = sa.create_engine("sqlite://", creator=lambda: _connect(uri), poolclass=NullPool)
        sa.event.listen(self.engine, "begin", _begin)

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

    def check_version(self) -> None:
        """Read whether there is a store, and the version of its tables, before anything is written."""
        with self.reading() as rows:
            version = rows.version()
        if version == 0:
            raise StoreError(
                f"{self.name}: holds no store yet", remedy="check --store; piga records add makes a new store"
            )
        if version != SCHEMA:
            raise StoreError(
                f"{self.name}: made by a newer piga (schema {version}, this piga knows up to {SCHEMA})",
                remedy="update piga; the store was not touched",
            )


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
    except (ArgumentError, ValueError):
        raise StoreError(
            "the URL of the store is not valid", remedy="e.g. postgresql://user@server/database"
        ) from None
    return url.render_as_string(hide_password=True), sa.create_engine(url, poolclass=NullPool)


@contextmanager
def explained(name: str) -> Iterator[None]:
    """Turn a database error into one clear message."""
    try:
        yield
    except (
        DBAPIError,
        NoResultFound,
        MultipleResultsFound,
        OverflowError,
        UnicodeDecodeError,
        sqlite3.Error,
    ) as error:
        text = " ".join(str(getattr(error, "orig", None) or error).split())
        what, remedy = next(
            (words for part, words in _WORDS.items() if part in text.lower()),
            ("the database refused", "check the name, the server and the rights"),
        )
        raise StoreError(f"{name}: {what} ({text})", remedy=remedy) from None


# -- rows ----------------------------------------------------------------------------------------------

_ROWS, _PARTS = 500, 16
"""Entries, and parts of a file, fetched at a time."""


class Rows:
    """What a store holds, read and written within one transaction."""

    def __init__(self, connection: sa.Connection) -> None:
        self.connection = connection

    def create(self, identity: bytes | None = None) -> None:
        """Create the tables of a new store, with its identity, its head and the version of the tables."""
        if self.connection.dialect.name == "sqlite":
            self.connection.exec_driver_sql(f"PRAGMA application_id={APPLICATION_ID}")
            self.connection.exec_driver_sql(f"PRAGMA user_version={SCHEMA}")
        metadata.create_all(self.connection)
        document = identity or new_identity()
        self.connection.execute(VERSION.insert().values(version_num=f"{SCHEMA:04d}"))
        self.connection.execute(STORE.insert().values(document=document))
        self.connection.execute(HEAD.insert().values(one=1, number=0, head=sha256(document)))

    def version(self) -> int:
        """Version of the tables; 0 if there are none yet."""
        if self.connection.dialect.name == "sqlite":
            owner, version = (
                int(self.connection.exec_driver_sql(f"PRAGMA {mark}").scalar_one())
                for mark in ("application_id", "user_version")
            )
            if owner != APPLICATION_ID and sa.inspect(self.connection).get_table_names():
                raise StoreError("it is a SQLite database of another program", remedy="check --store")
            return version if owner == APPLICATION_ID else 0
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
        wanted = sa.select(BLOB.c.size, CHUNK).select_from(BLOB.outerjoin(CHUNK)).where(BLOB.c.sha256 == name)
        size, digest, length = None, hashlib.sha256(), 0
        ordered = wanted.order_by(CHUNK.c.part)
        with self.connection.execute(ordered, execution_options={"yield_per": _PARTS}) as stored:
            for number, row in enumerate(stored):
                size = row.size
                if row.part is None:  # a file without content
                    break
                part = _as_bytes(row.data, f"file {name[:12]}")
                if (row.part, row.digest) != (number, sha256(part)) or row.codec not in ("plain", "zlib"):
                    raise _damaged(name)
                if row.codec == "zlib":
                    with suppress(zlib.error):  # then the digest of the whole is another
                        part = zlib.decompressobj().decompress(part, PART)
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
        for number, part in enumerate(parts):
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
    link, document = _as_bytes(row.link, what), _as_bytes(row.document, what)
    return Entry(row.number, link, document, (row.head, row.id, row.serial))


def _as_bytes(value: object, what: str) -> bytes:
    """The value of a column that must hold bytes."""
    if not isinstance(value, bytes | memoryview):
        raise StoreError(f"{what}: is damaged in the store", remedy="restore a backup")
    return bytes(value)


def _damaged(name: str) -> StoreError:
    return StoreError(f"file {name[:12]}: is damaged in the store", remedy="restore a backup")
