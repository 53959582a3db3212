"""Certificate: whose entries they are, numbers that are used once."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from piga.certificate.certificate_file import read_certificate_file
from piga.workbench.folder import Folder
from piga.workbench.pages.common import Bench
from piga.workbench.pages.later import _document, _items, _own


@pytest.fixture
def bench(tmp_path: Path) -> object:
    made = Bench(Folder(tmp_path))
    yield made
    made.jobs.stop_all()


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


def test_entries_that_the_form_does_not_show_stay_in_the_file(bench: Bench, tmp_path: Path) -> None:
    own = '[certificate]\nreplaces = "2025-0001"\n[people.authorised]\nname = "A"\n'
    (tmp_path / "certificate.toml").write_text(own, encoding="utf-8")
    rows = "Air temperature; 20.3 degC; 0.4 K\nHumidity; 46 %"
    text = _document(
        bench, {"certificate.number": "7", "people.authorised.name": "B", "environment": rows}, whole=False
    )
    made = read_certificate_file("certificate.toml", content=text)
    assert (made.certificate.number, made.certificate.replaces, made.people.authorised.name) == (
        "7",
        "2025-0001",
        "B",
    )
    assert [(one.name, one.value, one.uncertainty) for one in made.environment] == [
        ("Air temperature", "20.3 degC", "0.4 K"), ("Humidity", "46 %", ""),
    ]  # fmt: skip
    (item,) = [one for one in _items(bench, {"environment": "a; b; c; d"}) if one.key == "environment"]
    assert "too many parts" in item.refusal


def test_a_certificate_file_of_a_stranger_is_no_error(bench: Bench, tmp_path: Path) -> None:
    text = 'laboratory = "x"\nenvironment = ["y"]\n[people]\nauthorised = 3\n'
    (tmp_path / "certificate.toml").write_text(text, encoding="utf-8")
    assert "environment" not in _own(bench, None)
    made = _document(bench, {"laboratory.name": "Our Laboratory", "people.authorised.name": "A"}, whole=True)
    assert read_certificate_file("certificate.toml", content=made).laboratory.name == "Our Laboratory"
