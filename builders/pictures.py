"""Pictures of the product in README and docs: ``python -m builders.pictures [report] [workbench] [gallery] [twin] [coverage]``.

``report``: the top of the demo's report. Its numbers stand in ``report.json`` beside it, with the digest of the picture. A new
picture is taken where the product gives other numbers; ``--anew`` takes it in any case. ``workbench``: the path of the main job
on the shipped record. Both need Chromium. ``gallery``, ``twin``: figures by the report's own functions.
``coverage``: the intervals by scenario, from ``docs/measured``.
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import io
import json
import math
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from benchmarks.measured import ROOT, load

import piga
from piga.reports.calibration.page import figures
from piga.reports.calibration.page import page as calibration_page
from piga.reports.render.axes import write_figure
from piga.reports.render.figure import Figure, Plot, axis
from piga.reports.render.page import Table
from piga.units import ARCSEC, G0

if TYPE_CHECKING:
    from playwright.sync_api import Page

IMAGES, FIGURES = ROOT / "docs" / "images", ROOT / "docs" / "figures"
REPORT = IMAGES / "report.png"


@contextmanager
def window(width: int, height: int) -> Iterator[Page]:
    """A window of Chromium."""
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        sys.exit("no Chromium on the path to take a picture with")
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": width, "height": height}, color_scheme="light")
        page.set_default_timeout(120_000)
        yield page
        browser.close()


def take(page: Page, out: Path) -> None:
    """What the window shows, as a PNG of 256 colours."""
    from PIL import Image

    picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    picture.quantize(256, Image.Quantize.MAXCOVERAGE).save(out, optimize=True)


def numbers(calibration: Path) -> dict[str, Any]:
    """Verdict, tiles and coefficients in words, as the top of the report shows them."""
    page = calibration_page(piga.Calibration.from_json(calibration))
    blocks = next(section.blocks for section in page.sections if section.anchor == "coefficients")
    table = next(block for block in blocks if isinstance(block, Table))
    return {
        "verdict": page.judgement.headline if page.judgement else "",
        "tiles": [[tile.label, tile.value, tile.unit] for tile in page.tiles],
        "coefficients": [[cell.text for cell in row] for row in table.cells],
    }


def kept() -> dict[str, Any]:
    """The numbers beside the picture of the report; none if they describe another picture."""
    shown: dict[str, Any] = json.loads(REPORT.with_suffix(".json").read_text(encoding="utf-8"))
    same = shown.pop("picture") == hashlib.sha256(REPORT.read_bytes()).hexdigest()
    return shown if same else {}


def report(anew: bool) -> None:
    """Compare the picture of the report with the demo; take a new one if it shows other numbers."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-m", "piga", "demo", "--out", folder], check=True)
        now = numbers(Path(folder) / "calibration.json")
        if kept() == now and not anew:
            return
        with window(1000, 1480) as page:
            page.goto((Path(folder) / "report.html").as_uri())
            page.wait_for_timeout(3000)
            take(page, REPORT)
    text = json.dumps(
        {"picture": hashlib.sha256(REPORT.read_bytes()).hexdigest(), **now}, ensure_ascii=False, indent=1
    )
    REPORT.with_suffix(".json").write_text(text + "\n", encoding="utf-8")


