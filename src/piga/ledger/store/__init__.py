"""The store of records. It is append-only and chained, in one SQLite file or a PostgreSQL database."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from piga.errors import needed
from piga.ledger.store.documents import Draft, DraftFile, Head, Record

if TYPE_CHECKING:
    from piga.ledger.store.store import Store

__all__ = ["Draft", "DraftFile", "Head", "Record", "open_store"]


def open_store(where: str | Path, *, create: bool = False) -> Store:
    """Open the store in a SQLite file, or in a PostgreSQL database by URL.

    Parameters
    ----------
    where:
        ``lab.sqlite`` or ``postgresql://user@server/database``.
    create:
        Create a new store if there is none.

    Raises
    ------
    StoreError
        If there is no store, it is damaged, not a piga store or made by a newer piga.
    MissingPackageError
        If the extra ``records`` is not installed.
    """
    needed("sqlalchemy")
    from piga.ledger.store.store import Store

    return Store(where, create=create)
