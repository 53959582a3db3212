"""What a store cannot do is refused in words: missing extras, places that cannot be written, rows and exports made by hand."""

from __future__ import annotations

import hashlib
import json
import re
import sqlite3
import sys
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from piga.errors import MissingPackageError, StoreError
from piga.ledger.evidence import difference
from piga.ledger.store import Draft, DraftFile, open_store
from piga.ledger.store.transfer import export_records, import_records, restore, verify
from tests.ledger.store.drafts import add, content, filled
from tests.ledger.store.test_transfer_altered import tamper

LARGE = 200_000
"""Bytes of a file that is stored compressed."""


def test_without_the_extras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for package, extra, place in (
        ("psycopg", "postgres", "postgresql://piga@server/lab"),
        ("sqlalchemy", "records", tmp_path / "a.sqlite"),
    ):
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(MissingPackageError, match=rf"needs the package {package}(?s:.*)piga\[{extra}\]"):
            open_store(place, create=True)
    assert not list(tmp_path.iterdir())


def test_a_name_that_no_file_can_have(tmp_path: Path) -> None:
    path = tmp_path / ("a" * 300)
    for create in (False, True):
        with pytest.raises(StoreError, match=r"File name too long|unable to open database file"):
            open_store(path, create=create)
    assert "File name too long" in verify(path).problems[0]


def test_identity_and_order_by_the_time_of_the_test(tmp_path: Path) -> None:
    from tests.reports.example import calibration

    first = calibration(with_residuals=False)
    first.to_json(tmp_path / "c.json")
    file = DraftFile("calibration", "c.json", (tmp_path / "c.json").read_bytes())
    with open_store(tmp_path / "a.sqlite", create=True) as store:
        for when in ("2026-11-20T09:30:00+01:00", "2025-03-01"):
            made = Draft(first.serial, "A", "r", (file,), {}, {"piga": when[:4]}, measured=when)
            store.append(made)
        names = [record.id for record in store.records()]
        assert [name for name, _, _ in store.history(first.serial)] == names[::-1]
        result = difference(store, 1, 2)
        assert all(change["difference"] == 0.0 for change in result["coefficients"])
        assert result["facts"]["software piga"] == ("2026", "2025")


class Changing(type(Path())):  # type: ignore[misc]
    """A file that another program writes to whenever it is opened."""

    def __fspath__(self) -> str:
        with open(str(self), "ab") as stream:  # noqa: PTH123 - Path.open would ask for the name again
            stream.write(b"x")
        return str(self)


def test_a_file_that_changes_while_it_is_stored(tmp_path: Path) -> None:
    log = tmp_path / "run.csv"
    log.write_bytes(b"t,n\n")
    with filled(tmp_path / "a.sqlite", 1) as store:
        growing = DraftFile("data", "run.csv", Changing(log))
        with pytest.raises(StoreError, match="changed while it was stored"):
            store.append(Draft("T-1", "A", "B", (growing,)))
        assert store.head().number == 1
    assert verify(tmp_path / "a.sqlite").sound


def large_part(connection: sqlite3.Connection) -> tuple[str, bytes]:
    """Name and packed bytes of the file that is stored compressed."""
    return connection.execute("SELECT sha256, data FROM piga_chunk WHERE codec = 'zlib'").fetchone()


def repack(change: Callable[[bytes], bytes]) -> Callable[[sqlite3.Connection], None]:
    """Put other packed bytes in, with the digest that fits them."""

    def apply(connection: sqlite3.Connection) -> None:
        name, data = large_part(connection)
        forged = change(data)
        connection.execute(
            "UPDATE piga_chunk SET data = ?, digest = ? WHERE sha256 = ?",
            (forged, hashlib.sha256(forged).hexdigest(), name),
        )

    return apply


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (repack(lambda _: b"no zlib at all"), "is damaged in the store"),
        (repack(lambda data: zlib.compress(zlib.decompress(data)[:-1])), "is damaged in the store"),
        (lambda c: c.execute("DELETE FROM piga_chunk WHERE codec = 'zlib'"), "is damaged in the store"),
    ],
)
def test_a_stored_file_made_by_hand_is_not_given_out(
    tmp_path: Path, change: Callable[[sqlite3.Connection], None], message: str
) -> None:
    path = tmp_path / "a.sqlite"
    filled(path, 1, size=LARGE).close()
    with open_store(path) as store:
        assert store.read(1, "data") == content("a.sqlite-0", LARGE)
    tamper(path, change)
    with open_store(path) as store:
        with pytest.raises(StoreError, match=message):
            store.read(1, "data")
        assert store.read(1, "report") == b"<p>a.sqlite-0</p>"
        with pytest.raises(StoreError, match="is damaged"):
            export_records(store, tmp_path / "copy.zip")
    assert not verify(path).sound


