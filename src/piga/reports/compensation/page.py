"""The page of ``piga compensate --report``, for one instrument and for several that were solved together."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from piga._version import __version__
from piga.compensation import Compensated, Mounted
from piga.compensation.model import FLAGS, MEANING
from piga.compensation.result import Inputs
from piga.errors import CalibrationError
from piga.records.calibration import Calibration, Coefficient
from piga.records.run import Run
from piga.records.terms import shown_unit
from piga.reports.calibration.tables import judgement
from piga.reports.compensation.figures import (
    error_figures,
    flag_figure,
    force_figure,
    misfit_figure,
    orders_figure,
    result_figure,
    set_force_figure,
)
from piga.reports.compensation.outline import CORRECTION, CompensationOutline, SetOutline, outline_of
from piga.reports.render.envelope import SHOWN
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
    Table,
    TableColumn,
    TableOf,
    Text,
    Tile,
    Tone,
    named_values,
    write_page,
)
from piga.units import MICRO_G


@dataclass(frozen=True)
class CompensationFacts:
    """Inputs of a compensation.

    ``files`` are the run file, its data, other files read, and the calibration record, each with the SHA-256 of the bytes
    read. ``options``: as given, in words. ``repairs``: number of rows by kind, counted while reading.
    """

    calibration: Calibration
    files: Inputs
    options: dict[str, str]
    repairs: dict[str, int] = field(default_factory=dict)


def figures(result: Compensated) -> dict[str, Callable[[], Figure]]:
    """The figure of a compensation in memory."""
    return {"force": partial(result_figure, result)}


def brief(result: Compensated) -> Page:
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
    outline = outline_of(run.kind, calibration)
    outline.record(run, result)
    data = (Path(run.source).name or "arrays in memory", next(iter(run.input_sha256.values()), ""))
    facts = CompensationFacts(calibration, (("record", ""), data), {"method": result.method})
    return compensation_page(outline, facts, (run, result))


def coefficient_words(c: Coefficient) -> tuple[str, str]:
    """A coefficient with its standard uncertainty in brackets, and its unit, as the calibration's own report has them."""
    scale, unit = shown_unit(c.name, c.unit)
    return printed(rounded(c.value * scale, c.std * scale).concise), pretty_unit(unit)


def write_compensation_report(
    outline: CompensationOutline,
    facts: CompensationFacts,
    path: Path,
    whole: tuple[Run, Compensated] | None = None,
) -> Path:
    """Write the page as one HTML file that opens offline; ``whole`` adds the error against the reference."""
    return write_page(compensation_page(outline, facts, whole), path)


def compensation_page(
    outline: CompensationOutline, facts: CompensationFacts, whole: tuple[Run, Compensated] | None = None
) -> Page:
    """The page of a compensation."""
    sections = [
        Section("Specific force", "specific-force", (FigureBlock(force_figure(outline)),)),
        _orders(outline, [("", outline)], "output"),
        _reference(outline, facts.calibration, whole),
        _flags(outline),
        *_repairs(facts),
        _provenance(facts, outline.scale_factor),
    ]
    data = facts.files[1][0]
    return _page(
        f"Compensation of {facts.calibration.serial}",
        f"{data}, {count(outline.size)} rows; the instrument's output is its {outline.kind}.",
        _tiles(outline),
        tuple(sections),
        judgement(facts.calibration, "The calibration that was used: "),
    )


def _page(
    title: str, subtitle: str, tiles: tuple[Tile, ...], sections: tuple[Section, ...], judged: Judgement
) -> Page:
    return Page(
        title=title,
        subtitle=subtitle,
        tiles=tiles,
        sections=sections,
        judgement=judged,
        kicker="piga · compensation",
        footer=f"Made by piga {__version__} on {datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}. {ALONE}",
    )


def _tiles(outline: CompensationOutline) -> tuple[Tile, ...]:
    tiles = [
        Tile(
            "Velocity",
            printed(short(outline.velocity, 4)),
            "m/s",
            "sum of dv; time between stretches is not counted",
        ),
        Tile("Correction, rms", _micro_g(outline.rms("correction")), "µg", "indicated less compensated"),
    ]
    if outline.counts["u_ax"]:
        tiles.append(Tile("u(a_x), rms", _micro_g(outline.rms("u_ax")), "µg", "standard, one row"))
    return (*tiles, _flag_tile(outline))


def _flag_tile(outline: CompensationOutline | SetOutline) -> Tile:
    share = short(100.0 * outline.flagged / max(outline.size, 1))
    tone: Tone = "good" if outline.flagged == 0 else "doubtful"
    detail = f"{share} % of the rows, no_increment not counted"
    return Tile("Rows with a flag", count(outline.flagged), "", detail, tone)


def _micro_g(value: float) -> str:
    return short(value / MICRO_G) if math.isfinite(value) else "–"


