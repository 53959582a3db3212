"""The bench as a person uses it, in a real browser; no request may leave this machine."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest

from piga.records import Calibration
from tests.reports.example import calibration
from tests.workbench import logs
from tests.workbench.conftest import Browser, Server, both, entered, narrow, shipped_record, wait_until, window

pytestmark = pytest.mark.long
SCALE = "Nominal scale factor (pendulosity over angular momentum)"
COUNTS = "Counts of the output per revolution of the outer gimbal"


def answered(browser: Browser) -> str:
    """The answer of a record, once it is there."""
    browser.page.locator("#answer .light").wait_for()
    browser.until("!document.querySelector('#answer progress')")
    return str(browser.page.locator("#answer").inner_text())


def drawn(browser: Browser) -> None:
    """Wait until the picture of a record is drawn."""
    browser.until("document.querySelectorAll('figure.signal[data-points] canvas').length >= 2")


def filled(page: Any) -> None:
    """Type the example's entries where the form of a certificate misses some."""
    for entry in page.locator(".missing input, .missing textarea").all():
        entry.fill(entry.get_attribute("placeholder") or "")
    for name, choice in (("Place", "laboratory"), ("Performed", "false")):
        page.get_by_label(name, exact=True).select_option(choice)


@narrow
def test_a_strangers_log_takes_six_actions(browser: Browser, place: Path, tmp_path: Path) -> None:
    """Drop it, type scale factor and counts, go on, leave the moves out, keep: K within 2 u."""
    page = browser.page
    path = tmp_path / "Messung 7.csv"
    path.write_bytes(logs.german())
    browser.open("/")
    page.set_input_files("#file", path)  # 1
    page.wait_for_url("**/log/**")
    browser.is_accessible()
    page.get_by_label(SCALE, exact=True).fill("0,8884 rad/s/g")  # 2
    if page.get_by_label(COUNTS, exact=True).count():
        page.get_by_label(COUNTS, exact=True).fill(str(logs.COUNTS))  # 3
    page.get_by_role("button", name="Go on").click()  # 4
    page.wait_for_url("**/record/**")
    drawn(browser)
    page.get_by_role("button", name="Leave them out").click()  # 5
    browser.until("!document.querySelector('.notice.question')")
    drawn(browser)
    answered(browser)
    browser.is_accessible()
    page.get_by_role("button", name="Keep", exact=True).click()  # 6
    page.get_by_role("link", name="Certificate").wait_for()
    stem = unquote(page.url.rpartition("/")[2].partition("?")[0]).removesuffix(".toml")
    K = Calibration.from_json(place / f"{stem}-calibration" / "calibration.json")["scale_factor"]
    assert abs(K.value - logs.K) < 2.0 * K.std
    browser.open("/jobs")  # a page of the record asks for it again
    for kept in place.glob(f"{stem}*"):
        shutil.rmtree(kept) if kept.is_dir() else kept.unlink()


