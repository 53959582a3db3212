"""The certificate: complete or refused with the whole list; what stands on it; how it prints."""

from __future__ import annotations

import datetime as dt
import os
import re
import shutil
import subprocess
import tempfile
from dataclasses import replace

import msgspec
import pytest

from piga.calibration.uncertainty import with_given_servo
from piga.certificate import certificate_file
from piga.certificate.certificate_file import (
    CertificateFile,
    ConditionTable,
    ConformityTable,
    PersonTable,
    missing_items,
    quantity_text,
    read_certificate_file,
    verdicts,
)
from piga.certificate.page import certificate_html
from piga.errors import CalibrationError, PigaError, RunFileError
from tests.certificate.certificate_data import budgeted, changed, complete
from tests.reports.example import calibration


@pytest.fixture(scope="module")
def cal():
    return budgeted(calibration(with_residuals=False))


def plain(html):
    """Text of a page, white space made single."""
    import html as library

    body = html[html.index("<body>") :]
    return " ".join(library.unescape(re.sub(r"<[^>]*>", " ", body)).split())


def conforming(**keys):
    table = ConformityTable(
        specification="SPEC-1", rule="guarded", agreed_with_customer=True, limits={"k0": ("-5 mg", "5 mg")}
    )
    return msgspec.structs.replace(complete(), conformity=msgspec.structs.replace(table, **keys))


def test_an_empty_file_lists_everything_at_once(cal, tmp_path):
    path = tmp_path / "empty.toml"
    path.write_text("")
    data = read_certificate_file(path)
    missing = missing_items(data, cal)
    clauses = {clause for item in missing for clause in re.findall(r"7\.8\.\d\.\d [a-p]", item)}
    needed = {f"7.8.2.1 {letter}" for letter in "bcdefghijnop"} | {"7.8.4.1 b", "7.8.4.1 c", "7.8.4.1 d"}
    assert needed <= clauses
    with pytest.raises(CalibrationError, match=f"{len(missing)} items of ISO/IEC 17025:2017") as refused:
        certificate_html(data, cal)
    for item in missing:
        assert item in str(refused.value)


@pytest.mark.parametrize(
    ("table", "key"), [(table, key) for _, table, keys in certificate_file._NEEDED for key in keys]
)
def test_each_item_is_needed(cal, table, key):
    empty = getattr(getattr(CertificateFile(), table), key)
    empty = "" if key == "sampling" else empty
    missing = missing_items(changed(complete(), **{table: {key: empty}}), cal)
    assert len(missing) == 1
    assert missing[0].startswith(f"[{table}] {key} (7.8.")


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"people": {"authorised": PersonTable(name="A")}}, "who authorises"),
        ({"laboratory": {"country": "Germany"}}, "not a two-letter"),
        ({"certificate": {"replaces": "old"}}, "what was changed"),
        ({"statements": {"opinions": "stable"}}, "authorised to give opinions"),
        ({"statements": {"recalibrate": dt.date(2027, 1, 1)}}, "only where the customer agreed"),
        ({"calibration": {"end": dt.date(2020, 1, 1)}}, "is before"),
        ({"adjustment": {"performed": True}}, "results before adjustment"),
        ({"item": {"serial": "other"}}, "the calibration is of 'G-0417'"),
        ({"certificate": {"largest_masked_share": 1e-4}}, "rows are masked"),
    ],
)
def test_what_contradicts_itself(cal, tables, words):
    missing = missing_items(changed(complete(), **tables), cal)
    assert len(missing) == 1
    assert words in missing[0]


def test_it_is_not_issued_before_the_evaluation(cal):
    """Else the example is complete. Evaluated on 2026-01-01 at midnight UTC: still 2025-12-31 in the far west."""
    early = changed(complete(), certificate={"issued": dt.date(2020, 1, 1)})
    missing = missing_items(early, cal)
    assert any("2020-01-01 is before [calibration] end" in item for item in missing)
    later = replace(cal, provenance=replace(cal.provenance, created="2026-03-12T00:00:00Z"))
    (refused,) = missing_items(complete(), later)
    assert "2026-03-09 is before the evaluation, 2026-03-12" in refused
    west = replace(cal, provenance=replace(cal.provenance, created="2026-03-10T11:00:00Z"))
    assert missing_items(complete(), west) == []


