"""``piga certificate`` as a user runs it: issue, verify, read back; refused with the whole list."""

from __future__ import annotations

import json

import pytest

from piga.records.calibration_json import to_document
from tests.cli.test_commands import piga
from tests.reports.certificate_data import EXAMPLE, budgeted, key_pair
from tests.reports.example import calibration

pytest.importorskip("signxml")


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lab")
    budgeted(calibration(serial="tumble-a", with_residuals=False)).to_json(folder / "calibration.json")
    key_pair(folder, "lab")
    key_pair(folder, "other")
    return folder


def test_issue_verify_read(lab, tmp_path):
    done = piga(
        "certificate", "calibration.json", "--data", EXAMPLE, "--out", tmp_path, "--dcc", "--key", "lab-key.pem",
        "--certificate", "lab-cert.pem", cwd=lab,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in tmp_path.glob("[!.]*")) == [
        "certificate.html",
        "certificate.xml",
        "working-copy.html",
    ]
    checked = piga(
        "certificate",
        "verify",
        tmp_path / "certificate.xml",
        "--certificate",
        "lab-cert.pem",
        "--json",
        cwd=lab,
    )
    assert json.loads(checked.stdout)["signature"] == "holds"
    assert json.loads(checked.stdout)["remarks"] == []
    wrong = piga(
        "certificate", "verify", tmp_path / "certificate.xml", "--certificate", "other-cert.pem", cwd=lab
    )
    assert wrong.returncode == 2
    assert "does not hold" in wrong.stderr
    read = piga(
        "certificate", "read", tmp_path / "certificate.xml", "--certificate", "lab-cert.pem", "--out", tmp_path / "back.json",
        cwd=lab,
    )  # fmt: skip
    assert read.returncode == 0, read.stderr
    assert (tmp_path / "back.json").read_bytes() == (lab / "calibration.json").read_bytes()
    assert json.loads((tmp_path / "back.json").read_text()) == json.loads(
        json.dumps(to_document(budgeted(calibration(serial="tumble-a", with_residuals=False))))
    )


def test_refused_with_the_whole_list(lab, tmp_path):
    text = EXAMPLE.read_text(encoding="utf-8")
    text = text.replace("number =", "# number =").replace('role = "Head', '# role = "Head')
    (tmp_path / "c.toml").write_text(text, encoding="utf-8")
    done = piga(
        "certificate", lab / "calibration.json", "--data", tmp_path / "c.toml", "--out", tmp_path / "o", "--dcc"
    )
    assert done.returncode == 2
    assert "2 items of ISO/IEC 17025:2017 missing or wrong" in done.stderr
    assert "[certificate] number (7.8.2.1 d)" in done.stderr
    assert "[people.authorised] name and role" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "o").exists()


def test_options_that_belong_together(lab, tmp_path):
    alone = piga(
        "certificate", "calibration.json", "--data", EXAMPLE, "--out", tmp_path, "--key", "lab-key.pem", cwd=lab
    )
    assert alone.returncode == 2
    assert "belong together" in alone.stderr
    for command in ("issue", "verify", "read"):
        assert piga("certificate", command, "--help").returncode == 0
