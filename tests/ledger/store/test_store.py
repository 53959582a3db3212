"""The store as its users meet it: append, read, amend, refuse, copy, restore."""

from __future__ import annotations

import hashlib
import multiprocessing
import sqlite3
import zipfile
from pathlib import Path

import pytest

import piga
from piga.errors import PigaError, StoreError
from piga.ledger.store import PART, Draft, DraftFile, encode, open_store, safe_name, sha256
from piga.ledger.store import store as store_module
from piga.ledger.store.transfer import export_records, import_records, restore, verify
from tests.ledger.store import drafts
from tests.ledger.store.drafts import add, content, filled
from tests.ledger.store.test_transfer_altered import tamper


def test_what_is_appended_is_read_back(tmp_path: Path) -> None:
    with filled(tmp_path / "a.sqlite", 3, size=3 * PART + 17) as store:
        names = [record.id for record in store.records()]
        assert [record.number for record in store.records()] == [1, 2, 3]
        for index, name in enumerate(names):
            assert store.read(name, "data") == content(f"a.sqlite-{index}", 3 * PART + 17)
            assert store.record(index + 1).id == name == store.record(name.lower()).id
        assert store.head().number == 3
        assert store.head().sha256 == store.record(3).head
    with piga.open_store(tmp_path / "a.sqlite") as again:
        assert [record.id for record in again.records()] == names
    assert [path.name for path in tmp_path.iterdir()] == ["a.sqlite"]


def test_the_chain_by_hand(tmp_path: Path) -> None:
    """hashlib and the sqlite3 module alone find the chain sound: nothing of ours is needed to check it."""
    filled(tmp_path / "a.sqlite").close()
    raw = sqlite3.connect(tmp_path / "a.sqlite")
    (identity,) = raw.execute("SELECT document FROM piga_store").fetchone()
    head = hashlib.sha256(identity).hexdigest()
    for link, document in raw.execute("SELECT link, document FROM piga_entry ORDER BY number"):
        assert f'"previous":"{head}"'.encode() in link
        assert f'"record":"{hashlib.sha256(document).hexdigest()}"'.encode() in link
        head = hashlib.sha256(link).hexdigest()
    assert raw.execute("SELECT head FROM piga_head").fetchone() == (head,)
    raw.close()


def test_an_amendment_is_a_new_record(tmp_path: Path) -> None:
    with open_store(tmp_path / "a.sqlite", create=True) as store:
        first, other = add(store, "a"), add(store, "b", serial="T-2")
        second = add(store, "c", supersedes=first)
        assert store.record(second).document.supersedes == first
        for wrong, message in (
            (first, "superseded already, by"),
            (other, "is of instrument 'T-2'"),
            ("00000-00000", "no record"),
            ("1", "superseded already, by"),
            ("7", "no record"),
        ):
            with pytest.raises(PigaError, match=message):
                add(store, "d", supersedes=wrong)
        assert store.head().number == 3


@pytest.mark.parametrize(
    "name",
    ["", "/x", "../x", "a/../x", "a//b", "C:x", "a\\b", "a\x00b", "nul.csv", "a/COM1", "x.", "y ", "n" * 600],
)
def test_names_that_lead_elsewhere_are_refused(name: str) -> None:
    with pytest.raises(StoreError, match="cannot be stored"):
        safe_name(name)


def test_extract(tmp_path: Path) -> None:
    with filled(tmp_path / "a.sqlite", 1) as store:
        run = store.extract(1, tmp_path / "x")
        assert run == tmp_path / "x" / "run.toml"
        assert (tmp_path / "x" / "data" / "run.csv").read_bytes() == content("a.sqlite-0", 400)
        with pytest.raises(StoreError, match="exists already"):
            store.extract(1, tmp_path / "x")
        with pytest.raises(StoreError, match="it has: data, report, run"):
            store.read(1, "calibration")
        with pytest.raises(PigaError, match="cannot be read"):
            store.append(Draft("T-1", "A", "B", (DraftFile("a", "x", Path("missing.csv")),)))


