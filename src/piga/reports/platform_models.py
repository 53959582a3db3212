"""Pages of ``piga platform navigate`` and ``compare``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from piga.reports.numbers import short
from piga.reports.page import Block, Column, FigureBlock, Notice, Page, Section, Table, Text, Tile
from piga.reports.platform_figures import ARCMIN, model_name
from piga.reports.platform_model_figures import (
    histories_figure,
    lines_figure,
    model_figure,
    position_figure,
    published_figure,
    spectrum_figure,
)
from piga.reports.platform_parts import page, parameter_table
from piga.stable_platform.budget import BudgetRow, Scatter
from piga.stable_platform.chain import Comparison, Preparation
from piga.stable_platform.scenario import Scenario


def navigation_page(comparison: Comparison) -> Page:
    """Page of ``piga platform navigate``."""
    tiles = tuple(
        Tile(model_name(m), short(float(r.lines.position.max())), "m", "largest horizontal position error")
        for m, r in comparison.models.items()
    )
    sections = (
        Section(
            "Models over the run",
            "models",
            tuple(FigureBlock(model_figure(r)) for r in comparison.models.values()),
        ),
        Section("Position", "position", (FigureBlock(position_figure(comparison)),)),
        _preparation_section(comparison.run.scenario, comparison.preparation),
    )
    return page("Platform navigation", comparison.run.scenario, tiles, sections)


def comparison_page(
    comparison: Comparison, budget: Sequence[BudgetRow] = (), scatter: Scatter | None = None
) -> Page:
    """Page of ``piga platform compare``."""
    s = comparison.run.scenario
    sections = [
        Section(
            "Lines at the case-rotation period",
            "lines",
            (
                Text(_lines_sentence(comparison), lead=True),
                *((FigureBlock(lines_figure(comparison)),) if _days(comparison) > 1 else ()),
                _line_table(comparison, "east_velocity", "East velocity line", "mm/s", 1e3),
                _line_table(comparison, "heading", "Heading line", "arcmin", 1.0 / ARCMIN),
                _line_table(comparison, "roll", "Roll line", "arcmin", 1.0 / ARCMIN),
            ),
        ),
        Section(
            "Forty minutes and the whole run",
            "histories",
            (FigureBlock(published_figure(comparison)), FigureBlock(histories_figure(comparison))),
        ),
        Section(
            "Spectrum and position",
            "spectrum",
            (FigureBlock(spectrum_figure(comparison)), FigureBlock(position_figure(comparison))),
        ),
        _preparation_section(s, comparison.preparation),
    ]
    if budget:
        sections.append(Section("Error budget by source", "budget", (_budget_table(budget),)))
    if scatter is not None:
        sections.append(Section("Scatter over seeds", "scatter", (_scatter_table(scatter),)))
    return page("Compensation models compared", s, _comparison_tiles(comparison), tuple(sections))


def _preparation_section(s: Scenario, p: Preparation) -> Section:
    blocks: list[Block] = [Notice("info", note) for note in p.notes]
    if p.identification is not None:
        blocks.append(parameter_table(p.identification, s))
    else:
        blocks.append(Text("The true misalignments were used."))
    return Section("What the models were given", "given", tuple(blocks))


def _comparison_tiles(c: Comparison) -> tuple[Tile, ...]:
    return tuple(
        Tile(
            model_name(m),
            short(1e3 * float(r.lines.amplitude["east_velocity"][-1])),
            "mm/s",
            f"east velocity line, day {int(r.lines.day[-1])}",
        )
        for m, r in c.models.items()
    )


def _days(c: Comparison) -> int:
    return int(next(iter(c.models.values())).lines.day[-1])


def _lines_sentence(c: Comparison) -> str:
    day = _days(c)
    if "A" not in c.models:
        return f"Amplitudes at the case-rotation period, fitted over each of {day} days."
    left = float(c.models["A"].lines.amplitude["east_velocity"][-1])
    parts = [f"On day {day} model A leaves an east velocity line of {short(1e3 * left)} mm/s."]
    for m in ("B", "C"):
        if m in c.models:
            share = 1.0 - float(c.models[m].lines.amplitude["east_velocity"][-1]) / left
            parts.append(f"Model {m} removes {100.0 * share:.1f} % of it.")
    theory = c.models["A"].theory
    if theory is not None:
        ratio = float(theory.amplitude["east_velocity"][-1]) / left
        parts.append(f"The closed form for model A is {100.0 * (ratio - 1.0):+.2f} % off what was navigated.")
    return " ".join(parts)


def _line_table(c: Comparison, channel: str, heading: str, unit: str, scale: float) -> Table:
    """One channel day by day: every model, and the theory of model A beside it."""
    columns, values = [Column("day", align="text")], []
    for m, r in c.models.items():
        columns.append(Column(model_name(m), unit))
        values.append(r.lines.amplitude[channel] * scale)
        if r.theory is not None and m == "A":
            columns.append(Column("theory of A", unit))
            values.append(r.theory.amplitude[channel] * scale)
    days = next(iter(c.models.values())).lines.day
    rows = tuple((str(int(day)), *(short(float(v[k])) for v in values)) for k, day in enumerate(days))
    return Table(tuple(columns), rows, caption=heading)


def _budget_table(budget: Sequence[BudgetRow]) -> Table:
    columns = (
        Column("source", align="text"),
        Column("position, linear", "m"),
        Column("position, full run", "m"),
        Column("velocity, linear", "mm/s"),
        Column("velocity, full run", "mm/s"),
        Column("largest difference", "m"),
    )
    rows = tuple(
        (
            b.source,
            short(b.position_linear),
            short(b.position_full),
            short(1e3 * b.velocity_linear),
            short(1e3 * b.velocity_full),
            short(b.difference),
        )
        for b in budget
    )
    return Table(
        columns,
        rows,
        notes=("Largest horizontal error over the run: linear model against a run with the error put in.",),
    )


def _scatter_table(scatter: Scatter) -> Table:
    columns = (
        Column("model", align="text"),
        Column("position, median", "m"),
        Column("position, largest", "m"),
        Column("east line, mean", "mm/s"),
        Column("east line, scatter", "mm/s"),
    )
    rows = tuple(
        (
            model_name(m),
            short(float(np.median(p))),
            short(float(p.max())),
            short(1e3 * float(scatter.east_line[m].mean())),
            short(1e3 * float(scatter.east_line[m].std())),
        )
        for m, p in scatter.position.items()
    )
    return Table(
        columns,
        rows,
        notes=(
            f"{len(scatter.seeds)} runs of the whole chain, seeds {scatter.seeds[0]} to {scatter.seeds[-1]}.",
        ),
    )
