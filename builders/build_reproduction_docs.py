"""docs/reproduction.md, docs/errata.md and their figures: run ``python builders/build_reproduction_docs.py``.

Both pages are the page of ``piga reproduce`` in Markdown.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from piga.reports.render.axes import write_figure
from piga.reports.render.page import FigureBlock, Section, Table, Text
from piga.studies import Reproduction, reproduce
from piga.studies.reproduction import reproduction_page, summary

DOCS = Path(__file__).parents[1] / "docs"
FIGURES = "figures/reproduction"
HEAD = "# {}\n\n{}\n\n<!-- Made by builders/build_reproduction_docs.py; do not edit. -->\n"


def escaped(text: str) -> str:
    """Text without marks of Markdown."""
    return re.sub(r"([|*_<>\[\]])", r"\\\1", text)


def markdown(block: object) -> str:
    """A block of a section: text, figure or table."""
    if isinstance(block, Text):
        return f"{escaped(block.text)}\n"
    if isinstance(block, FigureBlock):
        figure = block.figure
        words = f"**{escaped(figure.title)}.** {escaped(figure.caption)}"
        return f"![{figure.title}]({FIGURES}/{figure.key}.svg)\n\n{words}\n"
    assert isinstance(block, Table)
    heads = [column.heading for column in block.columns]
    rule = ["---:" if column.align == "number" else "---" for column in block.columns]
    rows = [[f"`{row[0].text}`", *(escaped(cell.text) for cell in row[1:])] for row in block.cells]
    return "".join(f"| {' | '.join(row)} |\n" for row in (heads, rule, *rows))


def page(title: str, text: str, sections: list[Section]) -> str:
    """A page of these sections."""
    parts = [HEAD.format(title, text)]
    for section in sections:
        parts += [f"## {escaped(section.title)}\n", *map(markdown, section.blocks)]
    return "\n".join(parts)


def pages(result: Reproduction) -> dict[str, str]:
    """Both pages by the names of their files."""
    sections = reproduction_page(result).sections
    text = (
        f"`piga reproduce --out DIR` runs every published case and sets it beside ours: {summary(result)}. "
        "`--only ID` runs one chapter, `--json` prints the cases; the command ends with exit code 1 if a case disagrees. "
        "A tolerance is physical: printed digits, stated rounding, reading accuracy of a figure. Errata stand on "
        "[their own page](errata.md)."
    )
    errata = (
        "Errors in the [publications](references.md), with numbers from the run of [the reproduction](reproduction.md). "
        "`piga reproduce --only errata` computes them again."
    )
    reproduced = [section for section in sections if section.anchor != "errata"]
    others = [section for section in sections if section.anchor == "errata"]
    return {
        "reproduction.md": page("The published cases, reproduced", text, reproduced),
        "errata.md": page("Errata of the publications", errata, others),
    }


def main() -> None:
    """Write both pages and their figures."""
    reproduced = reproduce()
    folder = DOCS / FIGURES
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.svg"):
        old.unlink()
    for figure in reproduced.figures:
        write_figure(figure, folder / f"{figure.key}.svg")
    for name, text in pages(reproduced).items():
        (DOCS / name).write_text(text, encoding="utf-8", newline="\n")
    print(f"{summary(reproduced)}; {len(reproduced.figures)} figures")
    sys.exit(1 if reproduced.failed else 0)


if __name__ == "__main__":
    main()
