"""Picture of the report in README and docs: run ``python -m builders.build_report_image`` from the repository root.

Runs the demo and photographs its report with Chromium (``chromium`` on the path); ``--report FILE`` takes a report that
is there already.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

OUT = Path(__file__).parents[1] / "docs" / "images" / "report.png"
SIZE = (1000, 1480)


def demo(folder: Path) -> Path:
    """The report of the demo."""
    subprocess.run([sys.executable, "-m", "piga", "demo", "--out", str(folder)], check=True)
    return folder / "report.html"


def photograph(report: Path, out: Path) -> None:
    """The top of the page, as a PNG of 256 colours."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        raise SystemExit("no Chromium on the path")
    with tempfile.TemporaryDirectory() as folder:
        raw = Path(folder) / "raw.png"
        options = ["--headless", "--no-sandbox", "--hide-scrollbars", f"--screenshot={raw}"]
        options += [f"--window-size={SIZE[0]},{SIZE[1]}", "--virtual-time-budget=10000"]
        subprocess.run([browser, *options, report.resolve().as_uri()], check=True, timeout=300)
        Image.open(raw).convert("RGB").quantize(256).save(out, optimize=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--report", type=Path, default=None)
    given = parser.parse_args().report
    with tempfile.TemporaryDirectory() as scratch:
        photograph(given or demo(Path(scratch)), OUT)
