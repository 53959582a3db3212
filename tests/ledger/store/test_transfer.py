"""Import takes no record that ``add`` would refuse: what enters an append-only store stays for ever."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest

from piga.errors import PigaError, StoreError
from piga.ledger.store import Draft, DraftFile, encode, open_store
from piga.ledger.store.store import Store
from piga.ledger.store.transfer import export_records, import_records, verify
from piga.records.calibration.document import calibration_to_bytes
from tests.ledger.store.drafts import draft, filled
from tests.trend.history import record


def calibrated(serial: str = "T-1", data: bytes | None = None) -> Draft:
    """A draft with a calibration of instrument ``T-1``."""
    result = dataclasses.replace(record({"k0": 1e-3}, {"k0": 1e-6}), serial="T-1")
    file = DraftFile(
        "calibration", "results/calibration.json", calibration_to_bytes(result) if data is None else data
    )
    return Draft(serial, "A", "test", (file,), {}, {})


def twice(made: Draft) -> Draft:
    return dataclasses.replace(made, files=(made.files[0], made.files[0]))


CASES: dict[str, tuple[Callable[[], Draft], str]] = {
    "no date": (lambda: draft(measured="yesterday"), "measured: 'yesterday' is not a date"),
    "a date beyond the calendar": (lambda: draft(measured="0001-01-01T00:00:00+23:59"), "is not a date"),
    "a year nobody measured in": (lambda: draft(measured="0207-01-01"), "years 1900 to 2199"),
    "a line break in the serial": (lambda: draft(serial="T-1\n    2  AAAAA-AAAAA"), "control character"),
    "no serial": (lambda: draft(serial=" "), "the serial is empty"),
    "a serial of 3000 letters": (lambda: draft(serial="x" * 3000), "the serial has 3000 characters"),
    "a reason of a megabyte": (lambda: dataclasses.replace(draft(), reason="x" * 1_000_000), "reason: is empty, longer than"),
    "an operator with a control character": (
        lambda: dataclasses.replace(draft(), operator="A\x1b[2J"), "operator: is empty, longer than",
    ),
    "a control character in the software": (
        lambda: dataclasses.replace(draft(), software={"piga": "1\n2"}), "control character: 1.n2",
    ),
    "two files of one name": (lambda: twice(draft()), "two have the same name"),
    "no operator": (lambda: dataclasses.replace(draft(), operator=""), "operator: is empty"),
    "a file that leads out": (lambda: dataclasses.replace(draft(), files=(DraftFile("data", "../x", b""),)), "cannot be stored"),
    "no calibration": (lambda: calibrated(data=b"{}"), "not a calibration record"),
    "a calibration of another instrument": (lambda: calibrated("T-2"), "is of instrument 'T-1'"),
}  # fmt: skip


@pytest.fixture
def local(tmp_path: Path) -> Store:
    return filled(tmp_path / "local.sqlite", 2)


def forged(folder: Path, make: Callable[[], Draft], monkeypatch: pytest.MonkeyPatch) -> Path:
    """A sound export with one record that no piga would write."""
    with open_store(folder / "forged.sqlite", create=True) as store, monkeypatch.context() as patch:
        patch.setattr(Store, "check", lambda *_: None)
        store.append(make())
        export_records(store, folder / "forged.zip")
    assert verify(folder / "forged.zip").sound
    return folder / "forged.zip"


@pytest.mark.parametrize("case", CASES)
def test_what_add_refuses_import_refuses(
    tmp_path: Path, local: Store, case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    make, message = CASES[case]
    with pytest.raises(PigaError, match=message):
        local.append(make())
    path = forged(tmp_path, make, monkeypatch)
    with pytest.raises(StoreError, match=f"cannot be taken over: .*{message}"):
        import_records(local, path, "A", "merge")
    assert local.head().number == 2
    assert verify(tmp_path / "local.sqlite").sound


def test_a_foreign_record_cannot_supersede_a_local_one(
    tmp_path: Path, local: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = local.record(1)
    mine = own.id
    with monkeypatch.context() as patch:
        patch.setattr(Store, "_find", lambda *_: own)
        path = forged(tmp_path, lambda: draft("forged", supersedes=mine), monkeypatch)
    with pytest.raises(StoreError, match="is not of the store that the record comes from"):
        import_records(local, path, "A", "merge")
    assert local.head().number == 2


def test_amended_records_come_over_and_are_amended_here(tmp_path: Path, local: Store) -> None:
    """A foreign record and its successor; then this laboratory amends what it took over."""
    with filled(tmp_path / "other.sqlite", 1) as other:
        first = other.record(1).id
        second = other.append(draft("better", supersedes=first)).id
        export_records(other, tmp_path / "other.zip")
        export_records(other, tmp_path / "second.zip", [second])
    with open_store(tmp_path / "third.sqlite", create=True) as third:
        assert import_records(third, tmp_path / "second.zip", "A", "part") == [second]
        assert import_records(third, tmp_path / "other.zip", "A", "rest") == [first]
    assert import_records(local, tmp_path / "other.zip", "A", "merge") == [first, second]
    own = local.append(draft("mine", supersedes=second)).id
    assert {record.document.supersedes for record in local.records()} == {None, first, second}
    assert local.record(own).document.supersedes == second


def test_a_store_that_holds_such_a_record_can_still_be_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Piga 0.1 let them in: the list shows them, a history leaves out what cannot be read and says so."""
    with open_store(tmp_path / "old.sqlite", create=True) as store:
        with monkeypatch.context() as patch:
            patch.setattr(Store, "check", lambda *_: None)
            for made in (draft(measured="yesterday"), calibrated(data=b"{}"), calibrated()):
                store.append(made)
        assert len([record.measured for record in store.records()]) == 3
        with pytest.warns(match="left out: record .*: .*not a calibration record"):
            assert len(store.history("T-1")) == 1


@pytest.mark.parametrize("which", ["link", "record"])
def test_a_document_that_names_a_key_twice_is_not_sound(
    tmp_path: Path, which: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Programs differ in which of the two they take; the chain over the bytes holds all the same."""
    number = {"link": 2, "record": 1}[which]
    written = 0

    def doubled(document: object) -> bytes:
        nonlocal written
        written += 1
        raw = encode(document)  # type: ignore[arg-type]
        return b'{"schema":"another",' + raw[1:] if written == number else raw

    monkeypatch.setattr("piga.ledger.store.store.encode", doubled)
    with open_store(tmp_path / "forged.sqlite", create=True) as store:
        store.append(draft())
        assert written >= number
    verification = verify(tmp_path / "forged.sqlite")
    assert not verification.sound
    assert any("the key 'schema' occurs twice" in problem for problem in verification.problems), (
        verification.problems
    )