def test_what_the_calibration_must_have(cal):
    data = complete()
    few = tuple(replace(c, degrees_of_freedom=0.5) if c.name == "k0" else c for c in cal.coefficients)
    unknown = replace(cal, coefficients=few)
    assert any("no source of Type B" in item for item in missing_items(data, replace(cal, budget=())))
    assert any(
        "degrees of freedom for an expanded uncertainty of k0" in item for item in missing_items(data, unknown)
    )
    exact = tuple(replace(c, std=0.0) if c.name == "k0" else c for c in cal.coefficients)
    assert any(
        "k0 has no uncertainty" in item for item in missing_items(data, replace(cal, coefficients=exact))
    )
    other = replace(cal, serial="Z")
    before = changed(data, adjustment={"performed": True, "before": "x"})
    assert any("is of instrument 'Z'" in item for item in missing_items(before, cal, other))
    assert any("but no adjustment" in item for item in missing_items(data, cal, cal))


def test_conditions_need_known_units(cal):
    data = msgspec.structs.replace(complete(), environment=(ConditionTable(name="Air", value="20 degX"),))
    assert "unknown unit 'degX'" in missing_items(data, cal)[0]
    empty = msgspec.structs.replace(complete(), environment=(ConditionTable(name="Air", value=" "),))
    assert "does not begin with a number" in missing_items(empty, cal)[0]
    assert quantity_text("46 %") == quantity_text("46%") == (46.0, "%")
    assert quantity_text("1013.2 hPa") == (1013.2, "hPa")


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"specification": ""}, "which specification"),
        ({"rule": None}, '"simple" or "guarded"'),
        ({"agreed_with_customer": False}, "agreed with the customer"),
        ({"limits": {}}, "limits of at least one"),
        ({"limits": {"k9": ("0 g", "1 g")}}, "no such coefficient"),
        ({"limits": {"k0": ("0 g", "1 rad")}}, "limit '1 rad'"),
        ({"limits": {"k0": ("1 g", "0 g")}}, "not below"),
    ],
)
def test_conformity_needs_rule_and_limits(cal, keys, words):
    missing = missing_items(conforming(**keys), cal)
    assert len(missing) == 1
    assert words in missing[0]


@pytest.mark.parametrize(
    ("rule", "value", "status"),
    [
        ("guarded", 0.0, "pass"),
        ("guarded", 0.9, "conditionalPass"),
        ("guarded", 1.1, "conditionalFail"),
        ("guarded", 1.3, "fail"),
        ("guarded", -1.1, "conditionalFail"),
        ("guarded", -1.3, "fail"),
        ("simple", 0.99, "pass"),
        ("simple", 1.01, "fail"),
        ("simple", -1.01, "fail"),
    ],
)
def test_decision_rules(cal, rule, value, status):
    """Limits of 1 mg on both sides, expanded uncertainty 0.2 mg."""
    changed_value = tuple(
        replace(c, value=value * 1e-3, std=0.1e-3) if c.key == "k0" else c for c in cal.coefficients
    )
    data = conforming(rule=rule, limits={"k0": ("-1 mg", "1 mg")})
    used = budgeted(replace(cal, coefficients=changed_value))
    (verdict,) = verdicts(data, used)
    assert verdict.status == status
    assert verdict.words in plain(certificate_html(data, used))


def test_what_stands_on_it(cal):
    html = certificate_html(complete(), cal, record_sha256="ab" * 32)
    text = plain(html)
    for item in (
        "Calibration certificate 2026-0117-PIGA",
        "Serial number G-0417",
        "2026-03-03 to 2026-03-04, in the laboratory",
        "20.3 °C",
        "Local gravity 9.80166 m/s² 2 × 10⁻⁶ m/s²",
        "1600.2 2.2 µg 0.13 % ∞ 1.96",
        "0.8885092 0.0000027 rad/s/g",
        "SHA-256 of calibration.json " + "ab" * 32,
    ):
        assert item in text, item
    assert html == certificate_html(complete(), cal, record_sha256="ab" * 32)
    assert "<script" not in html
    assert "http" not in html.replace("http-equiv", "")


