"""The page and the text of a collected campaign: coverage, bias, variance over the bound, NEES, worst cases, failures."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from piga.campaign.campaign_file import NUMBER
from piga.campaign.collect import EDGES, CampaignCoefficient, Collected, GroupResult
from piga.records.terms import shown_unit
from piga.reports.render.figure import Axis, Figure, Panel, Series
from piga.reports.render.numbers import pretty_unit, printed, short, signed
from piga.reports.render.page import (
    ALONE,
    Block,
    Cell,
    FigureBlock,
    Notice,
    Page,
    Section,
    Table,
    TableColumn,
    TableOf,
    Text,
    Tile,
    Tone,
    write_page,
)


@dataclass(frozen=True)
class CampaignPageSettings:
    """What the page of a campaign shows (own choices)."""

    probability: float = 0.95
    """Probability of the intervals."""
    sure: float = 3.29
    """Standard errors beyond which a coverage is marked: 99.9 % of sound ones lie within."""
    groups: int = 60
    """Most groups whose tables are on the page; ``coefficients.csv`` has all."""
    figures: int = 8
    """Most coefficients with a figure over the grid."""


SHOWN = CampaignPageSettings()


def write_campaign_report(collected: Collected, path: Path) -> Path:
    """Write the page as one HTML file that opens offline."""
    return write_page(campaign_page(collected), path)


def campaign_page(collected: Collected) -> Page:
    """The page of a campaign."""
    sections = [Section("Judgement", "judgement", _judgement(collected))]
    judged = [result for result in collected.groups if _has_truth(result)]
    if judged:
        sections.append(Section("Intervals", "intervals", tuple(_intervals(judged))))
    compared = [result for result in collected.groups if result.group.subject == "archive"]
    if compared:
        sections.append(Section("Compared with the store", "store", tuple(_compared(compared))))
    plain = [r for r in collected.groups if r.coefficients and not _has_truth(r) and r not in compared]
    if plain:
        sections.append(Section("Results", "results", tuple(_plain_tables(plain))))
    grid = _grid_figures(collected)
    if grid:
        sections.append(Section("Over the grid", "grid", tuple(FigureBlock(figure) for figure in grid)))
    seen = [result for result in collected.groups if result.seen]
    if seen:
        sections.append(Section("What the calibrations report", "seen", (_seen_table(seen),)))
    if collected.worst:
        sections.append(Section("Worst cases", "worst", (_worst_table(collected),)))
    if collected.failures:
        sections.append(Section("Records that failed", "failures", (_failure_table(collected),)))
    return Page(
        title=collected.title,
        subtitle=f"{collected.computed} of {collected.records} records, from {collected.file}, seed {collected.seed}.",
        tiles=_tiles(collected, judged),
        sections=tuple(sections),
        kicker="piga · campaign",
        footer=f"Made by piga {collected.version}. {ALONE}",
    )


def _has_truth(result: GroupResult) -> bool:
    return any(c.coverage is not None for c in result.coefficients)


def _judgement(collected: Collected) -> tuple[Block, ...]:
    blocks: list[Block] = []
    if collected.set_aside:
        named = ", ".join(str(shard) for shard in sorted(collected.set_aside))
        blocks.append(
            Notice(
                "problem",
                f"Shards were set aside because their worker died twice: {named}. Their records are missing.",
            )
        )
    waiting = len(collected.missing) - len(collected.set_aside)
    if waiting > 0:
        blocks.append(Notice("warning", f"{waiting} of {collected.shards} shards are not computed yet."))
    empty = [r.group.label for r in collected.groups if r.failed and not r.coefficients]
    if empty:
        named = "; ".join(empty[:3]) + (f" and {len(empty) - 3} more" if len(empty) > 3 else "")
        blocks.append(Notice("problem", f"Not one record could be computed of: {named}."))
    if collected.failed:
        blocks.append(
            Notice(
                "warning",
                f"{collected.failed} of {collected.computed} records failed. They are not in the figures below.",
            )
        )
    off = [(r, c) for r in collected.groups for c in r.coefficients if _tone(c) == "bad"]
    named = "; ".join(f"{c.name} of {r.group.label} ({_percent(c.coverage)})" for r, c in off[:3])
    if off:
        more = f" and {len(off) - 3} more, marked below" if len(off) > 3 else ""
        blocks.append(
            Notice("warning", f"Coverage is away from 95 % by more than chance explains: {named}{more}.")
        )
    changed = sum(r.verdicts.get("different", 0) for r in collected.groups)
    if changed:
        blocks.append(Notice("warning", f"{changed} calibrations differ from what the store holds."))
    if not blocks:
        blocks.append(Notice("good", "All records are computed, and none is out of the ordinary."))
    return tuple(blocks)


def _tone(c: CampaignCoefficient) -> Tone:
    """Bad if fewer intervals hold than chance explains, doubtful if more hold."""
    if c.coverage is None:
        return ""
    off = (c.coverage - SHOWN.probability) / math.sqrt(SHOWN.probability * (1.0 - SHOWN.probability) / c.tests)
    return "bad" if off < -SHOWN.sure else "doubtful" if off > SHOWN.sure else ""


def _tiles(collected: Collected, judged: list[GroupResult]) -> tuple[Tile, ...]:
    tiles = [
        Tile("Records", str(collected.computed), f"of {collected.records}", f"{len(collected.groups)} groups"),
        Tile(
            "Failed",
            str(collected.failed),
            "",
            "see below" if collected.failed else "none",
            "doubtful" if collected.failed else "good",
        ),
    ]
    shares = [
        (c.coverage, c.name, r.group.label) for r in judged for c in r.coefficients if c.coverage is not None
    ]
    if shares:
        low, high = min(shares), max(shares)
        tiles.append(Tile("Lowest coverage", f"{100 * low[0]:.1f}", "%", f"{low[1]}, {low[2]}"))
        tiles.append(Tile("Highest coverage", f"{100 * high[0]:.1f}", "%", f"{high[1]}, {high[2]}"))
    aside = len(collected.set_aside)
    tiles.append(Tile("Shards set aside", str(aside), "", "", "bad" if aside else "good"))
    return tuple(tiles)


# --- intervals ---------------------------------------------------------------------------------------

_LEAD = (
    "Coverage is the share of 95 % intervals that hold the true value, with its binomial standard error. It is marked where "
    "it is away from 95 % by more than chance explains. Bias is the mean error over the spread of the errors. Variance / bound "
    "compares the spread with the bound of Cramer and Rao. NEES is the mean square of the errors over their standard "
    "uncertainties. Beside it stands what Student's t lets expect."
)


def _intervals(judged: list[GroupResult]) -> list[Block]:
    blocks: list[Block] = [Text(_LEAD, lead=True), FigureBlock(coverage_figure(judged))]
    blocks += [_interval_table(result) for result in judged[: SHOWN.groups]]
    if len(judged) > SHOWN.groups:
        blocks.append(Text(f"{len(judged) - SHOWN.groups} more groups are in coefficients.csv."))
    blocks.append(FigureBlock(error_figure(judged)))
    return blocks


def _interval_table(result: GroupResult) -> Table:
    note = f"{result.records} records, {sum(result.failed.values())} failed."
    if result.nees is not None:
        note += f" NEES of all coefficients together: {result.nees:.3f}; expected {result.nees_expected:.3f}."
    return (
        _coefficients("Coefficient", "Tests", result)
        .number("Coverage", lambda c: Cell(_with_error(c), _tone(c)), "%")
        .number("Spread of errors", lambda c: _number(c, c.spread))
        .number("Mean error", lambda c: _number(c, c.bias))
        .number("Bias / sigma", lambda c: _or_dash(c.bias_over_sigma, lambda x: printed(signed(x, 3))))
        .number("Variance / bound", lambda c: _or_dash(c.variance_over_bound, "{:.2f}".format))
        .number("NEES (expected)", lambda c: _or_dash(c.nees, lambda x: f"{x:.2f} ({c.nees_expected:.2f})"))
        .number("Largest error", lambda c: _or_dash(c.largest_z, "{:.1f}".format), "u")
        .table(result.group.label, (note,))
    )


def _coefficients(what: str, count: str, result: GroupResult) -> TableOf[CampaignCoefficient]:
    """The begin of a table of coefficients: name, unit, and how many tests there are."""
    return (
        TableOf(result.coefficients)
        .text(what, lambda c: c.name)
        .text("Unit", _unit)
        .number(count, lambda c: str(c.tests))
    )


def _or_dash(value: float | None, words: Callable[[float], str]) -> str:
    return "–" if value is None else words(value)


def _seen_table(results: list[GroupResult]) -> Table:
    """Share of the records of each group whose calibration reports a kind of noise or suggests a term."""
    names = sorted(dict.fromkeys(name for result in results for name in result.seen))
    columns = (
        TableColumn("Group", align="text"),
        TableColumn("Records"),
        *(TableColumn(name, "%") for name in names),
    )
    rows = tuple(
        (
            result.group.label,
            str(result.records),
            *(f"{100 * result.seen[name]:.1f}" if name in result.seen else "–" for name in names),
        )
        for result in results
    )
    return Table(
        columns, rows, notes=("Share of the records with this noise in the result, or this term suggested.",)
    )


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.1f} %"


def _with_error(c: CampaignCoefficient) -> str:
    if c.coverage is None or c.coverage_std_error is None:
        return "–"
    return f"{100 * c.coverage:.1f} ± {100 * c.coverage_std_error:.1f}"


def _unit(c: CampaignCoefficient) -> str:
    """Unit in which a coefficient is shown, as on all pages."""
    return pretty_unit(shown_unit(c.name, c.unit)[1]) or "1"


def _number(c: CampaignCoefficient, value: float | None) -> str:
    """A value of a coefficient in the unit that is shown."""
    if value is None or not math.isfinite(value):
        return "–"
    return printed(short(value * shown_unit(c.name, c.unit)[0], 3))


def coverage_figure(judged: list[GroupResult]) -> Figure:
    """Coverage of every coefficient, group by group, with two standard errors; the line at 95 %."""
    points = [(r, c) for r in judged for c in r.coefficients if c.coverage is not None]
    x = np.arange(1, len(points) + 1, dtype=float)
    share = np.array([100 * (c.coverage or 0.0) for _, c in points])
    error = np.array([200 * (c.coverage_std_error or 0.0) for _, c in points])
    marked = np.array([_tone(c) != "" for _, c in points])
    text = tuple(f"{r.group.label}: {c.name}" for r, c in points)
    series = [
        Series([0.5, len(points) + 0.5], [95.0, 95.0], "95 %", role="reference", dashed=True),
        *(
            Series(
                x[chosen],
                share[chosen],
                name,
                mark="points",
                role=role,  # type: ignore[arg-type]
                error=error[chosen],
                text=tuple(label for label, one in zip(text, chosen, strict=True) if one),
            )
            for chosen, name, role in ((~marked, "coefficients", "data"), (marked, "beyond chance", "warning"))
            if chosen.any()
        ),
    ]
    return Figure(
        "coverage",
        "Coverage of the 95 % intervals.",
        (Panel(Axis("coefficients in the order of the tables", ""), Axis("coverage", "%"), tuple(series)),),
        caption="One point for each coefficient of each group, with two standard errors. Good: the bars touch the line.",
    )


def error_figure(judged: list[GroupResult]) -> Figure:
    """Histogram of all errors over their standard uncertainties, beside the normal distribution."""
    counts = sum(
        (np.array(c.histogram) for r in judged for c in r.coefficients if c.histogram), np.zeros(EDGES.size - 1)
    )
    middle, width = 0.5 * (EDGES[1:] + EDGES[:-1]), EDGES[1] - EDGES[0]
    density = counts / max(counts.sum(), 1) / width
    grid = np.linspace(EDGES[0], EDGES[-1], 201)
    series = (
        Series(middle, density, "errors of all coefficients", mark="bars", role="data"),
        Series(grid, np.exp(-0.5 * grid**2) / math.sqrt(2 * math.pi), "normal distribution", role="model"),
    )
    return Figure(
        "errors",
        "Errors over standard uncertainties.",
        (Panel(Axis("error / u", "1"), Axis("density", "1"), series),),
        caption="All coefficients of all groups. Errors beyond 5 u are in the outer bars. Good: the bars follow the curve. "
        "With few degrees of freedom the tails are heavier, as those of Student's t.",
    )


# --- archive, platform -------------------------------------------------------------------------------


def _compared(results: list[GroupResult]) -> list[Block]:
    """How calibrations of an archive compare with the stored ones."""
    blocks: list[Block] = []
    for result in results:
        if not result.verdicts:
            blocks.append(
                Text("The archive was calibrated. No store was given, or it holds none of these runs.")
            )
        else:
            counted = sorted(result.verdicts.items(), key=lambda item: -item[1])
            unknown = result.records - sum(result.verdicts.values()) - sum(result.failed.values())
            table = TableOf(counted).text("Compared with the stored calibration", lambda item: item[0])
            table.number("Records", lambda item: str(item[1]))
            blocks.append(table.table(notes=(f"{unknown} records are not in the store.",)))
        blocks.append(
            _coefficients("Coefficient", "Records", result)
            .number("Mean", lambda c: _number(c, c.mean))
            .number("Std", lambda c: _number(c, c.std))
            .number("Mean change", lambda c: _number(c, c.bias))
            .number("Largest change", lambda c: _or_dash(c.largest_z, lambda x: printed(short(x, 2))), "u")
            .table("Coefficients, new less stored")
        )
    return blocks


def _plain_tables(results: list[GroupResult]) -> list[Block]:
    """Quantities without truth, group by group."""
    blocks: list[Block] = [
        _coefficients("Quantity", "Records", result)
        .number("Mean", lambda c: _number(c, c.mean))
        .number("Std", lambda c: _number(c, c.std))
        .number("Lowest", lambda c: _number(c, c.lowest))
        .number("Highest", lambda c: _number(c, c.highest))
        .table(result.group.label, (f"{result.records} records, {sum(result.failed.values())} failed.",))
        for result in results[: SHOWN.groups]
    ]
    if len(results) > SHOWN.groups:
        blocks.append(Text(f"{len(results) - SHOWN.groups} more groups are in coefficients.csv."))
    return blocks


# --- grid --------------------------------------------------------------------------------------------


def _grid_figures(collected: Collected) -> list[Figure]:
    """For each coefficient a figure over the first numeric key of the grid, with a line for each value of the other keys."""
    results = [result for result in collected.groups if result.group.set]
    keys = list(results[0].group.set) if results else []
    key = next(
        (k for k in keys if len({_as_quantity(r.group.set.get(k))[0] for r in results} - {None}) > 1), None
    )
    if key is None:
        return []
    names = dict.fromkeys(c.name for r in results for c in r.coefficients)
    return [_grid_figure(results, key, name) for name in list(names)[: SHOWN.figures]]


def _as_quantity(value: object) -> tuple[float | None, str]:
    """Number and unit of a value of the grid. A text that is no quantity is all unit."""
    match = NUMBER.fullmatch(str(value))
    return (float(match[1]), match[2]) if match else (None, str(value))


def _grid_figure(results: list[GroupResult], key: str, name: str) -> Figure:
    lines: dict[str, list[tuple[float, float, float]]] = {}
    unit, judged = "", False
    for result in results:
        c = next((one for one in result.coefficients if one.name == name), None)
        x, _ = _as_quantity(result.group.set.get(key))
        if c is None or x is None:
            continue
        scale, unit = shown_unit(c.name, c.unit)
        judged = judged or c.bias is not None
        others = [f"{k} = {v}" for k, v in result.group.set.items() if k != key]
        label = ", ".join([result.group.name] * bool(result.group.name) + others) or name
        middle = c.bias if c.bias is not None else c.mean
        spread = c.spread if c.bias is not None else c.std
        lines.setdefault(label, []).append((x, scale * middle, 0.0 if spread is None else scale * spread))
    places = sorted({x for line in lines.values() for x, _, _ in line})
    log = places[0] > 0.0 and places[-1] / places[0] > 20.0
    roles = ("data", "model", "before", "after", "x", "y", "z", "muted")
    series = []
    for index, (label, line) in enumerate(list(lines.items())[: len(roles)]):
        x, y, error = np.array(sorted(line)).T
        series.append(Series(x, y, label, mark="line+points", role=roles[index], error=error))  # type: ignore[arg-type]
    _, shown = _as_quantity(results[0].group.set[key])
    quantity = f"error of {name}" if judged else name
    return Figure(
        f"grid-{re.sub('[^A-Za-z0-9]+', '-', name).strip('-')}",
        f"{quantity} over {key}.",
        (Panel(Axis(key, shown, log=log), Axis(quantity, pretty_unit(unit)), tuple(series)),),
        caption="Mean of the records of each point, with the standard deviation of one record as bar."
        + (" Only the first lines are drawn; the tables have all." if len(lines) > len(roles) else ""),
    )


# --- worst cases -------------------------------------------------------------------------------------


def _worst_table(collected: Collected) -> Table:
    return (
        TableOf(collected.worst)
        .text("Group", lambda w: w.group)
        .text("Coefficient", lambda w: w.coefficient)
        .number("Error", lambda w: printed(signed(w.z, 1)), "u")
        .text("Repeat it with", lambda w: w.command)
        .table("The largest errors over their standard uncertainties")
    )


def _failure_table(collected: Collected) -> Table:
    return (
        TableOf(collected.failures)
        .text("Class", lambda f: f.error_class)
        .number("Records", lambda f: str(f.records))
        .text("First message", lambda f: f.message[:300])
        .text("Repeat it with", lambda f: f.command)
        .table("A record that fails is a row; the campaign goes on.")
    )


# --- text --------------------------------------------------------------------------------------------


def collected_text(collected: Collected) -> str:
    """Summary for the terminal."""
    lines = [
        f"{collected.title}: {collected.computed} of {collected.records} records, {collected.failed} failed"
    ]
    for result in collected.groups[: SHOWN.groups]:
        lines += ["", result.group.label]
        lines += [_text_line(c) for c in result.coefficients]
        if result.nees is not None:
            lines.append(f"  NEES {result.nees:.3f} (expected {result.nees_expected:.3f})")
        lines += [f"  {count} {name}" for name, count in result.verdicts.items()]
    if len(collected.groups) > SHOWN.groups:
        lines.append(f"and {len(collected.groups) - SHOWN.groups} more groups")
    lines += [
        f"failed: {f.records} x {f.error_class}: {f.message.splitlines()[0]}"
        for f in collected.failures
        if f.message
    ]
    lines += [f"worst: {w.coefficient} {w.z:+.1f} u: {w.command}" for w in collected.worst[:3]]
    return "\n".join(lines)


def _text_line(c: CampaignCoefficient) -> str:
    if c.coverage is None:
        spread = "" if c.std is None else f"   std {c.std:.2g}"
        change = "" if c.largest_z is None else f"   largest change {c.largest_z:.2g} u"
        return f"  {c.name:<34}{c.tests:>8} records   mean {c.mean:.9g} {c.unit}{spread}{change}"
    ratio = "" if c.variance_over_bound is None else f"   variance/bound {c.variance_over_bound:.2f}"
    bias = "" if c.bias_over_sigma is None else f"   bias {c.bias_over_sigma:+.3f} sigma"
    share = f"{100 * c.coverage:.1f} +- {100 * (c.coverage_std_error or 0):.1f} %"
    nees = f"NEES {c.nees or math.nan:.2f} ({c.nees_expected or math.nan:.2f})"
    return f"  {c.name:<16}{c.tests:>8} tests   coverage {share}{bias}{ratio}   {nees}"