def test_a_damaged_head(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    filled(path, 1).close()
    tamper(path, lambda connection: connection.execute("UPDATE piga_head SET number = 'one'"))
    with open_store(path) as store:
        with pytest.raises(StoreError, match="the head is damaged in the store"):
            store.head()
        with pytest.raises(StoreError, match="the head is damaged"):
            add(store, "next")
    assert any("the head is damaged" in problem for problem in verify(path).problems)


def members_of(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as export:
        return {name: export.read(name) for name in export.namelist()}


def rewrite(path: Path, members: dict[str, bytes]) -> None:
    """An export with sums that fit its members."""
    named = {name: data for name, data in members.items() if name != "SHA256SUMS"}
    digests = {
        name: name[6:] if name.startswith("files/") else hashlib.sha256(data).hexdigest()
        for name, data in named.items()
    }
    sums = "".join(f"{digest}  {name}\n" for name, digest in sorted(digests.items())).encode()
    with zipfile.ZipFile(path, "w") as export:
        for name, data in {**named, "SHA256SUMS": members.get("SHA256SUMS-as-is", sums)}.items():
            if name != "SHA256SUMS-as-is":
                export.writestr(name, data)


def forge(members: dict[str, bytes], change: Callable[[int, dict[str, Any]], None]) -> dict[str, bytes]:
    """Records changed, and every link, the manifest and the head made anew after them."""

    def packed(document: dict[str, Any]) -> bytes:
        return json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode()

    made, head = dict(members), hashlib.sha256(members["store.json"]).hexdigest()
    for name in sorted(name for name in members if name.startswith("links/")):
        number = int(name[6:14])
        link, document = json.loads(members[name]), json.loads(members[f"records/{number:08d}.json"])
        document["after"] = link["previous"] = head
        change(number, document)
        made[f"records/{number:08d}.json"] = packed(document)
        link["record"] = hashlib.sha256(made[f"records/{number:08d}.json"]).hexdigest()
        made[name] = packed(link)
        head = hashlib.sha256(made[name]).hexdigest()
    manifest = json.loads(members["manifest.json"]) | {"head": head}
    return made | {"manifest.json": json.dumps(manifest).encode()}


@pytest.fixture
def sound(tmp_path: Path) -> Path:
    with filled(tmp_path / "a.sqlite", 2) as store:
        export_records(store, tmp_path / "a.zip")
    return tmp_path / "a.zip"


def test_a_chain_forged_without_a_change_is_sound(sound: Path) -> None:
    """The forger's tools work: what the next tests find is what they changed."""
    rewrite(sound, forge(members_of(sound), lambda _number, _document: None))
    assert verify(sound).problems == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda _, record: record.update(id="AAAAA-AAAAA"),
            r"record 2: has the name of another \(AAAAA-AAAAA\)",
        ),
        (lambda number, record: record.update(number=number + 1), "record 1: was not written for this place"),
        (lambda number, record: record["files"][0].update(size=number), "another size"),
        (lambda _, record: record["files"][0].update(size=2**70), "another size"),
        (lambda _, record: record["files"][0].update(sha256="../x"), "'run.toml' has no valid digest or size"),
    ],
)
def test_a_chain_forged_from_end_to_end(
    sound: Path, change: Callable[[int, dict[str, Any]], None], message: str
) -> None:
    rewrite(sound, forge(members_of(sound), change))
    problems = "\n".join(verify(sound).problems)
    assert re.search(message, problems), problems
    with open_store(sound.parent / "b.sqlite", create=True) as store:
        with pytest.raises(StoreError):
            import_records(store, sound, "A", "merge")
        assert store.head().number == 0
    with pytest.raises(StoreError):
        restore(sound, sound.parent / "c.sqlite")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"notes.txt": b"hello"}, r"member 'notes\.txt' does not belong into an export"),
        ({"manifest.json": b"{"}, "the export is damaged"),
        ({"manifest.json": b'{"schema": ' + b"[" * 100_000}, "nested too deeply"),
        ({"manifest.json": b'{"schema": "piga.export/2"}'}, "export of schema 'piga.export/2'"),
        ({"SHA256SUMS-as-is": b"none\n"}, "SHA256SUMS does not fit its members"),
        ({"manifest.json": None}, r"member 'manifest\.json' is missing"),
    ],
)
def test_an_export_made_by_hand(sound: Path, change: dict[str, bytes | None], message: str) -> None:
    members = members_of(sound) | change
    rewrite(sound, {name: data for name, data in members.items() if data is not None})
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(sound.parent)
        (problem,) = verify("a.zip").problems
    assert re.search(message, problem), problem


def test_what_is_no_export(tmp_path: Path) -> None:
    with filled(tmp_path / "a.sqlite", 1) as store:
        with pytest.raises(StoreError, match="No such file"):
            import_records(store, tmp_path / "none.zip", "A", "merge")
        with pytest.raises(StoreError, match="not a zip file"):
            import_records(store, tmp_path / "a.sqlite", "A", "merge")
        (tmp_path / "b.zip").write_bytes(b"PK\x03\x04 and nothing that a ZIP file needs")
        with pytest.raises(StoreError, match="the export is damaged"):
            import_records(store, tmp_path / "b.zip", "A", "merge")
