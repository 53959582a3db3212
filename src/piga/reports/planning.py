"""The page of a planned test, its figures, and its summary for the terminal."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from piga._version import __version__
from piga.planning.candidates import Candidate, Prediction
from piga.planning.mounting import Mounting
from piga.planning.plan import Plan
from piga.records.terms import meaning_of, shown_unit, unit_of
from piga.reports.render.decimate import envelope_rows
from piga.reports.render.figure import Axis, Figure, Panel, Role, Series
from piga.reports.render.numbers import pretty_unit, printed, short, significant
from piga.reports.render.page import (
    Block,
    Cell,
    FigureBlock,
    Notice,
    Page,
    Section,
    Table,
    TableOf,
    Text,
    Tile,
    Tone,
    named_values,
    write_page,
)
from piga.units import G0

Array = NDArray[np.float64]

POINTS = 1500
SHOWN = 1e4
"""Largest margin that is drawn. Larger margins are drawn at this value."""


def _forces(candidates: tuple[Candidate, ...]) -> tuple[Array, Array]:
    """Force along and across the input axis [g]."""
    f = np.array([candidate.force for candidate in candidates]).reshape(-1, 3) / G0
    return f[:, 0], np.copysign(np.hypot(f[:, 1], f[:, 2]), np.where(np.abs(f[:, 1]) > 1e-9, f[:, 1], f[:, 2]))


def dwell_figure(plan: Plan) -> Figure:
    """Chosen positions in the plane of the forces, and the time in each."""
    x, y = _forces(plan.candidates)
    chosen = tuple(visit.candidate for visit in plan.best.visits)
    cx, cy = _forces(chosen)
    named = tuple(f"{v.candidate.label}: {short(v.dwell)} s" for v in plan.best.visits)
    places = [Series(x, y, "candidate", "points", "muted", text=tuple(c.label for c in plan.candidates))]
    if plan.excluded:
        ex, ey = _forces(tuple(item.candidate for item in plan.excluded))
        reasons = tuple(f"{item.candidate.label}: {item.reason}" for item in plan.excluded)
        places.append(Series(ex, ey, "excluded", "points", "warning", text=reasons))
    places.append(Series(cx, cy, "chosen", "points", "after", text=named))
    number = np.arange(1, len(chosen) + 1)
    dwells = [visit.dwell for visit in plan.best.visits]
    time = Series(number, dwells, "dwell", "bars", "after", text=named)
    return Figure(
        "plan-positions",
        "Chosen positions and the time in each",
        (
            Panel(
                Axis("force along X0", "g"), Axis("force across", "g"), tuple(places), "Positions", equal=True
            ),
            Panel(
                Axis("visit in the order of the table", "", limits=(0.4, len(chosen) + 0.6)),
                Axis("dwell", "s", limits=(0.0, 1.1 * max(dwells))),
                (time,),
                "Dwell",
            ),
        ),
        "The whole time goes to a few positions; the others would add less per second, moves counted.",
        columns=2,
    )


def uncertainty_figure(plan: Plan) -> Figure:
    """Predicted standard uncertainty of each coefficient over that of the plan, for the standard plans."""
    number = np.arange(1, len(plan.names) + 1)
    roles: tuple[Role, ...] = ("z", "y", "x", "before")
    series = [Series(number, np.ones(number.size), "planned", "line+points", "after")]
    for k, prediction in enumerate(plan.standard):
        ratio = np.array([prediction.std(name) / plan.best.std(name) for name in plan.names])
        shift = number + 0.09 * (k - 0.5 * (len(plan.standard) - 1))
        known = np.isfinite(ratio)
        if known.any():
            text = tuple(f"{n}: {short(r)}" for n, r, ok in zip(plan.names, ratio, known, strict=True) if ok)
            role = roles[k % len(roles)]
            series.append(Series(shift[known], ratio[known], prediction.name, "points", role, text=text))
    listed = ", ".join(f"{k} {name}" for k, name in zip(number, plan.names, strict=True))
    return Figure(
        "plan-uncertainty",
        "Uncertainty of the standard plans over that of this plan",
        (
            Panel(
                Axis(f"coefficient: {listed}", "", limits=(0.5, number.size + 0.5)),
                Axis("standard uncertainty, ratio", "1", log=True),
                tuple(series),
            ),
        ),
        "Type A, same total time. Above 1 the standard plan is less certain; a plan without a point cannot separate "
        "the terms.",
    )


def duration_figure(plan: Plan) -> Figure:
    """Uncertainty against duration, relative to the plan, per coefficient."""
    hours = np.array([duration for duration, _, _ in plan.stretched]) / 60.0
    panels = []
    for name in plan.names:
        own = np.array([a.std(name) for _, a, _ in plan.stretched]) / plan.best.std(name)
        usual = np.array([b.std(name) for _, _, b in plan.stretched]) / plan.best.std(name)
        curves = [Series(hours, own, "planned", "line+points", "after")]
        known = np.isfinite(usual)
        if known.any():
            label = plan.stretched[-1][2].name
            curves.append(Series(hours[known], usual[known], label, "line+points", "before"))
        middle = plan.request.duration / 60.0
        curves.append(Series(hours, np.sqrt(middle / hours), "1/sqrt(time)", "line", "muted", dashed=True))
        panels.append(
            Panel(
                Axis("duration of the test", "min", log=True),
                Axis("u over that of the plan", "1", log=True),
                tuple(curves),
                name,
            )
        )
    return Figure(
        "plan-duration",
        "Uncertainty against duration",
        tuple(panels),
        "Type A. With the angle random walk alone the curves fall as one over the root of the time; where quantisation "
        "rules, longer dwells gain more.",
        columns=2,
        height=2.6,
    )


def lock_figure(plan: Plan) -> Figure:
    """Distance of every candidate from the lock zone, and its gain per second."""
    number = np.arange(1, len(plan.candidates) + 1)
    margin = np.array([min(c.margin, SHOWN) for c in plan.candidates])
    shown = np.maximum(margin, 1e-2)
    limit = plan.request.settings.margin
    labels = tuple(f"{c.label}: {short(c.margin)}" for c in plan.candidates)
    return Figure(
        "plan-lock",
        "Distance from the lock zone",
        (
            Panel(
                Axis("candidate, in the order of the stand", ""),
                Axis("|a_x| over a_t tan(beta)", "1", log=True),
                (
                    Series(number, shown, "candidate", "points", "data", text=labels),
                    Series(
                        [0, number.size + 1], [limit, limit], "wanted margin", "line", "warning", dashed=True
                    ),
                    Series([0, number.size + 1], [1.0, 1.0], "lock zone", "line", "before"),
                ),
            ),
        ),
        "Below the solid line the output stands still whatever the input; positions below the dashed line are left out. "
        "Values beyond 0.01 and 10 000 are drawn there.",
    )


def mounting_figure(mounting: Mounting) -> Figure:
    """Margin against skew, and along the profile for the best mounting."""
    degrees = np.degrees(mounting.skews)
    best = np.clip(mounting.margins.max(axis=1), 1e-2, SHOWN)
    worst = np.clip(mounting.margins.min(axis=1), 1e-2, SHOWN)
    limits = [mounting.limit, mounting.limit]
    ends = [float(degrees[0]), float(degrees[-1])]
    skew = Panel(
        Axis("skew of the instrument", "deg"),
        Axis("least |a_x| over a_t tan(beta)", "1", log=True),
        (
            Series(degrees, best, "best direction", "line", "after"),
            Series(degrees, worst, "worst direction", "line", "before"),
            Series(ends, limits, "wanted margin", "line", "warning", dashed=True),
        ),
        "Margin against skew",
    )
    curves = []
    names: tuple[tuple[str, Array, Role], ...] = (
        ("not skewed", mounting.unskewed_history, "before"),
        (f"skew {math.degrees(mounting.skew):.3g} deg", mounting.margin_history, "after"),
    )
    for name, history, role in names:
        values = np.clip(history, 1e-2, SHOWN)
        rows = envelope_rows(np.log(values), POINTS)
        curves.append(Series(mounting.t[rows], values[rows], name, "line", role))
    span = [float(mounting.t[0]), float(mounting.t[-1])]
    curves.append(Series(span, limits, "wanted margin", "line", "warning", dashed=True))
    along = Panel(
        Axis("time", "s"), Axis("|a_x| over a_t tan(beta)", "1", log=True), tuple(curves), "Along the profile"
    )
    return Figure(
        "plan-mounting",
        "Skew of the instrument on the platform",
        (skew, along),
        "The instrument measures where the margin is above 1. Values beyond 0.01 and 10 000 are drawn there.",
    )


_CRITERIA = {
    "D": "the volume of the uncertainty ellipsoid",
    "A": "the mean variance of the coefficients, each over its wanted or equal-time variance",
    "c": "the variance of the given combination",
    "wanted": "the largest ratio of an uncertainty to the wanted one",
}


def write_plan_report(plan: Plan, mounting: Mounting | None, path: Path) -> None:
    """Write the page of ``plan`` to ``path``; ``mounting`` adds how to mount the instrument, or is None."""
    write_page(plan_page(plan, mounting), path)


def plan_page(plan: Plan, mounting: Mounting | None) -> Page:
    """The page of a planned test."""
    lead = Text(f"Least is {_CRITERIA[plan.request.settings.criterion]}.", lead=True)
    places, spread = FigureBlock(dwell_figure(plan)), FigureBlock(uncertainty_figure(plan))
    sections = [
        Section("The test", "the-test", (lead, places, visit_table(plan))),
        Section("What it will give", "what-it-gives", (uncertainty_table(plan), spread)),
        Section("Time", "time", (*_cheapest_blocks(plan), FigureBlock(duration_figure(plan)))),
        Section("Lock zone", "lock-zone", (FigureBlock(lock_figure(plan)), *_excluded_blocks(plan))),
    ]
    if mounting is not None:
        blocks = (_mounting_notice(mounting), FigureBlock(mounting_figure(mounting)))
        sections.append(Section("Mounting", "mounting", blocks))
    return Page(
        title=f"Planned test of {plan.request.table.instrument.serial}",
        subtitle=f"{len(plan.best.visits)} visits in {short(plan.best.duration)} s, moves of {short(plan.request.move)} s.",
        tiles=_tiles(plan),
        sections=tuple(sections),
        kicker="piga · plan",
        footer=f"Made by piga {__version__}. Predicted from the expected coefficients and noise; nothing was measured.",
    )


def relative_uncertainty(plan: Plan, prediction: Prediction) -> float:
    """Geometric mean of the uncertainties of the plan over those of another test (coefficients alike)."""
    ratios = [plan.best.std(name) / prediction.std(name) for name in plan.names]
    return math.exp(sum(math.log(r) for r in ratios) / len(ratios)) if min(ratios) > 0.0 else 0.0


def _tiles(plan: Plan) -> tuple[Tile, ...]:
    reference = plan.reference
    tiles = [
        Tile("Visits", str(len(plan.best.visits)), detail=f"of {len(plan.candidates)} candidates"),
        Tile("Recorded", short(plan.best.recorded), "s", f"of {short(plan.best.duration)} s"),
    ]
    if not reference.refusal:
        gain = relative_uncertainty(plan, reference)
        tiles.append(
            Tile(
                "Uncertainty",
                f"{100.0 * (1.0 - gain):.0f}",
                "% smaller",
                f"than {reference.name}, geometric mean",
                "good",
            )
        )
    tiles.append(
        Tile("Efficiency", f"{100.0 * plan.efficiency:.1f}", "%", "of the bound that no test can exceed")
    )
    return tuple(tiles)


def visit_table(plan: Plan) -> Table:
    """Visits of the plan in the order of the test."""
    return (
        TableOf(plan.best.visits)
        .text("position or level", lambda visit: visit.candidate.label)
        .number("dwell", lambda visit: f"{visit.dwell:.2f}", "s")
        .number("revolutions", lambda visit: f"{visit.dwell / visit.candidate.revolution:.2f}")
        .number("force along X0", lambda visit: f"{visit.candidate.force[0] / G0:+.4f}", "g")
        .table("Visits in the order of the test.")
    )


def uncertainty_table(plan: Plan) -> Table:
    """Predicted uncertainties, and those of the standard plans as multiples."""
    shown = [(name, *shown_unit(name, unit_of(name))) for name in plan.names]
    table = (
        TableOf(shown)
        .text("coefficient", lambda row: f"{row[0]}: {meaning_of(row[0])}")
        .text("unit", lambda row: pretty_unit(row[2]) or "1")
        .number("u, Type A", lambda row: printed(significant(plan.best.std(row[0]) * row[1], 3)))
        .number("u with the stand", lambda row: printed(significant(plan.best.combined(row[0]) * row[1], 3)))
    )
    for one in plan.standard:
        table.number(one.name, _over_planned(plan, one), "u / planned")
    refusals = tuple(f"{p.name}: {p.refusal}." for p in plan.standard if p.refusal) + _locked_notes(plan)
    caption = "Predicted standard uncertainties; standard plans in the same total time, as multiples of the plan's Type A."
    return table.table(caption, refusals)


def _over_planned(plan: Plan, prediction: Prediction) -> Callable[[tuple[str, float, str]], Cell]:
    """Cells of a standard plan: its uncertainties as multiples of the plan's."""

    def cell(row: tuple[str, float, str]) -> Cell:
        ratio = prediction.std(row[0]) / plan.best.std(row[0])
        tone: Tone = "quiet" if math.isinf(ratio) else "good" if ratio > 1.0 else "doubtful"
        return Cell(short(ratio), tone)

    return cell


