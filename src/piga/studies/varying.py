"""Time-varying input of [Wei2024]: four forms, the run with a_Y = 5 a_x, and the skew that avoids locking."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import solve_ivp

from piga.instrument import (
    Instrument,
    closed_form,
    dead_zone,
    mean_rate,
    published_closed_form,
)
from piga.instrument.motion.closed_form import Case as FormNumber
from piga.reports.render.figure import XYZ, Axis, Figure, Panel, Series
from piga.studies.case import (
    INSTRUMENT,
    RAMP_TOP,
    RATIO,
    SCALE,
    TRANSVERSE,
    Case,
    Chapter,
    model_phase,
    raw_error,
    record,
)
from piga.units import ARCSEC, G0

Array = NDArray[np.float64]

DURATION = 60.0
_SWING, _PERIOD = 0.6, 15.0
_DOTS = 45
_EVERY = 20
"""Every 20th sample of the run is drawn: at least seventeen per revolution."""


@dataclass(frozen=True)
class ForceForm:
    """A run at a constant ratio of components: number of the form, a_x at the mean of the swing [g], a_Y and a_Z [g]."""

    number: FormNumber
    title: str
    force: tuple[float, float, float]


FORMS = (
    ForceForm(1, "a_x = 0, a_Y and a_Z vary", (0.0, 3.0, 4.0)),
    ForceForm(2, "a_x = a_t tan(beta)", (RATIO, TRANSVERSE, 0.0)),
    ForceForm(3, "a_x = 0.4 a_t tan(beta)", (0.4 * RATIO, TRANSVERSE, 0.0)),
    ForceForm(4, "a_x = 0.2 a_t", (0.2 * TRANSVERSE, TRANSVERSE, 0.0)),
)


def swing(t: ArrayLike) -> Array:
    """Common factor of all components: 1 + 0.6 sin(2 pi t / 15 s). The ratio is constant, the size varies."""
    return np.asarray(1.0 + _SWING * np.sin(2.0 * np.pi * np.asarray(t) / _PERIOD))


def swung(t: Array) -> Array:
    """Integral of :func:`swing` from 0 [s]. The published forms hold if it replaces the time."""
    slope = 2.0 * np.pi / _PERIOD
    return np.asarray(t + _SWING / slope * (1.0 - np.cos(slope * np.asarray(t))))


@cache
def solved(form: ForceForm) -> tuple[Array, Array, Array]:
    """Time [s], rate by the published form and by SciPy's DOP853 to 1e-11 rad [rad/s]."""
    t = np.linspace(0.0, DURATION, 601)
    force = G0 * np.array(form.force)
    _, per_second = published_closed_form(form.number, INSTRUMENT, swung(t), *(float(v) for v in force))

    def rate(time: float | Array, alpha: Array) -> Array:
        a_x, a_Y, a_Z = np.multiply.outer(force, swing(time))
        coupling = INSTRUMENT.tan_beta * (a_Y * np.sin(alpha) - a_Z * np.cos(alpha))
        return np.asarray(INSTRUMENT.scale_factor * (a_x + coupling))

    start = np.array([INSTRUMENT.alpha0])
    run = solve_ivp(rate, (0.0, DURATION), start, method="DOP853", rtol=1e-13, atol=1e-13, t_eval=t)
    return t, per_second * swing(t), rate(t, run.y[0])


