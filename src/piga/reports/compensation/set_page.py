"""The page of ``piga compensate --report`` for several instruments that were solved together."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from piga._version import __version__
from piga.compensation import Mounted
from piga.compensation.flags import MEANING
from piga.reports.calibration.tables import judgement
from piga.reports.compensation.figures import MICRO_G, flag_figure
from piga.reports.compensation.page import coefficient_words
from piga.reports.compensation.set_figures import misfit_figure, set_force_figure, set_orders_figure
from piga.reports.compensation.set_outline import AXES, CORRECTION, SetOutline
from piga.reports.render.long_record import SHOWN
from piga.reports.render.numbers import count, printed, rounded, short
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
        tiles=_tiles(found),
        sections=(
            Section("Specific force", "specific-force", (FigureBlock(set_force_figure(found)),)),
            _misfit(found, facts),
            _orders(found, facts),
            _flags(found, facts),
            _instruments(found, facts),
            _provenance(facts),
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


def _micro_g(value: float) -> str:
    return short(value / MICRO_G) if math.isfinite(value) else "–"


def _tiles(found: SetOutline) -> tuple[Tile, ...]:
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


def _orders(found: SetOutline, facts: SetFacts) -> Section:
    figure = set_orders_figure(found, facts.names)
    if figure is None:
        text = "No part of the record turns far enough, or nothing turns with the outputs."
        return Section("Revolution orders", "orders", (Notice("info", text),))
    blocks: tuple[Block, ...] = (FigureBlock(figure),)
    if found.size > SHOWN:
        blocks += (Text(f"Of the first {count(SHOWN)} rows. Figures against time show the whole record."),)
    return Section("Revolution orders", "orders", blocks)


def _flags(found: SetOutline, facts: SetFacts) -> Section:
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


def _provenance(facts: SetFacts) -> Section:
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
