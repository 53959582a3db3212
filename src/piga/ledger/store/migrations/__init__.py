"""Alembic migrations of the store, run by :mod:`piga.ledger.store.database`."""
