"""A next schema, for the tests only: rebuilds the table of parts, as a real migration might."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"


def upgrade() -> None:
    op.execute("CREATE TABLE piga_note (number INTEGER PRIMARY KEY, text TEXT)")
    op.execute("DROP TRIGGER piga_chunk_no_update")
    op.execute("DROP TRIGGER piga_chunk_no_delete")
    op.execute("DROP TRIGGER piga_chunk_no_replace")
    op.add_column("piga_chunk", sa.Column("note", sa.Text))
    op.execute("UPDATE piga_chunk SET note = digest")
    op.execute("INSERT INTO piga_note SELECT number, head FROM piga_entry")
    refuse = "BEGIN SELECT RAISE(ABORT, 'piga: records are append-only'); END"
    op.execute(f"CREATE TRIGGER piga_chunk_no_update BEFORE UPDATE ON piga_chunk {refuse}")
    op.execute(f"CREATE TRIGGER piga_chunk_no_delete BEFORE DELETE ON piga_chunk {refuse}")
    same = "SELECT 1 FROM piga_chunk WHERE sha256 = NEW.sha256 AND part = NEW.part"
    op.execute(
        f"CREATE TRIGGER piga_chunk_no_replace BEFORE INSERT ON piga_chunk WHEN EXISTS ({same}) {refuse}"
    )
