"""Time-varying input of [Wei2024]: four forms, the run with a_Y = 5 a_x, and the skew that avoids locking."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp

from piga.instrument import (
    Instrument,
    closed_form,
    dead_zone,
    mean_rate,
)
from piga.reports.render.figure import XYZ, Figure, Plot
from piga.results import Array
from piga.studies.case import (
    INSTRUMENT,
    RAMP_TOP,
    RATIO,
    SCALE,
    TRANSVERSE,
    Chapter,
    Value,
    chapter_of,
    model_phase,
    raw_error,
    record,
)
from piga.studies.constant import FormNumber, published_closed_form
from piga.units import ARCSEC, G0

DURATION = 60.0
_SWING, _PERIOD = 0.6, 15.0
_DOTS = 45
_EVERY = 20
"""Every 20th sample of the run is drawn: at least seventeen per revolution."""


@dataclass(frozen=True)
class _ForceForm:
    """A run at a constant ratio of components: number of the form, a_x at the mean of the swing [g], a_Y and a_Z [g]."""

    number: FormNumber
    title: str
    force: tuple[float, float, float]


FORMS = (
    _ForceForm(1, "a_x = 0, a_Y and a_Z vary", (0.0, 3.0, 4.0)),
    _ForceForm(2, "a_x = a_t tan(beta)", (RATIO, TRANSVERSE, 0.0)),
    _ForceForm(3, "a_x = 0.4 a_t tan(beta)", (0.4 * RATIO, TRANSVERSE, 0.0)),
    _ForceForm(4, "a_x = 0.2 a_t", (0.2 * TRANSVERSE, TRANSVERSE, 0.0)),
)


def swing(t: ArrayLike) -> Array:
    """Common factor of all components: 1 + 0.6 sin(2 pi t / 15 s). The ratio is constant, the size varies."""
    return np.asarray(1.0 + _SWING * np.sin(2.0 * np.pi * np.asarray(t) / _PERIOD))


def _swung(t: Array) -> Array:
    """Integral of :func:`swing` from 0 [s]. The published forms hold if it replaces the time."""
    slope = 2.0 * np.pi / _PERIOD
    return np.asarray(t + _SWING / slope * (1.0 - np.cos(slope * np.asarray(t))))


@cache
def solved(form: _ForceForm) -> tuple[Array, Array, Array]:
    """Time [s], rate by the published form and by SciPy's DOP853 to 1e-11 rad [rad/s]."""
    t = np.linspace(0.0, DURATION, 601)
    force = G0 * np.array(form.force)
    _, per_second = published_closed_form(form.number, INSTRUMENT, _swung(t), *(float(v) for v in force))

    def rate(time: float | Array, alpha: Array) -> Array:
        a_x, a_Y, a_Z = np.multiply.outer(force, swing(time))
        coupling = INSTRUMENT.tan_beta * (a_Y * np.sin(alpha) - a_Z * np.cos(alpha))
        return np.asarray(INSTRUMENT.scale_factor * (a_x + coupling))

    start = np.array([INSTRUMENT.alpha0])
    run = solve_ivp(rate, (0.0, DURATION), start, method="DOP853", rtol=1e-13, atol=1e-13, t_eval=t)
    return t, per_second * swing(t), rate(t, run.y[0])


