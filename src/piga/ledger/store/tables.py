"""The tables of a store, for queries; migrations make them."""

from __future__ import annotations

from sqlalchemy import BigInteger, Column, Integer, LargeBinary, MetaData, Table, Text

metadata = MetaData()

STORE = Table("piga_store", metadata, Column("document", LargeBinary, primary_key=True))
"""One row: the identity."""

ENTRY = Table(
    "piga_entry",
    metadata,
    Column("number", Integer, primary_key=True, autoincrement=False),
    Column("head", Text, nullable=False),
    Column("id", Text, nullable=False),
    Column("serial", Text, nullable=False),
    Column("link", LargeBinary, nullable=False),
    Column("document", LargeBinary, nullable=False),
)
"""The chain: link and record document; head, id and serial are taken from them for look-ups."""

BLOB = Table("piga_blob", metadata, Column("sha256", Text, primary_key=True), Column("size", BigInteger))
"""Files, named by their content."""

CHUNK = Table(
    "piga_chunk",
    metadata,
    Column("sha256", Text, primary_key=True),
    Column("part", Integer, primary_key=True),
    Column("codec", Text, nullable=False),
    Column("digest", Text, nullable=False),
    Column("data", LargeBinary, nullable=False),
)
"""Parts of files in order: ``plain`` or ``zlib``, with the SHA-256 of the bytes as they lie here."""

HEAD = Table(
    "piga_head",
    metadata,
    Column("one", Integer, primary_key=True),
    Column("number", Integer),
    Column("head", Text),
)
"""One row: number and head of the last entry, so that a chain cut short is seen."""
