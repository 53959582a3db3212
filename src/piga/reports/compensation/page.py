"""The page of ``piga compensate --report``: one page for one instrument, and for several that were solved together."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from piga._version import __version__
from piga.compensation import Compensated, CompensatedSet
from piga.compensation.model import FLAGS, MEANING
from piga.compensation.result import Inputs
from piga.errors import CalibrationError
from piga.records.calibration import Coefficient
from piga.records.run import Run
from piga.records.terms import shown_unit
from piga.reports.calibration.tables import judgement, sentence
from piga.reports.compensation.figures import (
    error_figures,
    flag_figure,
    force_figure,
    misfit_figure,
    orders_figure,
    result_figure,
)
from piga.reports.compensation.outline import LEADING_ROWS, CompensationOutline, of_record
from piga.reports.render.figure import XYZ, Figure
from piga.reports.render.numbers import count, pretty_unit, printed, rounded, short
from piga.reports.render.page import (
    ALONE,
    Block,
    FigureBlock,
    Judgement,
    Notice,
    Page,
    Section,
    TableOf,
    Text,
    Tile,
    Tone,
    named_values,
)
from piga.units import MICRO_G

COMPARED_ROWS = 1 << 18
"""Most rows of a record that is compared with its reference."""


@dataclass(frozen=True)
class CompensationFacts:
    """Inputs of a compensation.

    ``names`` of the instruments. ``files`` are all files read, each with the SHA-256 of the bytes read. ``options``: as
    given, in words. ``repairs``: number of rows by kind, counted while reading. ``notes``: those of the result.
    ``u_velocity``: standard uncertainty of the velocity along each component [m/s], if it is known.
    """

    names: tuple[str, ...]
    files: Inputs
    options: dict[str, str]
    repairs: dict[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    u_velocity: tuple[float, ...] = ()


def figures(result: Compensated | CompensatedSet) -> dict[str, Callable[[], Figure]]:
    """The figure of a compensation in memory."""
    return {"force": partial(result_figure, result)}


def brief(result: Compensated | CompensatedSet) -> Page:
    """What a notebook and the terminal show of a compensation in memory."""
    facts = named_values("", "", result.in_brief())
    return Page(
        result.heading(), sections=(Section("", "result", (facts, FigureBlock(result_figure(result)))),)
    )


def page(result: Compensated) -> Page:
    """The page of a compensation in memory.

    Raises
    ------
    CalibrationError
        If the compensation was read or copied without its record.
    """
    if result.made_from is None:
        raise CalibrationError(
            "report: this compensation was read or copied without its record and calibration",
            remedy="compensate again: piga.compensate(run, cal)",
        )
    run, calibration = result.made_from
    outline = of_record(run, calibration, result)
    data = Path(run.source).name or "arrays in memory", next(iter(run.input_sha256.values()), "")
    facts = CompensationFacts(
        (data[0],), (data,), {"method": result.method}, notes=result.notes, u_velocity=(result.u_velocity,)
    )
    return compensation_page(outline, facts, (run, result))


def _coefficient_words(c: Coefficient) -> tuple[str, str]:
    """A coefficient with its standard uncertainty in brackets, and its unit, as the calibration's own report has them."""
    scale, unit = shown_unit(c.name, c.unit)
    return printed(rounded(c.value * scale, c.std * scale).concise), pretty_unit(unit)


def compensation_page(
    outline: CompensationOutline, facts: CompensationFacts, whole: tuple[Run, Compensated] | None = None
) -> Page:
    """The page of a compensation. ``whole``: record and result of a single instrument, compared with the reference."""
    single = not outline.mounted
    serial = outline.instruments[0].calibration.serial
    sections = [Section("Specific force", "specific-force", (FigureBlock(force_figure(outline)),))]
    if not single:
        sections.append(_misfit(outline, facts))
    direct = outline.instruments[0].calibration.direct
    sections += [] if direct else [_orders(outline, facts)]
    if single:
        sections.append(_reference(outline, whole))
    sections.append(_flags(outline, facts))
    if not single:
        sections.append(_instruments(outline, facts))
    sections += [*_repairs(facts), _provenance(outline, facts)]
    return Page(
        title=f"Compensation of {serial if single else f'{len(outline.mounted)} instruments'}",
        subtitle=f"{', '.join(facts.names)}; {count(outline.size)} rows; the output is of kind "
        f"{'count' if direct and outline.kind == 'angle' else outline.kind}.",
        tiles=_tiles(outline, facts),
        sections=tuple(sections),
        judgement=_judgement(outline, facts),
        kicker="piga · compensation",
        footer=f"Made by piga {__version__} on {datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}. {ALONE}",
    )