def forms() -> Chapter:
    """The four closed forms hold for time-varying input with a constant ratio of its components."""
    values: dict[str, float | Value] = {}
    plot = Plot(
        "closed-forms-varying",
        "The four forms under time-varying input at a constant ratio",
        columns=2,
        height=2.4,
    )
    for form in FORMS:
        t, published, exact = solved(form)
        at = int(np.argmax(np.abs(published - exact)))
        values[f"form-{form.number}"] = Value(
            math.degrees(exact[at]), published=math.degrees(published[at]), words={"t": t[at]}
        )
        shown = t <= (25.0 if form.number == 4 else DURATION)
        t, published, exact = t[shown], published[shown], exact[shown]
        dots = slice(None, None, max(1, t.size // _DOTS))
        ideal = INSTRUMENT.scale_factor * G0 * form.force[0] * swing(t)
        plot.panel("time [s]", "output rate [deg/s]", f"{form.number}  {form.title}")
        plot.dashed(t, np.degrees(ideal), "ideal: K a_x")
        plot.line(t, np.degrees(exact), "integrated", "after")
        plot.points(t[dots], np.degrees(published[dots]), "published form", "before")
    figure = plot.caption(
        "Points: published form. Line: the equation of motion integrated numerically (DOP853)."
    )
    return chapter_of("closed-forms", values, (figure,))


def run() -> Chapter:
    """a_Y = 5 a_x with a_x up to about 2 g: indicated against true acceleration."""
    log = record("ramp")
    error = raw_error(log)
    late = log.f[:, 0] > 0.5 * RAMP_TOP * G0
    values = {
        "error": float(np.abs(error).max()),
        "growth": float(np.abs(error[late] / (log.f[late, 0] / G0)).max()),
    }
    return chapter_of("time-varying", values, (_run_figure(error),))


def _run_figure(error: Array) -> Figure:
    log = record("ramp")
    drawn = slice(None, None, _EVERY)
    a_x, error = log.f[drawn, 0] / G0, error[drawn]
    indicated = a_x + error
    plot = Plot("time-varying-run", "Indicated against true acceleration, a_Y = 5 a_x", columns=2, height=2.6)
    close = a_x > RAMP_TOP - 0.25
    for part, ends, title in (
        (slice(None), np.array([0.0, RAMP_TOP]), "Indicated against true"),
        (close, a_x[close][[0, -1]], "The last quarter of a g"),
    ):
        plot.panel("true acceleration a_x [g]", "indicated acceleration [g]", title)
        plot.dashed(ends, ends, "ideal").line(a_x[part], indicated[part], "indicated", "before")
    plot.panel("true acceleration a_x [g]", "error [g]", "Error against the input")
    plot.band(a_x, -RATIO * a_x, RATIO * a_x, "envelope 5 a_x tan(beta)")
    plot.line(a_x, error, "error of the indication", "after")
    plot.panel("revolutions of the gimbal", "error [g]", "One period a revolution")
    plot.line(model_phase(log)[drawn] / (2.0 * np.pi), error, "error of the indication", "after")
    return plot.caption(
        "The error reaches 0.05 g at 2 g and repeats with each revolution: on the whole range the indication looks right."
    )


_SKEWS = np.geomspace(1.0, 36000.0, 400) * ARCSEC


def mounting() -> Chapter:
    """Skew that keeps a_x^2 > a_t^2 tan^2(beta)."""
    load = TRANSVERSE * G0
    values = {
        "least-skew": math.atan(float(dead_zone(INSTRUMENT, load, 0.0)[1]) / load) / ARCSEC,
        "moves": _revolving_skew(load),
        "shortfall": _shortfall(10.0 * INSTRUMENT.beta, load),
    }
    return chapter_of("mounting", values, (_mounting_figure(load),))


def _shortfall(skew: float, load: float) -> float:
    a_x = load * math.sin(skew)
    return 1.0 - float(mean_rate(INSTRUMENT, a_x, load * math.cos(skew), 0.0)) / (INSTRUMENT.scale_factor * a_x)


def _revolving_skew(load: float) -> float:
    """Least skew [arcsec] at which the exact motion makes one revolution within 50 000 s."""
    low, high = 500.0, 2000.0
    while high - low > 1e-3:
        skew = 0.5 * (low + high)
        angle = skew * ARCSEC
        turned = (
            closed_form(INSTRUMENT, 5e4, load * math.sin(angle), load * math.cos(angle), 0.0)[0]
            - INSTRUMENT.alpha0
        )
        low, high = (low, skew) if turned > 2.0 * math.pi else (skew, high)
    return 0.5 * (low + high)


def _mounting_figure(load: float) -> Figure:
    curves = []
    for seconds, role in zip((100.0, 1000.0, 5000.0), XYZ, strict=True):
        inst = Instrument(SCALE, seconds * ARCSEC)
        a_x, a_t = load * np.sin(_SKEWS), load * np.cos(_SKEWS)
        share = mean_rate(inst, a_x, a_t, 0.0) / (inst.scale_factor * a_x)
        curves.append((share, f"beta = {seconds:g} arcsec", role))
    x = "log skew of the input axis [arcsec]"
    plot = Plot("mounting-skew", "How far to skew the instrument", columns=2, height=3.0)
    plot.panel(x, "mean rate over K a_x", "Locked below beta")
    for share, name, role in curves:
        plot.line(_SKEWS / ARCSEC, share, name, role)
    plot.panel(x, "log missing share of the mean rate", "What skew alone leaves")
    for share, name, role in curves:
        moving = share > 0.0
        plot.line(_SKEWS[moving] / ARCSEC, np.maximum(1.0 - share[moving], 1e-9), name, role)
    return plot.caption(
        "Left: below a skew of beta the gimbal locks and nothing is measured; above, the mean rate rises to K a_x. Right: the "
        "missing share falls as (beta/skew)^2/2, so that skew alone does not replace compensation."
    )
