"""A planned test shown: its page, its figures, and what terminal and notebook show."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from piga._version import __version__
from piga.planning.candidates import Candidate, Prediction
from piga.planning.plan import Mounting, Plan
from piga.records.terms import shown_unit, term_words, unit_of
from piga.reports.render.figure import Axis, Figure, Plot
from piga.reports.render.numbers import count, pretty_unit, short, signed, significant
from piga.reports.render.page import Cell, Notice, Page, Section, Table, TableOf, Tile, named_values
from piga.results import Array
from piga.units import G0

SHOWN = 1e4
"""Largest margin that is told. Larger ones are drawn at this value."""


def _forces(candidates: tuple[Candidate, ...]) -> tuple[Array, Array]:
    """Force along and across the input axis [g]."""
    f = np.array([candidate.force for candidate in candidates]).reshape(-1, 3) / G0
    return f[:, 0], np.copysign(np.hypot(f[:, 1], f[:, 2]), np.where(np.abs(f[:, 1]) > 1e-9, f[:, 1], f[:, 2]))


def figures(plan: Plan) -> dict[str, Callable[[], Figure]]:
    """The figure of a plan."""
    return {"positions": partial(_dwell_figure, plan)}


def _dwell_figure(plan: Plan) -> Figure:
    chosen = tuple(visit.candidate for visit in plan.best.visits)
    named = tuple(f"{v.candidate.label}: {short(v.dwell)} s" for v in plan.best.visits)
    plot = Plot("plan-positions", "Chosen positions and the time in each", columns=2)
    plot.panel("force along X0 [g]", "force across [g]", "Positions", equal=True)
    labels = tuple(c.label for c in plan.candidates)
    plot.points(*_forces(plan.candidates), "candidate", "muted", text=labels)
    if plan.excluded:
        reasons = tuple(f"{one.label}: {reason}" for one, reason in plan.excluded)
        plot.points(*_forces(tuple(one for one, _ in plan.excluded)), "excluded", "warning", text=reasons)
    plot.points(*_forces(chosen), "chosen", "after", text=named)
    dwells = [visit.dwell for visit in plan.best.visits]
    visits = Axis("visit", "1", limits=(0.5, len(chosen) + 0.5), names=tuple(visit.label for visit in chosen))
    plot.panel(visits, Axis("dwell", "s", limits=(0.0, 1.1 * max(dwells))), "Dwell")
    plot.line(np.arange(1, len(chosen) + 1), dwells, "dwell", "after", mark="bars", text=named)
    return plot.caption(
        "The whole time goes to a few positions; the others would add less per second, moves counted."
    )


def _mounting_figure(mounting: Mounting) -> Figure:
    degrees, shown = np.degrees(mounting.skews), partial(np.clip, a_min=1e-2, a_max=SHOWN)
    plot = Plot("plan-mounting", "Skew of the instrument on the platform")
    plot.panel("skew of the instrument [deg]", "log least |a_x| over a_t tan(beta)", "Margin against skew")
    plot.line(degrees, shown(mounting.margins.max(axis=1)), "best direction", "after")
    plot.line(degrees, shown(mounting.margins.min(axis=1)), "worst direction", "before")
    plot.level(degrees, mounting.limit, "wanted margin", "warning")
    plot.panel("time [s]", "log |a_x| over a_t tan(beta)", "Along the profile")
    plot.line(mounting.t, shown(mounting.unskewed_history), "not skewed", "before")
    plot.line(
        mounting.t, shown(mounting.margin_history), f"skew {math.degrees(mounting.skew):.3g} deg", "after"
    )
    plot.level(mounting.t, mounting.limit, "wanted margin", "warning")
    return plot.caption(
        "The instrument measures where the margin is above 1. Values beyond 0.01 and 10 000 are drawn there."
    )


_CRITERIA = {
    "D": "the volume of the uncertainty ellipsoid",
    "A": "the mean variance of the coefficients, each over its wanted or equal-time variance",
    "c": "the variance of the given combination",
    "wanted": "the largest ratio of an uncertainty to the wanted one",
}


def page(plan: Plan) -> Page:
    """The page of a planned test."""
    lead = f"Least is {_CRITERIA[plan.request.table.plan.criterion]}."
    shown = [
        Section("The test", "the-test", (lead, partial(_dwell_figure, plan), _visit_table(plan))),
        Section("What it will give", "what-it-gives", (_uncertainty_table(plan),)),
        *([] if plan.cheapest is None else [Section("Time", "time", (_cheapest(plan, plan.cheapest),))]),
    ]
    if not plan.request.direct:
        left_out: Notice | Table = Notice("info", "No candidate is in or near the lock zone.")
        if plan.excluded:
            rows = ((one.label, reason) for one, reason in plan.excluded)
            left_out = named_values("candidate", "reason", rows, "Candidates left out.")
        shown.append(Section("Lock zone", "lock-zone", (left_out,)))
    if plan.mounting is not None:
        blocks = (_mounting_notice(plan.mounting), partial(_mounting_figure, plan.mounting))
        shown.append(Section("Mounting", "mounting", blocks))
    return Page(
        title=f"Planned test of {plan.request.table.instrument.serial}",
        subtitle=f"{len(plan.best.visits)} visits in {short(plan.best.duration)} s, moves of {short(plan.request.move)} s.",
        tiles=_tiles(plan),
        sections=tuple(shown),
        kicker="piga · plan",
        footer=f"Made by piga {__version__}. Predicted from the expected coefficients and noise; nothing was measured.",
    )


def _tiles(plan: Plan) -> tuple[Tile, ...]:
    best = plan.best
    tiles = [
        Tile("Visits", str(len(best.visits)), detail=f"of {len(plan.candidates)} candidates"),
        Tile("Recorded", short(best.recorded), "s", f"of {short(best.duration)} s"),
    ]
    if plan.standard and not plan.standard[-1].refusal:
        reference = plan.standard[-1]
        ratios = [best.std(name) / reference.std(name) for name in plan.request.names]
        gain = math.exp(sum(map(math.log, ratios)) / len(ratios)) if min(ratios) > 0.0 else 0.0
        unit, than = f"% {'smaller' if gain <= 1.0 else 'larger'}", f"than {reference.name}, geometric mean"
        number = f"{100.0 * abs(1.0 - gain):.0f}"
        tiles.append(Tile("Uncertainty", number, unit, than, "good" if gain <= 1.0 else ""))
    return tuple(tiles)


def _visit_table(plan: Plan) -> Table:
    table = TableOf(plan.best.visits)
    table.text("position or level", lambda visit: visit.candidate.label)
    table.number("dwell", lambda visit: f"{visit.dwell:.2f}", "s")
    if not plan.request.direct:
        table.number("revolutions", lambda visit: f"{visit.dwell / visit.candidate.revolution:.2f}")
        far = f"> {count(int(SHOWN))}"
        table.number(
            "|a_x| over a_t tan(beta)",
            lambda visit: short(visit.candidate.margin) if visit.candidate.margin < SHOWN else far,
        )
    table.number("force along X0", lambda visit: signed(visit.candidate.force[0] / G0, 4), "g")
    return table.table("Visits in the order of the test.")


def _uncertainty_table(plan: Plan) -> Table:
    shown = [(name, *shown_unit(name, unit_of(name, plan.request.unit))) for name in plan.request.names]
    table = (
        TableOf(shown)
        .text("coefficient", lambda row: Cell(row[0], title=term_words(row[0]).meaning))
        .text("unit", lambda row: pretty_unit(row[2]) or "1")
        .number("u, Type A", lambda row: significant(plan.best.std(row[0]) * row[1], 3))
        .number("u with the stand", lambda row: significant(plan.best.combined(row[0]) * row[1], 3))
    )
    table.across(plan.standard, lambda one: one.name, partial(_over_planned, plan))
    notes = [f"{one.name}: {one.refusal}." for one in plan.standard if one.refusal]
    for one in plan.standard:
        margin = plan.request.table.plan.margin
        near = [visit.candidate.label for visit in one.visits if visit.candidate.margin < margin]
        notes += [f"{one.name}: in or near the lock zone at {', '.join(near)}."] if near else []
    caption = "Predicted standard uncertainties; standard plans in the same total time, as multiples of the plan's Type A."
    return table.table(caption, tuple(notes))


def _over_planned(plan: Plan, row: tuple[str, float, str], standard: Prediction) -> Cell:
    """Uncertainty of a standard plan as a multiple of the plan's."""
    ratio = standard.std(row[0]) / plan.best.std(row[0])
    return Cell(short(ratio), "quiet" if math.isinf(ratio) else "good" if ratio > 1.0 else "doubtful")


