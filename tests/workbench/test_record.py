"""The answer: two pages with other terms, and what must not be kept."""

from __future__ import annotations

import re
import time
from pathlib import Path

import pytest

from piga.workbench import jobs as room
from piga.workbench.jobs import Jobs
from tests.workbench.conftest import Client, shipped_record

NAME, TERMS = "tumble-a.toml", ("scale_factor", "tan_beta", "k0")
pytestmark = pytest.mark.long


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
