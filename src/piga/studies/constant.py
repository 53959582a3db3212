r"""Constant input: the published closed forms, the four examples, and cases where the textbook period fails [Wei2020].

The published forms under constant input, one for each regime, for comparison.

[Wei2024] eq. 5 to 11 and [Wei2020], with poles of the tangent, a branch to choose and no count of turns. With
``p = tan(theta/2)``, ``theta = alpha - gamma``, ``r = a_t tan(beta)/a_x``:

1. ``a_x = 0``: ``p = p0 exp(K b t)``;
2. ``|r| = 1``: ``(p - 1)/(p + 1) = K a_x t + (p0 - 1)/(p0 + 1)``, mirrored for negative ``a_x``;
3. ``|r| > 1``: ``(p - p1)/(p - p2) = (p0 - p1)/(p0 - p2) exp(K a_x t sqrt(r^2 - 1))``;
4. ``|r| < 1``: ``p = sqrt(1 - r^2) tan(sqrt(1 - r^2)/2 (K a_x t + C)) - r``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from piga.errors import ArgumentError
from piga.instrument import (
    Instrument,
    closed_form,
    dead_zone,
    fixed_points,
    locking_time,
    mean_rate,
    propagate,
    revolution_period,
)
from piga.reports.render.figure import XYZ, Figure, Plot
from piga.results import Array, Result
from piga.studies.case import INSTRUMENT, RATIO, Chapter, Value, chapter_of, example_force
from piga.units import G0

DURATION = 100.0
_STEP = 0.05
_LATE = 1e4
_DOTS = 40


FormNumber = Literal[1, 2, 3, 4]
"""Number of a published form."""


def _case_2(p0: float, phase: Array, sign: float) -> Array:
    m = phase * sign + (sign * p0 - 1.0) / (sign * p0 + 1.0)
    return sign * (1.0 + m) / (1.0 - m)


def _case_3(p0: float, phase: Array, r: float) -> Array:
    root = math.sqrt(r * r - 1.0)
    p1, p2 = -r + root, -r - root
    m = (p0 - p1) / (p0 - p2) * np.exp(phase * root)
    return (p1 - p2 * m) / (1.0 - m)


def _case_4(p0: float, phase: Array, r: float) -> Array:
    root = math.sqrt(1.0 - r * r)
    return root * np.tan(0.5 * root * phase + math.atan((p0 + r) / root)) - r


def published_closed_form(
    case: FormNumber,
    inst: Instrument,
    t: ArrayLike,
    a_x: float,
    a_Y: float,
    a_Z: float,
    *,
    as_published: bool = False,
) -> tuple[Array, Array]:
    """Angle within one turn [rad] and rate [rad/s] by the published form of regime ``case``.

    Parameters
    ----------
    case:
        1 zero input, 2 critical, 3 locked, 4 running; must be the regime of the input.
    inst:
        The instrument; ``inst.alpha0`` is the angle at ``t = 0``.
    t:
        Time [s], any shape.
    a_x, a_Y, a_Z:
        Constant specific force in base axes [m/s^2].
    as_published:
        Use ``|r|`` instead of the signed ``r`` and do not mirror case 2, as printed. Differs only for negative
        ``a_x``, where the printed forms are wrong by 0.03 to 0.04 rad/s on the published data.

    Returns
    -------
    alpha, rate:
        ``alpha`` in (gamma - pi, gamma + pi]: these forms do not count revolutions.

    Raises
    ------
    ArgumentError
        If ``case`` is not 1 to 4, or its formula has no real value for this input.
    """
    a_t = math.hypot(a_Y, a_Z)
    b = a_t * inst.tan_beta
    if case not in (1, 2, 3, 4) or (case == 1) != (a_x == 0.0):
        raise ArgumentError(
            f"case: {case!r} does not fit a_x = {a_x!r} m/s^2",
            remedy="leave case out, or take the one of piga.regime",
        )
    if (case == 3 and abs(a_x) >= abs(b)) or (case == 4 and abs(a_x) <= abs(b)):
        raise ArgumentError(
            f"case: {case!r} has no real value for |a_x/b| = {abs(a_x / b) if b else math.inf}",
            remedy="leave case out, or take the one of piga.regime",
        )
    K, gamma = inst.scale_factor, math.atan2(a_Z, a_Y)
    p0 = math.tan(0.5 * (inst.alpha0 - gamma))
    phase = np.asarray(K * a_x * np.asarray(t, dtype=float))
    r = math.inf if a_x == 0.0 else b / a_x
    if as_published:
        r = abs(r)
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        if case == 1:
            p = np.asarray(p0 * np.exp(K * b * np.asarray(t, dtype=float)))
            rate = K * b * np.sin(2.0 * np.arctan(p))
        else:
            p = {2: _case_2, 3: _case_3, 4: _case_4}[case](p0, phase, math.copysign(1.0, r) if case == 2 else r)
            rate = K * a_x * (1.0 + (math.copysign(1.0, r) if case == 2 else r) * np.sin(2.0 * np.arctan(p)))
    return gamma + 2.0 * np.arctan(p), np.asarray(rate)


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
    return chapter_of("constant-input", values, (_rate_figure(),))


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