def _cheapest(plan: Plan, cheapest: Prediction) -> Notice:
    shown = (
        (name, u, *shown_unit(name, unit_of(name, plan.request.unit)))
        for name, u in plan.request.wanted.items()
    )
    wanted = ", ".join(f"u({name}) = {short(u * scale)} {pretty_unit(unit)}" for name, u, scale, unit in shown)
    if cheapest.refusal:
        return Notice("problem", f"Wanted {wanted}: {cheapest.refusal}.")
    visits = ", ".join(f"{v.candidate.label} {short(v.dwell)} s" for v in cheapest.visits)
    return Notice("good", f"Wanted {wanted}: {short(cheapest.duration)} s are enough ({visits}).")


def _mounting_notice(mounting: Mounting) -> Notice:
    kept = mounting.acceptable.size
    enough = f"{kept} of {mounting.skews.size} skews keep" if kept else "no skew keeps"
    text = (
        f"Best skew {math.degrees(mounting.skew):.4g} deg towards {math.degrees(mounting.clock):.4g} deg about X: "
        f"least |a_x| is {short(mounting.margin)} of a_t tan(beta); {enough} it at the wanted {mounting.limit:g} or more."
    )
    return Notice("good" if kept else "problem", text)


def brief(plan: Plan) -> Page:
    """The plan for terminal and notebook."""
    return page(plan)
