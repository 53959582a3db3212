"""The time-varying run of [Wei2024]: its error, the skew that avoids locking, calibration, compensation; and the errata."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from piga.instrument import closed_form, dead_zone, mean_rate, propagate
from piga.records import Calibration
from piga.reports.render.figure import Figure, Plot, Role
from piga.results import Array
from piga.studies.case import (
    INSTRUMENT,
    RAMP_TOP,
    RATIO,
    TRANSVERSE,
    Chapter,
    Value,
    chapter_of,
    closed_form_phase,
    compensated_error,
    model_phase,
    model_residual,
    own_calibration,
    published_calibration,
    raw_error,
    raw_state,
    record,
)
from piga.studies.constant import EXAMPLES, published_closed_form
from piga.studies.platform import CASE_RATE, CHANNELS, GRAVITY_OF_TABLE, compared, formula, last_lines
from piga.units import ARCMIN, ARCSEC, G0

_PUBLISHED_TAN_BETA, _PUBLISHED_PHASE = 4.848e-3, 0.802
_LATE = 20.0
_EVERY = 20
"""Every 20th sample of the run is drawn: at least seventeen per revolution."""


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


def mounting() -> Chapter:
    """Skew that keeps a_x^2 > a_t^2 tan^2(beta)."""
    load = TRANSVERSE * G0
    values = {
        "least-skew": math.atan(float(dead_zone(INSTRUMENT, load, 0.0)[1]) / load) / ARCSEC,
        "moves": _revolving_skew(load),
        "shortfall": _shortfall(10.0 * INSTRUMENT.beta, load),
    }
    return chapter_of("mounting", values, ())


def _shortfall(skew: float, load: float) -> float:
    a_x = load * math.sin(skew)
    return 1.0 - float(mean_rate(INSTRUMENT, a_x, load * math.cos(skew), 0.0)) / (INSTRUMENT.scale_factor * a_x)


def _revolving_skew(load: float) -> float:
    """Least skew [arcsec] at which the exact motion makes one revolution within 50 000 s."""
    from scipy.optimize import brentq

    def missing(skew: float) -> float:
        force = load * math.sin(skew * ARCSEC), load * math.cos(skew * ARCSEC), 0.0
        return float(closed_form(INSTRUMENT, 5e4, *force)[0]) - INSTRUMENT.alpha0 - 2.0 * math.pi

    return float(brentq(missing, 500.0, 2000.0, xtol=1e-4))


def recursion() -> Chapter:
    """[tan_beta, phi] from x0 = [4.5e-3, 0.4], P0 = 1e10 I, and wrong convergence with a constant input."""
    tan_beta, phi = raw_state(published_calibration("ramp"))
    wrong_tan_beta, wrong_phi = raw_state(published_calibration("constant"))
    ours, constant_ours = own_calibration("ramp"), own_calibration("constant")
    constant, lead = closed_form_phase()
    values = {
        "tan_beta": tan_beta,
        "phi": phi,
        "phase-constant": constant - lead,
        "own-tan_beta": ours["tan_beta"].value,
        "own-truth": ours["tan_beta"].value - INSTRUMENT.tan_beta,
        "own-phi": ours["phi"].value - INSTRUMENT.alpha0,
        "constant-tan_beta": wrong_tan_beta,
        "constant-phi": wrong_phi,
        "constant-own": constant_ours["tan_beta"].value - INSTRUMENT.tan_beta,
    }
    return chapter_of("recursion", values, (_history_figure(),))


def _history_figure() -> Figure:
    """Whole run on the left, from 20 s on the right; tan(beta) above, phi below."""
    t = record("ramp").t
    estimates: tuple[tuple[Calibration, str, Role], ...] = (
        (published_calibration("ramp"), "published recursion", "before"),
        (own_calibration("ramp"), "linear estimator, no first guess", "after"),
    )
    plot = Plot("recursion-history", "Recursive calibration: history of the estimates", columns=2, height=2.3)
    for name, scale, y, true, printed in (
        ("tan_beta", 1e3, "tan(beta) [1e-3]", INSTRUMENT.tan_beta, _PUBLISHED_TAN_BETA),
        ("phi", 1.0, "phi [rad]", INSTRUMENT.alpha0, _PUBLISHED_PHASE),
    ):
        for begin in (0.0, _LATE):
            above = "Whole run" if begin == 0.0 else f"From {_LATE:g} s on"
            plot.panel("time [s]", y, above if name == "tan_beta" else "")
            plot.level([begin, t[-1]], scale * true, "true")
            plot.level([begin, t[-1]], scale * printed, "published result", "warning")
            for calibration, label, role in estimates:
                history = calibration.history or {}
                when = t[history["sample"].astype(int) - 1]
                shown = when >= begin
                plot.line(when[shown], scale * history[name][shown], label, role)
    return plot.caption(
        "The published recursion settles within 20 s; its phase then drifts with the run, through the printed 0.802 rad, and "
        "would go on below the truth in a longer one. The linear estimator is at "
        "the truth as soon as there are more samples than unknowns (noiseless data)."
    )


def compensation() -> Chapter:
    """The published compensation (under 0.002 g) against the exact one (rounding)."""
    log = record("ramp")
    published, ours = published_calibration("ramp"), own_calibration("ramp")
    before, model = raw_error(log), model_residual(log, published)
    formula = compensated_error(log, _with_phase(published, _PUBLISHED_PHASE), "published")
    exact = compensated_error(log, ours, "exact")
    largest = [float(np.abs(error).max()) for error in (before, model, formula, exact)]
    values = {
        "before": largest[0],
        "model-limit": largest[1],
        "model": largest[1],
        "formula": largest[2],
        "exact": largest[3],
    }
    return chapter_of("compensation", values, (_compensation_figure(before, model, formula, exact),))


def _with_phase(calibration: Calibration, phi: float) -> Calibration:
    """The calibration with another phase [rad], as the phase of the output."""
    changed = tuple(replace(c, value=phi) if c.name == "phi" else c for c in calibration.coefficients)
    return replace(calibration, coefficients=changed, phase_source="output")


def _compensation_figure(before: Array, model: Array, formula: Array, exact: Array) -> Figure:
    t = record("ramp").t[::20]
    rows: tuple[tuple[Array, float, str, Role, str], ...] = (
        (before, 1.0, "g", "before", "Before"),
        (model, 1e3, "mg", "warning", "Published, phase from the input"),
        (formula, 1e3, "mg", "z", "Published, phase from the output"),
        (exact, 1e15, "1e-15 g", "after", "Exact"),
    )
    plot = Plot("compensation-errors", "What compensation leaves of the error", columns=2, height=2.3)
    for y, scale, unit, role, title in rows:
        plot.panel("time [s]", f"error [{unit}]", title).line(t, scale * y[::20], role=role)
    return plot.caption(
        "Four scales: g, mg twice, and 1e-15 g. Above right the phase is the integral of K a_x, below left that of the output "
        "plus the printed 0.802 rad. The published compensation takes the error from 0.05 g to "
        f"1 or 2 mg at {RAMP_TOP:g} g; the exact one to rounding."
    )


def _phase_walk() -> tuple[Array, Array]:
    """Phase of the published model minus the true phase [rad] on the ramp, and K V r^2/2 [rad]."""
    log = record("ramp")
    alpha = propagate(INSTRUMENT, log.t, log.f, between="linear")
    predicted = model_phase(log)
    constant, lead = closed_form_phase()
    return predicted + constant - lead - alpha, 0.5 * RATIO**2 * predicted


def _misread_phase_error() -> float:
    """Largest remaining error [g] if the printed 0.802 is taken as degrees."""
    degrees = _with_phase(published_calibration("ramp"), math.radians(_PUBLISHED_PHASE))
    return float(np.abs(compensated_error(record("ramp"), degrees, "published")).max())


# -- errors in the publications --------------------------------------------------------------------------

_T = np.linspace(0.0, 60.0, 1201)


def errata() -> Chapter:
    """All errata with their numbers."""
    values = {**_forms(), **_phase(), **_platform()}
    computed = {key: value.computed if isinstance(value, Value) else value for key, value in values.items()}
    signs = [computed[f"sign-{number}"] for number in (2, 3, 4)]
    return chapter_of(
        "errata",
        values,
        (),
        least_sign=min(signs),
        most_sign=max(signs),
        square=computed["square"],
        shift=abs(computed["phase-shift"]),
        residual=1e3 * computed["phase-residual"],
        degrees=computed["degrees"],
        effect=computed["degrees-effect"],
        gravity=computed["gravity"],
        heading=computed["heading-published"],
        roll=computed["roll-published"],
        ours=computed["heading-ours"],
    )


def _forms() -> dict[str, float | Value]:
    """The lost sign and the lost square of the printed forms, for the a_x of the examples turned negative."""
    values: dict[str, float | Value] = {}
    for example in EXAMPLES[1:]:
        a_x, a_Y, a_Z = example.force
        force = -a_x, a_Y, a_Z
        exact = closed_form(INSTRUMENT, _T, *force)[1]
        for suffix, printed in (("", True), ("-corrected", False)):
            _, rate = published_closed_form(example.number, INSTRUMENT, _T, *force, as_published=printed)
            values[f"sign-{example.number}{suffix}"] = float(np.abs(rate - exact).max())
    with_square, without, exact = _critical_rates()
    values["square"] = float(without[0])
    values["square-corrected"] = float(np.abs(with_square - exact).max())
    return values


def _critical_rates() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Critical example [rad/s]: with the square, without it, and by the exact motion."""
    force = EXAMPLES[1].force
    start = math.tan(0.5 * INSTRUMENT.alpha0)
    m = INSTRUMENT.scale_factor * force[0] * _T + (start - 1.0) / (start + 1.0)
    top = 2.0 * INSTRUMENT.scale_factor * force[0]
    return top / (1.0 + m * m), top / (1.0 + m), closed_form(INSTRUMENT, _T, *force)[1]


