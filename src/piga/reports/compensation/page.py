"""The page of ``piga compensate --report``, for one instrument and for several that were solved together."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from piga._version import __version__
from piga.compensation import Compensated, Mounted
from piga.compensation.flags import FLAGS, MEANING
from piga.records.calibration import Calibration, Coefficient
from piga.records.run import Run
from piga.records.terms import shown_unit, si_factor
from piga.reports.calibration.tables import judgement
from piga.reports.compensation.figures import (
    MICRO_G,
    correction_figure,
    correction_spectrum,
    error_figures,
    flag_figure,
    force_figure,
    misfit_figure,
    set_force_figure,
    set_orders_figure,
)
from piga.reports.compensation.outline import AXES, CORRECTION, CompensationOutline, SetOutline
from piga.reports.render.long_record import SHOWN
from piga.reports.render.numbers import count, pretty_unit, printed, rounded, short
from piga.reports.render.page import (
    Block,
    Column,
    FigureBlock,
    Judgement,
    Notice,
    Page,
    Section,
    Table,
    Text,
    Tile,
    Tone,
    write_page,
)


@dataclass(frozen=True)
class CompensationFacts:
    """What a compensation was made from.

    ``files`` are the run file, its data and the calibration record; ``options`` as given, in words; ``repairs``
    rows by kind, as found while reading.
    """

    calibration: Calibration
    files: tuple[Path, ...]
    options: dict[str, str]
    repairs: dict[str, int] = field(default_factory=dict)


def coefficient_words(c: Coefficient) -> tuple[str, str]:
    """A coefficient with its standard uncertainty in brackets, and its unit, as the calibration's own report has them."""
    scale, unit = shown_unit(c.name, c.unit)
    return printed(rounded(c.value * scale, c.std * scale).concise), pretty_unit(unit)


def outline_of(kind: str, calibration: Calibration) -> CompensationOutline:
    """A fresh outline for records of this kind (``"angle"`` or ``"rate"``) and calibration."""
    values = [c.value for c in calibration.coefficients if c.name == "scale_factor"]
    K = values[0] * si_factor("scale_factor") if values else calibration.scale_factor_nominal
    return CompensationOutline(kind, K)


def write_compensation_report(
    found: CompensationOutline,
    facts: CompensationFacts,
    path: Path,
    whole: tuple[Run, Compensated] | None = None,
) -> Path:
    """Write the page as one HTML file that opens offline; ``whole`` adds the error against the reference."""
    return write_page(compensation_page(found, facts, whole), path)


def compensation_page(
    found: CompensationOutline, facts: CompensationFacts, whole: tuple[Run, Compensated] | None = None
) -> Page:
    """The page of a compensation."""
    sections = [
        Section("Specific force", "specific-force", (FigureBlock(force_figure(found)),)),
        _orders(found),
        _reference(found, facts.calibration, whole),
        _flags(found),
        *_repairs(facts),
        _provenance(facts, found.scale_factor),
    ]
    data = facts.files[1].name
    return Page(
        title=f"Compensation of {facts.calibration.serial}",
        subtitle=f"{data}, {count(found.size)} rows; the instrument's output is its {found.kind}.",
        tiles=_tiles(found),
        sections=tuple(sections),
        judgement=judgement(facts.calibration, "The calibration that was used: "),
        kicker="piga · compensation",
        footer=f"Made by piga {__version__} on {datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}. This file holds all it "
        "shows: it opens without a network, and prints on A4.",
    )


def _tiles(found: CompensationOutline) -> tuple[Tile, ...]:
    tiles = [
        Tile(
            "Velocity",
            printed(short(found.velocity, 4)),
            "m/s",
            "sum of dv, what lies between stretches left out",
        ),
        Tile("Correction, rms", _micro_g(found.rms("correction")), "µg", "indicated less compensated"),
    ]
    if found.counts["u_ax"]:
        tiles.append(Tile("u(a_x), rms", _micro_g(found.rms("u_ax")), "µg", "standard, one row"))
    share = 100.0 * found.flagged / max(found.size, 1)
    tone: Tone = "good" if found.flagged == 0 else "doubtful"
    detail = f"{short(share)} % of the rows, no_increment not counted"
    tiles.append(Tile("Rows with a flag", count(found.flagged), "", detail, tone))
    return tuple(tiles)


def _micro_g(value: float) -> str:
    return short(value / MICRO_G) if math.isfinite(value) else "–"


def _orders(found: CompensationOutline) -> Section:
    order, amplitude = correction_spectrum(found)
    blocks: list[Block] = []
    if not (amplitude > 0.0).any():
        blocks.append(
            Notice("info", "No part of the record turns far enough, or nothing turns with the output.")
        )
    else:
        blocks.append(FigureBlock(correction_figure(order, amplitude)))
    if found.size > SHOWN:
        blocks.append(Text(f"Of the first {count(SHOWN)} rows. Figures against time show the whole record."))
    return Section("Revolution orders", "orders", tuple(blocks))


