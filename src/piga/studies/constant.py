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
    published_closed_form,
    revolution_period,
)
from piga.instrument.motion.closed_form import Case as FormNumber
from piga.reports.render.figure import XYZ, Axis, Figure, Panel, Series
from piga.results import Result
from piga.studies.case import INSTRUMENT, RATIO, Case, Chapter, example_force
from piga.units import G0

Array = NDArray[np.float64]

DURATION = 100.0
_STEP = 0.05
_LATE = 1e4
_DOTS = 40
_FLOOR = 1e-16


@dataclass(frozen=True)
class Example:
    """One example of [Wei2020]: its regime's form, a_x [g], the ideal rate [deg/s] and its last printed digit."""

    number: FormNumber
    regime: str
    a_x: float
    ideal: float
    digit: float

    @property
    def force(self) -> tuple[float, float, float]:
        """Specific force [m/s^2]."""
        return example_force(self.a_x)


EXAMPLES = (
    Example(1, "zero input", 0.0, 0.0, 0.0),
    Example(2, "critical", RATIO, 1.23, 0.01),
    Example(3, "locked", 0.01, 0.509, 0.001),
    Example(4, "running", 1.0, 50.9, 0.1),
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
    sampled = propagate(INSTRUMENT, t, f, with_rate=True)
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
    cases = [case for example in EXAMPLES for case in _example_cases(example)]
    text = (
        "K = 0.8884 (rad/s)/g, beta = 1000 arcsec, alpha0 = pi/4, a_Y = 5 g, a_Z = 0. Each example is solved by "
        "the published form of its regime, by the one closed form that the product computes with, by its "
        "propagator for sampled input and by an independent integrator (SciPy, DOP853, relative tolerance 1e-12)."
    )
    return Chapter(
        "constant-input",
        "Constant input, four examples",
        "[Wei2020] examples 1-4",
        text,
        tuple(cases),
        (_rate_figure(), _agreement_figure()),
    )


def _example_cases(example: Example) -> list[Case]:
    name, source = f"constant-input.example-{example.number}", f"[Wei2020] example {example.number}"
    known = solved(example)
    ideal = math.degrees(INSTRUMENT.scale_factor * example.force[0])
    digits = (
        "a_x is zero, so that K a_x is zero exactly: no tolerance"
        if example.a_x == 0.0
        else f"printed to {example.digit:g} deg/s: half of that digit"
    )
    cases = [
        Case(
            f"{name}.ideal",
            source,
            "ideal rate K a_x",
            "deg/s",
            example.ideal,
            ideal,
            0.5 * example.digit,
            digits,
        )
    ]
    at = int(np.argmax(np.abs(known.published - known.integrated[1])))
    cases.append(
        Case(
            f"{name}.form",
            source,
            f"rate by form {example.number} where it is farthest from the integration (t = {known.t[at]:.2f} s)",
            "deg/s",
            math.degrees(known.published[at]),
            math.degrees(known.integrated[1][at]),
            1e-9,
            "both solve one equation exactly: the integrator keeps 1e-12 of the angle per step, "
            "which over 100 s stays below 1e-9 deg/s",
        )
    )
    worst = max(float(np.abs(one[0] - known.integrated[0]).max()) for one in (known.closed, known.sampled))
    cases.append(
        Case(
            f"{name}.agreement",
            source,
            "angle: closed form and propagator against the integration, largest difference in 100 s",
            "rad",
            0.0,
            worst,
            1e-10,
            "three ways to one solution differ by rounding and by what the integrator leaves (1e-12 a step)",
        )
    )
    cases.append(_last_case(example, name, source))
    return cases


def _last_case(example: Example, name: str, source: str) -> Case:
    if example.number == 4:
        rate = math.degrees(float(mean_rate(INSTRUMENT, *example.force)))
        note = "figure reading: the published curve swings about the ideal line, which is printed to 0.1 deg/s"
        return Case(f"{name}.mean", source, "mean rate over whole revolutions", "deg/s", 50.9, rate, 0.05, note)
    rate = math.degrees(float(closed_form(INSTRUMENT, _LATE, *example.force)[1]))
    note = (
        "the published curve runs into the zero line; 0.001 deg/s is far below the width of a printed line "
        "(the critical case decays only as 1/t^2)"
    )
    return Case(f"{name}.end", source, "rate after 10 000 s", "deg/s", 0.0, rate, 1e-3, note)


def _rate_figure() -> Figure:
    panels = []
    for example in EXAMPLES:
        known = solved(example)
        shown = known.t <= (20.0 if example.number == 4 else DURATION)
        shown &= np.arange(known.t.size) % 5 == 0
        t, ideal = known.t[shown], math.degrees(INSTRUMENT.scale_factor * example.force[0])
        dots = slice(None, None, max(1, t.size // _DOTS))
        series = (
            Series([0.0, t[-1]], [ideal, ideal], "ideal: K a_x", role="reference", dashed=True),
            Series(t, np.degrees(known.closed[1][shown]), "cross-coupled: closed form", role="after"),
            Series(t[dots], np.degrees(known.published[shown][dots]), "published form", "points", "before"),
        )
        title = f"{example.number}  {example.regime}: a_x = {example.a_x:.5g} g"
        panels.append(Panel(Axis("time", "s"), Axis("output rate", "deg/s"), series, title))
    return Figure(
        "constant-input-rates",
        "Output rate under constant input, four regimes",
        tuple(panels),
        "Dashed: what an ideal instrument would turn. In regimes 1 to 3 the rate dies although in 2 and 3 there is "
        "specific force along the input axis; in regime 4 it swings about a mean just below the ideal line.",
        columns=2,
        height=2.5,
    )


def _agreement_figure() -> Figure:
    panels = []
    for example in EXAMPLES:
        known = solved(example)
        every = slice(1, None, 8)
        left = np.abs(known.closed[0] - known.integrated[0])[every]
        right = np.abs(known.closed[0] - known.sampled[0])[every]
        series = (
            Series(known.t[every], np.maximum(left, _FLOOR), "closed form less integration", role="before"),
            Series(known.t[every], np.maximum(right, _FLOOR), "closed form less propagator", role="after"),
        )
        axis = Axis("difference in angle", "rad", log=True, limits=(_FLOOR, 1e-9))
        panels.append(Panel(Axis("time", "s"), axis, series, f"{example.number}  {example.regime}"))
    return Figure(
        "constant-input-agreement",
        "Three solutions of the same motion",
        tuple(panels),
        "The independent integrator errs by up to 1e-10 rad, closed form and propagator differ from each other by "
        "rounding only. Differences below 1e-16 rad are drawn there.",
        columns=2,
        height=2.1,
    )


def period() -> Chapter:
    """The period 2 pi / (K sqrt(a^2 - b^2)) in the four regimes, compared with the exact motion."""
    text = (
        "The textbook period of a revolution, T = 2 pi / (K sqrt(a_x^2 - a_t^2 tan^2(beta))), holds only where the "
        "gimbal revolves. Revolutions per second, 1/T, are compared where T is infinite."
    )
    cases = (_running_period(), *_infinite_periods(), _imaginary_period(), *_rest_cases())
    source = "[Wei2020] period"
    return Chapter("period", "The textbook period, and where it fails", source, text, cases, (_rest_figure(),))


def _running_period() -> Case:
    running = EXAMPLES[3]
    turned = closed_form(
        INSTRUMENT, np.array([0.0, float(revolution_period(INSTRUMENT, *running.force))]), *running.force
    )
    excess = float(turned[0][1] - turned[0][0] - 2.0 * math.pi)
    return Case(
        "period.example-4",
        "[Wei2020] example 4",
        "turn of the gimbal in one textbook period, less a revolution",
        "rad",
        0.0,
        excess,
        1e-12,
        "the formula is exact in the running regime: rounding of 2 pi over a few hundred operations",
    )


def _infinite_periods() -> list[Case]:
    return [
        Case(
            f"period.example-{example.number}",
            f"[Wei2020] example {example.number}",
            "revolutions per second (the textbook period is infinite)",
            "1/s",
            0.0,
            1.0 / float(revolution_period(INSTRUMENT, *example.force)),
            0.0,
            "an infinite period is a frequency of zero exactly: no tolerance",
        )
        for example in EXAMPLES[:2]
    ]


def _imaginary_period() -> Case:
    locked = EXAMPLES[2]
    square = (INSTRUMENT.scale_factor**2) * (
        locked.force[0] ** 2 - float(dead_zone(INSTRUMENT, *locked.force[1:])[1]) ** 2
    )
    return Case(
        "period.example-3",
        "[Wei2020] example 3",
        "K^2 (a_x^2 - a_t^2 tan^2(beta))",
        "rad^2/s^2",
        None,
        square,
        None,
        "no number is published: the square under the root is negative, so that the textbook period has no real value",
    )


def _rest_cases() -> list[Case]:
    cases = []
    for example in EXAMPLES[:3]:
        rest = float(fixed_points(INSTRUMENT, *example.force)[0])
        rest += 2.0 * math.pi * (rest < 0.0)
        end = float(closed_form(INSTRUMENT, _LATE, *example.force)[0])
        left, tolerance = 0.0, 1e-9
        note = "approached exponentially: nothing but rounding is left after 10 000 s"
        if example.number == 2:
            left, tolerance = 2.0 / (INSTRUMENT.scale_factor * example.force[0] * _LATE), 5e-3
            note = "the critical approach is algebraic: 2/(K a_x t) = 0.009 rad is left after 10 000 s; half of it each way"
        cases.append(
            Case(
                f"period.rest-{example.number}",
                f"[Wei2020] example {example.number}",
                "angle at rest: fixed point sin(theta) = -a/b against the motion at 10 000 s",
                "rad",
                rest,
                end + left,
                tolerance,
                note,
            )
        )
    time_constant = float(locking_time(INSTRUMENT, *EXAMPLES[2].force))
    note = "not published; the time in which the rate falls by e, 1/(K sqrt(b^2 - a^2)), instead of a period"
    cases.append(
        Case(
            "period.locking-time",
            "[Wei2020] example 3",
            "time constant of the locking",
            "s",
            None,
            time_constant,
            None,
            note,
        )
    )
    return cases


def _rest_figure() -> Figure:
    t = np.linspace(0.0, 600.0, 1201)
    curves, rests = [], []
    for example, role in zip(EXAMPLES[:3], XYZ, strict=True):
        alpha = np.degrees(closed_form(INSTRUMENT, t, *example.force)[0])
        curves.append(Series(t, alpha, f"{example.number} {example.regime}", role=role))
        rest = math.degrees(float(fixed_points(INSTRUMENT, *example.force)[0])) % 360.0
        rests.append(Series([0.0, 600.0], [rest, rest], "where it rests", role="muted", dashed=True))
    border = float(dead_zone(INSTRUMENT, *EXAMPLES[2].force[1:])[1])
    a_x = border * np.concatenate((1.0 + np.geomspace(1e-4, 3.0, 400), np.geomspace(4.0, 40.0, 60)))
    a_t = EXAMPLES[2].force[1]
    periods = revolution_period(INSTRUMENT, a_x, a_t, 0.0)
    ideal = 2.0 * np.pi / (INSTRUMENT.scale_factor * a_x)
    measured = np.array([_measured_period(float(a), a_t) for a in a_x[::20]])
    right = (
        Series(a_x / G0, periods, "textbook period", role="after"),
        Series(a_x[::20] / G0, measured, "period of the motion", "points", "before"),
        Series(a_x / G0, ideal, "ideal: 2 pi / (K a_x)", role="reference", dashed=True),
    )
    left = Panel(
        Axis("time", "s"), Axis("outer-gimbal angle", "deg"), (*rests, *curves), "No revolution: regimes 1-3"
    )
    panel = Panel(
        Axis("specific force a_x", "g", log=True),
        Axis("time of a revolution", "s", log=True),
        right,
        "Revolving: regime 4",
    )
    return Figure(
        "period-and-rest",
        "Where the textbook period fails, and what happens instead",
        (left, panel),
        "Left: the gimbal creeps to a resting angle and has no period. Right: towards the border a_t tan(beta) the "
        "period grows without bound; the formula is right for every running input.",
        columns=2,
        height=3.0,
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
