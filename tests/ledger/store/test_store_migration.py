"""An older store is migrated when it is opened: in one transaction, and the chain stays word for word."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from piga.errors import StoreError
from piga.ledger.store import database, open_store
from piga.ledger.store import verify as verify_module
from piga.ledger.store.verify import verify
from tests.ledger.store.drafts import add, filled
from tests.ledger.store.newer import become_newer


@pytest.fixture
def newer(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> Iterator[pytest.MonkeyPatch]:
    yield monkeypatch
    monkeypatch.undo()
    verify_module._sqlite_schema.cache_clear()


def test_older_store_is_migrated(tmp_path: Path, newer: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.sqlite"
    with filled(path, 3) as store:
        head = store.head()
    become_newer(tmp_path / "versions", newer)
    with open_store(path) as store:
        assert store.head() == head
        add(store, "after")
    assert verify(path, [head.sha256]).problems == []
    newer.undo()
    verify_module._sqlite_schema.cache_clear()
    with pytest.raises(StoreError, match="made by a newer piga"):
        open_store(path)


def test_older_store_that_cannot_be_written(tmp_path: Path, newer: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.sqlite"
    filled(path, 1).close()
    raw = path.read_bytes()
    become_newer(tmp_path / "versions", newer)
    newer.setattr(os, "access", lambda *_: False)
    with pytest.raises(StoreError, match="older schema 1 and cannot be written to"):
        open_store(path)
    assert path.read_bytes() == raw


def test_a_migration_that_fails_changes_nothing(tmp_path: Path, newer: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.sqlite"
    filled(path, 1).close()
    raw = path.read_bytes()
    become_newer(tmp_path / "versions", newer)
    bad = tmp_path / "versions" / "v0002_next.py"
    bad.write_text(
        bad.read_text().replace('op.execute("INSERT INTO piga_note', 'op.execute("INSERT INTO nowhere')
    )
    with pytest.raises(StoreError, match="no such table"):
        open_store(path)
    assert path.read_bytes() == raw
    assert database.SCHEMA == 2
