"""The same store in PostgreSQL: a real server, two stations at once, nothing lost."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from piga.errors import StoreError
from piga.ledger.store import open_store
from piga.ledger.store.transfer import export_records, import_records, restore, verify
from tests.ledger.store import drafts
from tests.ledger.store.drafts import add, content, filled
from tests.ledger.store.postgres_server import missing, server

psycopg = pytest.importorskip("psycopg", reason="the extra 'postgres' is not installed")
pytestmark = pytest.mark.skipif(missing() is not None, reason=str(missing()))


@pytest.fixture(scope="module")
def socket() -> Iterator[Path]:
    with server() as folder:
        yield folder


@pytest.fixture
def url(socket: Path, request: pytest.FixtureRequest) -> str:
    """An empty database of its own."""
    return new_database(socket, f"t{abs(hash(request.node.name))}")


def new_database(socket: Path, name: str) -> str:
    with psycopg.connect(f"host={socket} user=piga dbname=postgres", autocommit=True) as connection:
        connection.execute(f'CREATE DATABASE "{name}"')
    return f"postgresql://piga@/{name}?host={socket}"


def _start(context: multiprocessing.context.BaseContext, url: str, name: str, count: int, together=None):  # type: ignore[no-untyped-def]
    mine, other = context.Pipe(duplex=False)
    process = context.Process(target=drafts.station, args=(url, name, count, other, together))
    process.start()
    other.close()
    return process, mine


def _acknowledged(pipe) -> list[str]:  # type: ignore[no-untyped-def]
    names = []
    try:
        while True:
            names.append(pipe.recv())
    except EOFError:
        return names


@pytest.mark.long
def test_two_stations_at_once(url: str) -> None:
    context = multiprocessing.get_context("spawn")
    together = context.Barrier(2)
    stations = [_start(context, url, name, 15, together) for name in ("east", "west")]
    names = [name for _, pipe in stations for name in _acknowledged(pipe)]
    for process, _ in stations:
        process.join(60)
        assert process.exitcode == 0
    with open_store(url) as store:
        records = store.records()
        reasons = [record.document.reason for record in records]
    assert len(names) == 30
    assert sorted(record.id for record in records) == sorted(names)
    assert [record.number for record in records] == list(range(1, 31))
    verification = verify(url)
    assert verification.sound, verification.problems
    changes = sum(a.split("-")[0] != b.split("-")[0] for a, b in pairwise(reasons))
    assert changes >= 14, "a station waited for the other to end"


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ("UPDATE piga_entry SET serial = 'x' WHERE number = 1", "columns do not fit"),
        ("DELETE FROM piga_entry WHERE number = 2", "was cut short"),
        ("UPDATE piga_chunk SET data = 'x' WHERE part = 0", "is damaged"),
        ("UPDATE piga_head SET number = 7", "was cut short"),
        ("UPDATE piga_schema_version SET version_num = '0009'", "made by a newer piga"),
    ],
)
def test_what_an_administrator_changed_is_found(socket: Path, change: str, problem: str) -> None:
    name = f"changed_{abs(hash(change))}"
    url = new_database(socket, name)
    with open_store(url, create=True) as store:
        add(store, "a")
        add(store, "b")
    with psycopg.connect(f"host={socket} user=piga dbname={name}", autocommit=True) as connection:
        connection.execute("SET session_replication_role = replica")
        connection.execute(change)
    verification = verify(url)
    assert any(problem in text for text in verification.problems), verification.problems


@pytest.mark.long
def test_between_the_two_databases(socket: Path, tmp_path: Path) -> None:
    """SQLite to PostgreSQL and back: the same chain, the same head."""
    with filled(tmp_path / "a.sqlite", 3, size=3_000_000) as store:
        head = store.head().sha256
        names = [record.id for record in store.records()]
        export_records(store, tmp_path / "a.zip")
    url = new_database(socket, "restored")
    assert restore(tmp_path / "a.zip", url).head == head
    with pytest.raises(StoreError, match="there is a store already"):
        restore(tmp_path / "a.zip", url)
    with open_store(url) as store:
        assert store.read(names[1], "data") == content("a.sqlite-1", 3_000_000)
        assert export_records(store, tmp_path / "backup.zip").head == head
        export_records(store, tmp_path / "two.zip", names[:2])
    assert restore(tmp_path / "backup.zip", tmp_path / "again.sqlite").head == head
    other = new_database(socket, "other")
    with open_store(other, create=True) as store:
        assert import_records(store, tmp_path / "two.zip", "A", "merge") == names[:2]
    assert verify(other).sound


def test_messages(socket: Path) -> None:
    url = new_database(socket, "empty")
    with pytest.raises(StoreError, match="holds no store yet"):
        open_store(url)
    with pytest.raises(StoreError, match="the database refused"):
        open_store(f"postgresql://piga@/none?host={socket}")
    with pytest.raises(StoreError) as caught:
        open_store("postgresql://me:secret@localhost:1/x?connect_timeout=2")
    assert "secret" not in str(caught.value)
    with pytest.raises(StoreError, match="URL"):
        open_store("postgresql://[::1/x")