def test_the_first_screen_leads_to_an_answer_and_a_certificate(program: Any, tmp_path: Path) -> None:
    """From an empty folder to a certificate, as somebody who never saw it."""
    server = entered(tmp_path)
    context = window(program, server)
    browser = Browser(context, server)
    page = browser.page
    try:
        browser.open("/")
        browser.is_accessible()
        page.get_by_role("button", name="Try the shipped record").click()
        drawn(browser)
        assert "0.888506" in answered(browser)
        assert "Clear" in page.inner_text("#answer")
        browser.is_accessible()
        page.get_by_role("button", name="Keep", exact=True).click()
        command = tmp_path / ".by-command"
        command.mkdir()
        shipped_record(command)
        subprocess.run([sys.executable, "-m", "piga", "calibrate", "tumble-a.toml"], cwd=command, check=True)
        page.get_by_role("link", name="Certificate").click()
        kept, other = tmp_path / "tumble-a-calibration", command / "tumble-a-calibration"
        for file in ("calibration.json", "residuals.parquet"):
            assert _timeless(kept / file) == _timeless(other / file), file
        browser.is_accessible()
        page.get_by_text("DRAFT: 23 to settle").wait_for()
        page.get_by_role("button", name="Issue").click()
        page.locator(".missing .refusal").first.wait_for()
        browser.is_accessible()
        page.get_by_label("begin").fill("May 1")
        page.get_by_role("button", name="See the draft").click()
        page.locator(".refusal", has_text="invalid RFC3339 encoded date").wait_for()
        assert page.get_by_label("begin").input_value() == "May 1"
        page.get_by_label("begin").fill("2026-05-01")
        page.get_by_role("button", name="See the draft").click()
        frame = page.frame_locator("iframe")
        frame.get_by_text("DRAFT: not a certificate").wait_for()
        browser.open("/certificate?of=tumble-a-calibration")  # what was typed is there
        assert page.get_by_label("begin").input_value() == "2026-05-01"
        filled(page)
        page.locator("[id='laboratory.name']").fill("Our Laboratory")
        page.get_by_label("As digital certificate").select_option("yes")
        number = page.get_by_label("number").input_value()
        page.get_by_role("button", name="Issue").click()
        page.get_by_role("link", name="certificate.xml").wait_for()
        browser.is_accessible()
        document = (tmp_path / f"certificate-{number}" / "certificate.xml").read_text(encoding="utf-8")
        assert "Rubidium frequency standard" in document
        browser.open("/certificate?of=tumble-a-calibration")
        assert page.get_by_label("number").input_value() != number  # a number is used once
    finally:
        context.close()
        assert server.end() == (0, "")
    assert not browser.faults, browser.faults


def _timeless(path: Path) -> bytes:
    """A result without the time at which it was made."""
    raw = path.read_bytes()
    return re.sub(rb'"created": "[^"]*"', b"", raw) if path.suffix == ".json" else raw


def test_keep_keep_another_compare_undo(browser: Browser, place: Path) -> None:
    page = browser.page
    browser.open("/record/tumble-a.toml?term=scale_factor&term=tan_beta&term=k0")
    before = len(list(place.glob("tumble-a-calibration*")))
    answered(browser)
    page.get_by_role("button", name="Keep", exact=True).click()
    wait_until(lambda: len(list(place.glob("tumble-a-calibration*"))) == before + 1)
    answered(browser)
    page.get_by_text("second-order coefficient (a_x^2)").click()  # a term follows by itself
    browser.until("document.querySelector('#answer .coefficients')?.textContent.includes('k2')")
    browser.until("location.search.includes('k2')")
    assert "was " in page.inner_text("#answer")
    page.reload()  # nothing is lost
    browser.until("document.querySelector('#answer .coefficients')?.textContent.includes('k2')")
    page.get_by_role("button", name="Keep", exact=True).click()
    wait_until(lambda: len(list(place.glob("tumble-a-calibration*"))) == before + 2)
    page.wait_for_load_state()
    browser.is_accessible()
    for box in page.locator("input[name=of]").all()[:2]:
        box.check()
    page.get_by_role("button", name="Compare two").click()
    page.get_by_role("heading", name="Two results side by side").wait_for()
    browser.is_accessible()
    for left in (before + 1, before):
        page.get_by_role("button", name="Undo").click()
        wait_until(lambda left=left: len(list(place.glob("tumble-a-calibration*"))) == left)
        page.wait_for_load_state()


def test_leave_out_by_mouse_and_undo(browser: Browser, place: Path) -> None:
    page = browser.page
    shutil.copy(place / "tumble-a.toml", place / "marked.toml")
    first = (place / "marked.toml").read_bytes()
    browser.open("/record/marked.toml")
    drawn(browser)
    page.get_by_role("button", name="Mark a span").click()
    page.locator(".u-over").first.scroll_into_view_if_needed()
    box = page.locator(".u-over").first.bounding_box()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 40)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.55 * box["width"], box["y"] + 40, steps=5)
    page.mouse.up()
    page.get_by_label("because").fill('the door "slammed"')
    browser.is_accessible()
    page.get_by_role("button", name="Leave out").click()
    page.get_by_text('the door "slammed"').first.wait_for()
    assert b"leave_out" in (place / "marked.toml").read_bytes()
    drawn(browser)
    page.get_by_role("button", name="Undo").click()
    wait_until(lambda: (place / "marked.toml").read_bytes() == first)
    browser.open("/jobs")  # a page of the record asks for it again
    (place / "marked.toml").unlink()


