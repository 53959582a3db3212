"""``piga certificate`` as a user runs it: issue, verify, read back; refused with the whole list."""

from __future__ import annotations

import datetime as dt
import json
import re

import pytest

from tests.certificate.certificate_data import EXAMPLE, budgeted, complete, key_pair
from tests.cli.runner import outcome
from tests.reports.example import calibration

pytest.importorskip("signxml")


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lab")
    budgeted(calibration(serial="tumble-a", with_residuals=False)).to_json(folder / "calibration.json")
    key_pair(folder, "lab")
    key_pair(folder, "other")
    return folder


@pytest.fixture
def certificate(lab, monkeypatch, capsys):
    """Run ``piga certificate ...`` in the folder of the laboratory: exit code, stdout and stderr."""
    monkeypatch.chdir(lab)
    return lambda *words: outcome(capsys, "certificate", *words)


@pytest.mark.long
def test_issue_verify_read(lab, certificate, tmp_path):
    code, _, err = certificate(
        "issue", "calibration.json", "--data", EXAMPLE, "--out", tmp_path, "--dcc", "--key", "lab-key.pem",
        "--certificate", "lab-cert.pem",
    )  # fmt: skip
    assert code == 0, err
    written = {path.name for path in tmp_path.glob("[!.]*")}
    assert written == {"certificate.html", "certificate.xml"}
    xml, back = tmp_path / "certificate.xml", tmp_path / "back.json"
    checked = json.loads(certificate("verify", xml, "--certificate", "lab-cert.pem", "--json")[1])
    assert checked["signature"] == "holds"
    assert checked["remarks"] == []
    assert checked["signer_in_force"] is True
    code, _, err = certificate("verify", xml, "--certificate", "other-cert.pem")
    assert code == 2
    assert "does not hold" in err
    code, _, err = certificate("read", xml, "--certificate", "lab-cert.pem", "--out", back)
    assert code == 0, err
    assert back.read_bytes() == (lab / "calibration.json").read_bytes()


def test_entries_of_the_example_are_a_draft(lab, tmp_path, capsys):
    """Laboratory or customer of the example: the mark on the page and a line; none where both are one's own."""
    own = tmp_path / "own.toml"
    text = EXAMPLE.read_text(encoding="utf-8").replace('"Example Navigation Ltd"', '"A customer"')
    own.write_text(text, encoding="utf-8")
    words = ("certificate", "issue", lab / "calibration.json", "--data", own, "--issued", "2027-06-01", "--out")
    code, _, err = outcome(capsys, *words, tmp_path / "draft")
    assert (code, "DRAFT" in err) == (0, True), err
    own.write_text(text.replace('"Example Inertial Metrology Laboratory"', '"A laboratory"'), encoding="utf-8")
    code, _, err = outcome(capsys, *words, tmp_path / "whole")
    assert (code, "DRAFT" in err) == (0, False), err
    marked = [
        (tmp_path / name / "certificate.html").read_text().count('class="draft"') for name in ("draft", "whole")
    ]
    assert marked == [1, 0]


def test_a_number_is_used_once(certificate, tmp_path):
    """The same certificate may be written again; a different one needs another number, also beside it."""
    out = tmp_path / "o"
    text = EXAMPLE.read_text(encoding="utf-8")
    (number,) = re.findall(r'^number = "(.*?)"', text, re.MULTILINE)

    def issue(text, *options, name="c.toml"):
        """Exit code and message."""
        data = tmp_path / name
        data.write_text(text, encoding="utf-8")
        return certificate("issue", "calibration.json", "--data", data, "--out", out, *options)[::2]

    assert issue(text)[0] == issue(text)[0] == 0
    page = (out / "certificate.html").read_text(encoding="utf-8")
    changed = text.replace("Head of", "Deputy head of")
    assert changed != text
    code, message = issue(changed)
    assert code == 2
    assert f"a different certificate has the number {number}" in message
    assert (out / "certificate.html").read_text(encoding="utf-8") == page
    assert not (out / "2").exists()
    code, message = issue(changed.replace(f'number = "{number}"', f'number = "{number}-b"'), name="d.toml")
    assert code == 0, message
    assert f"{number}-b" in (out / "2" / "certificate.html").read_text(encoding="utf-8")
    assert (out / "certificate.html").read_text(encoding="utf-8") == page
    other = text.replace(f'number = "{number}"', f'number = "{number}-b"')
    assert f"{out}/2/certificate.html: a different certificate" in issue(other)[1]
    assert issue(changed, "--force")[0] == 0
    assert "Deputy head of" in (out / "certificate.html").read_text(encoding="utf-8")


def test_the_result_of_a_set_is_named(certificate, tmp_path):
    path = tmp_path / "set-calibration.json"
    path.write_text('{"schema": "piga.set-calibration/1", "terms": {}}', encoding="utf-8")
    code, _, err = certificate("issue", path, "--data", EXAMPLE, "--out", tmp_path / "o")
    assert code == 2
    assert f"{path}: is the set-calibration.json of a set of accelerometers, not the calibration of one" in err
    assert "calibrate each instrument by itself" in err


def test_options_that_belong_together(certificate, tmp_path):
    code, _, err = certificate(
        "issue", "calibration.json", "--data", EXAMPLE, "--out", tmp_path, "--key", "lab-key.pem"
    )
    assert code == 2
    assert "belong together" in err


@pytest.fixture(scope="module")
def expired(lab):
    """Signed, when it was in force, with a certificate that has expired since, by the library alone."""
    from cryptography.hazmat.primitives.serialization import load_pem_private_key
    from cryptography.x509 import load_pem_x509_certificate
    from signxml.signer import XMLSigner

    from piga.certificate.dcc import dcc_document
    from piga.certificate.xml_signature import written

    key, certificate = (path.read_bytes() for path in key_pair(lab, "expired", start=-2000, days=1700))
    root = dcc_document(complete(serial="tumble-a"), calibration(serial="tumble-a", with_residuals=False))
    root = XMLSigner(signature_algorithm="ecdsa-sha256").sign(
        root, key=load_pem_private_key(key, None), cert=[load_pem_x509_certificate(certificate)]
    )
    (lab / "expired.xml").write_bytes(written(root))
    return lab


@pytest.mark.long
def test_an_expired_signer_stands_in_the_first_line_and_the_exit_code(expired, certificate, tmp_path):
    verify = ("expired.xml", "--certificate", "expired-cert.pem")
    code, out, _ = certificate("verify", *verify)
    assert code == 2
    first = out.splitlines()[0]
    assert "the signer's X.509 certificate has expired: valid from" in first
    dates = re.search(
        r"valid from \S+ to (\S+), judged for \S+; on the date of issue that the file states, 2026-03-09, it was not in",
        first,
    )
    day = dt.date.fromisoformat(dates[1]) - dt.timedelta(days=2)
    code, out, err = certificate("verify", *verify, "--at", str(day))
    assert code == 0, err
    assert f"the signature holds as of {day}" in out.splitlines()[0]
    code, _, err = certificate("read", *verify, "--out", tmp_path / "back.json")
    assert code == 2
    assert "has expired" in err
    assert not (tmp_path / "back.json").exists()
