"""Run the chapters: all of them, or the one that is asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from piga._version import __version__
from piga.errors import ArgumentError
from piga.reports.render.figure import Figure
from piga.studies import constant, errata, five, mounting, platform, recursion, ten_days, varying
from piga.studies.case import Case, Chapter

CHAPTERS: dict[str, Callable[[], Chapter]] = {
    "constant-input": constant.examples,
    "period": constant.period,
    "closed-forms": varying.forms,
    "time-varying": varying.run,
    "recursion": recursion.recursion,
    "compensation": recursion.compensation,
    "five-coefficients": five.chapter,
    "mounting": mounting.chapter,
    "redundancy-angle": platform.table,
    "drift-coupling": platform.coupling,
    "ten-days": ten_days.chapter,
    "wobble": ten_days.wobble,
    "errata": errata.chapter,
}
"""Every chapter by its id, in the order of the publications."""


@dataclass(frozen=True)
class Reproduction:
    """Chapters that were run, and the version that ran them."""

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
    """Ids of the chapters to run: all, or the one named by its id or by a case in it.

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


def reproduce(only: str | None = None) -> Reproduction:
    """Run the published cases.

    Parameters
    ----------
    only:
        Id of one chapter, or of a case in it; None runs all.

    Raises
    ------
    ArgumentError
        If there is no such chapter.
    """
    return Reproduction(tuple(chapter for chapter in run_chapters(chosen(only))))


def run_chapters(names: list[str]) -> Iterator[Chapter]:
    """The chapters one by one, as they are done."""
    for name in names:
        yield CHAPTERS[name]()
