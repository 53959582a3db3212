"""Run all chapters or one, and show the results as a page and a terminal table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from piga._version import __version__
from piga.errors import ArgumentError
from piga.progress import Progress, Steps
from piga.reports.render.figure import Figure
from piga.reports.render.numbers import pretty_unit, significant
from piga.reports.render.page import (
    Cell,
    Page,
    Section,
    Table,
    TableOf,
    Tile,
    Tone,
    named_values,
)
from piga.studies import constant, platform, recursion
from piga.studies.case import Case, Chapter, Verdict

CHAPTERS: dict[str, Callable[[], Chapter]] = {
    "constant-input": constant.examples,
    "period": constant.period,
    "closed-forms": constant.varying,
    "time-varying": recursion.run,
    "recursion": recursion.recursion,
    "compensation": recursion.compensation,
    "five-coefficients": recursion.five,
    "mounting": recursion.mounting,
    "redundancy-angle": platform.table,
    "drift-coupling": platform.coupling,
    "ten-days": platform.ten_days,
    "wobble": platform.wobble,
    "errata": recursion.errata,
}
"""Every chapter by its id, in the order of the publications."""


@dataclass(frozen=True)
class Reproduction:
    """Chapters that were run, and the version of piga."""

    chapters: tuple[Chapter, ...]
    version: str = __version__

    @property
    def cases(self) -> tuple[Case, ...]:
        """All cases in order."""
        return tuple(case for chapter in self.chapters for case in chapter.cases)

    @property
    def figures(self) -> tuple[Figure, ...]:
        """All figures in order."""
        return tuple(figure for chapter in self.chapters for figure in chapter.figures)

    @property
    def failed(self) -> tuple[Case, ...]:
        """Cases that do not agree."""
        return tuple(case for case in self.cases if case.verdict == "fail")

    def document(self) -> dict[str, list[dict]]:
        """The JSON document of ``piga reproduce``."""
        return {"cases": [case.document() for case in self.cases]}


def chosen(only: str | None) -> list[str]:
    """Ids of the chapters to run: all, or the one given by its id or by one of its cases.

    Raises
    ------
    ArgumentError
        If there is no such chapter.
    """
    if only is None:
        return list(CHAPTERS)
    name = only.partition(".")[0]
    if name not in CHAPTERS:
        raise ArgumentError(f"--only: there is no '{only}'", remedy=f"one of: {', '.join(CHAPTERS)}")
    return [name]


def reproduce(only: str | None = None, *, progress: Progress | None = None) -> Reproduction:
    """Run the published cases.

    Parameters
    ----------
    only:
        Id of one chapter, or of one of its cases; None: all chapters.
    progress:
        Called as ``progress(done, total, what)`` before each chapter; it returns False to stop (:mod:`piga.progress`).

    Raises
    ------
    ArgumentError
        If there is no such chapter.
    """
    names = chosen(only)
    steps = Steps(progress, len(names))
    chapters: list[Chapter] = []
    for name in names:
        steps(name)
        chapters.append(CHAPTERS[name]())
    steps.finish()
    return Reproduction(tuple(chapters))


TONES: dict[Verdict, Tone] = {"pass": "good", "fail": "bad", "info": "quiet"}
SOURCES = {
    "Wei2020": "Z. Wei, patent application, Gyro accelerometer output determination method caused by constant acceleration, "
    "filed 2020-12-11, published 2021-03-30.",
    "Wei2024": "Z. Wei, R. Gao, A Calibration and Compensation Method for PIGA's Cross Coupling Error, Missiles and Space "
    "Vehicles 47(5), 56-63, 2024, doi:10.7654/j.issn.2097-1974.20240509.",
    "He2014": "Q. He, Z. Gao, Q. Wu, Accurate compensation for case rolling misalignment angle in space-stable systems, "
    "Journal of Chinese Inertial Technology 22(5), 572-575, 2014, doi:10.13695/j.cnki.12-1222/o3.2014.05.003.",
}
"""Publications in the order of the chapters."""


def number(value: float | None, digits: int = 6) -> str:
    """A number as the tables print it; a dash where there is none."""
    return "–" if value is None else significant(value, digits)


def short_id(case: Case) -> str:
    """Name of the case without that of its chapter."""
    return case.id.partition(".")[2]


def difference(case: Case) -> str:
    """Difference with three digits. More digits would be rounding error."""
    return number(case.difference, 3)


def reproduction_page(reproduction: Reproduction) -> Page:
    """All tables and figures on one page, with sections by publication."""
    counts = {verdict: sum(case.verdict == verdict for case in reproduction.cases) for verdict in TONES}
    tiles = (
        Tile("Cases", str(len(reproduction.cases)), detail=f"in {len(reproduction.chapters)} chapters"),
        Tile("Agree", str(counts["pass"]), detail="within the tolerance in their note", tone="good"),
        Tile("Disagree", str(counts["fail"]), tone="bad" if counts["fail"] else "good"),
        Tile("For information", str(counts["info"]), detail="no comparable published number", tone="quiet"),
        Tile("Figures", str(len(reproduction.figures))),
    )
    sections = [_section(chapter) for chapter in reproduction.chapters]
    return Page(
        title="The published cases, reproduced",
        subtitle="Every number and figure of three publications beside ours, and what they got wrong.",
        tiles=tiles,
        sections=(*sections, _sources()),
        kicker="piga · reproduction",
        footer=f"Made by piga {reproduction.version}; every computed number comes from this run.",
    )


def _section(chapter: Chapter) -> Section:
    lead, tables = f"{chapter.source}. {chapter.text}", (_numbers(chapter), _notes(chapter))
    publication = chapter.source[1:].partition("]")[0]
    title = chapter.title if chapter.id == "errata" else f"{publication}: {chapter.title}"
    return Section(title, chapter.id, (lead, *chapter.figures, *tables))


def _numbers(chapter: Chapter) -> Table:
    return (
        TableOf(chapter.cases)
        .text("case", short_id)
        .text("quantity", lambda case: case.quantity)
        .number("published", lambda case: number(case.published))
        .number("computed", lambda case: number(case.computed))
        .number("difference", difference)
        .number("tolerance", lambda case: number(case.tolerance, 2))
        .text("unit", lambda case: pretty_unit(case.unit))
        .text("verdict", lambda case: Cell(case.verdict, TONES[case.verdict]))
        .table("Published, computed, judged.")
    )


def _notes(chapter: Chapter) -> Table:
    return (
        TableOf(chapter.cases)
        .text("case", short_id)
        .text("source", lambda case: case.source)
        .text("why this tolerance, or none", lambda case: case.note)
        .table("Sources and tolerances.")
    )


def _sources() -> Section:
    rows = ((f"[{key}]", text) for key, text in SOURCES.items())
    return Section("Sources", "sources", (named_values("key", "publication", rows),))


def brief(reproduction: Reproduction) -> Page:
    """The numbers of every chapter, for the terminal."""
    sections = (
        Section(f"{one.title}  {one.source}", one.id, (_numbers(one),)) for one in reproduction.chapters
    )
    return Page(summary(reproduction), sections=tuple(sections))


def summary(reproduction: Reproduction) -> str:
    """One line: how many agree."""
    passed = sum(case.verdict == "pass" for case in reproduction.cases)
    unjudged = sum(case.verdict == "info" for case in reproduction.cases)
    judged = f"{len(reproduction.cases)} cases: {passed} agree, {len(reproduction.failed)} do not"
    return f"{judged}, {unjudged} without a comparable published number"
