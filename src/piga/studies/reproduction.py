"""The errata of the publications; all chapters or one, run and shown as a page and a terminal table."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from piga._version import __version__
from piga.errors import ArgumentError
from piga.instrument import closed_form, propagate
from piga.progress import Progress, Steps
from piga.reports.render.figure import Figure
from piga.reports.render.numbers import pretty_unit, significant
from piga.reports.render.page import (
    Cell,
    Page,
    Section,
    Table,
    TableOf,
    Tone,
    named_values,
)
from piga.studies import constant, platform, recursion
from piga.studies.case import INSTRUMENT, RATIO, TRANSVERSE, Case, Chapter, Value, Verdict, chapter_of
from piga.studies.constant import EXAMPLES, published_closed_form
from piga.studies.platform import CASE_RATE, CHANNELS, GRAVITY_OF_TABLE, compared, last_lines, printed
from piga.studies.recursion import (
    PUBLISHED_PHASE,
    RAMP_TOP,
    closed_form_phase,
    compensated_error,
    model_phase,
    model_residual,
    published_calibration,
    raw_state,
    record,
    with_phase,
)
from piga.units import ARCMIN

# -- errors in the publications --------------------------------------------------------------------------


def errata() -> Chapter:
    """All errata with their numbers."""
    values = _forms() | _phase()
    values["gravity"] = 100.0 * (0.222 / (GRAVITY_OF_TABLE * ARCMIN / CASE_RATE) - 1.0)
    lines = last_lines(compared(wobble=False), "A")
    for channel in ("heading", "roll"):
        theory = printed(channel, "formula")
        values[f"{channel}-published"] = 100.0 * (printed(channel, "A") / theory - 1.0)
        values[f"{channel}-ours"] = 100.0 * (lines[channel] / CHANNELS[channel] / theory - 1.0)
    return chapter_of("errata", values)


def _forms() -> dict[str, float | Value]:
    """The lost sign of the printed forms, for the a_x of the examples turned negative; the lost square of the critical one."""
    values: dict[str, float | Value] = {}
    t = np.linspace(0.0, 60.0, 1201)
    for example in EXAMPLES[1:]:
        a_x, a_Y, a_Z = example.force
        force = -a_x, a_Y, a_Z
        exact = closed_form(INSTRUMENT, t, *force)[1]
        for suffix, as_published in (("", True), ("-corrected", False)):
            _, rate = published_closed_form(example.number, INSTRUMENT, t, *force, as_published=as_published)
            values[f"sign-{example.number}{suffix}"] = float(np.abs(rate - exact).max())
    force = EXAMPLES[1].force
    start, top = math.tan(0.5 * INSTRUMENT.alpha0), 2.0 * INSTRUMENT.scale_factor * force[0]
    m = 0.5 * top * t + (start - 1.0) / (start + 1.0)
    exact = closed_form(INSTRUMENT, t, *force)[1]
    values["square"] = float(top / (1.0 + m[0]))
    values["square-corrected"] = float(np.abs(top / (1.0 + m * m) - exact).max())
    return values


def _phase() -> dict[str, float | Value]:
    """The phase of the published model, which walks away from the true one by K V r^2/2, and the phase printed in degrees."""
    log, calibration, (constant, lead) = record("ramp"), published_calibration("ramp"), closed_form_phase()
    predicted = model_phase(log)
    walk = predicted + constant - lead - propagate(INSTRUMENT, log.t, log.f, between="linear")
    shift = raw_state("ramp")[1] - (constant - lead)
    misread = compensated_error(log, with_phase(calibration, math.radians(PUBLISHED_PHASE)), "published")
    bound = TRANSVERSE * RAMP_TOP * INSTRUMENT.tan_beta * float(np.abs(walk + shift).max())
    left = float(np.abs(model_residual(log, calibration)).max())
    return {
        "phase-walk": float(np.polyfit(0.5 * RATIO**2 * predicted, walk, 1)[0]),
        "phase-shift": shift,
        "phase-residual": Value(left, words={"bound": bound}),
        "degrees": math.degrees(constant - lead),
        "degrees-effect": float(np.abs(misread).max()),
    }


# -- the whole reproduction ------------------------------------------------------------------------------

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
    "errata": errata,
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
        return tuple(case for chapter in self.chapters for case in chapter.cases.values())

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
    names = list(CHAPTERS) if only is None else [only.partition(".")[0]]
    if names[0] not in CHAPTERS:
        raise ArgumentError(f"--only: there is no '{names[0]}'", remedy=f"one of: {', '.join(CHAPTERS)}")
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


def _number(value: float | None, digits: int = 6) -> str:
    """A number as the tables print it; a dash where there is none."""
    return "–" if value is None else significant(value, digits)


def reproduction_page(reproduction: Reproduction) -> Page:
    """All tables and figures on one page, with sections by publication."""
    sources = ((f"[{key}]", text) for key, text in SOURCES.items())
    listed = Section("Sources", "sources", (named_values("key", "publication", sources),))
    return Page(
        title="The published cases, reproduced",
        subtitle=f"{summary(reproduction)}. Every number of three publications beside ours, and what they got wrong.",
        sections=(*map(_section, reproduction.chapters), listed),
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
        TableOf(chapter.cases.values())
        .text("case", lambda case: case.id.partition(".")[2])
        .text("quantity", lambda case: case.quantity)
        .number("published", lambda case: _number(case.published))
        .number("computed", lambda case: _number(case.computed))
        .number("difference", lambda case: _number(case.difference, 3))
        .number("tolerance", lambda case: _number(case.tolerance, 2))
        .text("unit", lambda case: pretty_unit(case.unit))
        .text("verdict", lambda case: Cell(case.verdict, TONES[case.verdict]))
        .table("Published, computed, judged.")
    )


def _notes(chapter: Chapter) -> Table:
    return (
        TableOf(chapter.cases.values())
        .text("case", lambda case: case.id.partition(".")[2])
        .text("source", lambda case: case.source)
        .text("why this tolerance, or none", lambda case: case.note)
        .table("Sources and tolerances.")
    )


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