def test_what_is_no_store_of_ours(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    with pytest.raises(StoreError, match=r"No such file(?s:.*)piga records add makes a new one"):
        open_store(path)
    for raw in (b"hello", b"SQLite format 3\x00" + bytes(600), bytes(5000)):
        path.write_bytes(raw)
        for create in (False, True):
            with pytest.raises(StoreError, match="file is not a database"):
                open_store(path, create=create)
        assert path.read_bytes() == raw
    path.write_bytes(b"")
    with pytest.raises(StoreError, match="holds no store yet"):
        open_store(path)
    other = sqlite3.connect(path)
    other.execute("CREATE TABLE t (a)")
    other.close()
    with pytest.raises(StoreError, match="of another program"):
        open_store(path, create=True)
    for create in (False, True):
        with pytest.raises(StoreError, match="is not a regular file, but a folder"):
            open_store(tmp_path, create=create)
    with pytest.raises(StoreError, match="unable to open database file"):
        open_store(tmp_path / "missing" / "a.sqlite", create=True)


def test_a_newer_store_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    filled(path, 1).close()
    tamper(path, lambda connection: connection.execute("UPDATE piga_schema_version SET version_num = '0007'"))
    raw = path.read_bytes()
    with pytest.raises(StoreError, match=r"made by a newer piga \(schema 0007"):
        open_store(path)
    assert path.read_bytes() == raw


def test_read_only_store_can_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """SQLite opens a file that may not be written to in this mode by itself."""
    path = tmp_path / "a.sqlite"
    filled(path, 1).close()
    connect = store_module._connect
    monkeypatch.setattr(store_module, "_connect", lambda uri: connect(uri.replace("mode=rw", "mode=ro")))
    with open_store(path) as store:
        assert store.head().number == 1
        with pytest.raises(StoreError, match="attempt to write a readonly database"):
            add(store, "b")


def test_disk_full_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """SQLite's own page limit stands for a full disk: at every size the store stays whole."""
    path, connect = tmp_path / "a.sqlite", store_module._connect
    with filled(path, 1) as store:
        pages = path.stat().st_size // 4096
        for extra in (0, 1, 3, 10, 10_000):

            def limited(uri: str, most: int = pages + extra) -> sqlite3.Connection:
                connection = connect(uri)
                connection.execute(f"PRAGMA max_page_count={most}")
                return connection

            monkeypatch.setattr(store_module, "_connect", limited)
            if extra == 10_000:
                add(store, "big", size=200_000)
                continue
            with pytest.raises(StoreError, match="database or disk is full"):
                add(store, "big", size=200_000)
            assert store.head().number == 1
            assert verify(path).sound
    assert store.head().number == 2


def test_export_is_deterministic_complete_and_readable_without_us(tmp_path: Path) -> None:
    with filled(tmp_path / "a.sqlite") as store:
        exported = export_records(store, tmp_path / "a.zip")
        export_records(store, tmp_path / "b.zip")
        assert (exported.sound, exported.records, exported.head) == (True, 3, store.head().sha256)
        with pytest.raises(StoreError, match="exists already"):
            export_records(store, tmp_path / "a.zip")
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.zip") as export:
        sums = dict(reversed(line.split("  ")) for line in export.read("SHA256SUMS").decode().splitlines())
        assert set(sums) == set(export.namelist()) - {"SHA256SUMS"}
        assert all(sha256(export.read(name)) == digest for name, digest in sums.items())


def test_import_keeps_documents_and_origin(tmp_path: Path) -> None:
    with filled(tmp_path / "a.sqlite") as a, filled(tmp_path / "b.sqlite", 1) as b:
        chosen = a.record(2).id
        export_records(a, tmp_path / "one.zip", [chosen])
        export_records(a, tmp_path / "all.zip")
        assert import_records(b, tmp_path / "one.zip", "B", "merge") == [chosen]
        assert len(import_records(b, tmp_path / "all.zip", "B", "merge")) == 2
        assert import_records(b, tmp_path / "all.zip", "B", "merge") == []
        for record in a.records():
            taken = b.record(record.id)
            assert encode(taken.document) == encode(record.document)
            assert taken.link.taken_over is not None
            assert sha256(taken.link.taken_over.link.encode()) == record.head
        export_records(b, tmp_path / "b.zip")
        with open_store(tmp_path / "c.sqlite", create=True) as c:
            import_records(c, tmp_path / "b.zip", "C", "again")
            assert {record.id for record in c.records()} == {record.id for record in b.records()}
    for name in ("a.sqlite", "b.sqlite", "c.sqlite", "one.zip", "b.zip"):
        assert verify(tmp_path / name).sound, name


def test_restore_gives_the_same_head(tmp_path: Path) -> None:
    with filled(tmp_path / "a.sqlite") as store:
        head = store.head().sha256
        export_records(store, tmp_path / "part.zip", [store.record(1).id])
        export_records(store, tmp_path / "all.zip")
    target = tmp_path / "restored.sqlite"
    assert restore(tmp_path / "all.zip", target).head == head
    with open_store(target) as store:
        add(store, "after")
    assert verify(target, [head]).sound
    with pytest.raises(StoreError, match="exists already"):
        restore(tmp_path / "all.zip", tmp_path / "a.sqlite")
    with pytest.raises(StoreError, match="the export lacks record"):
        restore(tmp_path / "part.zip", tmp_path / "new.sqlite")
    with pytest.raises(StoreError, match=r"not a zip file(?s:.*)if it is a store itself"):
        restore(target, tmp_path / "new.sqlite")
    assert not (tmp_path / "new.sqlite").exists()
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_two_programs_at_once_on_one_file(tmp_path: Path) -> None:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([drafts.__name__])
    started = []
    for name in ("east", "west"):
        mine, other = context.Pipe(duplex=False)
        process = context.Process(target=drafts.station, args=(str(tmp_path / "a.sqlite"), name, 12, other))
        process.start()
        other.close()
        started.append((process, mine))
    names = []
    for process, pipe in started:
        process.join(120)
        assert process.exitcode == 0
        names += [pipe.recv() for _ in range(12)]
    with open_store(tmp_path / "a.sqlite") as store:
        assert sorted(record.id for record in store.records()) == sorted(names)
    assert verify(tmp_path / "a.sqlite").sound


def test_a_forged_record_under_a_known_name_is_refused(tmp_path: Path) -> None:
    """The same name with other content: built with our own functions, as a forger would."""
    with filled(tmp_path / "a.sqlite", 1) as a, open_store(tmp_path / "b.sqlite", create=True) as b:
        name = a.record(1).id
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(store_module, "new_id", lambda: name)
            add(b, "forged")
        export_records(b, tmp_path / "b.zip")
        with pytest.raises(StoreError, match="with other content"):
            import_records(a, tmp_path / "b.zip", "A", "merge")
        assert a.head().number == 1