def forms() -> Chapter:
    """The four closed forms hold for time-varying input with a constant ratio of its components."""
    cases, panels = [], []
    for form in FORMS:
        t, published, exact = solved(form)
        at = int(np.argmax(np.abs(published - exact)))
        note = (
            "the form is exact at a constant ratio: the integrator is asked for 1e-13 rad a step, "
            "the published forms lose a few digits near the poles of the tangent"
        )
        name, source = f"closed-forms.form-{form.number}", f"[Wei2024] eq. 5-11, form {form.number}"
        quantity = f"rate where form and integrator differ most (t = {t[at]:.2f} s)"
        values = (math.degrees(published[at]), math.degrees(exact[at]))
        cases.append(Case(name, source, quantity, "deg/s", *values, 1e-8, note))
        panels.append(_form_panel(form, t, published, exact))
    text = (
        "All components swing together by 60 % with a period of 15 s (the publication's profiles are not printed), "
        "so that their ratio stays. The published forms then hold with the integrals V and W of the input."
    )
    figure = Figure(
        "closed-forms-varying",
        "The four forms under time-varying input at a constant ratio",
        tuple(panels),
        "Points: published form. Line: the equation of motion integrated numerically (DOP853).",
        columns=2,
        height=2.4,
    )
    source = "[Wei2024] eq. 5-11"
    return Chapter(
        "closed-forms", "The four forms with time-varying input", source, text, tuple(cases), (figure,)
    )