def _orders(
    outline: CompensationOutline | SetOutline,
    instruments: Iterable[tuple[str, CompensationOutline]],
    output: str,
) -> Section:
    figure = orders_figure(instruments)
    nothing = f"No part of the record turns far enough, or nothing turns with the {output}."
    blocks: list[Block] = [Notice("info", nothing) if figure is None else FigureBlock(figure)]
    if outline.size > SHOWN:
        blocks.append(Text(f"Of the first {count(SHOWN)} rows. Figures against time show the whole record."))
    return Section("Revolution orders", "orders", tuple(blocks))


def _reference(
    outline: CompensationOutline, calibration: Calibration, whole: tuple[Run, Compensated] | None
) -> Section:
    title, anchor = "Against the reference", "reference"
    if whole is None:
        text = (
            "The error against the reference along the input axis is shown for records of at most 262 144 rows."
        )
        return Section(title, anchor, (Notice("info", text),))
    noise = (calibration.angle_rms, calibration.angle_random_walk)
    lead = Text(
        "Where the record holds a reference along the input axis that is worth comparing with (a laboratory does), "
        "these are the errors against it; they hold the errors of that reference, too.",
        lead=True,
    )
    figures = error_figures(*whole, outline.scale_factor, noise)
    return Section(title, anchor, (lead, *(FigureBlock(figure) for figure in figures)))


def _flags(outline: CompensationOutline) -> Section:
    counted = {
        name: (str(FLAGS[name]), count(marks.count), short(100.0 * marks.count / outline.size))
        for name, marks in outline.marks.items()
        if marks.count
    }
    columns = (TableColumn("bit"), TableColumn("rows"), TableColumn("share", "%"))
    return _flag_section(outline, columns, counted, "Flags that were raised; times since the first row.")


def _flag_section(
    outline: CompensationOutline | SetOutline,
    columns: tuple[TableColumn, ...],
    counted: Mapping[str, tuple[str, ...]],
    caption: str,
    notes: tuple[str, ...] = (),
) -> Section:
    """The figure of flags and their table: ``columns`` with the cells ``counted`` by flag, times and meaning."""
    figure = flag_figure(outline)
    if figure is None:
        return Section("Flags", "flags", (Notice("good", "No row carries a flag."),))
    heads = (
        TableColumn("flag", align="text"), *columns, TableColumn("first at", "s"), TableColumn("last at", "s"),
        TableColumn("meaning", align="text"),
    )  # fmt: skip
    rows = tuple(
        (
            name, *cells, short(outline.marks[name].first - outline.start, 6),
            short(outline.marks[name].last - outline.start, 6), MEANING[name],
        )
        for name, cells in counted.items()
    )  # fmt: skip
    return Section("Flags", "flags", (FigureBlock(figure), Table(heads, rows, caption, notes)))


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


def _provenance(facts: CompensationFacts, scale_factor: float) -> Section:
    cal = facts.calibration
    options = {
        "calibration of": f"{cal.serial}, by {cal.provenance.software} on {cal.provenance.created}",
        "phases of the calibration": cal.phases,
        "scale factor of the indication": f"{printed(short(scale_factor, 8))} (rad/s)/(m/s²)",
        **facts.options,
    }
    coefficients = (
        TableOf(cal.coefficients)
        .text("coefficient", lambda c: c.key)
        .number("value", lambda c: coefficient_words(c)[0])
        .text("unit", lambda c: coefficient_words(c)[1])
        .table("Coefficients of the calibration, standard uncertainty in brackets.")
    )
    return _provenance_section(options, facts.files, coefficients)


def _provenance_section(options: dict[str, str], files: Inputs, *tables: Table) -> Section:
    how = named_values("", "", options, "How it was compensated.")
    read = named_values("file", "SHA-256", files, "Files as they were read.", code=True)
    return Section("Provenance", "provenance", (how, *tables, read))


@dataclass(frozen=True)
class SetFacts:
    """Inputs of a set: ``names`` of the instruments, ``files`` read with their SHA-256, ``options`` in words."""

    names: tuple[str, ...]
    files: Inputs
    options: dict[str, str]


def write_set_report(outline: SetOutline, facts: SetFacts, path: Path) -> Path:
    """Write the page as one HTML file that opens offline."""
    return write_page(set_page(outline, facts), path)


def set_page(outline: SetOutline, facts: SetFacts) -> Page:
    """The page of a compensated set."""
    sections = (
        Section("Specific force", "specific-force", (FigureBlock(set_force_figure(outline)),)),
        _misfit(outline, facts),
        _orders(outline, zip(facts.names, outline.instruments, strict=True), "outputs"),
        _set_flags(outline, facts),
        _instruments(outline, facts),
        _provenance_section(facts.options, facts.files),
    )
    return _page(
        f"Compensation of {len(outline.mounted)} instruments",
        f"{', '.join(facts.names)}; {count(outline.size)} rows; their output is the {outline.kind}.",
        _set_tiles(outline),
        sections,
        _judgement(outline, facts),
    )


