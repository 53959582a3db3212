"""Reading a store's tables as they stand: identity, head, entries one by one, sizes of the files."""

from __future__ import annotations

from collections.abc import Iterator

import sqlalchemy as sa

from piga.errors import StoreError
from piga.ledger.store import blobs
from piga.ledger.store.record import Entry, Head
from piga.ledger.store.tables import BLOB, CHUNK, ENTRY, HEAD, STORE

ROWS = 200
"""Entries that are fetched at once."""


def read_identity(connection: sa.Connection) -> bytes:
    """The identity document."""
    return blobs.as_bytes(connection.execute(sa.select(STORE.c.document)).scalar_one(), "the identity")


def read_head(connection: sa.Connection) -> Head:
    """Number and hash of the last entry."""
    row = connection.execute(sa.select(HEAD)).one()
    if not isinstance(row.number, int) or not isinstance(row.head, str):
        raise StoreError("the head is damaged in the store", remedy="restore a backup")
    return Head(row.number, row.head)


def read_entries(connection: sa.Connection) -> Iterator[Entry]:
    """The chain in order; a few entries are in memory at a time."""
    wanted = sa.select(ENTRY.c.number, ENTRY.c.link, ENTRY.c.document).order_by(ENTRY.c.number).limit(ROWS)
    number = 0
    while rows := connection.execute(wanted.where(ENTRY.c.number > number)).all():
        for row in rows:
            number, what = row.number, f"record {row.number}"
            yield Entry(number, blobs.as_bytes(row.link, what), blobs.as_bytes(row.document, what))


def stored_sizes(connection: sa.Connection) -> dict[str, tuple[int, int]]:
    """Size of each stored file, and of what it takes in the store [bytes]."""
    taken = sa.select(CHUNK.c.sha256, sa.func.sum(sa.func.length(CHUNK.c.data)).label("taken")).group_by(
        CHUNK.c.sha256
    )
    packed = {row.sha256: int(row.taken) for row in connection.execute(taken)}
    return {row.sha256: (row.size, packed.get(row.sha256, 0)) for row in connection.execute(sa.select(BLOB))}