def test_before_and_after_adjustment(cal):
    before = replace(
        cal, coefficients=tuple(replace(c, value=2.5e-3) if c.key == "k0" else c for c in cal.coefficients)
    )
    data = changed(complete(), adjustment={"performed": True, "before": "x", "description": "bias trimmed"})
    text = plain(certificate_html(data, cal, before))
    assert (
        text.index("Results before adjustment") < text.index("2500.0") < text.index("Results after adjustment")
    )
    assert "adjusted or repaired: bias trimmed" in text


def test_hostile_text_stays_text(cal):
    number = '7"; } body { display: none } /* </style><script>alert(1)</script>'
    data = changed(
        complete(), certificate={"number": number}, laboratory={"name": "<img src=x onerror=alert(1)>"}
    )
    html = certificate_html(data, cal)
    assert "<script" not in html
    assert "<img" not in html
    style = html[html.index("<style>") : html.index("</style>")]
    assert "display: none }" not in style
    assert html.count("</style>") == 1


def test_gravity_of_the_certificate_is_that_of_the_reference(cal):
    """9.80166 m/s^2 in the example; K depends on it one to one."""
    limit = cal["scale_factor"].std / cal["scale_factor"].value
    for change, wrong in ((0.0, False), (0.9 * limit, False), (-1.1 * limit, True), (1.1 * limit, True)):
        used = f"{9.80166 * (1.0 + change):.12g} m/s^2, from [stand] gravity"
        items = missing_items(complete(), replace(cal, gravity=used))
        assert (
            any("Local gravity" in item and f"{1e6 * abs(change):.3g} ppm" in item for item in items) == wrong
        )
    assert not missing_items(complete(), replace(cal, gravity=""))


def test_unknown_keys_are_named(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text('[laboratory]\nnam = "x"\n')
    with pytest.raises(RunFileError, match="unknown key 'nam'"):
        read_certificate_file(path)
    path.write_text("[item]\nreceived = 5\n")
    with pytest.raises(PigaError, match="received"):
        read_certificate_file(path)


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.mark.skipif(
    CHROMIUM is None or shutil.which("pdftotext") is None, reason="needs Chromium and pdftotext (poppler-utils)"
)
def test_every_printed_page_carries_the_number(cal, tmp_path):
    page, pdf = tmp_path / "certificate.html", tmp_path / "certificate.pdf"
    data = changed(complete(), certificate={"number": "A/1 é-7"}, statements={"remarks": "long " * 3000})
    page.write_text(certificate_html(data, cal), encoding="utf-8")
    with tempfile.TemporaryDirectory() as profile:
        command = [
            str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
            "--disable-background-networking", "--disable-component-update", "--disable-sync",
            f"--user-data-dir={profile}", "--no-pdf-header-footer", f"--print-to-pdf={pdf}", page.as_uri(),
        ]  # fmt: skip
        subprocess.run(
            command, check=True, capture_output=True, timeout=120, env=os.environ | {"HOME": profile}
        )
    text = subprocess.run(
        ["pdftotext", "-layout", str(pdf), "-"], check=True, capture_output=True, text=True
    ).stdout
    pages = text.rstrip("\f").split("\f")
    assert len(pages) >= 4
    for number, content in enumerate(pages, start=1):
        assert "Calibration certificate A/1 é-7" in content
        assert re.search(rf"Certificate A/1 é-7\s+Page {number} of {len(pages)}", content)
    assert "End of certificate A/1 é-7" in pages[-1]


def test_a_given_servo_without_an_uncertainty_is_certified(cal):
    """``[instrument] servo`` may give it exactly; any other coefficient needs an uncertainty."""
    exact = with_given_servo(cal, {"servo": 1.3e-7}, {})
    assert exact["servo"].std == 0.0
    assert missing_items(complete(), exact) == []
    assert "12.5021 given µg/g³ – – –" in plain(certificate_html(complete(), exact))