def _judgement(outline: CompensationOutline, facts: CompensationFacts) -> Judgement:
    """The verdicts on all calibrations in one box, the worst on top; each doubt of a set names its instruments."""
    each = [judgement(instrument.calibration) for instrument in outline.instruments]
    if len(each) == 1:
        return judgement(outline.instruments[0].calibration, "The calibration that was used: ")
    worst = max(each, key=lambda one: _SEVERITY.index(one.tone))
    named: dict[tuple[str, str], list[str]] = {}
    for name, instrument in zip(facts.names, outline.instruments, strict=True):
        for doubt in instrument.calibration.verdict.doubts:
            named.setdefault((sentence(doubt.what), doubt.remedy), []).append(name)
    problems = tuple((f"{', '.join(names)}: {what}", remedy) for (what, remedy), names in named.items())
    tested, open_ones = (
        tuple(dict.fromkeys(words for one in each for words in getattr(one, name)))
        for name in ("tested", "not_tested")
    )
    headline = f"The calibrations that were used: {worst.headline}"
    return Judgement(worst.tone, headline, "", problems, tested, open_ones)


_SEVERITY: tuple[Tone, ...] = ("", "quiet", "good", "doubtful", "bad")


def _micro_g(value: float) -> str:
    return short(value / MICRO_G) if math.isfinite(value) else "–"


def _together(outline: CompensationOutline, kind: str) -> str:
    """Root mean square of a kind of curve, all components together."""
    return _micro_g(math.hypot(*(outline.rms(f"{kind} {name}") for name in outline.components)))


def _tiles(outline: CompensationOutline, facts: CompensationFacts) -> tuple[Tile, ...]:
    velocity = ", ".join(printed(short(float(v), 4)) for v in outline.velocity)
    axes = "" if len(outline.velocity) == 1 else " x, y, z"
    known = [printed(short(u, 2)) for u in facts.u_velocity if math.isfinite(u)]
    u = f"standard uncertainty {', '.join(known)} m/s; " if known else ""
    tiles = [
        Tile(f"Velocity{axes}", velocity, "m/s", f"{u}sum of dv; time between stretches is not counted"),
        Tile("Correction, rms", _together(outline, "correction"), "µg", "indicated less compensated"),
    ]
    if outline.has(f"u {outline.components[0]}"):
        tiles.append(Tile("u, rms", _together(outline, "u"), "µg", "standard uncertainty of one row"))
    if outline.has("residual"):
        tiles.append(Tile("Residual, rms", _micro_g(outline.rms("residual")), "µg", "of the redundant set"))
    share = short(100.0 * outline.flagged / max(outline.size, 1))
    tone: Tone = "good" if outline.flagged == 0 else "doubtful"
    detail = f"{share} % of the rows, no_increment not counted"
    return (*tiles, Tile("Rows with a flag", count(outline.flagged), "", detail, tone))


def _misfit(outline: CompensationOutline, facts: CompensationFacts) -> Section:
    title, anchor = "Instruments against each other", "misfit"
    if not outline.redundant:
        text = "Three instruments fit any force exactly: nothing is left over that could contradict it."
        return Section(title, anchor, (Notice("info", text),))
    faults = outline.marks["fault"].count
    words = f"{count(faults)} rows contradict themselves beyond the uncertainties (flag fault)."
    notice = Notice("warning", words)
    if faults == 0:
        notice = Notice("good", "No row contradicts itself beyond the uncertainties of the calibrations.")
    return Section(title, anchor, (notice, FigureBlock(misfit_figure(outline, facts.names))))


def _orders(outline: CompensationOutline, facts: CompensationFacts) -> Section:
    figure = orders_figure(outline, facts.names)
    nothing = "No part of the record turns far enough, or nothing turns with the output."
    blocks: list[Block] = [Notice("info", nothing) if figure is None else FigureBlock(figure)]
    if outline.size > LEADING_ROWS:
        blocks.append(
            Text(f"Of the first {count(LEADING_ROWS)} rows. Figures against time show the whole record.")
        )
    return Section("Revolution orders", "orders", tuple(blocks))


