"""The tables of a store, row by row: identity, head and entries, and files in parts of a megabyte.

Each file is stored once, under its SHA-256.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Iterable, Iterator

import sqlalchemy as sa
from sqlalchemy import (
    BigInteger,
    CheckConstraint,
    Column,
    ForeignKey,
    Integer,
    LargeBinary,
    MetaData,
    Table,
    Text,
)

from piga.errors import StoreError
from piga.ledger.store.documents import PART, Entry, Head, digest_of, sha256

metadata = MetaData()

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
"""Files larger than this are stored compressed [bytes]; ``Store(compress_above=...)`` changes it."""


def as_bytes(value: object, what: str) -> bytes:
    """The value of a column that must hold bytes.

    Raises
    ------
    StoreError
        If it holds anything else.
    """
    if not isinstance(value, bytes | memoryview):
        raise StoreError(f"{what}: is damaged in the store", remedy="restore a backup")
    return bytes(value)


def insert_blob(
    connection: sa.Connection,
    name: str,
    size: int,
    parts: Iterable[bytes],
    compress_above: int = COMPRESS_ABOVE,
) -> None:
    """Store a file under its announced digest and size. A file that the store already has is not stored again.

    Raises
    ------
    StoreError
        If the content does not have that digest and size.
    """
    if connection.execute(sa.select(BLOB.c.size).where(BLOB.c.sha256 == name)).first() is not None:
        return
    connection.execute(BLOB.insert().values(sha256=name, size=size))
    digest, length = hashlib.sha256(), 0
    for number, part in enumerate(_evenly(parts)):
        digest.update(part)
        length += len(part)
        codec, data = ("zlib", zlib.compress(part, 6)) if size > compress_above else ("plain", part)
        connection.execute(
            CHUNK.insert().values(sha256=name, part=number, codec=codec, digest=sha256(data), data=data)
        )
    if (digest.hexdigest(), length) != (name, size):
        raise StoreError(
            f"file {name[:12]}: changed while it was stored",
            remedy="stop the program that writes it, try again",
        )


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


def read_blob(connection: sa.Connection, name: str) -> Iterator[bytes]:
    """The parts of a stored file. Each stored part is checked, and the whole file at the end.

    Raises
    ------
    StoreError
        If the file is not in the store, or was changed.
    """
    row = connection.execute(sa.select(BLOB.c.size).where(BLOB.c.sha256 == name)).one_or_none()
    if row is None:
        raise _missing(name)
    digest, length, number = hashlib.sha256(), 0, 0
    while part_row := connection.execute(
        sa.select(CHUNK).where(CHUNK.c.sha256 == name, CHUNK.c.part == number)
    ).one_or_none():
        part = _unpacked(part_row)
        digest.update(part)
        length += len(part)
        number += 1
        yield part
    if (digest.hexdigest(), length) != (name, row.size):
        raise _damaged(name)


_BATCH_FILES, _BATCH_BYTES = 200, 32 << 20
"""Most files, and most bytes, that are read in one query."""


def read_blobs(connection: sa.Connection, wanted: Iterable[tuple[str, int]]) -> Iterator[tuple[str, bytes]]:
    """Read many small files whole, in the order of ``wanted``. Each is checked as in :func:`read_blob`.

    ``wanted`` holds name and size [bytes] of each.

    Raises
    ------
    StoreError
        For the first file that is missing or changed.
    """
    for name, _, data in _in_batches(connection, wanted):
        if isinstance(data, StoreError):
            raise data
        yield name, data


def check_blobs(
    connection: sa.Connection, wanted: Iterable[tuple[str, int]]
) -> Iterator[tuple[str, StoreError | None]]:
    """The fault of each stored file; None if content and size are unchanged."""

    def small() -> Iterator[tuple[str, int]]:
        for name, size in wanted:
            if size <= PART:
                yield name, size
            else:
                large.append((name, size))

    large: list[tuple[str, int]] = []
    for name, size, data in _in_batches(connection, small()):
        altered = not isinstance(data, StoreError) and len(data) != size
        yield name, _altered(name) if altered else data if isinstance(data, StoreError) else None
    for name, size in large:
        try:
            stored = digest_of(read_blob(connection, name))
        except StoreError as error:
            yield name, error
        else:
            yield name, None if stored == (name, size) else _altered(name)


def _altered(name: str) -> StoreError:
    return StoreError(f"file {name[:12]}: was altered", remedy="restore a backup")


def _in_batches(
    connection: sa.Connection, wanted: Iterable[tuple[str, int]]
) -> Iterator[tuple[str, int, bytes | StoreError]]:
    batch: list[tuple[str, int]] = []
    size_of_batch = 0
    for name, size in wanted:
        batch.append((name, size))
        size_of_batch += size
        if len(batch) == _BATCH_FILES or size_of_batch > _BATCH_BYTES:
            yield from _read_batch(connection, batch)
            batch, size_of_batch = [], 0
    yield from _read_batch(connection, batch)


def _read_batch(
    connection: sa.Connection, batch: list[tuple[str, int]]
) -> Iterator[tuple[str, int, bytes | StoreError]]:
    names = [name for name, _ in batch]
    there = {
        row.sha256: row.size for row in connection.execute(sa.select(BLOB).where(BLOB.c.sha256.in_(names)))
    }
    parts: dict[str, list[bytes]] = {}
    faults: dict[str, StoreError] = {}
    chunks = sa.select(CHUNK).where(CHUNK.c.sha256.in_(names)).order_by(CHUNK.c.sha256, CHUNK.c.part)
    for row in connection.execute(chunks):
        try:
            parts.setdefault(row.sha256, []).append(_unpacked(row))
        except StoreError as error:
            faults.setdefault(row.sha256, error)
    for name, size in batch:
        data = b"".join(parts.get(name, []))
        if name not in there:
            faults[name] = _missing(name)
        elif name not in faults and (sha256(data), len(data)) != (name, there[name]):
            faults[name] = _damaged(name)
        yield name, size, faults.get(name, data)


def _missing(name: str) -> StoreError:
    return StoreError(f"file {name[:12]}: is not in the store", remedy="run piga records verify")


def _unpacked(row: sa.Row) -> bytes:
    data = as_bytes(row.data, f"file {row.sha256[:12]}")
    if sha256(data) != row.digest or row.codec not in ("plain", "zlib"):
        raise _damaged(row.sha256)
    if row.codec == "plain":
        return data
    unpacker = zlib.decompressobj()
    try:
        part = unpacker.decompress(data, PART)
    except zlib.error:
        raise _damaged(row.sha256) from None
    if not unpacker.eof or unpacker.unused_data:
        raise _damaged(row.sha256)
    return part


def _damaged(name: str) -> StoreError:
    return StoreError(f"file {name[:12]}: is damaged in the store", remedy="restore a backup")


ROWS = 200
"""Entries fetched in one query."""


def read_identity(connection: sa.Connection) -> bytes:
    """The identity document."""
    return as_bytes(connection.execute(sa.select(STORE.c.document)).scalar_one(), "the identity")


def read_head(connection: sa.Connection) -> Head:
    """Number and hash of the last entry."""
    row = connection.execute(sa.select(HEAD)).one()
    if not isinstance(row.number, int) or not isinstance(row.head, str):
        raise StoreError("the head is damaged in the store", remedy="restore a backup")
    return Head(row.number, row.head)


def read_entries(connection: sa.Connection) -> Iterator[Entry]:
    """The chain in order. Only a few entries are in memory at a time."""
    wanted = sa.select(ENTRY.c.number, ENTRY.c.link, ENTRY.c.document).order_by(ENTRY.c.number).limit(ROWS)
    number = 0
    while rows := connection.execute(wanted.where(ENTRY.c.number > number)).all():
        for row in rows:
            number, what = row.number, f"record {row.number}"
            yield Entry(number, as_bytes(row.link, what), as_bytes(row.document, what))


def stored_sizes(connection: sa.Connection) -> dict[str, tuple[int, int]]:
    """Size of each file, and its size in the store [bytes]."""
    taken = sa.select(CHUNK.c.sha256, sa.func.sum(sa.func.length(CHUNK.c.data)).label("taken")).group_by(
        CHUNK.c.sha256
    )
    packed = {row.sha256: int(row.taken) for row in connection.execute(taken)}
    return {row.sha256: (row.size, packed.get(row.sha256, 0)) for row in connection.execute(sa.select(BLOB))}