def workbench() -> None:
    """The workbench with the shipped record: the result, a certificate, a foreign log."""
    with tempfile.TemporaryDirectory(prefix="tests-") as name:
        folder = Path(name) / "stand-3"
        folder.mkdir()
        data = ROOT / "src" / "piga" / "data"
        (folder / "tumble-a.csv").write_bytes(gzip.decompress((data / "tumble-a.csv.gz").read_bytes()))
        shutil.copy(data / "tumble-a.toml", folder)
        shutil.copy(ROOT / "tests" / "data" / "logs" / "german.csv", folder / "foreign.csv")
        command = [sys.executable, "-m", "piga", "ui", str(folder), "--no-browser"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
            address = re.findall(r"http\S+", server.stdout.readline() if server.stdout else "")[0]
            home = address.partition("/?")[0]
            try:
                with window(1300, 900) as page:
                    page.goto(address)
                    page.locator("#answer .light").wait_for()
                    page.get_by_role("button", name="Keep").click()
                    page.get_by_role("link", name="Certificate").wait_for()
                    page.locator("#answer .light").wait_for()
                    page.locator("figure.signal[data-points] canvas").first.wait_for()
                    page.wait_for_timeout(1500)
                    take(page, IMAGES / "workbench-record.png")
                    page.goto(f"{home}/certificate?of=tumble-a-calibration")
                    take(page, IMAGES / "workbench-certificate.png")
                    page.goto(f"{home}/log/foreign.csv")
                    take(page, IMAGES / "workbench-log.png")
            finally:
                server.terminate()


def gallery() -> None:
    """Lock zones, the shipped plan, ten days of the published platform, and the ripple of the shipped record."""
    from piga.reports.stand import locking_figure

    curves = (("1000 arcsec", 5 * G0), ("300 arcsec", 2 * G0))
    platform = piga.platform.load_scenario(ROOT / "examples" / "platform-published.toml")
    made = {
        "locking": locking_figure(*((piga.Instrument("0.8884 rad/s/g", beta), a_t) for beta, a_t in curves)),
        "gallery-planning": piga.plan_test(
            piga.read_plan(ROOT / "examples" / "plan-dividing-head.toml")
        ).figure(),
        "gallery-ten-days": piga.platform.compare(platform).figure(),
        "gallery-first-calibration": figures(piga.calibrate(piga.example_run()))["ripple"](),
    }
    for name, figure in made.items():
        write_figure(figure, FIGURES / f"{name}.svg")


def twin() -> None:
    """The servo twin: its loop, its start, a soft servo, loss of lock; and a triad of twins before and after compensation."""
    from tests.compensation.twin_triad import run as run_triad
    from tests.compensation.twin_triad import spectrum

    from piga.earth import Site
    from piga.instrument.electronics import Electronics
    from piga.instrument.twin import PRESETS, run_twin
    from piga.reports import stand
    from piga.stand import DividingHead, Specimen, read_scenario, run_scenario, simulate_test
    from piga.stand.write_run import run_file_text, write_data

    example = PRESETS["example"]
    save(replace(stand.bode_figure(example), key="twin-loop-bode"))
    p, t = replace(example, alpha0=0.7), np.arange(1000) * 2e-4
    runs = {
        name: run_twin(p, t, np.tile([G0, 0.5 * G0, 0.0], (t.size, 1)), start=name)
        for name in ("transient", "slow-manifold")
    }
    plot = Plot("twin-start", "Two ways to start", columns=2).panel("time [ms]", "tilt [arcsec]", "Tilt")
    for (name, motion), role in zip(runs.items(), ("before", "after"), strict=True):
        plot.line(1e3 * t, motion.beta / ARCSEC, name, role)
    plot.panel(axis("time [ms]", limits=(0.0, 40.0)), "rate/(K a_x)", "Output rate")
    for (name, motion), role in zip(runs.items(), ("before", "after"), strict=True):
        plot.line(1e3 * t[:201], motion.rate[:201] / (p.K * G0), name, role)
    save(plot.caption(""))
    head = DividingHead(Site(math.radians(40.0)), (math.pi / 4, 7 * math.pi / 4), dwell=120.0, move=5.0)
    instrument = piga.Instrument("0.8884 rad/s/g", "74 arcsec", 0.8)
    soft = Specimen(instrument, piga.ErrorModel(), twin=replace(example, integral_gain=0.0))
    test = simulate_test(head, soft, Electronics(sample_rate=20.0), model="twin")
    with tempfile.TemporaryDirectory() as folder:
        write_data(test, Path(folder) / "run.parquet")
        path = Path(folder) / "run.toml"
        path.write_text(
            run_file_text(read_scenario(ROOT / "examples" / "twin.toml"), test, "run.parquet"), "utf-8"
        )
        cal = piga.calibrate(piga.read_run(path), ["tan_beta", "k0"])
    order = figures(cal)["orders"]()
    save(replace(order, key="twin-order-two", title="A soft servo shows at order 2"))
    spun = run_scenario(read_scenario(ROOT / "examples" / "twin-spin-up.toml"))
    save(replace(stand.servo_figure(spun, spun.motion), key="twin-lock"))
    orders, outcome = np.arange(0.3, 5.01, 0.02), run_triad(120.0)
    plot = Plot(
        "compensation-triad-orders", "A triad of servo twins, before and after compensation.",
        "revolution order [cycles/rev]", "log error along the input axis [µg]", height=3.0,
    )  # fmt: skip
    for name, error in (("before", outcome.before), ("after", outcome.after), ("noise put in", outcome.noise)):
        size = spectrum(outcome.psi, error, orders) / (1e-6 * G0)
        plot.line(orders, size, name, "reference", dashed=name == "noise put in")
    save(plot.caption("Three twins on a cone, 120 s of slow swing. Order 1 is cross-coupling."))


def save(figure: Figure) -> None:
    """The figure as an SVG of the manual, named by its key."""
    write_figure(figure, FIGURES / f"{figure.key}.svg")


def coverage() -> None:
    """Coverage of the intervals by scenario."""
    import matplotlib as mpl
    from matplotlib.figure import Figure as Canvas

    rows = [
        (figure["row"], figure["value"]) for figure in load("intervals")[1] if figure["column"] == "coverage"
    ]
    drawn = Canvas(figsize=(9.0, 0.5 + 0.24 * len(rows)), layout="constrained")
    axes = drawn.subplots()
    axes.axvspan(93.0, 97.0, color="#2e7d32", alpha=0.15, lw=0)
    for k, (_, shares) in enumerate(rows):
        axes.plot(shares, [k] * len(shares), "o-", color="#0a5ea8", ms=5)
    axes.set_yticks(range(len(rows)), [row for row, _ in rows])
    axes.invert_yaxis()
    axes.grid(axis="x", alpha=0.3)
    words = "intervals that hold, worst and best coefficient [%]; green: the goal"
    drawn.supxlabel(words, fontsize=10)
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "piga", "font.size": 10}):
        drawn.savefig(FIGURES / "drawing-scenarios.svg", metadata={"Date": None})


def main() -> None:
    """Make the pictures that are named, or all."""
    pictures = {made.__name__: made for made in (workbench, gallery, twin, coverage)}
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pictures", nargs="*", choices=["report", *pictures, []], help="all when none is named")
    parser.add_argument("--anew", action="store_true")
    asked = parser.parse_args()
    for name in asked.pictures or ("report", *pictures):
        report(asked.anew) if name == "report" else pictures[name]()


if __name__ == "__main__":
    main()
