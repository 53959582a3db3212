"""The whole path as a person goes it, in a real browser; no request may leave this machine."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from piga.records.text_files import toml_document
from tests.certificate.certificate_data import budgeted, key_pair
from tests.planning.cases import DEFAULTS as PLAN_DEFAULTS
from tests.planning.cases import HEAD as PLAN
from tests.reports.example import calibration
from tests.stand.test_run_reference import edited
from tests.workbench.conftest import Browser, Server, shipped_record

pytestmark = pytest.mark.only_compiled
WIDE = pytest.mark.parametrize("browser", [(1300, "light")], ids=["wide-light"], indirect=True)
"""Paths that differ only in what they fill in are gone in one window."""


def test_every_page_is_clean(browser: Browser) -> None:
    for path in (
        "/",
        "/calibrate/tumble-a.toml",
        "/compensate/tumble-a.toml",
        "/instrument",
        "/certificate",
        "/plan",
        "/twin",
        "/platform",
        "/explore",
        "/jobs",
    ):
        browser.open(path)
        browser.is_accessible()


def test_the_main_job_by_mouse(browser: Browser, place: Path, tmp_path: Path) -> None:
    page = browser.page
    browser.open("/")
    link = page.get_by_role("link", name="Signals").first
    box = link.bounding_box()
    assert box["x"] + box["width"] <= page.viewport_size["width"]  # seen without moving the table
    link.click()
    browser.until("document.querySelectorAll('figure.signal[data-points]').length >= 3")
    wide = "(canvas) => canvas.clientWidth > 0.8 * canvas.closest('figure').clientWidth"
    assert page.evaluate(f"[...document.querySelectorAll('figure canvas')].every({wide})")
    browser.is_accessible()
    page.get_by_role("button", name="Zoom in").click()
    browser.until("document.getElementById('span').textContent.startsWith('532.5')")
    page.get_by_role("button", name="3", exact=True).click()
    browser.until("document.getElementById('span').textContent.startsWith('270')")
    page.get_by_role("link", name="Calibrate").click()
    page.get_by_role("button", name="Calibrate").click()
    page.get_by_role("button", name="Keep this result").wait_for()
    frame = page.frame_locator("iframe")
    frame.get_by_role("heading", name="Calibration of tumble-a").wait_for()
    assert "0.88850659" in frame.locator("#coefficients + * + .table").inner_text()
    assert frame.locator(".judgement").count() == 1
    assert "Verdict" not in page.inner_text("main")
    browser.is_accessible()
    page.get_by_role("button", name="Keep this result").click()
    page.get_by_text("Kept results lie in").wait_for()
    results = place / "tumble-a-calibration"
    command = tmp_path / "by-command"
    command.mkdir()
    shipped_record(command)
    subprocess.run([sys.executable, "-m", "piga", "calibrate", "tumble-a.toml"], cwd=command, check=True)
    for name in ("calibration.json", "report.html", "residuals.parquet"):
        assert _timeless(results / name) == _timeless(command / "tumble-a-calibration" / name), name
    page.get_by_role("link", name="Compensate").click()
    page.get_by_role("button", name="Compensate").click()
    page.get_by_role("heading", name="Files").wait_for()
    assert (place / "tumble-a-compensated.parquet").is_file()
    browser.open("/instrument")
    page.get_by_role("button", name="Certificate").first.click()
    browser.is_accessible()
    page.get_by_role("button", name="Preview").click()
    page.get_by_role("heading", name="Files").wait_for()
    issued = place / "certificate-tumble-a-calibration"
    assert not issued.exists() or page.viewport_size["width"] == 400  # the wide test came before
    page.locator("iframe").wait_for()
    page.go_back()
    page.get_by_label("certificate.number").fill('"K-7"')
    page.get_by_role("button", name="Issue").click()
    page.get_by_role("heading", name="Files").wait_for()
    assert "K-7" in (issued / "certificate.html").read_text(encoding="utf-8")
    browser.is_accessible()
    browser.open("/instrument")
    store = f"lab-{page.viewport_size['width']}.sqlite"
    page.get_by_label("in", exact=True).fill(store)
    page.get_by_label("Operator").fill("A. Meyer")
    page.get_by_label("Reason").fill("--reason=<b>")
    page.get_by_role("button", name="Keep").click()
    page.get_by_text("done").first.wait_for()
    browser.open("/instrument")
    page.locator("form", has_text=store).get_by_role("button", name="Verify").click()
    page.get_by_text("done").first.wait_for()
    browser.is_accessible()


def _timeless(path: Path) -> Any:
    """The contents but for the times of the run."""
    if path.suffix == ".parquet":
        import pyarrow.parquet as pq

        return pq.read_table(path).replace_schema_metadata(None)
    if path.suffix == ".json":
        document = json.loads(path.read_text(encoding="utf-8"))
        document["provenance"].pop("created", None)
        return document
    document = json.loads(path.with_name("calibration.json").read_text(encoding="utf-8"))
    return path.read_text(encoding="utf-8").replace(document["provenance"]["created"], "")


def test_one_is_stopped_and_one_is_discarded(browser: Browser, place: Path) -> None:
    page = browser.page
    browser.open("/platform?file=platform-published.toml")
    page.get_by_role("button", name="Navigate").click()
    page.get_by_role("button", name="Stop").click()
    page.get_by_text("stopped").first.wait_for()
    assert not (place / "platform-published-navigate").exists()
    browser.open("/calibrate/tumble-a.toml")
    before = set((place / ".piga-ui" / "trials").glob("*"))
    page.get_by_label("k2 ").first.uncheck()
    page.get_by_role("button", name="Calibrate").click()
    page.get_by_role("button", name="Discard").wait_for()
    page.get_by_role("button", name="Discard").click()
    page.wait_for_url("**/calibrate/tumble-a.toml")
    assert set((place / ".piga-ui" / "trials").glob("*")) == before


def test_two_tabs_see_one_job_and_a_reload_keeps_it(browser: Browser, running: Server) -> None:
    page = browser.page
    browser.open("/calibrate/tumble-a.toml")
    page.get_by_role("button", name="Calibrate").click()
    page.wait_for_url("**/result/*")
    address = page.url
    other = page.context.new_page()
    other.goto(address)
    page.reload()
    for tab in (page, other):
        tab.get_by_role("button", name="Keep this result").wait_for(timeout=90_000)
    page.get_by_role("button", name="Discard").click()


def test_sliders_draw_the_regimes_anew(browser: Browser) -> None:
    page = browser.page
    browser.open("/explore")
    assert "locked" in page.inner_text("#picture")
    page.fill("#a_x", "0.03")
    browser.until("document.getElementById('picture').innerText.includes('running')")
    assert page.get_attribute("[data-pair=a_x]", "max") == "2.0"
    assert "65.77 ug/g^3" in page.inner_text("#picture")  # K ml/(2 k_i), by hand
    page.fill("#k_i", "1200")
    browser.until("document.getElementById('picture').innerText.includes('32.89 ug/g^3')")
    page.fill("#c", "0")
    page.fill("#k_p", "0")
    browser.until("document.getElementById('picture').innerText.includes('unstable')")
    browser.is_accessible()


def test_a_file_is_added_and_a_wrong_one_is_refused(browser: Browser, place: Path, tmp_path: Path) -> None:
    page = browser.page
    log = tmp_path / "new log.csv"
    log.write_text("t,x\n0,1\n1,2\n", encoding="utf-8")
    browser.open("/")
    page.set_input_files("#file", log)
    page.get_by_text("new-log.csv").first.wait_for()
    (place / "new-log.csv").unlink()
    browser.open("/")
    wrong = tmp_path / "tool.exe"
    wrong.write_bytes(b"MZ")
    page.set_input_files("#file", wrong)
    page.get_by_text("files of this kind are not accepted").wait_for()
    browser.faults = [fault for fault in browser.faults if "404" not in fault]


def test_a_span_is_left_out_by_mouse(browser: Browser, place: Path) -> None:
    page = browser.page
    text = (place / "tumble-a.toml").read_text(encoding="utf-8")
    (place / "marked.toml").write_text(text, encoding="utf-8")
    browser.open("/signals/marked.toml")
    browser.until("document.querySelectorAll('figure.signal[data-points]').length >= 3")
    page.get_by_role("button", name="Mark a span").click()
    over = page.locator(".u-over").first.bounding_box()
    page.mouse.move(over["x"] + 0.5 * over["width"], over["y"] + 40)
    page.mouse.down()
    page.mouse.move(over["x"] + 0.52 * over["width"], over["y"] + 40, steps=4)
    page.mouse.up()
    page.get_by_label("Leave it out, because").fill('the door "slammed"')
    browser.is_accessible()
    page.get_by_role("button", name="Write into the run file").click()
    page.get_by_text("left-out").first.wait_for()
    written = (place / "marked.toml").read_text(encoding="utf-8")
    assert written.startswith(text.partition("segment =")[0])  # comments and all
    from piga.records.run_file import read_run_file

    (entry,) = read_run_file(place / "marked.toml").data.leave_out
    assert entry.reason == 'the door "slammed"'
    share = [(row - 2) / 28824 for row in entry.rows]
    assert 0.45 < share[0] < share[1] < 0.56
    (place / "marked.toml").unlink()


def test_a_german_log_is_described_and_calibrated(browser: Browser, place: Path) -> None:
    page = browser.page
    log = place / "Messung 7.csv"
    log.write_bytes(german_log().encode("cp1252"))
    browser.open("/")
    page.get_by_role("row", name="Messung 7.csv").get_by_role("link", name="Describe").click()
    browser.is_accessible()
    page.get_by_label("Nominal scale factor").fill("0.8884 rad/s/g")
    page.get_by_role("button", name="Apply to the text below").click()
    if page.get_by_label("Counts of the output per revolution").count():
        page.get_by_label("Counts of the output per revolution").fill("72000")
    page.get_by_role("button", name="Write the run file").first.click()
    page.get_by_role("link", name="See its signals").wait_for()
    browser.is_accessible()
    page.get_by_role("link", name="Calibrate").last.click()
    page.get_by_role("button", name="Calibrate").click()
    page.get_by_role("button", name="Keep this result").wait_for()
    page.frame_locator("iframe").get_by_role("rowheader", name="k0", exact=True).first.wait_for()
    (place / "Messung 7.toml").unlink()


@WIDE
def test_instrument_and_stand_are_taken_over(browser: Browser, place: Path, tmp_path: Path) -> None:
    """A log without reference columns, and the run file of an earlier one on the same stand."""
    page = browser.page
    lines = (place / "tumble-a.csv").read_text(encoding="utf-8").splitlines()
    log = "".join(",".join(line.split(",")[:3]) + "\n" for line in lines)
    for name in ("earlier.csv", "later.csv"):
        (place / name).write_text(log, encoding="utf-8")
    earlier = edited(tmp_path, uncertainty='\n[uncertainty]\nreference_scale = "1 ppm"\n')
    text = earlier.read_text(encoding="utf-8").replace("tumble-a.csv", "earlier.csv")
    (place / "earlier.toml").write_text(text, encoding="utf-8")
    browser.open("/describe/later.csv")
    page.get_by_label("The same instrument as in an earlier run file").select_option("earlier.toml")
    page.get_by_role("button", name="Take it over").click()
    browser.until("document.getElementById('k-stand.kind')?.value === '\"dividing-head\"'")
    shown = page.input_value("#text")
    for line in ('serial = "tumble-a"', 'positions = "0:360:15 deg"', 'reference_scale = "1 ppm"'):
        assert line in shown
    browser.is_accessible()
    page.get_by_role("button", name="Write the run file").first.click()
    page.get_by_text("The record can be calibrated.").wait_for()
    one, other = (toml_document(place / f"{name}.toml") for name in ("earlier", "later"))
    for table in ("instrument", "stand", "uncertainty"):
        assert one[table] == other[table], table
    for path in place.glob("*er.*"):
        path.unlink()


@WIDE
def test_a_plan_is_made_from_its_form(browser: Browser, place: Path) -> None:
    page = browser.page
    (place / "small.toml").write_text(PLAN.format(**PLAN_DEFAULTS), encoding="utf-8")
    browser.open("/plan?file=small.toml")
    page.fill("#name", "short.toml")
    page.fill("#k-plan\\.duration", '"800 s"')
    page.locator("#k-plan\\.duration").blur()
    browser.until("document.getElementById('text').value.includes('duration = \"800 s\"')")
    page.fill("#k-plan\\.duration", '"900 s"')  # the button follows at once
    page.get_by_role("button", name="Plan the test").click()
    page.get_by_role("heading", name="Files").wait_for()
    browser.is_accessible()
    assert 'duration = "900 s"' in (place / "short.toml").read_text(encoding="utf-8")
    assert toml_document(place / "short-plan" / "scenario.toml")["stand"]
    assert (place / "short-plan" / "program.csv").is_file()
    browser.open("/platform?file=platform-published.toml")
    page.fill("#name", "days.toml")
    page.fill("#k-run\\.duration", '"2 h"')
    page.get_by_role("button", name="Save").click()
    page.get_by_role("link", name="days.toml").wait_for()
    former = toml_document(place / "platform-published.toml")
    former["run"]["duration"] = "2 h"
    assert toml_document(place / "days.toml") == former
    for name in ("small", "short", "days"):
        (place / f"{name}.toml").unlink()


@WIDE
def test_a_certificate_is_signed_verified_and_refused_when_it_was_changed(
    browser: Browser, place: Path
) -> None:
    page = browser.page
    made_up = place / "made-up"
    made_up.mkdir()
    budgeted(calibration(serial="tumble-a", with_residuals=False)).to_json(made_up / "calibration.json")
    key_pair(place, "lab")
    browser.open("/certificate?calibration=made-up/calibration.json")
    page.get_by_label("Also as digital certificate").check()
    page.get_by_label("Key that signs the DCC").select_option("lab-key.pem")
    page.get_by_label("X.509 certificate of the laboratory").select_option("lab-cert.pem")
    page.get_by_role("button", name="Issue").click()
    page.get_by_role("link", name="certificate.xml").wait_for()
    signed = place / "certificate-made-up" / "certificate.xml"
    forged = place / "forged.xml"
    text = signed.read_text(encoding="utf-8")
    assert text.count("Example Navigation Ltd") == 1
    forged.write_text(text.replace("Example Navigation Ltd", "Other Navigation Ltd"), encoding="utf-8")
    for name, state, words in (
        ("certificate-made-up/certificate.xml", "done", "the signature holds"),
        ("forged.xml", "failed", "does not hold"),
    ):
        browser.open("/certificate")
        page.locator("select[name=signed]").select_option(name)
        page.get_by_label("signed by").select_option("lab-cert.pem")
        page.get_by_role("button", name="Verify").click()
        page.locator(f".state.{state}").wait_for()
        page.get_by_text(words).first.wait_for()
        browser.is_accessible()
    forged.unlink()


def test_a_chinese_log_takes_six_actions(browser: Browser, place: Path, tmp_path: Path) -> None:
    page = browser.page
    log = tmp_path / "\u53f0\u67b6.csv"
    log.write_bytes(chinese_log().encode("gb18030"))
    browser.open("/")
    page.set_input_files("#file", log)  # 1: drop it; the page Describe opens
    page.wait_for_url("**/describe/*")
    browser.is_accessible()
    page.get_by_label("Nominal scale factor").fill("0.8884 rad/s/g")  # 2
    page.get_by_role("button", name="Write the run file").first.click()  # 3
    page.get_by_text("The record can be calibrated.").wait_for()
    browser.is_accessible()
    page.get_by_role("link", name="Calibrate").last.click()  # 4
    page.locator("#p-m_Z.bad").wait_for()  # before the fit: a_Y and a_Z move together here
    assert "cannot separate m_Y, m_Z" in page.inner_text("#p-m_Z")
    assert "determined, u = " in page.inner_text("#p-k2")
    browser.is_accessible()
    page.get_by_role("button", name="Calibrate").click()  # 5
    page.get_by_role("button", name="Keep this result").click()  # 6
    page.get_by_text("Kept results lie in").wait_for()
    from piga.records import Calibration

    (path,) = place.glob("\u53f0\u67b6*-calibration/calibration.json")
    result = {c.key: c for c in Calibration.from_json(path).coefficients}
    for key, true in CHINESE_TRUTH.items():
        assert abs(result[key].value - true) < 3.0 * result[key].std, key
    shutil.rmtree(path.parent)
    for part in place.glob("\u53f0\u67b6*"):
        part.unlink()


CHINESE_TRUTH = {"scale_factor": 0.8884 * 1.0007, "tan_beta": 4e-3, "k0": 3.1e-4}


def chinese_log() -> str:
    """Eight positions: preamble, Chinese names, a units row, decimal commas, a 16-bit counter that wraps, a gap.

    The motion is integrated here by Runge and Kutta's rule; piga has no part in it.
    """
    import numpy as np

    K, tan_beta, k0 = CHINESE_TRUTH.values()
    text = "\u6d4b\u8bd5\u53f0;\u5206\u5ea6\u5934\n\u65f6\u95f4;\u8109\u51b2\u8ba1\u6570;\u4f4d\u7f6e"
    text += ";X\u8f74\u6bd4\u529b;Y\u8f74\u6bd4\u529b;Z\u8f74\u6bd4\u529b;\u6e29\u5ea6\n"
    text += "s;\u8109\u51b2;-;g;g;g;\u2103\n"
    rng, alpha, t, step = np.random.default_rng(1), 0.7, 0.0, 0.1
    for position in range(8):
        angle = math.radians(45.0 * position + (11.0 if position % 2 else 0.0))
        f = (math.cos(angle), 0.8 * math.sin(angle), 0.6 * math.sin(angle))

        def rate(a: float, f: tuple[float, float, float] = f) -> float:
            return K * (k0 + f[0] + tan_beta * (f[1] * math.sin(a) - f[2] * math.cos(a)))

        for row in range(600):
            count = int(alpha / (2.0 * math.pi) * 72000 + 0.2 * rng.standard_normal()) % 65536
            cells = (
                f"{t:.1f}",
                str(count),
                str(position + 1),
                *(f"{x:.9f}" for x in f),
                f"{20.0 + t / 6000.0:.3f}",
            )
            if not (position == 3 and 200 <= row < 260):
                text += ";".join(cells).replace(".", ",") + "\n"
            one = rate(alpha)
            two = rate(alpha + 0.5 * step * one)
            three = rate(alpha + 0.5 * step * two)
            alpha += step / 6.0 * (one + 2.0 * two + 2.0 * three + rate(alpha + step * three))
            t += step
        alpha, t = alpha + 15.0 * rate(alpha), t + 15.0
    return text


def german_log() -> str:
    """Eight positions of a dividing head as a spreadsheet writes them: preamble, units, decimal commas."""
    text = "Pr\u00fcfstand 3;Teilkopf\nBediener;M\u00fcller\nZeit;Z\u00e4hlerstand;Position;fx;fy;fz\ns;-;-;g;g;g\n"
    t = n = 0.0
    for position in range(8):
        a = math.radians(45 * position)
        for _ in range(600):
            row = (f"{t:.2f}", str(int(n)), str(position), f"{math.cos(a):.9f}", f"{math.sin(a):.9f}", "0.0")
            text += ";".join(row).replace(".", ",") + "\n"
            n += 0.8884 * (math.cos(a) + 3e-4) * 0.05 * 72000 / (2 * math.pi)
            t += 0.05
        t += 30.0
    return text


def test_form_and_text_of_a_run_file_follow_each_other(browser: Browser, place: Path) -> None:
    page = browser.page
    (place / "form.toml").write_text((place / "tumble-a.toml").read_text(encoding="utf-8"), encoding="utf-8")
    browser.open("/describe/form.toml")
    browser.is_accessible()
    page.fill("#k-instrument\\.serial", '"G-7"')
    page.locator("#k-instrument\\.serial").blur()
    browser.until("document.getElementById('text').value.includes('serial = \"G-7\"')")
    text = page.input_value("#text")
    page.fill("#text", text.replace('"G-7"', '"G-8"'))
    page.locator("#text").blur()
    browser.until("document.getElementById('k-instrument.serial').value === '\"G-8\"'")
    page.fill("#text", "[instrument")
    page.locator("#text").blur()
    page.get_by_text("the form follows then").wait_for()
    page.fill("#text", text)
    page.locator("#text").blur()
    page.locator("#k-instrument\\.serial").wait_for()
    page.get_by_role("button", name="Save and check").click()
    page.get_by_role("link", name="See its signals").wait_for()
    assert 'serial = "G-7"' in (place / "form.toml").read_text(encoding="utf-8")
    (place / "form.toml").unlink()
