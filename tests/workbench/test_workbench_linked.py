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
    .map(trace => ({ x: trace.x.filter((_, k) => trace.y[k] !== null), y: trace.y.filter(y => y !== null) }))"""


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


def test_a_segment_is_selected_everywhere(browser: Browser, place: Path, running: Any) -> None:
    import pyarrow.parquet as pq

    client, name, page = running.client, "tumble-a.toml?term=scale_factor&term=tan_beta&term=k0", browser.page
    answer = client.until(f"/record/{name}", lambda text: "Full report" in text)
    key = re.search('name="key" value="([^"]+)"', answer)[1]  # type: ignore[index]
    assert client.post("/keep/tumble-a.toml", {"key": key})[0] == 303
    residuals = pq.read_table(place / "tumble-a-calibration" / "residuals.parquet").to_pandas()
    own = residuals[residuals["segment"].astype(int) == 3]
    browser.open("/kept/tumble-a-calibration")
    page.frame_locator("iframe").get_by_role("heading", name="Calibration of tumble-a").wait_for()
    frame = next(part for part in page.frames if part != page.main_frame)

    # By keyboard, in the table of segments
    button = frame.locator("#segments ~ .table tr[data-segment='3'] button")
    button.focus()
    page.keyboard.press("Enter")
    assert button.get_attribute("aria-pressed") == "true"
    assert frame.locator("tr.selected").count() == frame.locator("tr[data-segment='3']").count() >= 2
    begin = residuals["t"].min()
    for part in selected(frame, "residual-time", 2):  # extremes are drawn, not every sample
        assert min(part["x"]) == pytest.approx(own["t"].min() - begin, abs=2.0)
        assert max(part["x"]) == pytest.approx(own["t"].max() - begin, abs=2.0)
    rms = np.sqrt((own[["before", "after"]] ** 2).mean()) * 648000.0 / np.pi
    for part, value in zip(selected(frame, "segment-rms", 2), rms, strict=True):
        assert part["y"] == pytest.approx([value], rel=1e-4)

    # In a figure: the point of another segment; then none
    index, other = frame.evaluate(
        """() => { const { meta } = document.querySelector('#segment-rms .live').data[1];
           const at = meta.findIndex(segment => segment !== 3); return [at, meta[at]]; }"""
    )
    frame.locator("#segment-rms .trace.scatter").nth(1).locator("path.point").nth(index).click(force=True)
    wait_until(lambda: frame.locator("#chosen").input_value() == str(other))
    page.keyboard.press("Escape")
    selected(frame, "residual-time", 0)
    assert frame.locator("tr.selected").count() == 0
