"""``piga records`` and ``certificate`` as a user runs them."""

from __future__ import annotations

import datetime as dt
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from piga.cli.records import history as records_of
from piga.cli.records import trend
from piga.errors import PigaError
from piga.ledger.store import Draft, DraftFile, open_store
from piga.records.calibration.coefficient import NO_REFERENCE
from piga.records.calibration.document import calibration_to_bytes
from tests.certificate.certificate_data import EXAMPLE, budgeted, complete, key_pair
from tests.cli.runner import outcome
from tests.ledger.store.drafts import add, filled
from tests.ledger.test_evidence import small_run
from tests.reports.example import calibration
from tests.trend.history import history

Command = Callable[..., tuple[int, str, str]]
LAB = ("--store", "lab.sqlite")
WHO = ("--operator", "A. Meyer", "--reason", "yearly")


@pytest.fixture
def records(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Run ``piga records ...`` in a folder: exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PIGA_STORE", raising=False)
    return lambda *words: outcome(capsys, "records", *words)


def ok(records: Command, *words: object) -> str:
    code, out, err = records(*words)
    assert code == 0, err
    return out


@pytest.mark.long
def test_the_life_of_a_record(tmp_path: Path, records: Command) -> None:
    small_run(tmp_path)
    added = json.loads(ok(records, "add", "run.toml", *LAB, *WHO, "--no-report", "--json"))
    name, head = added["id"], added["head"]
    assert name in ok(records, "list", *LAB)
    shown = ok(records, "show", name, *LAB, "--extract", "x")
    assert "scale_factor" in shown
    assert head in shown
    assert (tmp_path / "x" / "results" / "calibration.json").exists()
    assert "identical to the bit" in ok(records, "reproduce", *LAB)
    assert "known head" in ok(records, "verify", *LAB, "--head", head)
    assert head in ok(records, "export", "lab.zip", *LAB)
    assert json.loads(ok(records, "verify", "lab.zip", "--json"))["sound"] is True
    taken = json.loads(ok(records, "import", "lab.zip", "--store", "b.sqlite", *WHO, "--json"))
    assert taken["added"] == [name]
    same = ok(records, "diff", "1", name, *LAB)
    assert re.search(r"k0 +0 \+/- [\d.]+ +ug +0\.00 u", same), same
    assert f"  {name}: {NO_REFERENCE}" in ok(records, "diff", "1", name, *LAB)
    assert json.loads(ok(records, "diff", "1", name, *LAB, "--json"))["notes"] == [f"{name}: {NO_REFERENCE}"]
    assert head in ok(records, "restore", "lab.zip", "--store", "c.sqlite")
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"run.csv", "run.toml", "x", "lab.sqlite", "lab.zip", "b.sqlite", "c.sqlite"}


def test_a_list_says_what_is_superseded(tmp_path: Path, records: Command) -> None:
    with filled(tmp_path / "a.sqlite", 2) as store:
        first, second = (record.id for record in store.records())
        last = add(store, "c", supersedes=first)
    lines = ok(records, "list", "--store", "a.sqlite").splitlines()
    marked = {
        name: line.endswith("superseded") for name in (first, second, last) for line in lines if name in line
    }
    assert marked == {first: True, second: False, last: False}


