"""Constant input: the four examples, and cases where the textbook period fails [Wei2020]."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from piga.instrument import (
    closed_form,
    dead_zone,
    fixed_points,
    locking_time,
    mean_rate,
    propagate,
    revolution_period,
)
from piga.reports.render.figure import XYZ, Figure, Plot, axis
from piga.results import Result
from piga.studies.case import INSTRUMENT, RATIO, Chapter, Value, chapter_of, example_force
from piga.studies.published_forms import Case as FormNumber
from piga.studies.published_forms import published_closed_form
from piga.units import G0

Array = NDArray[np.float64]

DURATION = 100.0
_STEP = 0.05
_LATE = 1e4
_DOTS = 40
_FLOOR = 1e-16


@dataclass(frozen=True)
class Example:
    """One example of [Wei2020]: number of its form, regime and a_x [g]."""

    number: FormNumber
    regime: str
    a_x: float

    @property
    def force(self) -> tuple[float, float, float]:
        """Specific force [m/s^2]."""
        return example_force(self.a_x)


EXAMPLES = (
    Example(1, "zero input", 0.0),
    Example(2, "critical", RATIO),
    Example(3, "locked", 0.01),
    Example(4, "running", 1.0),
)


@dataclass(frozen=True, eq=False, repr=False)
class Solved(Result):
    """One example solved three ways at times ``t`` [s]: angle [rad] and rate [rad/s]."""

    t: Array
    closed: tuple[Array, Array]
    sampled: tuple[Array, Array]
    integrated: tuple[Array, Array]
    published: Array


@cache
def solved(example: Example) -> Solved:
    """Solve an example with piga's closed form, piga's propagator for records, SciPy's DOP853, and the published form."""
    t = np.linspace(0.0, DURATION, round(DURATION / _STEP) + 1)
    f = np.tile(np.array(example.force), (t.size, 1))
    sampled = propagate(INSTRUMENT, t, f, with_rate=True, between="linear")
    closed = closed_form(INSTRUMENT, t, *example.force)
    _, published = published_closed_form(example.number, INSTRUMENT, t, *example.force)
    return Solved(t, closed, sampled, _integrated(example, t), published)


def _integrated(example: Example, t: Array) -> tuple[Array, Array]:
    from scipy.integrate import solve_ivp

    a, b = (INSTRUMENT.scale_factor * v for v in (example.force[0], example.force[1] * INSTRUMENT.tan_beta))
    solution = solve_ivp(
        lambda _t, alpha: [a + b * math.sin(alpha[0])],
        (0.0, DURATION),
        [INSTRUMENT.alpha0],
        method="DOP853",
        t_eval=t,
        rtol=1e-12,
        atol=1e-13,
    )
    return solution.y[0], a + b * np.sin(solution.y[0])


def examples() -> Chapter:
    """Rate against time in the four regimes, with the ideal line."""
    values: dict[str, float | Value] = {}
    for example in EXAMPLES:
        name, solution = f"example-{example.number}", solved(example)
        at = int(np.argmax(np.abs(solution.published - solution.integrated[1])))
        values[f"{name}.ideal"] = math.degrees(INSTRUMENT.scale_factor * example.force[0])
        values[f"{name}.form"] = Value(
            math.degrees(solution.integrated[1][at]),
            published=math.degrees(solution.published[at]),
            words={"t": solution.t[at]},
        )
        values[f"{name}.agreement"] = max(
            float(np.abs(angle - solution.integrated[0]).max())
            for angle, _ in (solution.closed, solution.sampled)
        )
        if example.number == 4:
            values[f"{name}.mean"] = math.degrees(float(mean_rate(INSTRUMENT, *example.force)))
        else:
            values[f"{name}.end"] = math.degrees(float(closed_form(INSTRUMENT, _LATE, *example.force)[1]))
    return chapter_of("constant-input", values, (_rate_figure(), _agreement_figure()))


