"""Stores of older versions: they open, hold what they held, take new records, and can be recomputed."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import pytest

from piga.ledger import reproduce
from piga.ledger.store import open_store
from piga.ledger.store.store import Store
from piga.ledger.store.transfer import restore, verify
from tests.ledger.store.drafts import add

CORPUS = Path(__file__).parent / "corpus"


VERSIONS = sorted(path.name for path in CORPUS.iterdir() if path.is_dir())


@pytest.fixture(params=VERSIONS)
def version(request: pytest.FixtureRequest) -> Path:
    return CORPUS / request.param


@pytest.fixture(params=["store", "export"])
def store(version: Path, request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    """The old store itself, and one restored from its export."""
    if request.param == "store":
        shutil.copy(version / "store.sqlite", tmp_path / "lab.sqlite")
    else:
        restore(version / "export.zip", tmp_path / "lab.sqlite")
    return open_store(tmp_path / "lab.sqlite")


def test_there_is_a_corpus() -> None:
    assert VERSIONS == ["0.1.0", "0.2.0"]


def test_everything_is_still_there(version: Path, store: Store) -> None:
    expected = json.loads((version / "expected.json").read_text(encoding="utf-8"))
    verification = verify(store.name, [expected["head"]])
    assert verification.problems == []
    assert store.head().sha256 == expected["head"]
    records = store.records()
    assert len(records) == len(expected["records"])
    for record, known in zip(records, expected["records"], strict=True):
        document = record.document
        assert (record.number, record.id, record.head) == (known["number"], known["id"], known["head"])
        assert (document.serial, document.operator) == (known["serial"], known["operator"])
        assert record.measured.isoformat() == known["measured"]
        assert {file.name: file.sha256 for file in document.files} == known["files"]
        for name, (value, std, unit) in known.get("coefficients", {}).items():
            coefficient = store.calibration(record.id)[name]
            assert (coefficient.value, coefficient.std, coefficient.unit) == (value, std, unit)
    for serial, names in expected["history"].items():
        assert [name for name, _, _ in store.history(serial)] == names


def test_files_come_out_as_they_went_in(version: Path, store: Store, tmp_path: Path) -> None:
    expected = json.loads((version / "expected.json").read_text(encoding="utf-8"))
    for known in expected["records"]:
        folder = tmp_path / known["id"]
        store.extract(known["id"], folder)
        for name, digest in known["files"].items():
            assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest


def test_every_calibration_can_be_recomputed(version: Path, tmp_path: Path) -> None:
    """In the run file of 0.2.0 no number has a unit: they are SI, as they were."""
    shutil.copy(version / "store.sqlite", tmp_path / "lab.sqlite")
    with open_store(tmp_path / "lab.sqlite") as store:
        for record in store.records():
            if record.file("calibration"):
                reproduced = reproduce(store, record.id)
                assert reproduced.comparison.agrees, reproduced.comparison.differences


def test_an_old_store_takes_new_records(version: Path, tmp_path: Path) -> None:
    """Tables of 0.1 and 0.2 have triggers that refuse changes: appending is none."""
    shutil.copy(version / "store.sqlite", tmp_path / "lab.sqlite")
    with open_store(tmp_path / "lab.sqlite") as store:
        before = store.head()
        add(store, "after")
        assert store.head().number == before.number + 1
    assert verify(tmp_path / "lab.sqlite", [before.sha256]).problems == []
