"""Pages of ``piga platform navigate`` and ``compare``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from piga.platform.model.scenario import Scenario
from piga.platform.navigation.analysis import case_rates
from piga.platform.runs.budget import BudgetRow, LineRow, Scatter, last_east_lines
from piga.platform.runs.chain import Comparison, Preparation
from piga.reports.platform.figures import ARCMIN, model_name
from piga.reports.platform.model_figures import (
    REFERENCE_MODEL,
    Case,
    histories_figure,
    lines_figure,
    model_figure,
    position_figure,
    published_figure,
    spectrum_figure,
)
from piga.reports.platform.parts import page, parameter_table
from piga.reports.render.numbers import short
from piga.reports.render.page import Block, Column, FigureBlock, Notice, Page, Section, Table, Text, Tile
from piga.units import ARCSEC


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
    comparison: Comparison,
    budget: Sequence[BudgetRow] = (),
    lines: Sequence[LineRow] = (),
    scatter: Scatter | None = None,
) -> Page:
    """Page of ``piga platform compare``."""
    s = comparison.run.scenario
    sections = [
        *_line_sections(comparison),
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
        tables = (_budget_table(budget), *((_line_budget_table(lines),) if lines else ()))
        sections.append(Section("Error budget by source", "budget", tables))
    if scatter is not None:
        sections.append(Section("Scatter over seeds", "scatter", (_scatter_table(scatter),)))
    return page("Compensation models compared", s, _comparison_tiles(comparison), tuple(sections))


def _line_sections(c: Comparison) -> list[Section]:
    """Lines at the polar case's rate and, at another speed, at the equatorial one's."""
    if not _unequal(c):
        return [Section("Lines at the case-rotation period", "lines", _line_blocks(c, "amplitude"))]
    periods = [2.0 * np.pi / rate if rate > 0.0 else np.inf for rate in case_rates(c.run.scenario)]
    titles = [
        f"Lines of the {gyro} gyro's case, period {short(period)} s"
        for gyro, period in zip(("polar", "equatorial"), periods, strict=True)
    ]
    return [
        Section(titles[0], "lines", _line_blocks(c, "amplitude")),
        Section(titles[1], "equatorial-lines", _line_blocks(c, "equatorial")),
    ]


def _unequal(c: Comparison) -> bool:
    return any(r.lines.equatorial for r in c.models.values())


def _line_blocks(c: Comparison, which: Case) -> tuple[Block, ...]:
    tables = (
        _line_table(c, which, "east_velocity", "East velocity line", "mm/s", 1e3),
        _line_table(c, which, "north_velocity", "North velocity line", "mm/s", 1e3),
        _line_table(c, which, "heading", "Heading line", "arcmin", 1.0 / ARCMIN),
        _line_table(c, which, "roll", "Roll line", "arcmin", 1.0 / ARCMIN),
    )
    figure = (FigureBlock(lines_figure(c, which)),) if _days(c) > 1 else ()
    return (Text(_lines_sentence(c, which), lead=True), *figure, *tables)


def _preparation_section(s: Scenario, p: Preparation) -> Section:
    blocks: list[Block] = [Notice("info", note) for note in p.notes]
    if p.identification is not None:
        blocks.append(parameter_table(p.identification, s))
    else:
        blocks.append(Text("The true misalignments were used."))
    return Section("What the models were given", "given", tuple(blocks))


def _comparison_tiles(c: Comparison) -> tuple[Tile, ...]:
    whose = " (polar, equatorial case)" if _unequal(c) else ""
    return tuple(
        Tile(
            model_name(m),
            ", ".join(short(1e3 * line) for line in last_east_lines(r.lines)),
            "mm/s",
            f"east velocity line{whose}, day {int(r.lines.day[-1])}",
        )
        for m, r in c.models.items()
    )


def _days(c: Comparison) -> int:
    return int(next(iter(c.models.values())).lines.day[-1])


def _lines_sentence(c: Comparison, which: Case) -> str:
    day, shown = _days(c), REFERENCE_MODEL[which]
    east = {m: float(getattr(r.lines, which)["east_velocity"][-1]) for m, r in c.models.items()}
    left = east.get(shown, np.nan)
    if not np.isfinite(left):
        return f"Amplitudes at the case-rotation period, fitted over each of {day} days."
    whose = "no model leaves" if shown == "none" else f"model {shown} leaves"
    parts = [f"On day {day} {whose} an east velocity line of {short(1e3 * left)} mm/s."]
    removed = {m: 100.0 * (1.0 - line / left) for m, line in east.items() if m not in ("none", shown)}
    parts += [f"Model {m} removes {share:.1f} % of it." for m, share in removed.items()]
    theory = c.models[shown].theory
    if theory is not None:
        ratio = float(getattr(theory, which)["east_velocity"][-1]) / left
        name = "no model" if shown == "none" else f"model {shown}"
        parts.append(f"The closed form for {name} is {100.0 * (ratio - 1.0):+.2f} % off what was navigated.")
    return " ".join(parts)


def _line_table(c: Comparison, which: Case, channel: str, heading: str, unit: str, scale: float) -> Table:
    """One channel day by day: every model, and the theory of one of them beside it."""
    columns, values = [Column("day", align="text")], []
    for m, r in c.models.items():
        columns.append(Column(model_name(m), unit))
        values.append(getattr(r.lines, which)[channel] * scale)
        if r.theory is not None and m == REFERENCE_MODEL[which]:
            columns.append(Column(f"theory, {model_name(m)}", unit))
            values.append(getattr(r.theory, which)[channel] * scale)
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


def _line_budget_table(budget: Sequence[LineRow]) -> Table:
    """Lines of each misalignment alone: closed form and full run."""
    shown = (("east_velocity", "mm/s", 1e3), ("north_velocity", "mm/s", 1e3), ("heading", "arcsec", 1.0 / ARCSEC),
             ("roll", "arcsec", 1.0 / ARCSEC))  # fmt: skip
    columns = [Column("source", align="text"), Column("period", "s")]
    for name, unit, _ in shown:
        columns += [Column(f"{name.replace('_', ' ')}, {how}", unit) for how in ("linear", "full run")]
    rows = []
    for b in budget:
        numbers = [short(scale * v[name]) for name, _, scale in shown for v in (b.theory, b.full)]
        rows.append((b.source, f"{b.period:g}", *numbers))
    return Table(
        tuple(columns),
        tuple(rows),
        caption="Lines at the case-rotation periods by misalignment",
        notes=(
            "Last day; the misalignment is wrong by its standard uncertainty (or one arc-second), base at rest.",
        ),
    )


def _scatter_table(scatter: Scatter) -> Table:
    lines = [("east line", scatter.east_line)]
    if scatter.equatorial_line:
        lines.append(("east line, equatorial case", scatter.equatorial_line))
    columns = [
        Column("model", align="text"),
        Column("position, median", "m"),
        Column("position, largest", "m"),
    ]
    for name, _ in lines:
        columns += [Column(f"{name}, {what}", "mm/s") for what in ("mean", "scatter")]
    rows = []
    for m, p in scatter.position.items():
        numbers = [f(1e3 * drawn[m]) for _, drawn in lines for f in (np.mean, np.std)]
        rows.append((model_name(m), *(short(float(v)) for v in (np.median(p), p.max(), *numbers))))
    return Table(
        tuple(columns),
        tuple(rows),
        notes=(
            f"{len(scatter.seeds)} runs of the whole chain, seeds {scatter.seeds[0]} to {scatter.seeds[-1]}.",
        ),
    )
