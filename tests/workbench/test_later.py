"""Certificate: whose entries they are, numbers that are used once."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from piga.certificate.certificate_file import read_certificate_file
from piga.errors import PigaError
from piga.workbench.common import Bench
from piga.workbench.folder import Folder, Kept
from piga.workbench.later import _document, _own, _typed
from tests.reports.example import calibration


@pytest.fixture
def bench(tmp_path: Path) -> object:
    made = Bench(Folder(tmp_path))
    yield made
    made.jobs.stop_all()


@pytest.fixture
def kept(bench: Bench, tmp_path: Path) -> Kept:
    (tmp_path / "kept").mkdir()
    calibration(serial="tumble-a", with_residuals=False).to_json(tmp_path / "kept" / "calibration.json")
    kept = bench.folder.kept(tmp_path / "kept")
    assert kept is not None
    return kept


def test_entries_of_the_example_are_nobodys_own(bench: Bench, kept: Kept, tmp_path: Path) -> None:
    first = _own(bench, kept)[2]
    shutil.copy(Path("examples/certificate.toml"), tmp_path)
    assert _own(bench, kept)[2] | {"certificate.number": ""} == first | {"certificate.number": ""}
    text = (tmp_path / "certificate.toml").read_text(encoding="utf-8").replace("12 Meridian Road", "3 Pier")
    (tmp_path / "certificate.toml").write_text(text, encoding="utf-8")
    own = _own(bench, kept)[2]
    assert (own["laboratory.name"], own["laboratory.street"], own["item.serial"]) == ("", "3 Pier", "tumble-a")


def test_what_is_typed_is_what_the_file_says_and_other_entries_stay(
    bench: Bench, kept: Kept, tmp_path: Path
) -> None:
    own = '[certificate]\nreplaces = "2025-0001"\n[people.authorised]\nname = "A"\n'
    (tmp_path / "certificate.toml").write_text(own, encoding="utf-8")
    typed = {
        "certificate.number": "7", "people.authorised.name": 'B "C"',
        "calibration.begin": "2026-05-01", "adjustment.performed": "false",
        "environment": "Air temperature; 20.3 degC; 0.4 K\nHumidity; 46 %", "method.documents": "SOP-1\nSOP-2",
    }  # fmt: skip
    text = _document(_own(bench, kept)[0], {key: _typed(key, value) for key, value in typed.items()})
    made = read_certificate_file("certificate.toml", content=text)
    assert (made.certificate.replaces, made.people.authorised.name) == ("2025-0001", 'B "C"')
    assert (str(made.calibration.begin), made.adjustment.performed) == ("2026-05-01", False)
    assert made.method.documents == ("SOP-1", "SOP-2")
    rows = [(one.name, one.value, one.uncertainty) for one in made.environment]
    assert rows == [("Air temperature", "20.3 degC", "0.4 K"), ("Humidity", "46 %", "")]
    (tmp_path / "certificate.toml").write_text(text, encoding="utf-8")
    shown = _own(bench, kept)[2]
    assert {key: shown[key] for key in typed} == typed


def test_a_file_that_cannot_be_used_is_refused(bench: Bench, kept: Kept, tmp_path: Path) -> None:
    (tmp_path / "certificate.toml").write_text('laboratory = "x"\n', encoding="utf-8")
    with pytest.raises(PigaError, match=r"certificate\.toml"):
        _own(bench, kept)
