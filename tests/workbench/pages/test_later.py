"""Certificate: whose entries they are, numbers that are used once."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from piga.certificate.certificate_file import read_certificate_file
from piga.certificate.page import is_draft
from piga.errors import PigaError
from piga.workbench.folder import Folder
from piga.workbench.pages.common import Bench
from piga.workbench.pages.later import _document, _items, _mine, _own


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
        _mine(bench), {"certificate.number": "7", "people.authorised.name": "B", "environment": rows}
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


def test_a_file_that_cannot_be_used_is_refused_and_a_draft_is_marked(bench: Bench, tmp_path: Path) -> None:
    (tmp_path / "certificate.toml").write_text('laboratory = "x"\n', encoding="utf-8")
    with pytest.raises(PigaError, match=r"certificate\.toml"):
        _own(bench, None)
    values = {"certificate.number": "7", "laboratory.name": "Our Laboratory", "customer.name": "Our Customer"}
    assert not is_draft(read_certificate_file("certificate.toml", content=_document({}, values)))
    assert is_draft(read_certificate_file("certificate.toml", content=_document({}, values, draft=True)))