def _judgement(outline: SetOutline, facts: SetFacts) -> Judgement:
    """The verdicts on all calibrations in one box, the worst on top; each doubt names its instruments."""
    each = [judgement(item.calibration) for item in outline.mounted]
    worst = max(each, key=lambda one: _SEVERITY.index(one.tone))
    named: dict[tuple[str, str], list[str]] = {}
    for name, one in zip(facts.names, each, strict=True):
        for doubt in one.problems:
            named.setdefault(doubt, []).append(name)
    problems = tuple((f"{', '.join(names)}: {what}", remedy) for (what, remedy), names in named.items())
    holds = tuple(dict.fromkeys(words for one in each for words in one.holds)) if not problems else ()
    count_of_doubts = f"Use with care: {len(problems)} doubt{'s' * (len(problems) > 1)}."
    headline = count_of_doubts if worst.tone == "doubtful" else worst.headline
    return Judgement(worst.tone, f"The calibrations that were used: {headline}", problems, holds)


_SEVERITY: tuple[Tone, ...] = ("", "quiet", "good", "doubtful", "bad")


def _set_tiles(outline: SetOutline) -> tuple[Tile, ...]:
    velocity = ", ".join(printed(short(float(v), 4)) for v in outline.velocity)
    corrections = math.sqrt(sum(outline.rms(name) ** 2 for name in CORRECTION))
    tiles = [
        Tile("Velocity x, y, z", velocity, "m/s", "sums of dv; time between stretches is not counted"),
        Tile("Correction, rms", _micro_g(corrections), "µg", "all three components together"),
    ]
    if outline.redundant:
        tiles.append(
            Tile("Residual, rms", _micro_g(outline.rms("residual")), "µg", "of the redundant solution")
        )
    return (*tiles, _flag_tile(outline))


def _misfit(outline: SetOutline, facts: SetFacts) -> Section:
    title, anchor = "Instruments against each other", "misfit"
    if not outline.redundant:
        text = "Three instruments fit any force exactly: nothing is left over that could contradict it."
        return Section(title, anchor, (Notice("info", text),))
    if not outline.counts[outline.misfits[0]]:
        return Section(title, anchor, (Notice("info", "The published formula gives no misfits."),))
    faults = outline.marks["fault"].count
    said = (
        Notice("good", "No row contradicts itself beyond the uncertainties of the calibrations.")
        if faults == 0
        else Notice(
            "warning", f"{count(faults)} rows contradict themselves beyond the uncertainties (flag fault)."
        )
    )
    return Section(title, anchor, (said, FigureBlock(misfit_figure(outline, facts.names))))


def _set_flags(outline: SetOutline, facts: SetFacts) -> Section:
    counted = {
        name: (count(marks.count), *(count(single.marks[name].count) for single in outline.instruments))
        for name, marks in outline.marks.items()
        if marks.count
    }
    columns = (TableColumn("set"), *(TableColumn(name) for name in facts.names))
    notes = ("Rows; a row of the set carries the flags of all its instruments. A fault is one of the set.",)
    return _flag_section(outline, columns, counted, "Flags that were raised.", notes)


def _instruments(outline: SetOutline, facts: SetFacts) -> Section:
    mounting = (
        TableColumn("instrument", align="text"), *(TableColumn(f"X0 along {axis}") for axis in XYZ),
        TableColumn("correction, rms", "µg"), TableColumn("misfit, rms", "µg"),
    )  # fmt: skip
    names = ("scale_factor", "tan_beta", "phi")
    coefficients = (TableColumn("instrument", align="text"), *(TableColumn(name) for name in names))
    placed, known = [], []
    for name, item, single, misfit in zip(
        facts.names, outline.mounted, outline.instruments, outline.misfits, strict=True
    ):
        axis = (printed(short(float(v), 6)) for v in item.axes[0])
        shown = _micro_g(outline.rms(misfit)) if outline.redundant else "–"
        placed.append((name, *axis, _micro_g(single.rms("correction")), shown))
        known.append((name, *(_coefficient(item, key) for key in names)))
    return Section(
        "Instruments",
        "instruments",
        (
            Table(
                mounting, tuple(placed), "Input axes in the common frame; what was taken out and what is left."
            ),
            Table(coefficients, tuple(known), "Coefficients used, standard uncertainty in brackets."),
        ),
    )


def _coefficient(item: Mounted, name: str) -> str:
    if name == "phi" and item.phase is not None:
        return f"{printed(rounded(item.phase.value, item.phase.std).concise)} rad (given)"
    for c in item.calibration.coefficients:
        if c.name == name and c.segment in (None, item.segment):
            return " ".join(coefficient_words(c)).rstrip()
    return "–"
