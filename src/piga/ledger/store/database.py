"""Open, create and recover the database of a store: a SQLite file, or PostgreSQL by URL.

SQLite: one file, rollback journal, ``synchronous=EXTRA`` (FULL, and the directory too). ``BEGIN IMMEDIATE`` lets one
writer work at a time. PostgreSQL: an advisory lock lets one writer work at a time; readers see one snapshot.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import ArgumentError, DBAPIError, MultipleResultsFound, NoResultFound
from sqlalchemy.pool import NullPool, StaticPool

from piga.errors import StoreError, install_command
from piga.ledger.store.documents import new_identity, sha256
from piga.ledger.store.rows import HEAD, STORE, VERSION, metadata
from piga.output import write_whole
from piga.records.limits import open_regular

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
    def reading(self) -> Iterator[sa.Connection]:
        """A read-only transaction on one snapshot."""
        with explained(self.name), self.engine.connect() as connection:
            if self.path is None:
                connection.execution_options(isolation_level="REPEATABLE READ", postgresql_readonly=True)
            with connection.begin():
                if self.path is not None:
                    connection.exec_driver_sql("PRAGMA query_only=ON")
                yield connection

    @contextmanager
    def writing(self) -> Iterator[sa.Connection]:
        """The transaction of the only writer. At its end it is committed and on disk; on any error it is rolled back."""
        with explained(self.name), self.engine.connect() as connection:
            connection.execution_options(piga_writing=True)
            with connection.begin():
                if self.path is None:
                    connection.exec_driver_sql("SET LOCAL synchronous_commit = on")
                    connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_ADVISORY_LOCK)))
                yield connection


@contextmanager
def explained(name: str) -> Iterator[None]:
    """Turn a database error into one clear message."""
    try:
        yield
    except UnicodeDecodeError as error:
        raise StoreError(f"{name}: the file is damaged ({error})", remedy=_DAMAGED) from None
    except (DBAPIError, ArgumentError, NoResultFound, MultipleResultsFound, sqlite3.Error) as error:
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
    """Open the database of a store. A hot journal is rolled back.

    Parameters
    ----------
    where:
        SQLite file, or URL of a PostgreSQL database.
    create:
        Create the store if there is none.
    identity:
        Identity of a new store (for restore); None: a random one.

    Raises
    ------
    StoreError
        If there is no store, it is not a piga store, it is damaged, or a newer piga made it.
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
    database = Database(
        str(path), _sqlite_engine(lambda: _of_a_store(path, connect_sqlite(uri)), NullPool), path
    )
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
        raise _foreign(path)


def connect_sqlite(uri: str) -> sqlite3.Connection:
    """A SQLite connection with the settings of a store."""
    connection = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=_BUSY, check_same_thread=False)
    for setting in ("foreign_keys=ON", "synchronous=EXTRA", "trusted_schema=OFF", "cell_size_check=ON"):
        connection.execute(f"PRAGMA {setting}")
    return connection


def _of_a_store(path: Path, connection: sqlite3.Connection) -> sqlite3.Connection:
    """The connection, after a second check of the application id: the file may have been replaced since the first."""
    if connection.execute("PRAGMA application_id").fetchone() != (APPLICATION_ID,):
        connection.close()
        raise _foreign(path)
    return connection


def _foreign(path: Path) -> StoreError:
    return StoreError(f"{path}: a SQLite database of another program", remedy="check --store")


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
        with database.writing() as connection:
            connection.exec_driver_sql(f"PRAGMA application_id={APPLICATION_ID}")
            connection.exec_driver_sql(f"PRAGMA user_version={SCHEMA}")
            create_tables(connection, identity)
        return memory.serialize()


def create_tables(connection: sa.Connection, identity: bytes | None) -> None:
    """Create the tables of a new store, with its identity, its head and the version of the tables."""
    metadata.create_all(connection)
    document = identity or new_identity()
    connection.execute(VERSION.insert().values(version_num=f"{SCHEMA:04d}"))
    connection.execute(STORE.insert().values(document=document))
    connection.execute(HEAD.insert().values(one=1, number=0, head=sha256(document)))


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
    with database.reading() as connection:
        version = schema_version(connection)
    if version != SCHEMA:
        raise StoreError(
            f"{database.name}: made by a newer piga (schema {version}, this piga knows up to {SCHEMA})"
            if version > SCHEMA
            else f"{database.name}: the version of its tables is missing",
            remedy="update piga; the store was not touched" if version > SCHEMA else _DAMAGED,
        )


def schema_version(connection: sa.Connection) -> int:
    """Schema version of the store; 0 if it has none yet."""
    if connection.dialect.name == "sqlite":
        return int(connection.exec_driver_sql("PRAGMA user_version").scalar_one())
    if not sa.inspect(connection).has_table(VERSION.name):
        return 0
    version = connection.execute(sa.select(VERSION.c.version_num)).scalar_one_or_none()
    return 0 if version is None else int(version)


def postgresql_database(where: str) -> Database:
    """Connections to a PostgreSQL database. Its content is not checked.

    Raises
    ------
    StoreError
        If the URL is not valid or the extra is not installed.
    """
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
    with database.reading() as connection:
        version = schema_version(connection)
    if version == 0 and not create:
        raise StoreError(
            f"{database.name}: holds no store yet", remedy="piga records add makes a store in an empty database"
        )
    if version == 0:
        with database.writing() as connection:
            if schema_version(connection) == 0:
                create_tables(connection, identity)
    _check_version(database)
    return database