def _locked_notes(plan: Plan) -> tuple[str, ...]:
    """Which standard plans visit positions that this plan leaves out."""
    notes = []
    for prediction in plan.standard:
        near = [
            v.candidate.label for v in prediction.visits if v.candidate.margin < plan.request.settings.margin
        ]
        if near:
            notes.append(f"{prediction.name}: in or near the lock zone at {', '.join(near)}.")
    return tuple(notes)


def _cheapest_blocks(plan: Plan) -> tuple[Block, ...]:
    cheapest = plan.cheapest
    if cheapest is None:
        return ()
    shown = ((name, u, *shown_unit(name, unit_of(name))) for name, u in plan.request.wanted.items())
    wanted = ", ".join(f"u({name}) = {short(u * scale)} {pretty_unit(unit)}" for name, u, scale, unit in shown)
    if cheapest.plan is None:
        return (Notice("problem", f"Wanted {wanted}: {cheapest.refusal}."),)
    visits = ", ".join(f"{v.candidate.label} {short(v.dwell)} s" for v in cheapest.plan.visits)
    return (
        Notice(
            "good",
            f"Wanted {wanted}: {short(cheapest.plan.duration)} s are enough ({visits}); no test of these candidates "
            f"is shorter than {short(cheapest.bound)} s.",
        ),
    )


