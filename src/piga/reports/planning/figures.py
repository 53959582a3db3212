"""Figures of a planned test: time per position, uncertainties, duration, lock zone, mounting."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga.planning.candidates import Candidate
from piga.planning.mounting import Mounting
from piga.planning.plan import Plan
from piga.reports.render.decimate import envelope_rows
from piga.reports.render.figure import Axis, Figure, Panel, Role, Series
from piga.reports.render.numbers import short
from piga.units import G0

Array = NDArray[np.float64]

POINTS = 1500
SHOWN = 1e4
"""Margins above this are drawn at it."""


def planning_figures(plan: Plan, mounting: Mounting | None) -> tuple[Figure, ...]:
    """All figures of a plan, in reading order."""
    figures = [dwell_figure(plan), uncertainty_figure(plan), duration_figure(plan), lock_figure(plan)]
    if mounting is not None:
        figures.append(mounting_figure(mounting))
    return tuple(figures)


def _forces(candidates: tuple[Candidate, ...]) -> tuple[Array, Array]:
    """Force along and across the input axis [g]."""
    f = np.array([candidate.force for candidate in candidates]).reshape(-1, 3) / G0
    return f[:, 0], np.copysign(np.hypot(f[:, 1], f[:, 2]), np.where(np.abs(f[:, 1]) > 1e-9, f[:, 1], f[:, 2]))


def dwell_figure(plan: Plan) -> Figure:
    """Where the test goes: chosen positions in the plane of the forces, and the time in each."""
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
    """Distance of every candidate from the lock zone, and what it would earn per second."""
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