def test_the_second_of_two_tabs_is_told_what_changed(browser: Browser, place: Path) -> None:
    page = browser.page
    shutil.copy(place / "tumble-a.toml", place / "tabs.toml")
    browser.open("/text?file=tabs.toml")
    text = page.input_value("#text")
    (place / "tabs.toml").write_text(text.replace('"tumble-a"', '"G-7"', 1), encoding="utf-8")
    page.fill("#text", text.replace("72000", "36000"))
    page.get_by_role("button", name="Save", exact=True).click()
    page.get_by_role("heading", name="changed meanwhile").wait_for()
    assert '+serial = "G-7"' in page.inner_text("pre")
    assert "36000" not in (place / "tabs.toml").read_text(encoding="utf-8")
    browser.is_accessible()
    page.get_by_role("button", name="Back to what I typed").click()
    browser.until("document.getElementById('text')?.value.includes('36000')")
    (place / "tabs.toml").unlink()


def test_a_lost_server_is_said_and_found_again(program: Any, tmp_path: Path) -> None:
    shipped_record(tmp_path)
    server = entered(tmp_path)
    context = window(program, server)
    page = context.new_page()
    page.set_default_timeout(120_000)
    page.goto(f"{server.client.home}/record/tumble-a.toml")
    page.locator("#answer .light").wait_for()
    server.process.kill()
    server.process.communicate()
    page.get_by_text("The server does not answer").wait_for()
    again = Server(tmp_path, "--port", str(server.client.port))
    page.get_by_text("The server does not answer").wait_for(state="hidden")
    page.locator("#answer .light").wait_for()
    context.close()
    assert again.end() == (0, "")


@both
def test_every_other_page_is_clean(browser: Browser, place: Path) -> None:
    page = browser.page
    made_up = place / "made-up-calibration"
    made_up.mkdir()
    calibration(serial="tumble-a", with_residuals=False).to_json(made_up / "calibration.json")
    browser.open("/certificate?of=made-up-calibration")
    browser.is_accessible()
    shutil.rmtree(made_up)
    for path in ("/text", "/text?file=twin.toml", "/text?example=plan-dividing-head.toml", "/jobs", "/explore"):
        browser.open(path)
        browser.is_accessible()
    page.frame_locator("iframe").get_by_text("locked", exact=True).first.wait_for()
    page.get_by_label("Specific force along the input axis", exact=True).fill("1 g")
    page.get_by_role("button", name="Explore").click()
    page.frame_locator("iframe").get_by_text("running", exact=True).first.wait_for()
    page.get_by_label("Time shown", exact=True).fill("50")
    page.get_by_role("button", name="Explore").click()
    page.locator(".refusal", has_text="unit is missing").wait_for()
    browser.is_accessible()
    page.emulate_media(media="print")
    browser.open("/record/tumble-a.toml")
    drawn(browser)
    answered(browser)
    assert not page.get_by_role("button", name="Keep", exact=True).is_visible()


@narrow
def test_a_plan_is_made_and_a_record_compensated(browser: Browser, place: Path) -> None:
    page = browser.page
    browser.open("/record/tumble-a.toml")
    answered(browser)
    page.get_by_role("button", name="Keep", exact=True).click()
    page.get_by_role("link", name="Compensate", exact=True).wait_for()  # the page of the kept answer
    answered(browser)
    page.get_by_role("link", name="Compensate", exact=True).click()
    browser.is_accessible()
    page.get_by_label("Phase of the output zero, if it is known", exact=True).fill("-0.0003 rad")
    page.get_by_role("button", name="Compensate").click()
    page.get_by_role("link", name="tumble-a-compensated.parquet").wait_for()
    page.locator("code", has_text="--phase=-0.0003 rad").wait_for()
    browser.is_accessible()
    browser.open("/plan?of=tumble-a-calibration")
    page.get_by_label("Time at the stand", exact=True).fill("2130")
    page.get_by_role("button", name="Plan the test").click()
    page.locator(".refusal", has_text="unit is missing").wait_for()
    page.get_by_label("Time at the stand", exact=True).fill("2130 s")
    page.get_by_role("button", name="Plan the test").click()
    page.get_by_role("link", name="program.csv").wait_for()
    browser.is_accessible()
