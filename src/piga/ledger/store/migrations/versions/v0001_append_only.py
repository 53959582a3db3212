"""The first schema: chain, files in parts, and triggers that refuse every change and deletion."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None

APPEND_ONLY = ("piga_store", "piga_entry", "piga_blob", "piga_chunk")
WORDS = "piga: records are append-only"


def upgrade() -> None:
    """Create tables and triggers."""
    _tables()
    if op.get_context().dialect.name == "sqlite":
        _sqlite_triggers()
    else:
        _postgresql_triggers()


def _tables() -> None:
    op.create_table("piga_store", sa.Column("document", sa.LargeBinary, primary_key=True))
    op.create_table(
        "piga_entry",
        sa.Column(
            "number", sa.Integer, sa.CheckConstraint("number > 0"), primary_key=True, autoincrement=False
        ),
        sa.Column("head", sa.Text, nullable=False, unique=True),
        sa.Column("id", sa.Text, nullable=False, unique=True),
        sa.Column("serial", sa.Text, nullable=False, index=True),
        sa.Column("link", sa.LargeBinary, nullable=False),
        sa.Column("document", sa.LargeBinary, nullable=False),
    )
    op.create_table(
        "piga_blob",
        sa.Column("sha256", sa.Text, primary_key=True),
        sa.Column("size", sa.BigInteger, sa.CheckConstraint("size >= 0"), nullable=False),
    )
    op.create_table(
        "piga_chunk",
        sa.Column("sha256", sa.Text, sa.ForeignKey("piga_blob.sha256"), primary_key=True),
        sa.Column("part", sa.Integer, primary_key=True),
        sa.Column("codec", sa.Text, nullable=False),
        sa.Column("digest", sa.Text, nullable=False),
        sa.Column("data", sa.LargeBinary, nullable=False),
    )
    op.create_table(
        "piga_head",
        sa.Column("one", sa.Integer, sa.CheckConstraint("one = 1"), primary_key=True, autoincrement=False),
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("head", sa.Text, nullable=False),
    )


_SAME_ROW = {
    "piga_store": "1",
    "piga_entry": "number = NEW.number OR head = NEW.head OR id = NEW.id",
    "piga_blob": "sha256 = NEW.sha256",
    "piga_chunk": "sha256 = NEW.sha256 AND part = NEW.part",
    "piga_head": "1",
}
"""Conditions for rows that an ``INSERT OR REPLACE`` would delete without firing a delete trigger."""


def _sqlite_triggers() -> None:
    refuse = f"BEGIN SELECT RAISE(ABORT, '{WORDS}'); END"
    for table in (*APPEND_ONLY, "piga_head"):
        op.execute(f"CREATE TRIGGER {table}_no_delete BEFORE DELETE ON {table} {refuse}")
        same = f"SELECT 1 FROM {table} WHERE {_SAME_ROW[table]}"  # noqa: S608 - names are constants
        op.execute(f"CREATE TRIGGER {table}_no_replace BEFORE INSERT ON {table} WHEN EXISTS ({same}) {refuse}")
    for table in APPEND_ONLY:
        op.execute(f"CREATE TRIGGER {table}_no_update BEFORE UPDATE ON {table} {refuse}")
    op.execute(
        f"CREATE TRIGGER piga_head_forward BEFORE UPDATE ON piga_head WHEN NEW.number <> OLD.number + 1 {refuse}"
    )


def _postgresql_triggers() -> None:
    op.execute(
        f"CREATE FUNCTION piga_refuse() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN RAISE EXCEPTION '{WORDS}'; END $$"
    )
    for table in (*APPEND_ONLY, "piga_head"):
        op.execute(
            f"CREATE TRIGGER {table}_no_truncate BEFORE TRUNCATE ON {table} "
            "FOR EACH STATEMENT EXECUTE FUNCTION piga_refuse()"
        )
        op.execute(
            f"CREATE TRIGGER {table}_no_delete BEFORE DELETE ON {table} FOR EACH ROW EXECUTE FUNCTION piga_refuse()"
        )
    for table in APPEND_ONLY:
        op.execute(
            f"CREATE TRIGGER {table}_no_update BEFORE UPDATE ON {table} FOR EACH ROW EXECUTE FUNCTION piga_refuse()"
        )
    op.execute(
        "CREATE TRIGGER piga_head_forward BEFORE UPDATE ON piga_head FOR EACH ROW "
        "WHEN (NEW.number <> OLD.number + 1) EXECUTE FUNCTION piga_refuse()"
    )
