"""Make this process one of a newer piga: schema 2, with the migration that leads to it."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from piga.ledger.store import database, verify

HERE = Path(__file__).parent


def become_newer(folder: Path, patch: Any = None) -> None:
    """Patch schema and migrations (with ``patch.setattr`` where one is given)."""
    folder.mkdir(exist_ok=True)
    for source in (*database.MIGRATIONS.glob("v*.py"), HERE / "next_schema" / "v0002_next.py"):
        shutil.copy(source, folder)
    put = patch.setattr if patch is not None else setattr
    for module in (database, verify):
        put(module, "SCHEMA", 2)
        put(module, "MIGRATIONS", folder)
    verify._sqlite_schema.cache_clear()