def _phase() -> dict[str, float | Value]:
    """The phase of the published model, and the phase printed in degrees."""
    walk, predicted = _phase_walk()
    calibration, (constant, lead) = published_calibration("ramp"), closed_form_phase()
    shift = raw_state(calibration)[1] - (constant - lead)
    bound = TRANSVERSE * RAMP_TOP * INSTRUMENT.tan_beta * float(np.abs(walk + shift).max())
    left = float(np.abs(model_residual(record("ramp"), calibration)).max())
    return {
        "phase-walk": float(np.polyfit(predicted, walk, 1)[0]),
        "phase-shift": shift,
        "phase-residual": Value(left, words={"bound": bound}),
        "degrees": math.degrees(constant - lead),
        "degrees-effect": _misread_phase_error(),
    }


def _platform() -> dict[str, float | Value]:
    """G of the table, and the simulated lines of heading and roll over the formula."""
    values: dict[str, float | Value] = {
        "gravity": 100.0 * (0.222 / (GRAVITY_OF_TABLE * ARCMIN / CASE_RATE) - 1.0)
    }
    lines = last_lines(compared(wobble=False), "A")
    for c in CHANNELS[1:]:
        theory = formula(c.channel)
        values[f"{c.channel}-published"] = 100.0 * (c.simulated * c.scale / theory - 1.0)
        values[f"{c.channel}-ours"] = 100.0 * (lines[c.channel] / theory - 1.0)
    return values
