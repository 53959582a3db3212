"""The picture of the report shows the product's numbers, or the build of the docs fails."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("PIL")

from builders import build_report_image
from builders.build_report_image import OUT, numbers_file, renew, shown, stale

from piga.records.calibration.document import calibration_to_bytes
from piga.reports.calibration.page import page as calibration_page
from tests.reports.example import calibration


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Results of a calibration, and a picture that shows them."""
    cal = calibration(with_residuals=False)
    (tmp_path / "calibration.json").write_bytes(calibration_to_bytes(cal))
    picture = tmp_path / "report.png"
    picture.write_bytes(b"picture")
    kept = {"picture": hashlib.sha256(b"picture").hexdigest(), **shown(calibration_page(cal))}
    numbers_file(picture).write_text(json.dumps(kept), encoding="utf-8")
    return tmp_path


def no_browser(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build_report_image, "BROWSERS", ())


def test_the_shipped_picture_is_the_one_whose_numbers_stand_beside_it():
    kept = json.loads(numbers_file(OUT).read_text(encoding="utf-8"))
    assert stale(OUT, {name: value for name, value in kept.items() if name != "picture"}) == ""


def test_a_picture_of_the_numbers_is_kept(results, monkeypatch):
    no_browser(monkeypatch)
    assert "shows the product's numbers" in renew(results, results / "report.png")


def test_a_picture_of_other_numbers_fails_without_a_browser(results, monkeypatch):
    no_browser(monkeypatch)
    cal = calibration(with_residuals=False)
    moved = replace(cal.coefficients[0], value=cal.coefficients[0].value * (1.0 + 1e-5))
    cal = replace(cal, coefficients=(moved, *cal.coefficients[1:]))
    (results / "calibration.json").write_bytes(calibration_to_bytes(cal))
    with pytest.raises(SystemExit, match="other tiles, coefficients than the product's; no Chromium"):
        renew(results, results / "report.png")


@pytest.mark.parametrize("change", ["picture", "numbers"])
def test_a_picture_without_its_numbers_fails(results, monkeypatch, change):
    no_browser(monkeypatch)
    picture = results / "report.png"
    if change == "picture":
        picture.write_bytes(b"another")
    else:
        numbers_file(picture).unlink()
    with pytest.raises(SystemExit, match=r"is not the picture that|report\.json is missing"):
        renew(results, picture)


def test_a_new_picture_is_taken_with_a_browser(results, monkeypatch):
    def photograph(report: Path, out: Path, browser: str) -> None:
        assert (report, browser) == (results / "report.html", "/bin/browser")
        out.write_bytes(b"new")

    monkeypatch.setattr(build_report_image.shutil, "which", lambda name: f"/bin/{name}")
    monkeypatch.setattr(build_report_image, "BROWSERS", ("browser",))
    monkeypatch.setattr(build_report_image, "photograph", photograph)
    picture = results / "report.png"
    numbers_file(picture).unlink()
    assert "took report.png" in renew(results, picture)
    no_browser(monkeypatch)
    assert "shows the product's numbers" in renew(results, picture)
