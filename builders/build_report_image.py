"""Picture of the report in README and docs: run ``python -m builders.build_report_image`` from the repository root.

Runs the demo. What the picture shows (verdict, tiles, coefficients) stands in ``report.json`` beside it, with the
digest of the picture. Where these are not what the product gives now, the report is photographed anew with Chromium;
without a browser this ends with an error. ``--anew`` takes the picture in any case.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from PIL import Image

from piga.records.calibration.calibration import Calibration
from piga.reports.calibration.page import page as calibration_page
from piga.reports.render.page import Page, Table

OUT = Path(__file__).parents[1] / "docs" / "images" / "report.png"
SIZE = (1000, 1480)
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def demo(folder: Path) -> Path:
    """Run the demo; its folder."""
    subprocess.run([sys.executable, "-m", "piga", "demo", "--out", str(folder)], check=True)
    return folder


def shown(page: Page) -> dict[str, Any]:
    """The numbers in words, as the top of the page shows them."""
    coefficients = next(section for section in page.sections if section.anchor == "coefficients")
    table = next(block for block in coefficients.blocks if isinstance(block, Table))
    return {
        "verdict": page.judgement.headline if page.judgement else "",
        "tiles": [[tile.label, tile.value, tile.unit] for tile in page.tiles],
        "coefficients": [[cell.text for cell in row] for row in table.cells],
    }


def numbers_file(picture: Path) -> Path:
    """Where the numbers of a picture stand."""
    return picture.with_suffix(".json")


def stale(picture: Path, now: dict[str, Any]) -> str:
    """In which respect a picture is not of these numbers; empty when it is."""
    try:
        kept = json.loads(numbers_file(picture).read_text(encoding="utf-8"))
        digest = hashlib.sha256(picture.read_bytes()).hexdigest()
    except FileNotFoundError as error:
        return f"{Path(error.filename).name} is missing"
    if kept.get("picture") != digest:
        return f"{picture.name} is not the picture that {numbers_file(picture).name} describes"
    parts = [name for name, value in now.items() if kept.get(name) != value]
    return f"other {', '.join(parts)} than the product's" if parts else ""


def photograph(report: Path, out: Path, browser: str) -> None:
    """The top of the page, as a PNG of 256 colours."""
    with tempfile.TemporaryDirectory() as folder:
        raw = Path(folder) / "raw.png"
        options = ["--headless", "--no-sandbox", "--hide-scrollbars", f"--screenshot={raw}"]
        options += [f"--user-data-dir={folder}/profile", "--disable-background-networking", "--no-first-run"]
        options += [f"--window-size={SIZE[0]},{SIZE[1]}", "--virtual-time-budget=10000"]
        subprocess.run([browser, *options, report.resolve().as_uri()], check=True, timeout=300)
        Image.open(raw).convert("RGB").quantize(256).save(out, optimize=True)


def renew(results: Path, picture: Path, *, anew: bool = False) -> str:
    """Bring a picture up to date with the results of the demo; says what was done.

    Raises
    ------
    SystemExit
        If the picture shows other numbers and there is no browser to take a new one.
    """
    now = shown(calibration_page(Calibration.from_json(results / "calibration.json")))
    reason = stale(picture, now)
    if not reason and not anew:
        return f"{picture.name} shows the product's numbers"
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise SystemExit(
            f"{picture}: {reason or 'a new picture is wanted'}; no Chromium on the path to take a new one"
        )
    photograph(results / "report.html", picture, browser)
    kept = {"picture": hashlib.sha256(picture.read_bytes()).hexdigest(), **now}
    numbers_file(picture).write_text(json.dumps(kept, ensure_ascii=False, indent=1) + "\n", encoding="utf-8")
    return f"took {picture.name} ({reason or 'as asked'})"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--anew", action="store_true")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        print(renew(demo(Path(scratch) / "demo"), OUT, anew=asked.anew))