def _excluded_blocks(plan: Plan) -> tuple[Block, ...]:
    if not plan.excluded:
        return (Notice("info", "No candidate is in or near the lock zone."),)
    rows = ((item.candidate.label, item.reason) for item in plan.excluded)
    return (named_values("candidate", "reason", rows, "Candidates left out."),)


def _mounting_notice(mounting: Mounting) -> Notice:
    return Notice("good" if mounting.margin >= mounting.limit else "problem", mounting_text(mounting) + ".")


def mounting_text(mounting: Mounting) -> str:
    """The answer to the mounting question in one sentence."""
    kept = [math.degrees(float(s)) for s in mounting.acceptable]
    text = (
        f"best skew {math.degrees(mounting.skew):.4g} deg towards {math.degrees(mounting.clock):.4g} deg about X: "
        f"least |a_x| is {short(mounting.margin)} of a_t tan(beta)"
    )
    if not kept:
        return f"{text}; no skew keeps it at the wanted {mounting.limit:g} or more"
    return (
        f"{text}; {len(kept)} of {mounting.skews.size} skews keep it at the wanted {mounting.limit:g} or more"
    )


def plan_text(plan: Plan, mounting: Mounting | None) -> str:
    """Lines for the terminal."""
    lines = [
        f"planned: {len(plan.best.visits)} visits, {plan.best.recorded:.6g} s recorded in {plan.best.duration:.6g} s"
    ]
    lines += [f"  {v.candidate.label:<16}{v.dwell:>10.2f} s" for v in plan.best.visits]
    heads = "".join(f"{p.name.replace(' positions', ' pos.'):>12}" for p in plan.standard)
    lines.append(f"  {'coefficient':<14}{'u (Type A)':>12} {'unit':<10}{heads}   (times the plan's u)")
    for name in plan.names:
        ratios = "".join(f"{short(p.std(name) / plan.best.std(name)):>12}" for p in plan.standard)
        scale, unit = shown_unit(name, unit_of(name))
        lines.append(f"  {name:<14}{significant(plan.best.std(name) * scale, 3):>12} {unit:<10}{ratios}")
    lines += [f"  {p.name}: {p.refusal}" for p in plan.standard if p.refusal]
    lines.append(
        f"  efficiency {100.0 * plan.efficiency:.1f} % of the bound; {len(plan.excluded)} candidates left out"
    )
    lines += [f"    left out {item.candidate.label}: {item.reason}" for item in plan.excluded]
    if plan.cheapest is not None:
        cheapest = plan.cheapest
        lines.append(
            f"  wanted uncertainties: {cheapest.refusal}"
            if cheapest.plan is None
            else f"  wanted uncertainties: {cheapest.plan.duration:.6g} s (bound {cheapest.bound:.6g} s)"
        )
    if mounting is not None:
        lines.append(f"  mounting: {mounting_text(mounting)}")
    return "\n".join(lines)
