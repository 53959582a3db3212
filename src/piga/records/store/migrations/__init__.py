"""Alembic migrations of the store, run by :mod:`piga.records.store.database`."""
