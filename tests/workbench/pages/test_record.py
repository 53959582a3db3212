"""The answer: the thinned copy first, two pages with other terms, and what must not be kept."""

from __future__ import annotations

import re
import shutil
import time
from pathlib import Path
from typing import Any

import pytest

import piga
from piga.records.run_file import read_run_file
from piga.workbench import jobs as room
from piga.workbench import signals
from piga.workbench.folder import Folder
from piga.workbench.jobs import Jobs
from piga.workbench.pages.common import Bench
from piga.workbench.pages.record import _cache_of, _fitted
from tests.workbench.conftest import Client, shipped_record, wait_until

NAME, TERMS = "tumble-a.toml", ("scale_factor", "tan_beta", "k0")
pytestmark = pytest.mark.long


def test_the_thinned_copy_is_answered_first_and_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signals, "LONG", 1000)
    run = shipped_record(tmp_path)
    bench = Bench(Folder(tmp_path))
    jobs = bench.jobs
    cache = _cache_of(bench, NAME)
    monkeypatch.setattr(signals, "THINNED", 5000)
    outline = signals.write_envelopes(piga.read_run(run), read_run_file(run), cache)
    assert outline.thinned == 5

    def asked() -> Any:
        return _fitted(bench, NAME, "key", TERMS, outline)

    def ended(job: Any) -> bool:
        return job.state != "running"

    try:
        _, _, job = asked()
        assert job.command[1].endswith("thinned.toml")
        jobs.stop(job)
        assert asked()[2] == job  # what was stopped is not followed by the longer fit
        jobs.forget(job)
        _, _, job = asked()
        wait_until(lambda: ended(job))
        thinned, every, whole = asked()
        assert every == 5
        assert thinned.calibration["scale_factor"].std > 0.0
        assert whole.command[1] == NAME
        wait_until(lambda: ended(whole))
        _, every, none = asked()
        assert (every, none) == (1, None)
        place = tmp_path / ".piga-ui" / "trials"
        assert (place / "key" / "report.html").is_file()
        shutil.rmtree(place)
        for job in jobs.all():
            jobs.forget(job)
        (cache / "thinned.toml").write_text("nothing", encoding="utf-8")
        _, _, job = asked()
        wait_until(lambda: ended(job))
        assert asked()[2].command[1] == NAME  # a thinned copy that cannot be fitted is no reason to wait
    finally:
        jobs.stop_all()


def test_two_tabs_with_other_terms_are_both_answered(client: Client) -> None:
    """Neither stops the fit of the other while its page asks."""
    client.until(f"/record/{NAME}", lambda text: "data-drawn" in text)
    pages = [f"/record/{NAME}?term=scale_factor&term={term}" for term in ("k2", "k3")]
    keys = [re.search(r'hx-get="/jobs/([^/"]+)/progress"', client.page(page))[1] for page in pages]  # type: ignore[index]
    assert keys[0] != keys[1]
    limit = time.monotonic() + 120.0
    while b"".join(client.ask(f"/jobs/{key}/progress")[2] for key in keys):
        assert time.monotonic() < limit
        time.sleep(0.2)
    assert all("Full report" in client.page(page) for page in pages)


def test_a_fit_that_no_page_asks_for_ends_and_comes_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped_record(tmp_path)
    jobs = Jobs(tmp_path)
    try:
        left, shown, other = (
            jobs.start(("calibrate", NAME, "--out", place), room.FIT, subject, place)
            for place, subject in (("a", NAME), ("b", NAME), ("c", "other.toml"))
        )
        left.asked = other.asked = time.time() - room.LAPSE - 1.0
        jobs.attend(shown)
        assert (left.was_stopped, shown.was_stopped, other.was_stopped) == (True, False, False)
        assert jobs.latest(NAME, "a") is None  # the page that comes back starts it anew
    finally:
        jobs.stop_all()


def test_what_must_not_be_used_is_not_kept(client: Client, lab: Path) -> None:
    text = (lab / NAME).read_text(encoding="utf-8")
    (lab / "nine.toml").write_text(text.replace("0.8884 rad/s/g", "0.0987 rad/s/g"), encoding="utf-8")
    page = client.until("/record/nine.toml", lambda text: 'class="light' in text)
    assert 'class="light red"' in page
    assert "times the nominal" in page
    key = re.search(r'name="key" value="([^"]+)"', page)[1]  # type: ignore[index]
    status, _, body = client.post("/keep/nine.toml", {"key": key})
    assert (status, b"cannot be kept" in body) == (422, True)
    assert not (lab / "nine-calibration").exists()
    (lab / "nine.toml").unlink()


def test_a_pair_of_terms_needs_both(client: Client) -> None:
    """The boxes stay, and the answer says what is wrong."""
    client.until(f"/record/{NAME}", lambda text: "data-drawn" in text)
    page = client.page(f"/record/{NAME}?term=scale_factor&term=s1")
    assert "No answer" in page
    assert 'value="c1"' in page or "c1" in page