def test_a_difference_is_given_in_its_own_uncertainty(tmp_path: Path, records: Command) -> None:
    first = calibration(with_residuals=False)
    moved = replace(first.coefficients[0], value=first.coefficients[0].value + 3.0 * first.coefficients[0].std)
    second = replace(first, coefficients=(moved, *first.coefficients[1:]))
    with open_store(tmp_path / "a.sqlite", create=True) as store:
        for one in (first, second):
            files = (DraftFile("calibration", "calibration.json", calibration_to_bytes(one)),)
            store.append(Draft(first.serial, "A", "r", files))
    change = json.loads(ok(records, "diff", "1", "2", "--store", "a.sqlite", "--json"))["coefficients"][0]
    assert change["std"] == pytest.approx(moved.std * 2**0.5)
    assert change["ratio"] == pytest.approx(3.0 / 2**0.5)
    assert f"{change['ratio']:+.2f} u" in ok(records, "diff", "1", "2", "--store", "a.sqlite")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["list"], "Missing option '--store'"),
        (["list", "--store", "none.sqlite"], "No such file"),
        (["list", "--store", "text.txt"], "file is not a database"),
        (["show", "77", "--store", "a.sqlite"], "no record 77"),
        (["show", "first", "--store", "a.sqlite"], "is not a record"),
        (
            ["show", "1", "--store", "a.sqlite", "--extract", "text.txt"],
            "text.txt: File exists\n  remedy: check name",
        ),
        (["verify"], "nothing to verify"),
        (["verify", "--store", "bad.sqlite"], "malformed"),
        (["verify", "--store", "bad.sqlite"], "remedy: keep it as it is"),
        (
            ["verify", "none.zip"],
            "none.zip: cannot be read (No such file or directory)\n  remedy: check the file name",
        ),
        (["verify", "--store", "a.sqlite", "--head", "12"], "head 12: is not in this chain"),
        (["export", "a.sqlite", "--store", "a.sqlite"], "exists already"),
        (["import", "text.txt", "--store", "new.sqlite", "--operator", "A", "--reason", "B"], "not a zip file"),
        (["export", "missing/x", "--store", "a.sqlite"], "cannot be written"),
        (["backup", "x", "--store", "a.sqlite"], "piga records export FILE"),
        (["restore", "text.txt", "--store", "new.sqlite"], "not a zip file"),
        (["reproduce", "--store", "a.sqlite"], "cannot be recomputed"),
        (["add", "none.toml", "--store", "new.sqlite", "--operator", "A", "--reason", "B"], "cannot be read"),
        (
            ["add", "none.toml", "--store", "new.sqlite", "--operator", " ", "--reason", "B"],
            "--operator: is empty",
        ),
        (["add", "none.toml", *LAB, *WHO, "--measured", "soon"], "--measured soon: is not a date"),
        (
            ["add", "none.toml", "--store", "text.txt", "--operator", "A", "--reason", "B"],
            "file is not a database",
        ),
    ],
)
def test_wrong_use_is_exit_2_with_one_message(
    tmp_path: Path, records: Command, arguments: list[str], message: str
) -> None:
    filled(tmp_path / "a.sqlite", 1).close()
    (tmp_path / "text.txt").write_text("hello")
    (tmp_path / "bad.sqlite").write_bytes((tmp_path / "a.sqlite").read_bytes()[:8192])
    before = {path.name for path in tmp_path.iterdir()}
    code, _, errors = records(*arguments)
    assert {path.name for path in tmp_path.iterdir()} == before
    assert code == 2, errors
    assert message in errors
    assert "Traceback" not in errors


