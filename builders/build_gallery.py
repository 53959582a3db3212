"""docs/figures/gallery-*.svg: pictures of the how-tos, drawn by the report's own functions.

Run ``python builders/build_gallery.py`` after a change of a page or a figure.
"""

from __future__ import annotations

from pathlib import Path

import piga
from piga.reports import write_figure
from piga.reports.calibration.page import figures

ROOT = Path(__file__).parents[1]


def main() -> None:
    """The shipped plan, the ten days of the published platform, and the ripple of the shipped record."""
    examples = ROOT / "examples"
    made = {
        "planning": piga.plan_test(piga.read_plan(examples / "plan-dividing-head.toml")).figure(),
        "ten-days": piga.platform.compare(
            piga.platform.load_scenario(examples / "platform-published.toml")
        ).figure(),
        "first-calibration": figures(piga.calibrate(piga.example_run()))["ripple"](),
    }
    for name, figure in made.items():
        target = ROOT / "docs" / "figures" / f"gallery-{name}.svg"
        write_figure(figure, target)
        print(f"wrote {target.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
