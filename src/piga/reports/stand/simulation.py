"""The page of a simulated test, and its summary for the terminal."""

from __future__ import annotations

import math
from pathlib import Path

from piga._version import __version__
from piga.instrument.twin.linear import analyse_loop
from piga.instrument.twin.parameters import TwinParameters, parameter_table
from piga.records.terms import shown_unit
from piga.reports.render.figure import Figure
from piga.reports.render.numbers import count, pretty_unit, printed, short, significant
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
    write_page,
)
from piga.reports.stand.simulation_figures import simulation_figures
from piga.stand.simulate import SimulatedTest
from piga.stand.truth import TrueValue, coefficients, imperfection_values, predictions

_MODELS = {"quasi-steady": "quasi-steady model", "twin": "servo twin"}


def write_simulation_report(test: SimulatedTest, serial: str, path: Path) -> None:
    """Write the page of a simulated test as one HTML file that opens offline."""
    write_page(simulation_page(test, serial), path)


def simulation_page(test: SimulatedTest, serial: str) -> Page:
    """The page of a simulated test."""
    figures = {figure.key: figure for figure in simulation_figures(test)}
    sections = [_stand_section(test, figures), _output_section(figures)]
    if test.motion is not None:
        sections += [_servo_section(test, figures), _design_section(test.specimen.design)]
    sections.append(_truth_section(test))
    duration = test.profile.segments[-1].stop - test.profile.segments[0].start
    return Page(
        title=f"Simulated test of {serial}",
        subtitle=f"{test.stand.kind}, {_MODELS[test.model]}, {short(duration)} s, seed {test.seed}.",
        tiles=_tiles(test),
        sections=tuple(sections),
        kicker="piga · simulated test",
        footer=f"Made by piga {__version__}. All data on this page are simulated.",
    )


def _tiles(test: SimulatedTest) -> tuple[Tile, ...]:
    e, log = test.electronics, test.log
    turns = (test.alpha[-1] - test.alpha[0]) / (2.0 * math.pi)
    tiles = [
        Tile(
            "Rows in the log",
            count(log.t.size),
            detail=f"{len(log.labels)} segments at {short(e.sample_rate)} Hz",
        ),
        Tile(
            "Output",
            e.kind,
            detail=f"{short(e.counts_per_revolution)} per revolution" if e.kind == "counts" else "",
        ),
        Tile("Net turn of the gimbal", short(float(turns)), "rev"),
    ]
    if test.motion is not None:
        analysis = analyse_loop(test.specimen.design)
        tiles.append(Tile("Nutation", short(analysis.nutation / (2.0 * math.pi)), "Hz"))
        tiles.append(
            Tile(
                "Phase margin",
                short(math.degrees(analysis.phase_margin)),
                "°",
                f"crossover {short(analysis.crossover / (2.0 * math.pi))} Hz",
                "good" if analysis.stable else "bad",
            )
        )
        tiles.append(
            Tile("Integration error", short(test.motion.local_error), "rad", "sum of local errors, at most")
        )
    return tuple(tiles)


def _blocks(figures: dict[str, Figure], *keys: str) -> tuple[Block, ...]:
    return tuple(FigureBlock(figures[key]) for key in keys if key in figures)


def _stand_section(test: SimulatedTest, figures: dict[str, Figure]) -> Section:
    values = imperfection_values(test.imperfections)
    table: tuple[Block, ...] = ()
    if values:
        table = (_values_table(values, "Imperfections of the stand: true less assumed value."),)
    return Section("The stand", "the-stand", (*_blocks(figures, "stand", "imperfections"), *table))


def _output_section(figures: dict[str, Figure]) -> Section:
    lead = Text(
        "The lab sees the counts only. The lower panel is the truth that a calibration has to find.", lead=True
    )
    return Section("The output", "the-output", (lead, *_blocks(figures, "output", "locking")))


def _servo_section(test: SimulatedTest, figures: dict[str, Figure]) -> Section:
    blocks: list[Block] = []
    changes = test.motion.lock_changes() if test.motion is not None else ()
    if changes:
        when = ", ".join(f"{word} at {short(t, 4)} s" for t, word in changes[:6])
        blocks.append(Notice("warning", f"Pick-off or torque motor left their range: lock {when}."))
    blocks += _blocks(figures, "servo", "loop-bode", "loop-step", "loop-poles")
    blocks.append(
        _values_table(
            predictions(test),
            "What finite servo stiffness does beyond the quasi-steady model (linear prediction).",
        )
    )
    return Section("The servo loop", "the-servo", tuple(blocks))


def _design_section(p: TwinParameters) -> Section:
    columns = (
        Column("parameter", align="text"),
        Column("symbol", align="text"),
        Column("value"),
        Column("unit", align="text"),
        Column("plausible range"),
        Column("source of the default", align="text"),
    )
    rows = []
    for entry in parameter_table():
        about = entry.metadata
        low, high = about["range"]
        span = f"{_number(low)} to {_number(high)}"
        value = _number(getattr(p, entry.name))
        rows.append(
            (about["meaning"], about["symbol"], value, pretty_unit(about["unit"]), span, about["source"])
        )
    table = Table(columns, tuple(rows), "Parameters of the twin. Example values describe no real instrument.")
    return Section("The design", "the-design", (table,))


def _number(value: float) -> str:
    return "unlimited" if math.isinf(value) else printed(significant(value, 5))


def _truth_section(test: SimulatedTest) -> Section:
    caption = "True coefficients, under the names and units of a calibration."
    return Section("The truth", "the-truth", (_values_table(coefficients(test), caption),))


def _name(value: TrueValue) -> str:
    return value.name if value.segment is None else f"{value.name}[{value.segment}]"


def _values_table(values: tuple[TrueValue, ...], caption: str) -> Table:
    columns = (
        Column("name", align="text"),
        Column("value"),
        Column("unit", align="text"),
        Column("", align="text"),
    )
    rows = [
        (
            _name(value),
            printed(significant(value.value * scale, 8)),
            pretty_unit(unit),
            value.note,
        )
        for value, (scale, unit) in ((value, shown_unit(value.name, value.unit)) for value in values)
    ]
    return Table(columns, tuple(rows), caption)


def simulation_text(test: SimulatedTest) -> str:
    """A few lines for the terminal: what was simulated, and the truth."""
    log = test.log
    lines = [f"{test.stand.kind}, {_MODELS[test.model]}: {count(log.t.size)} rows, {len(log.labels)} segments"]
    for value in coefficients(test):
        scale, unit = shown_unit(value.name, value.unit)
        lines.append(f"  {_name(value):<16}{significant(value.value * scale, 8):>16} {unit}")
    if test.motion is not None:
        changes = test.motion.lock_changes()
        lines.append(
            f"  lock lost {sum(word == 'lost' for _, word in changes)} times" if changes else "  lock kept"
        )
    return "\n".join(lines)