def _form_panel(form: ForceForm, t: Array, published: Array, exact: Array) -> Panel:
    shown = t <= (25.0 if form.number == 4 else DURATION)
    t, published, exact = t[shown], published[shown], exact[shown]
    dots = slice(None, None, max(1, t.size // _DOTS))
    ideal = INSTRUMENT.scale_factor * G0 * form.force[0] * swing(t)
    series = (
        Series(t, np.degrees(ideal), "ideal: K a_x", role="reference", dashed=True),
        Series(t, np.degrees(exact), "integrated", role="after"),
        Series(t[dots], np.degrees(published[dots]), "published form", "points", "before"),
    )
    return Panel(Axis("time", "s"), Axis("output rate", "deg/s"), series, f"{form.number}  {form.title}")


def run() -> Chapter:
    """a_Y = 5 a_x with a_x up to about 2 g: indicated against true acceleration."""
    log = record("ramp")
    error = raw_error(log)
    worst = float(np.abs(error).max())
    late = log.f[:, 0] > 0.5 * RAMP_TOP * G0
    slope = float(np.abs(error[late] / (log.f[late, 0] / G0)).max())
    cases = (
        Case(
            "time-varying.error",
            "[Wei2024] time-varying run",
            "largest error of the indicated acceleration",
            "g",
            0.05,
            worst,
            0.005,
            "printed as 'up to 0.05 g': one digit, half of the next",
        ),
        Case(
            "time-varying.growth",
            "[Wei2024] eq. 2-4",
            "error over a_x, largest in the upper half of the range",
            "1",
            RATIO,
            slope,
            0.02 * RATIO,
            "the envelope is 5 tan(beta); within a revolution of the top it is met to 2 %",
        ),
    )
    text = (
        "a_x rises evenly from 0 to 2.06 g in 100 s with a_Y = 5 a_x (up to about 10 g), sampled at 100 Hz; the "
        "publication does not print its profile. The error turns with the gimbal and grows with a_x: "
        "its envelope is a_Y tan(beta)."
    )
    source = "[Wei2024] time-varying run"
    return Chapter("time-varying", "The run with a_Y = 5 a_x", source, text, cases, (_run_figure(error),))


def _against_true(a_x: Array, indicated: Array, ends: ArrayLike, title: str) -> Panel:
    """Indicated against true acceleration, with the ideal line between its ends."""
    ideal = np.asarray(ends, dtype=float)
    series = (
        Series(ideal, ideal, "ideal", role="reference", dashed=True),
        Series(a_x, indicated, "indicated", role="before"),
    )
    return Panel(Axis("true acceleration a_x", "g"), Axis("indicated acceleration", "g"), series, title)


def _run_figure(error: Array) -> Figure:
    log = record("ramp")
    drawn = slice(None, None, _EVERY)
    a_x, error = log.f[drawn, 0] / G0, error[drawn]
    envelope = RATIO * a_x
    indicated = a_x + error
    revolutions = model_phase(log)[drawn] / (2.0 * np.pi)
    close = a_x > RAMP_TOP - 0.25
    panels = (
        _against_true(a_x, indicated, (0.0, RAMP_TOP), "Indicated against true"),
        _against_true(a_x[close], indicated[close], a_x[close][[0, -1]], "The last quarter of a g"),
        Panel(
            Axis("true acceleration a_x", "g"),
            Axis("error", "g"),
            (
                Series(a_x, -envelope, "envelope 5 a_x tan(beta)", "band", "muted", upper=envelope),
                Series(a_x, error, "error of the indication", role="after"),
            ),
            "Error against the input",
        ),
        Panel(
            Axis("revolutions of the gimbal", "1"),
            Axis("error", "g"),
            (Series(revolutions, error, "error of the indication", role="after"),),
            "One period a revolution",
        ),
    )
    return Figure(
        "time-varying-run",
        "Indicated against true acceleration, a_Y = 5 a_x",
        panels,
        "The error reaches 0.05 g at 2 g and repeats with each revolution: on the whole range the indication looks right.",
        columns=2,
        height=2.6,
    )


_SKEWS = np.geomspace(1.0, 36000.0, 400) * ARCSEC


def mounting() -> Chapter:
    """Skew that keeps a_x^2 > a_t^2 tan^2(beta)."""
    load = TRANSVERSE * G0
    border = math.atan(float(dead_zone(INSTRUMENT, load, 0.0)[1]) / load) / ARCSEC
    source = "[Wei2024] mounting recommendation"
    cases = (
        Case(
            "mounting.least-skew",
            source,
            "least skew against the load at which the gimbal revolves, a_x^2 = a_t^2 tan^2(beta)",
            "arcsec",
            1000.0,
            border,
            1e-9,
            "the condition gives beta itself, whatever the load: rounding",
        ),
        Case(
            "mounting.moves",
            source,
            "skew at which the motion passes one revolution in the long run, found by bisection",
            "arcsec",
            1000.0,
            _revolving_skew(load),
            0.1,
            "within 50 000 s a revolution shows down to 1e-4 of the border: 0.1 arcsec",
        ),
        Case(
            "mounting.shortfall",
            source,
            "mean rate missing at a skew of ten times beta, share of K a_x",
            "1",
            None,
            _shortfall(10.0 * INSTRUMENT.beta, load),
            None,
            "not published: running is not enough, the mean rate is still short by r^2/2 until it is compensated",
        ),
    )
    text = (
        "The whole load a lies across the input axis but for a skew: a_x = a sin(skew), a_t = a cos(skew). The recommendation is "
        "to skew the instrument so far that a_x^2 > a_t^2 tan^2(beta); with the load in one plane this is skew > beta."
    )
    return Chapter("mounting", "Mounting", source, text, cases, (_mounting_figure(load),))


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
    rates, missing = [], []
    for seconds, role in zip((100.0, 1000.0, 5000.0), XYZ, strict=True):
        inst = Instrument(SCALE, seconds * ARCSEC)
        a_x, a_t = load * np.sin(_SKEWS), load * np.cos(_SKEWS)
        share = mean_rate(inst, a_x, a_t, 0.0) / (inst.scale_factor * a_x)
        name = f"beta = {seconds:g} arcsec"
        rates.append(Series(_SKEWS / ARCSEC, share, name, role=role))
        running = share > 0.0
        missing.append(
            Series(_SKEWS[running] / ARCSEC, np.maximum(1.0 - share[running], 1e-9), name, role=role)
        )
    x = Axis("skew of the input axis", "arcsec", log=True)
    left = Panel(x, Axis("mean rate over K a_x", "1"), tuple(rates), "Locked below beta")
    right = Panel(
        x, Axis("missing share of the mean rate", "1", log=True), tuple(missing), "What skew alone leaves"
    )
    return Figure(
        "mounting-skew",
        "How far to skew the instrument",
        (left, right),
        "Left: below a skew of beta the gimbal locks and nothing is measured; above, the mean rate rises to K a_x. Right: the "
        "missing share falls as (beta/skew)^2/2, so that skew alone does not replace compensation.",
        columns=2,
        height=3.0,
    )
