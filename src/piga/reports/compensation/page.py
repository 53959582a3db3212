"""The page of ``piga compensate --report``: what was indicated, what was taken out, how sure the rest is."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from piga._version import __version__
from piga.compensation import Compensated
from piga.compensation.flags import FLAGS, MEANING
from piga.records.calibration import Calibration, Coefficient
from piga.records.run import Run
from piga.records.terms import shown_unit, si_factor
from piga.reports.calibration.tables import judgement
from piga.reports.compensation.errors import error_figures
from piga.reports.compensation.figures import (
    MICRO_G,
    correction_figure,
    correction_spectrum,
    flag_figure,
    force_figure,
)
from piga.reports.compensation.outline import CompensationOutline
from piga.reports.render.long_record import SHOWN
from piga.reports.render.numbers import count, pretty_unit, printed, rounded, short
from piga.reports.render.page import (
    Block,
    Column,
    FigureBlock,
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