def _rate_figure() -> Figure:
    plot = Plot("constant-input-rates", "Output rate under constant input, four regimes", columns=2, height=2.5)
    for example in EXAMPLES:
        solution = solved(example)
        shown = solution.t <= (20.0 if example.number == 4 else DURATION)
        shown &= np.arange(solution.t.size) % 5 == 0
        t = solution.t[shown]
        dots = slice(None, None, max(1, t.size // _DOTS))
        title = f"{example.number}  {example.regime}: a_x = {example.a_x:.5g} g"
        plot.panel("time [s]", "output rate [deg/s]", title)
        plot.level([0.0, t[-1]], math.degrees(INSTRUMENT.scale_factor * example.force[0]), "ideal: K a_x")
        plot.line(t, np.degrees(solution.closed[1][shown]), "cross-coupled: closed form", "after")
        plot.points(t[dots], np.degrees(solution.published[shown][dots]), "published form", "before")
    return plot.caption(
        "Dashed: what an ideal instrument would turn. In regimes 1 to 3 the rate dies although in 2 and 3 there is "
        "specific force along the input axis; in regime 4 it swings about a mean just below the ideal line."
    )


def _agreement_figure() -> Figure:
    plot = Plot("constant-input-agreement", "Three solutions of the same motion", columns=2, height=2.1)
    for example in EXAMPLES:
        solution = solved(example)
        every = slice(1, None, 8)
        left = np.abs(solution.closed[0] - solution.integrated[0])[every]
        right = np.abs(solution.closed[0] - solution.sampled[0])[every]
        y = axis("log difference in angle [rad]", limits=(_FLOOR, 1e-9))
        plot.panel("time [s]", y, f"{example.number}  {example.regime}")
        plot.line(solution.t[every], np.maximum(left, _FLOOR), "closed form less integration", "before")
        plot.line(solution.t[every], np.maximum(right, _FLOOR), "closed form less propagator", "after")
    return plot.caption(
        "The independent integrator errs by up to 1e-10 rad, closed form and propagator differ from each other by "
        "rounding only. Differences below 1e-16 rad are drawn there."
    )


def period() -> Chapter:
    """The period 2 pi / (K sqrt(a^2 - b^2)) in the four regimes, compared with the exact motion."""
    locked, running = EXAMPLES[2].force, EXAMPLES[3].force
    turn = closed_form(INSTRUMENT, np.array([0.0, float(revolution_period(INSTRUMENT, *running))]), *running)[0]
    border = float(dead_zone(INSTRUMENT, *locked[1:])[1])
    values: dict[str, float | Value] = {
        "example-4": float(turn[1] - turn[0] - 2.0 * math.pi),
        "example-1": 1.0 / float(revolution_period(INSTRUMENT, *EXAMPLES[0].force)),
        "example-2": 1.0 / float(revolution_period(INSTRUMENT, *EXAMPLES[1].force)),
        "example-3": (INSTRUMENT.scale_factor**2) * (locked[0] ** 2 - border**2),
        "locking-time": float(locking_time(INSTRUMENT, *locked)),
    }
    for example in EXAMPLES[:3]:
        rest = float(fixed_points(INSTRUMENT, *example.force)[0])
        rest += 2.0 * math.pi * (rest < 0.0)
        left = 2.0 / (INSTRUMENT.scale_factor * example.force[0] * _LATE) if example.number == 2 else 0.0
        end = float(closed_form(INSTRUMENT, _LATE, *example.force)[0])
        values[f"rest-{example.number}"] = Value(end + left, published=rest)
    return chapter_of("period", values, (_rest_figure(),))


def _rest_figure() -> Figure:
    t = np.linspace(0.0, 600.0, 1201)
    plot = Plot(
        "period-and-rest", "Where the textbook period fails, and what happens instead", columns=2, height=3.0
    )
    plot.panel("time [s]", "outer-gimbal angle [deg]", "No revolution: regimes 1-3")
    for example in EXAMPLES[:3]:
        rest = math.degrees(float(fixed_points(INSTRUMENT, *example.force)[0])) % 360.0
        plot.level(t, rest, "where it rests", "muted")
    for example, role in zip(EXAMPLES[:3], XYZ, strict=True):
        alpha = np.degrees(closed_form(INSTRUMENT, t, *example.force)[0])
        plot.line(t, alpha, f"{example.number} {example.regime}", role)
    border = float(dead_zone(INSTRUMENT, *EXAMPLES[2].force[1:])[1])
    a_x = border * np.concatenate((1.0 + np.geomspace(1e-4, 3.0, 400), np.geomspace(4.0, 40.0, 60)))
    a_t = EXAMPLES[2].force[1]
    measured = np.array([_measured_period(float(a), a_t) for a in a_x[::20]])
    plot.panel("log specific force a_x [g]", "log time of a revolution [s]", "Revolving: regime 4")
    plot.line(a_x / G0, revolution_period(INSTRUMENT, a_x, a_t, 0.0), "textbook period", "after")
    plot.points(a_x[::20] / G0, measured, "period of the motion", "before")
    plot.dashed(a_x / G0, 2.0 * np.pi / (INSTRUMENT.scale_factor * a_x), "ideal: 2 pi / (K a_x)")
    return plot.caption(
        "Left: the gimbal creeps to a resting angle and has no period. Right: towards the border a_t tan(beta) the "
        "period grows without bound; the formula is right for every running input."
    )


def _measured_period(a_x: float, a_Y: float) -> float:
    """Time [s] of ten revolutions of the exact motion, divided by ten. It comes from a root search, not from the formula."""
    from scipy.optimize import brentq

    def missing(t: float) -> float:
        return float(closed_form(INSTRUMENT, t, a_x, a_Y, 0.0)[0]) - INSTRUMENT.alpha0 - 20.0 * math.pi

    late = 20.0 * math.pi / (INSTRUMENT.scale_factor * a_x)
    while missing(late) < 0.0:
        late *= 2.0
    return float(brentq(missing, 0.0, late, xtol=1e-9 * late)) / 10.0