def _reference(
    found: CompensationOutline, calibration: Calibration, whole: tuple[Run, Compensated] | None
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
    figures = error_figures(*whole, found.scale_factor, noise)
    return Section(title, anchor, (lead, *(FigureBlock(figure) for figure in figures)))


def _flags(found: CompensationOutline) -> Section:
    figure = flag_figure(found)
    if figure is None:
        return Section("Flags", "flags", (Notice("good", "No row carries a flag."),))
    columns = (
        Column("flag", align="text"),
        Column("bit"),
        Column("rows"),
        Column("share", "%"),
        Column("first at", "s"),
        Column("last at", "s"),
        Column("meaning", align="text"),
    )
    rows = tuple(
        (
            name, str(FLAGS[name]), count(marks.count), short(100.0 * marks.count / found.size),
            short(marks.first - found.start, 6), short(marks.last - found.start, 6), MEANING[name],
        )
        for name, marks in found.marks.items()
        if marks.count
    )  # fmt: skip
    table = Table(columns, rows, "Flags that were raised; times since the first row.")
    return Section("Flags", "flags", (FigureBlock(figure), table))


def _repairs(facts: CompensationFacts) -> tuple[Section, ...]:
    if not facts.repairs:
        return ()
    columns = (Column("finding", align="text"), Column("count"))
    rows = tuple((name, count(number)) for name, number in facts.repairs.items())
    return (Section("Found while reading", "repairs", (Table(columns, rows, "Repairs of the record."),)),)


def _provenance(facts: CompensationFacts, scale_factor: float) -> Section:
    cal = facts.calibration
    text = (Column("", align="text"), Column("", align="text"))
    made = cal.provenance
    options = {
        "calibration of": f"{cal.serial}, by {made.software} on {made.created}",
        "phase of the calibration": cal.phase,
        "scale factor of the indication": f"{printed(short(scale_factor, 8))} (rad/s)/(m/s²)",
        **facts.options,
    }
    digests = tuple((path.name, _digest(path)) for path in facts.files)
    names = (Column("coefficient", align="text"), Column("value"), Column("unit", align="text"))
    values = tuple((c.key, *coefficient_words(c)) for c in cal.coefficients)
    return Section(
        "Provenance",
        "provenance",
        (
            Table(text, tuple(options.items()), "How it was compensated."),
            Table(names, values, "Coefficients of the calibration, standard uncertainty in brackets."),
            Table(
                (Column("file", align="text"), Column("SHA-256", align="text")), digests, "Files.", code=True
            ),
        ),
    )


def _digest(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@dataclass(frozen=True)
class SetFacts:
    """What a set was made from: ``names`` of the instruments, ``files`` read, ``options`` in words."""

    names: tuple[str, ...]
    files: tuple[Path, ...]
    options: dict[str, str]


def write_set_report(found: SetOutline, facts: SetFacts, path: Path) -> Path:
    """Write the page as one HTML file that opens offline."""
    return write_page(set_page(found, facts), path)


def set_page(found: SetOutline, facts: SetFacts) -> Page:
    """The page of a compensated set."""
    return Page(
        title=f"Compensation of {len(found.mounted)} instruments",
        subtitle=f"{', '.join(facts.names)}; {count(found.size)} rows; their output is the {found.kind}.",
        tiles=_set_tiles(found),
        sections=(
            Section("Specific force", "specific-force", (FigureBlock(set_force_figure(found)),)),
            _misfit(found, facts),
            _set_orders(found, facts),
            _set_flags(found, facts),
            _instruments(found, facts),
            _set_provenance(facts),
        ),
        judgement=_judgement(found, facts),
        kicker="piga · compensation",
        footer=f"Made by piga {__version__} on {datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}. This file holds all it "
        "shows: it opens without a network, and prints on A4.",
    )


def _judgement(found: SetOutline, facts: SetFacts) -> Judgement:
    """The verdicts on all calibrations in one box, the worst on top; each doubt names its instrument."""
    each = [judgement(item.calibration) for item in found.mounted]
    worst = max(each, key=lambda one: _SEVERITY.index(one.tone))
    problems = tuple(
        (f"{name}: {what}", remedy)
        for name, one in zip(facts.names, each, strict=True)
        for what, remedy in one.problems
    )
    holds = tuple(dict.fromkeys(words for one in each for words in one.holds)) if not problems else ()
    count_of_doubts = f"Use with care: {len(problems)} doubt{'s' * (len(problems) > 1)}."
    headline = count_of_doubts if worst.tone == "doubtful" else worst.headline
    return Judgement(worst.tone, f"The calibrations that were used: {headline}", problems, holds)


_SEVERITY: tuple[Tone, ...] = ("", "quiet", "good", "doubtful", "bad")


def _set_tiles(found: SetOutline) -> tuple[Tile, ...]:
    velocity = ", ".join(printed(short(float(v), 4)) for v in found.velocity)
    corrections = math.sqrt(sum(found.rms(name) ** 2 for name in CORRECTION))
    tone: Tone = "good" if found.flagged == 0 else "doubtful"
    share = short(100.0 * found.flagged / max(found.size, 1))
    tiles = [
        Tile("Velocity x, y, z", velocity, "m/s", "sums of dv, what lies between stretches left out"),
        Tile("Correction, rms", _micro_g(corrections), "µg", "all three components together"),
    ]
    if found.redundant:
        tiles.append(Tile("Residual, rms", _micro_g(found.rms("residual")), "µg", "of the redundant solution"))
    return (
        *tiles,
        Tile(
            "Rows with a flag",
            count(found.flagged),
            "",
            f"{share} % of the rows, no_increment not counted",
            tone,
        ),
    )


def _misfit(found: SetOutline, facts: SetFacts) -> Section:
    title, anchor = "Instruments against each other", "misfit"
    if not found.redundant:
        text = "Three instruments fit any force exactly: nothing is left over that could contradict it."
        return Section(title, anchor, (Notice("info", text),))
    if not found.counts[found.misfits[0]]:
        return Section(title, anchor, (Notice("info", "The published formula gives no misfits."),))
    faults = found.marks["fault"].count
    said = (
        Notice("good", "No row contradicts itself beyond the uncertainties of the calibrations.")
        if faults == 0
        else Notice(
            "warning", f"{count(faults)} rows contradict themselves beyond the uncertainties (flag fault)."
        )
    )
    return Section(title, anchor, (said, FigureBlock(misfit_figure(found, facts.names))))


def _set_orders(found: SetOutline, facts: SetFacts) -> Section:
    figure = set_orders_figure(found, facts.names)
    if figure is None:
        text = "No part of the record turns far enough, or nothing turns with the outputs."
        return Section("Revolution orders", "orders", (Notice("info", text),))
    blocks: tuple[Block, ...] = (FigureBlock(figure),)
    if found.size > SHOWN:
        blocks += (Text(f"Of the first {count(SHOWN)} rows. Figures against time show the whole record."),)
    return Section("Revolution orders", "orders", blocks)


def _set_flags(found: SetOutline, facts: SetFacts) -> Section:
    figure = flag_figure(found)
    if figure is None:
        return Section("Flags", "flags", (Notice("good", "No row carries a flag."),))
    columns = (
        Column("flag", align="text"), Column("set"), *(Column(name) for name in facts.names),
        Column("first at", "s"), Column("last at", "s"), Column("meaning", align="text"),
    )  # fmt: skip
    rows = tuple(
        (
            name, count(marks.count), *(count(single.marks[name].count) for single in found.instruments),
            short(marks.first - found.start, 6), short(marks.last - found.start, 6), MEANING[name],
        )
        for name, marks in found.marks.items()
        if marks.count
    )  # fmt: skip
    notes = ("Rows; a row of the set carries the flags of all its instruments. A fault is one of the set.",)
    return Section(
        "Flags", "flags", (FigureBlock(figure), Table(columns, rows, "Flags that were raised.", notes))
    )


def _instruments(found: SetOutline, facts: SetFacts) -> Section:
    mounting = (
        Column("instrument", align="text"), *(Column(f"X0 along {axis}") for axis in AXES),
        Column("correction, rms", "µg"), Column("misfit, rms", "µg"),
    )  # fmt: skip
    names = ("scale_factor", "tan_beta", "phi")
    coefficients = (Column("instrument", align="text"), *(Column(name) for name in names))
    placed, known = [], []
    for name, item, single, misfit in zip(
        facts.names, found.mounted, found.instruments, found.misfits, strict=True
    ):
        axis = (printed(short(float(v), 6)) for v in item.axes[0])
        shown = _micro_g(found.rms(misfit)) if found.redundant else "–"
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


def _set_provenance(facts: SetFacts) -> Section:
    text = (Column("", align="text"), Column("", align="text"))
    digests = []
    for path in facts.files:
        with path.open("rb") as stream:
            digests.append((path.name, hashlib.file_digest(stream, "sha256").hexdigest()))
    columns = (Column("file", align="text"), Column("SHA-256", align="text"))
    return Section(
        "Provenance",
        "provenance",
        (
            Table(text, tuple(facts.options.items()), "How it was compensated."),
            Table(columns, tuple(digests), "Files.", code=True),
        ),
    )