@pytest.mark.long
def test_what_is_superseded_is_checked_before_the_work(
    tmp_path: Path, records: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By number or name; a record that is not there, of another instrument or corrected already is refused at once."""
    small_run(tmp_path)
    add_again = ("add", "run.toml", *LAB, *WHO, "--no-report", "--json")
    first = json.loads(ok(records, *add_again))["id"]
    second = json.loads(ok(records, *add_again, "--supersedes", "1"))["id"]
    shown = ok(records, "show", second, "--store", "lab.sqlite")
    assert first in shown

    def work(*_arguments: object, **_options: object) -> None:
        raise AssertionError("the calibration began")

    monkeypatch.setattr("piga.ledger.prepare_run", work)
    code, _, err = records(*add_again, "--supersedes", "9")
    assert (code, "no record 9" in err) == (2, True)
    code, _, err = records(*add_again, "--supersedes", first)
    assert (code, f"superseded already, by {second}" in err) == (2, True)
    text = (tmp_path / "run.toml").read_text()
    (tmp_path / "run.toml").write_text(re.sub(r'serial = "[^"]*"', 'serial = "other"', text))
    code, _, err = records(*add_again, "--supersedes", second)
    assert (code, "not 'other'" in err) == (2, True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("history")
    rng = np.random.default_rng(1)
    for name, time, one in history(np.arange(6) / 2, 1e-3 + rng.normal(0, 1e-6, 6), 1e-6):
        (path / name).mkdir()
        stamp = time.astimezone(dt.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        used = replace(one, provenance=replace(one.provenance, created=stamp))
        used.to_json(path / name / "calibration.json")
    return path


@pytest.mark.long
def test_directories_and_files(folder, tmp_path, capsys):
    def trend_of(*words):
        code, out, err = outcome(capsys, "records", "trend", *words, "--at", "2024-01-01", "--json")
        assert code == 0, err
        return json.loads(out)

    document = trend_of(folder, "--common", "0.5", "--out", tmp_path)
    assert document["serial"] == "G-0417"
    assert len(document["coefficients"][0]["records"]) == 6
    assert json.loads((tmp_path / "trend.json").read_text()) == document
    again = trend_of(*(folder / f"r{i}" / "calibration.json" for i in range(6)), "--common", "1")
    drifts = [one["coefficients"][0]["drift_per_year"] for one in (document, again)]
    assert drifts[0] == drifts[1]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"sources": []}, "no records are named"),
        ({"sources": [], "store": "x.sqlite"}, "--serial"),
        ({"at": "soon"}, "not a date"),
        ({"common": 7.0}, "not between 0 and 1"),
        ({"serial": "other"}, "at least two records"),
        ({"sources": ["empty"]}, "holds no calibration"),
        ({"sources": ["r0/calibration.json", "r0/none.json"]}, "cannot be read"),
    ],
)
def test_wrong_use_in_words(folder, options, words):
    (folder / "empty").mkdir(exist_ok=True)
    used = {"sources": ["."], "store": None, "serial": None, "at": None, "out": None} | options
    used["sources"] = [folder / name for name in used["sources"]]
    with pytest.raises(PigaError, match=words):
        trend(**used)


@pytest.mark.long
def test_records_of_a_store(tmp_path, capsys):
    pytest.importorskip("sqlalchemy")
    from piga.ledger.store import Draft, DraftFile, open_store

    path = tmp_path / "lab.sqlite"
    with open_store(path, create=True) as store:
        for i, (_, time, one) in enumerate(history(np.arange(4) / 2, 1e-3 + 1e-6 * np.arange(4), 1e-6)):
            file = DraftFile("calibration", "results/calibration.json", calibration_to_bytes(one))
            made = Draft(
                "G-0417", "A", f"test {i}", (file,), {}, {"piga": "0"}, measured=f"{time:%Y-%m-%dT%H:%M:%SZ}"
            )
            store.append(made)
    entries = list(records_of([], str(path), "G-0417"))
    assert len(entries) == 4
    code, out, err = outcome(capsys, "records", "trend", "--store", path, "--serial", "G-0417", "--json")
    assert code == 0, err
    (trend_of_k0,) = json.loads(out)["coefficients"]
    assert trend_of_k0["drift_per_year"]["value"] == pytest.approx(2e-6, rel=1e-6)
    with pytest.raises(PigaError):
        list(records_of([], str(tmp_path / "none.sqlite"), "G-0417"))
    with pytest.raises(PigaError, match=r"holds no record of 'G-417'\n  remedy: --serial is one of: G-0417"):
        list(records_of([], str(path), "G-417"))


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
    words = ("certificate", "issue", lab / "calibration.json", "--dcc", "--data", own, "--out")
    code, _, err = outcome(capsys, *words, tmp_path / "draft")
    assert (code, "DRAFT" in err) == (0, True), err
    own.write_text(text.replace('"Example Inertial Metrology Laboratory"', '"A laboratory"'), encoding="utf-8")
    code, _, err = outcome(capsys, *words, tmp_path / "whole")
    assert (code, "DRAFT" in err) == (0, False), err
    marked = [
        (tmp_path / name / "certificate.html").read_text().count('class="draft"') for name in ("draft", "whole")
    ]
    assert marked == [1, 0]
    numbers = [
        re.search(r"<\w+:uniqueIdentifier>(.*?)</", (tmp_path / name / "certificate.xml").read_text())[1]
        for name in ("draft", "whole")
    ]
    assert numbers == [f"DRAFT {numbers[1]}", numbers[1]]


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
    assert f"a different certificate has the number DRAFT {number}" in message
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

    from piga.certificate.dcc import dcc_document, written

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
    assert "the signer's X.509 certificate has expired: valid from" in out.splitlines()[0]
    assert "on the date of issue that the file states, 2026-03-09, it was not in force" in out
    dates = re.search(r"valid from \S+ to (\S+), judged for \S+", out)
    day = dt.date.fromisoformat(dates[1]) - dt.timedelta(days=2)
    code, out, err = certificate("verify", *verify, "--at", str(day))
    assert code == 0, err
    assert f"the signature holds as of {day}" in out.splitlines()[0]
    code, _, err = certificate("read", *verify, "--out", tmp_path / "back.json")
    assert code == 2
    assert "has expired" in err
    assert not (tmp_path / "back.json").exists()
