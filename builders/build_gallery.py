"""docs/figures/gallery-*.svg and locking.svg: pictures of the pages, drawn by the report's own functions.

Run ``python builders/build_gallery.py`` after a change of a page or a figure.
"""

from __future__ import annotations

from pathlib import Path

import piga
from piga.reports import write_figure
from piga.reports.calibration.page import figures
from piga.reports.stand import locking_figure
from piga.units import ARCSEC, G0

ROOT = Path(__file__).parents[1]


def main() -> None:
    """Draw lock zones, the shipped plan, ten days of the published platform, and the ripple of the shipped record."""
    examples = ROOT / "examples"
    inst = piga.Instrument(scale_factor="0.8884 rad/s/g", beta="1000 arcsec")
    made = {
        "locking": locking_figure(inst, (5 * G0, 2 * G0), (1000 * ARCSEC, 300 * ARCSEC)),
        "gallery-planning": piga.plan_test(piga.read_plan(examples / "plan-dividing-head.toml")).figure(),
        "gallery-ten-days": piga.platform.compare(
            piga.platform.load_scenario(examples / "platform-published.toml")
        ).figure(),
        "gallery-first-calibration": figures(piga.calibrate(piga.example_run()))["ripple"](),
    }
    for name, figure in made.items():
        target = ROOT / "docs" / "figures" / f"{name}.svg"
        write_figure(figure, target)
        print(f"wrote {target.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
