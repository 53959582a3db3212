r"""The published closed forms, the four examples, the textbook period, and forms under varying input [Wei2020], [Wei2024].

The forms, one for each regime, have poles of the tangent, a branch to choose and no count of turns. With
``p = tan(theta/2)``, ``theta = alpha - gamma``, ``r = a_t tan(beta)/a_x``:

1. ``a_x = 0``: ``p = p0 exp(K b t)``;
2. ``|r| = 1``: ``(p - 1)/(p + 1) = K a_x t + (p0 - 1)/(p0 + 1)``, mirrored for negative ``a_x``;
3. ``|r| > 1``: ``(p - p1)/(p - p2) = (p0 - p1)/(p0 - p2) exp(K a_x t sqrt(r^2 - 1))``;
4. ``|r| < 1``: ``p = sqrt(1 - r^2) tan(sqrt(1 - r^2)/2 (K a_x t + C)) - r``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
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
from piga.reports.render.figure import Plot
from piga.results import Array
from piga.studies.case import INSTRUMENT, RATIO, TRANSVERSE, Chapter, Value, chapter_of
from piga.units import G0

_LATE = 1e4
_SWING, _PERIOD = 0.6, 15.0

FormNumber = Literal[1, 2, 3, 4]
"""Number of a published form."""


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
    inst, t:
        The instrument; ``inst.alpha0`` is the angle at ``t = 0``. Time [s], any shape.
    a_x, a_Y, a_Z:
        Constant specific force in base axes [m/s^2].
    as_published:
        Use ``|r|`` instead of the signed ``r`` and do not mirror case 2, as printed: wrong for negative ``a_x``.

    Returns
    -------
    alpha, rate:
        ``alpha`` in (gamma - pi, gamma + pi]: these forms do not count revolutions.

    Raises
    ------
    ArgumentError
        If the formula of ``case`` has no real value for this input.
    """
    a_t = math.hypot(a_Y, a_Z)
    b = a_t * inst.tan_beta
    fits = {1: a_x == 0.0, 2: a_x != 0.0, 3: 0.0 < abs(a_x) < abs(b), 4: abs(a_x) > abs(b)}
    if not fits.get(case, False):
        raise ArgumentError(
            f"case: form {case!r} has no real value for a_x = {a_x!r} m/s^2 and a_t tan(beta) = {b!r} m/s^2",
            remedy="take the one of piga.regime",
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
            return gamma + 2.0 * np.arctan(p), K * b * np.sin(2.0 * np.arctan(p))
        if case == 2:
            r = math.copysign(1.0, r)
            m = phase * r + (r * p0 - 1.0) / (r * p0 + 1.0)
            p = r * (1.0 + m) / (1.0 - m)
        elif case == 3:
            root = math.sqrt(r * r - 1.0)
            p1, p2 = -r + root, -r - root
            m = (p0 - p1) / (p0 - p2) * np.exp(phase * root)
            p = (p1 - p2 * m) / (1.0 - m)
        else:
            root = math.sqrt(1.0 - r * r)
            p = root * np.tan(0.5 * root * phase + math.atan((p0 + r) / root)) - r
        return gamma + 2.0 * np.arctan(p), K * a_x * (1.0 + r * np.sin(2.0 * np.arctan(p)))


@dataclass(frozen=True)
class Example:
    """A force of constant direction: number of its published form, a_x, a_Y and a_Z [g] at the mean of the swing, title."""

    number: FormNumber
    in_g: tuple[float, float, float]
    title: str = ""

    @property
    def force(self) -> tuple[float, float, float]:
        """Specific force [m/s^2]."""
        x, y, z = self.in_g
        return x * G0, y * G0, z * G0


EXAMPLES = (
    Example(1, (0.0, TRANSVERSE, 0.0), "zero input"),
    Example(2, (RATIO, TRANSVERSE, 0.0), "critical"),
    Example(3, (0.01, TRANSVERSE, 0.0), "locked"),
    Example(4, (1.0, TRANSVERSE, 0.0), "running"),
)
_SWUNG = (
    Example(1, (0.0, 3.0, 4.0)),
    Example(2, (RATIO, TRANSVERSE, 0.0)),
    Example(3, (0.4 * RATIO, TRANSVERSE, 0.0)),
    Example(4, (0.2 * TRANSVERSE, TRANSVERSE, 0.0)),
)


def swing(t: ArrayLike, size: float) -> Array:
    """Common factor of all components: 1 + size sin(2 pi t / 15 s). The ratio is constant, the size varies."""
    return np.asarray(1.0 + size * np.sin(2.0 * np.pi * np.asarray(t) / _PERIOD))


def _integrated(example: Example, t: Array, size: float = 0.0) -> tuple[Array, Array]:
    """Angle [rad] and rate [rad/s] by SciPy's DOP853 under the force times its swing."""
    from scipy.integrate import solve_ivp

    def rate(time: float | Array, alpha: Array) -> Array:
        a_x, a_Y, a_Z = np.multiply.outer(np.array(example.force), swing(time, size))
        coupling = INSTRUMENT.tan_beta * (a_Y * np.sin(alpha) - a_Z * np.cos(alpha))
        return np.asarray(INSTRUMENT.scale_factor * (a_x + coupling))

    start = [INSTRUMENT.alpha0]
    run = solve_ivp(rate, (0.0, float(t[-1])), start, method="DOP853", t_eval=t, rtol=1e-13, atol=1e-13)
    return run.y[0], rate(t, run.y[0])


def _worst(t: Array, published: Array, integrated: Array) -> Value:
    """The published rate beside the integrated one where they differ most [deg/s]."""
    at = int(np.argmax(np.abs(published - integrated)))
    degrees = math.degrees(integrated[at]), math.degrees(published[at])
    return Value(degrees[0], published=degrees[1], words={"t": t[at]})


def examples() -> Chapter:
    """Rate against time in the four regimes, with the ideal line.

    Solved four ways: piga's closed form, piga's propagator for records, SciPy's DOP853, and the published form.
    """
    values: dict[str, float | Value] = {}
    plot = Plot("constant-input-rates", "Output rate under constant input, four regimes", columns=2, height=2.5)
    t = np.linspace(0.0, 100.0, 2001)
    for example in EXAMPLES:
        name, force = f"example-{example.number}", example.force
        sampled = propagate(INSTRUMENT, t, np.tile(np.array(force), (t.size, 1)), between="linear")
        angle, rate = closed_form(INSTRUMENT, t, *force)
        integrated, integrated_rate = _integrated(example, t)
        _, published = published_closed_form(example.number, INSTRUMENT, t, *force)
        ideal = INSTRUMENT.scale_factor * force[0]
        values[f"{name}.ideal"] = math.degrees(ideal)
        values[f"{name}.form"] = _worst(t, published, integrated_rate)
        values[f"{name}.agreement"] = max(float(np.abs(a - integrated).max()) for a in (angle, sampled))
        if example.number == 4:
            values[f"{name}.mean"] = math.degrees(float(mean_rate(INSTRUMENT, *force)))
        else:
            values[f"{name}.end"] = math.degrees(float(closed_form(INSTRUMENT, _LATE, *force)[1]))
        drawn = slice(0, 401 if example.number == 4 else None, 5)
        plot.panel("time [s]", "output rate [deg/s]", f"{example.number}  {example.title}")
        plot.level(t[drawn], math.degrees(ideal), "ideal: K a_x")
        plot.line(t[drawn], np.degrees(rate[drawn]), "cross-coupled: closed form", "after")
    figure = plot.caption(
        "Dashed: what an ideal instrument would turn. In regimes 1 to 3 the rate dies although in 2 and 3 there is "
        "specific force along the input axis; in regime 4 it swings about a mean just below the ideal line."
    )
    return chapter_of("constant-input", values, (figure,))


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
    return chapter_of("period", values)


def varying() -> Chapter:
    """The four closed forms hold for time-varying input with a constant ratio of its components."""
    values: dict[str, float | Value] = {}
    t = np.linspace(0.0, 60.0, 601)
    slope, factor = 2.0 * np.pi / _PERIOD, swing(t, _SWING)
    swung = t + _SWING / slope * (1.0 - np.cos(slope * t))  # the integral of the factor replaces the time
    for example in _SWUNG:
        _, exact = _integrated(example, t, _SWING)
        published = published_closed_form(example.number, INSTRUMENT, swung, *example.force)[1] * factor
        values[f"form-{example.number}"] = _worst(t, published, exact)
    return chapter_of("closed-forms", values)
