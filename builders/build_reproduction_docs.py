"""docs/reproduction.md, docs/errata.md and their figures: run ``python builders/build_reproduction_docs.py``.

Everything on both pages comes from one run of ``piga.studies``.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from piga.reports.render.axes import write_figure
from piga.reports.render.figure import Figure
from piga.studies import Chapter, Reproduction, reproduce
from piga.studies.reproduction import SOURCES, difference, number, short_id, summary

DOCS = Path(__file__).parents[1] / "docs"
FIGURES = "figures/reproduction"


def escaped(text: str) -> str:
    return re.sub(r"([|*_<>\[\]])", r"\\\1", text)


def table(heads: tuple[str, ...], rows: list[tuple[str, ...]], right: range) -> list[str]:
    rule = ["---:" if k in right else "---" for k in range(len(heads))]
    return ["| " + " | ".join(row) + " |" for row in (heads, tuple(rule), *rows)] + [""]


def figure_lines(figure: Figure) -> list[str]:
    return [
        f"![{figure.title}]({FIGURES}/{figure.key}.svg)",
        "",
        f"**{escaped(figure.title)}.** {escaped(figure.caption)}",
        "",
    ]


def chapter_lines(chapter: Chapter) -> list[str]:
    title = (
        chapter.title if chapter.id == "errata" else f"{chapter.source[1:].partition(']')[0]}: {chapter.title}"
    )
    lines = [f"## {escaped(title)}", "", f"{escaped(chapter.source)}. {escaped(chapter.text)}", ""]
    for figure in chapter.figures:
        lines += figure_lines(figure)
    numbers = [
        (
            f"`{short_id(case)}`",
            escaped(case.quantity),
            number(case.published),
            number(case.computed),
            difference(case),
            number(case.tolerance, 2),
            escaped(case.unit),
            case.verdict,
        )
        for case in chapter.cases
    ]
    heads = ("case", "quantity", "published", "computed", "difference", "tolerance", "unit", "verdict")
    lines += table(heads, numbers, range(2, 6))
    notes = [(f"`{short_id(case)}`", escaped(case.source), escaped(case.note)) for case in chapter.cases]
    return lines + table(("case", "source", "why this tolerance, or none"), notes, range(0))


def head(title: str, text: str) -> list[str]:
    return [
        f"# {title}",
        "",
        text,
        "",
        "<!-- Made by builders/build_reproduction_docs.py; do not edit. -->",
        "",
    ]


def sources() -> list[str]:
    return ["## Sources", "", *(f"- \\[{key}\\] {escaped(text)}" for key, text in SOURCES.items()), ""]


def reproduction_page(result: Reproduction) -> list[str]:
    text = (
        f"`piga reproduce --out DIR` runs every published case and sets it beside ours: {summary(result)}. "
        "`--only ID` runs one chapter, `--json` prints the cases; the command ends with exit code 1 if a case disagrees. "
        "A tolerance is physical: printed digits, stated rounding, reading accuracy of a figure. Errata stand on "
        "[their own page](errata.md)."
    )
    lines = head("The published cases, reproduced", text)
    for chapter in result.chapters:
        if chapter.id != "errata":
            lines += chapter_lines(chapter)
    return lines + sources()


def errata_page(result: Reproduction) -> list[str]:
    (chapter,) = [chapter for chapter in result.chapters if chapter.id == "errata"]
    text = (
        "Errors in the [publications](references.md), with numbers from the run of [the reproduction](reproduction.md). "
        "`piga reproduce --only errata` computes them again."
    )
    return [*head("Errata of the publications", text), *chapter_lines(chapter)]


def main() -> None:
    reproduced = reproduce()
    folder = DOCS / FIGURES
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.svg"):
        old.unlink()
    for figure in reproduced.figures:
        write_figure(figure, folder / f"{figure.key}.svg")
    for name, lines in (
        ("reproduction.md", reproduction_page(reproduced)),
        ("errata.md", errata_page(reproduced)),
    ):
        (DOCS / name).write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8", newline="\n")
    size = sum(path.stat().st_size for path in folder.glob("*.svg"))
    print(f"{summary(reproduced)}; {len(reproduced.figures)} figures, {size / 1e6:.2f} MB")
    sys.exit(1 if reproduced.failed else 0)


if __name__ == "__main__":
    main()
