"""A selected segment of a result is selected in all its figures and tables."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.workbench.conftest import Browser, wait_until

pytestmark = pytest.mark.long
SELECTED = """key => document.getElementById(key).querySelector('.live').data
    .filter(trace => trace.uid.endsWith('-selected'))
    .map(trace => ({ name: trace.name, x: trace.x.filter((_, k) => trace.y[k] !== null), y: trace.y.filter(y => y !== null) }))"""


def selected(frame: Any, key: str, count: int) -> list[dict[str, Any]]:
    """The marked parts of a figure, once there are ``count``."""
    frame.locator(f"#{key}").scroll_into_view_if_needed()
    frame.locator(f"#{key}.upgraded .main-svg").first.wait_for()
    limit = time.monotonic() + 120.0
    while True:
        found: list[dict[str, Any]] = frame.evaluate(SELECTED, key)
        if len(found) == count:
            return found
        assert time.monotonic() < limit, (key, found)
        time.sleep(0.05)


@pytest.fixture(scope="module")
def report(place: Path, running: Any) -> tuple[str, Any]:
    """Path of a result's page, and its residuals."""
    import pyarrow.parquet as pq

    client, name = running.client, "tumble-a.toml?term=scale_factor&term=tan_beta&term=k0"
    answer = client.until(f"/record/{name}", lambda text: "Full report" in text)
    key = re.search('name="key" value="([^"]+)"', answer)[1]  # type: ignore[index]
    assert client.post("/keep/tumble-a.toml", {"key": key})[0] == 303
    residuals = pq.read_table(place / "tumble-a-calibration" / "residuals.parquet").to_pandas()
    return "/kept/tumble-a-calibration", residuals.astype({"segment": int})


def test_a_segment_is_selected_everywhere(browser: Browser, report: tuple[str, Any]) -> None:
    path, residuals = report
    page = browser.page
    browser.open(path)
    page.frame_locator("iframe").get_by_role("heading", name="Calibration of tumble-a").wait_for()
    frame = next(part for part in page.frames if part != page.main_frame)

    # By keyboard, in the table of segments
    button = frame.locator("#segments ~ .table tr[data-segment='3'] button")
    button.focus()
    page.keyboard.press("Enter")
    assert button.get_attribute("aria-pressed") == "true"
    assert frame.locator("#chosen").input_value() == "3"
    assert frame.locator("tr.selected").count() == frame.locator("tr[data-segment='3']").count() >= 2
    own = residuals[residuals["segment"] == 3]
    first, last = own["t"].min() - residuals["t"].min(), own["t"].max() - residuals["t"].min()
    for part in selected(frame, "residual-time", 2):
        assert part["name"] == "segment 3"
        assert min(part["x"]) == pytest.approx(first, abs=2.0)  # extremes are drawn, not every sample
        assert max(part["x"]) == pytest.approx(last, abs=2.0)
    rms = np.sqrt((own[["before", "after"]] ** 2).mean()) * 648000.0 / np.pi
    places = selected(frame, "segment-rms", 2)
    for part, value in zip(places, rms, strict=True):
        assert part["x"] == pytest.approx([own["a_x"].mean() / 9.80665], abs=1e-5)
        assert part["y"] == pytest.approx([value], rel=1e-4)
    (allan,) = selected(frame, "allan", 1)
    angle, step = own["after"].to_numpy() * 648000.0 / np.pi, np.median(np.diff(own["t"]))
    second = angle[2:] - 2.0 * angle[1:-1] + angle[:-2]
    assert allan["y"][0] == pytest.approx(np.sqrt(np.mean(second**2) / 2.0) / step, rel=1e-4)
    selected(frame, "residual-order", 1)
    for key in ("ripple", "whiteness"):  # these are of all segments together
        selected(frame, key, 0)

    # In a figure: the point of another segment
    selected(frame, "segment-rms", 2)
    index, other = frame.evaluate(
        """() => { const { meta } = document.querySelector('#segment-rms .live').data[1];
           const at = meta.findIndex(segment => segment !== 3); return [at, meta[at]]; }"""
    )
    frame.locator("#segment-rms .trace.scatter").nth(1).locator("path.point").nth(index).click(force=True)
    wait_until(lambda: frame.locator("#chosen").input_value() == str(other))
    assert frame.locator("tr.selected").first.get_attribute("data-segment") == str(other)
    assert button.get_attribute("aria-pressed") == "false"
    again = residuals[residuals["segment"] == other]
    assert selected(frame, "residual-time", 2)[0]["x"][0] == pytest.approx(
        again["t"].min() - residuals["t"].min(), abs=0.01
    )

    # In the list: segment 7 turns twice only, so it has no spectrum of its own; then none
    frame.locator("#chosen").select_option("7")
    selected(frame, "residual-order", 0)
    selected(frame, "allan", 1)
    frame.locator("#chosen").select_option("0")
    assert selected(frame, "residual-time", 2)[0]["x"][0] == pytest.approx(0.0, abs=0.01)
    page.keyboard.press("Escape")
    selected(frame, "residual-time", 0)
    assert frame.locator("tr.selected").count() == 0
    assert frame.locator("#chosen").input_value() == ""
