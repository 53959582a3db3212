"""Screenshots of the workbench for README and docs: ``python -m builders.build_workbench_images [--chromium PATH]``.

Needs the packages of the tests and a Chromium on this machine. It goes the path of the main job on the shipped record,
as ``tests/workbench/test_workbench_browser.py`` does.
"""

from __future__ import annotations

import argparse
import gzip
import io
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

ROOT = Path(__file__).resolve().parent.parent
IMAGES = ROOT / "docs" / "images"
SIZE = {"width": 1300, "height": 900}


def take(page: Page, name: str) -> None:
    """What the window shows, as a PNG of 256 colours."""
    picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE)
    picture.save(IMAGES / f"{name}.png", optimize=True)


def main() -> None:
    """Take the pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--chromium", default=shutil.which("chromium") or "chromium")
    chromium = parser.parse_args().chromium
    with tempfile.TemporaryDirectory(prefix="tests-") as name:
        folder = Path(name) / "stand-3"
        folder.mkdir()
        data = ROOT / "src" / "piga" / "data"
        (folder / "tumble-a.csv").write_bytes(gzip.decompress((data / "tumble-a.csv.gz").read_bytes()))
        shutil.copy(data / "tumble-a.toml", folder)
        shutil.copy(ROOT / "tests" / "data" / "logs" / "german.csv", folder / "foreign.csv")
        server = subprocess.Popen(
            [sys.executable, "-m", "piga", "ui", str(folder), "--no-browser"], stdout=subprocess.PIPE, text=True
        )
        assert server.stdout is not None
        address = re.search(r"http\S+", server.stdout.readline())
        assert address is not None
        home = address[0].partition("/?")[0]
        try:
            with sync_playwright() as play:
                browser = play.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
                page = browser.new_page(viewport=SIZE, color_scheme="light")
                page.set_default_timeout(120_000)
                page.goto(address[0])
                page.locator("#answer .light").wait_for()
                page.get_by_role("button", name="Keep").click()
                page.get_by_role("link", name="Certificate").wait_for()
                page.locator("#answer .light").wait_for()
                page.locator("figure.signal[data-points] canvas").first.wait_for()
                page.wait_for_timeout(1500)
                take(page, "workbench-record")
                page.goto(f"{home}/certificate?of=tumble-a-calibration")
                take(page, "workbench-certificate")
                page.goto(f"{home}/log/foreign.csv")
                take(page, "workbench-log")
                browser.close()
        finally:
            server.terminate()
            server.wait(timeout=60)


if __name__ == "__main__":
    main()
