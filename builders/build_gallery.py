"""docs/figures/gallery-*.svg: one picture of each notebook, drawn by the report's own functions.

Run ``python builders/build_gallery.py`` after a change of a notebook or a figure.
"""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path

from piga.reports import write_figure
from piga.reports.calibration.page import figures

ROOT = Path(__file__).parents[1]
PICTURES = {
    "first-calibration": ("cal", "ripple"),
    "dividing-head": ("cal", "segments"),
    "centrifuge": ("test", ""),
    "triad": ("together", ""),
    "ten-days": ("comparison", ""),
    "planning": ("plan", ""),
}
"""Result and figure of each notebook."""


def main() -> None:
    """Run the cells of each notebook, and write the picture."""
    for name, (result, figure) in PICTURES.items():
        text = (ROOT / "docs" / "notebooks" / f"{name}.md").read_text(encoding="utf-8")
        cells = re.findall(r"```\{code-cell\} ipython3\n(.*?)```", text, flags=re.DOTALL)
        names: dict[str, object] = {}
        os.chdir(tempfile.mkdtemp())
        for cell in cells:
            exec(cell, names)
        target = ROOT / "docs" / "figures" / f"gallery-{name}.svg"
        made = names[result]
        write_figure(figures(made)[figure]() if figure else made.figure(), target)
        print(f"wrote {target.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
