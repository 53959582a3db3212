"""docs/figures/gallery-*.svg: pictures of the how-tos, drawn by the report's own functions.

Run ``python builders/build_gallery.py`` after a change of a page or a figure.
"""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path

import piga
from piga.reports import write_figure
from piga.reports.calibration.page import figures

ROOT = Path(__file__).parents[1]
PICTURES = {"ten-days": "comparison", "planning": "plan"}
"""Result that is drawn, in the cells of each how-to."""


def main() -> None:
    """Run the cells of each page, and write the picture; and that of the shipped record."""
    for name, result in PICTURES.items():
        text = (ROOT / "docs" / "how-to" / f"{name}.md").read_text(encoding="utf-8")
        cells = re.findall(r"```\{code-cell\} ipython3\n(.*?)```", text, flags=re.DOTALL)
        names: dict[str, object] = {}
        os.chdir(tempfile.mkdtemp())
        for cell in cells:
            exec(cell, names)
        target = ROOT / "docs" / "figures" / f"gallery-{name}.svg"
        made = names[result]
        write_figure(made.figure(), target)
        print(f"wrote {target.relative_to(ROOT)}")
    target = ROOT / "docs" / "figures" / "gallery-first-calibration.svg"
    write_figure(figures(piga.calibrate(piga.example_run()))["ripple"](), target)
    print(f"wrote {target.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
