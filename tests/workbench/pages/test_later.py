"""Certificate: whose entries they are, numbers that are used once, the files that the page offers."""

from __future__ import annotations

import datetime as dt
import shutil
import tomllib
from pathlib import Path

import pytest

from piga.workbench.folder import Folder
from piga.workbench.history import History
from piga.workbench.jobs import Jobs
from piga.workbench.pages.common import Bench
from piga.workbench.pages.later import _document, _items, _own, _pem_files
from piga.workbench.security import Door
from tests.certificate.certificate_data import key_pair


@pytest.fixture
def bench(tmp_path: Path) -> object:
    folder = Folder(tmp_path)
    jobs = Jobs(tmp_path)
    yield Bench(folder, jobs, History(folder), Door(1))
    jobs.stop_all()


def test_entries_of_the_example_are_nobodys_own(bench: Bench, tmp_path: Path) -> None:
    empty = {key: value for key, value in _own(bench, None).items() if value}
    shutil.copy(Path("examples/certificate.toml"), tmp_path)
    assert {key: value for key, value in _own(bench, None).items() if value} == empty
    assert "laboratory.name" not in empty
    text = (tmp_path / "certificate.toml").read_text(encoding="utf-8").replace("12 Meridian Road", "3 Pier")
    (tmp_path / "certificate.toml").write_text(text, encoding="utf-8")
    assert _own(bench, None)["laboratory.street"] == "3 Pier"


def test_a_number_is_used_once(bench: Bench, tmp_path: Path) -> None:
    first = _own(bench, None)["certificate.number"]
    (tmp_path / f"certificate-{first}").mkdir()
    assert _own(bench, None)["certificate.number"] != first
    (item,) = [one for one in _items(bench, {"certificate.number": first}) if one.key == "certificate.number"]
    assert "was used" in item.refusal


def test_a_draft_is_whole_and_own_entries_stand_in_it(bench: Bench) -> None:
    values = {"laboratory.name": "Lab <b>", "calibration.begin": "2026-05-01"}
    whole = tomllib.loads(_document(values, whole=True))
    assert whole["laboratory"]["name"] == "Lab <b>"
    assert whole["calibration"]["begin"] == dt.date(2026, 5, 1)
    assert whole["traceability"]["standard"]
    assert whole["method"]["documents"] == ["LAB-SOP-031, issue 4"]
    documents = {"method.documents": "LAB-7, issue 4; LAB-8"}
    assert tomllib.loads(_document(documents, whole=False))["method"]["documents"] == [
        "LAB-7, issue 4",
        "LAB-8",
    ]
    assert tomllib.loads(_document(values, whole=False)).keys() == {"laboratory", "calibration"}
    (wrong,) = [one for one in _items(bench, {"calibration.begin": "May 1"}) if one.key == "calibration.begin"]
    assert "date" in wrong.refusal
    table = "[[environment]]\nname = 'Air'\nvalue = '20 degC'\nuncertainty = '1 K'\n"
    for text, refusal in (("x = 1", "not [[environment]] alone"), (f"x = 1\n{table}", "alone"), (table, "")):
        (item,) = [one for one in _items(bench, {"environment": text}) if one.key == "environment"]
        assert refusal in item.refusal
        assert bool(item.refusal) == bool(refusal)


def test_keys_and_certificates_are_told_apart(bench: Bench, tmp_path: Path) -> None:
    key, certificate = key_pair(tmp_path, "lab")
    (tmp_path / "both.pem").write_bytes(certificate.read_bytes() + key.read_bytes())
    (tmp_path / "binary.cer").write_bytes(b"\x30\x82")
    (tmp_path / "link.pem").symlink_to(key)
    assert _pem_files(bench) == (["both.pem", "lab-key.pem"], ["binary.cer", "both.pem", "lab-cert.pem"])