def _reference(outline: CompensationOutline, whole: tuple[Run, Compensated] | None) -> Section:
    title, anchor = "Against the reference", "reference"
    if whole is None or outline.size > COMPARED_ROWS:
        text = f"The error against the reference along the input axis is shown for records of at most {count(COMPARED_ROWS)} rows."
        return Section(title, anchor, (Notice("info", text),))
    instrument = outline.instruments[0]
    noise = (instrument.calibration.angle_rms, instrument.calibration.angle_random_walk)
    lead = Text(
        "Where the record holds a reference along the input axis that is worth comparing with (a laboratory does), "
        "these are the errors against it; they hold the errors of that reference, too.",
        lead=True,
    )
    drawn = error_figures(*whole, instrument.scale_factor, noise)
    return Section(title, anchor, (lead, *(FigureBlock(figure) for figure in drawn)))


def _flags(outline: CompensationOutline, facts: CompensationFacts) -> Section:
    """The figure of flags, and their table; of a set with the rows of each instrument."""
    figure = flag_figure(outline)
    if figure is None:
        return Section("Flags", "flags", (Notice("good", "No row carries a flag."),))
    raised = [(name, marks) for name, marks in outline.marks.items() if marks.count]
    table = (
        TableOf(raised)
        .text("flag", lambda row: row[0])
        .number("bit", lambda row: str(FLAGS[row[0]]))
        .number("rows", lambda row: count(row[1].count))
        .number("share", lambda row: short(100.0 * row[1].count / outline.size), "%")
    )
    notes: tuple[str, ...] = ()
    if outline.mounted:
        instruments = list(zip(facts.names, outline.instruments, strict=True))
        table.across(instruments, lambda one: one[0], lambda row, one: count(one[1].flagged[row[0]]))
        notes = ("A row of the set carries the flags of all its instruments. A fault is one of the set.",)
    table.number("first at", lambda row: short(row[1].first - outline.start, 6), "s")
    table.number("last at", lambda row: short(row[1].last - outline.start, 6), "s")
    table.text("meaning", lambda row: MEANING[row[0]])
    caption = "Flags that were raised; times since the first row."
    said = [Notice("warning", words) for words in facts.notes]
    return Section("Flags", "flags", (*said, FigureBlock(figure), table.table(caption, notes)))


def _instruments(outline: CompensationOutline, facts: CompensationFacts) -> Section:
    indices = range(len(outline.instruments))
    table = (
        TableOf(indices)
        .text("instrument", lambda i: facts.names[i])
        .across(
            range(3),
            lambda axis: f"X0 along {XYZ[axis]}",
            lambda i, axis: printed(short(float(outline.mounted[i].axes[0][axis]), 6)),
        )
        .number("correction, rms", lambda i: _micro_g(outline.instruments[i].correction), "µg")
        .number("misfit, rms", lambda i: _micro_g(outline.rms(f"misfit {i}")), "µg")
        .table("Input axes in the common frame; what was taken out and what is left.")
    )
    return Section("Instruments", "instruments", (table,))


def _repairs(facts: CompensationFacts) -> tuple[Section, ...]:
    if not facts.repairs:
        return ()
    table = (
        TableOf(facts.repairs.items())
        .text("finding", lambda item: item[0])
        .number("count", lambda item: count(item[1]))
        .table("Repairs of the record.")
    )
    return (Section("Found while reading", "repairs", (table,)),)


def _provenance(outline: CompensationOutline, facts: CompensationFacts) -> Section:
    many = len(outline.instruments) > 1
    options = dict(facts.options)
    coefficients = []
    for name, instrument in zip(facts.names, outline.instruments, strict=True):
        calibration, of = instrument.calibration, f" ({name})" if many else ""
        made = calibration.provenance
        options[f"calibration of{of}"] = f"{calibration.serial}, by {made.software} on {made.created}"
        if not calibration.direct:
            options[f"phases of the calibration{of}"] = calibration.phases
        options[f"scale factor of the indication{of}"] = (
            f"{printed(short(instrument.scale_factor, 8))} ({calibration.unit})/(m/s²)"
        )
        coefficients += [(name, c) for c in calibration.coefficients]
    for name, item in zip(facts.names, outline.mounted, strict=False):
        if item.phase is not None:
            phase = printed(rounded(item.phase.value, item.phase.std).concise)
            options[f"phase used ({name})"] = f"{phase} rad, as given"
    table = TableOf(coefficients)
    if many:
        table.text("instrument", lambda row: row[0])
    table.text("coefficient", lambda row: row[1].key)
    table.number("value", lambda row: _coefficient_words(row[1])[0])
    table.text("unit", lambda row: _coefficient_words(row[1])[1])
    how = named_values("", "", options, "How it was compensated.")
    read = named_values("file", "SHA-256", facts.files, "Files as they were read.", code=True)
    used = table.table("Coefficients of the calibration, standard uncertainty in brackets.")
    return Section("Provenance", "provenance", (how, used, read))
