"""Recursive calibration, compensation with its result [Wei2024], and the errors in the publications, shown by numbers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from piga.instrument import closed_form, propagate
from piga.records import Calibration
from piga.reports.render.figure import Figure, Plot, Role
from piga.results import Array
from piga.studies.case import (
    INSTRUMENT,
    RAMP_TOP,
    RATIO,
    TRANSVERSE,
    Chapter,
    ForceHistory,
    Value,
    chapter_of,
    closed_form_phase,
    compensated_error,
    example_force,
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
from piga.units import ARCMIN

_PUBLISHED_TAN_BETA, _PUBLISHED_PHASE = 4.848e-3, 0.802
_LATE = 20.0


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
    figures = (
        _history_figure(
            "recursion-history",
            "Recursive calibration: history of the estimates",
            "ramp",
            "The published recursion settles within 20 s; its phase then drifts with the run, through the printed 0.802 rad, and "
            "would go on below the truth in a longer one. The linear estimator is at "
            "the truth as soon as there are more samples than unknowns (noiseless data).",
        ),
        _history_figure(
            "recursion-constant",
            "The wrong convergence from a constant input",
            "constant",
            "a_x = 2.06 g throughout: the recursion ends at a negative tan(beta) of about half the true size, more than half a "
            "turn away in phase, and stays there. The linear estimator has one optimum.",
        ),
    )
    return chapter_of("recursion", values, figures)


def _history_figure(key: str, title: str, profile: ForceHistory, caption: str) -> Figure:
    """Whole run on the left, from 20 s on the right; tan(beta) above, phi below."""
    t = record(profile).t
    estimates: tuple[tuple[Calibration, str, Role], ...] = (
        (published_calibration(profile), "published recursion", "before"),
        (own_calibration(profile), "linear estimator, no first guess", "after"),
    )
    plot = Plot(key, title, columns=2, height=2.3)
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
    return plot.caption(caption)


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


def _phase_walk() -> tuple[Array, Array, Array]:
    """Time [s], phase of the published model minus the true phase [rad] on the ramp, and K V r^2/2 [rad]."""
    log = record("ramp")
    alpha = propagate(INSTRUMENT, log.t, log.f, between="linear")
    predicted = model_phase(log)
    constant, lead = closed_form_phase()
    return log.t, predicted + constant - lead - alpha, 0.5 * RATIO**2 * predicted


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
        (_sign_figure(), _phase_figure()),
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


def _negative(case: int, *, as_published: bool) -> tuple[np.ndarray, np.ndarray]:
    """Rates [rad/s] at ``_T`` for the example's a_x turned negative: form and exact motion."""
    example = EXAMPLES[case - 1]
    force = example_force(-example.a_x)
    _, rate = published_closed_form(example.number, INSTRUMENT, _T, *force, as_published=as_published)
    return rate, closed_form(INSTRUMENT, _T, *force)[1]


def _forms() -> dict[str, float | Value]:
    """The lost sign and the lost square of the printed forms."""
    values: dict[str, float | Value] = {}
    for number in (2, 3, 4):
        for suffix, as_published in (("", True), ("-corrected", False)):
            rate, exact = _negative(number, as_published=as_published)
            values[f"sign-{number}{suffix}"] = float(np.abs(rate - exact).max())
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
    _, walk, predicted = _phase_walk()
    calibration, (constant, lead) = published_calibration("ramp"), closed_form_phase()
    bound = TRANSVERSE * RAMP_TOP * INSTRUMENT.tan_beta * float(np.abs(_model_phase_error()).max())
    left = float(np.abs(model_residual(record("ramp"), calibration)).max())
    return {
        "phase-walk": float(np.polyfit(predicted, walk, 1)[0]),
        "phase-shift": raw_state(calibration)[1] - (constant - lead),
        "phase-residual": Value(left, words={"bound": bound}),
        "degrees": math.degrees(constant - lead),
        "degrees-effect": _misread_phase_error(),
    }


def _model_phase_error() -> np.ndarray:
    """Phase of the published model, with its estimated phi, minus the true angle [rad]."""
    _, walk, _ = _phase_walk()
    constant, lead = closed_form_phase()
    return walk - (constant - lead) + raw_state(published_calibration("ramp"))[1]


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


def _sign_figure() -> Figure:
    plot = Plot("errata-sign", "The sign defect: the printed forms for negative input", columns=3, height=2.6)
    for number in (2, 3, 4):
        wrong, exact = _negative(number, as_published=True)
        shown = (15.0 if number == 4 else 60.0) >= _T
        plot.panel("time [s]", "output rate [deg/s]", f"form {number}: a_x = {-EXAMPLES[number - 1].a_x:.4g} g")
        plot.line(_T[shown], np.degrees(exact[shown]), "exact", "after")
        plot.dashed(_T[shown], np.degrees(wrong[shown]), "as printed, |r|", "before")
    return plot.caption(
        "With |r| instead of the signed r, the printed forms start at a wrong rate and end at a wrong phase for a_x < 0."
    )


def _phase_figure() -> Figure:
    residual = model_residual(record("ramp"), published_calibration("ramp"))[::20]
    t, walk, predicted = (values[::20] for values in _phase_walk())
    envelope = (
        1e3 * TRANSVERSE * INSTRUMENT.tan_beta * RAMP_TOP * t / t[-1] * np.abs(_model_phase_error()[::20])
    )
    plot = Plot("errata-phase", "The phase of the published model drifts", height=2.3)
    plot.panel("time [s]", "phase error [mrad]")
    plot.line(t, 1e3 * walk, "model less motion", "before").dashed(t, 1e3 * predicted, "K V r^2 / 2")
    plot.panel("time [s]", "residual [mg]")
    plot.band(t, -envelope, envelope, "bound by the phase error")
    plot.line(t, 1e3 * residual, "left by the calibration", "after")
    return plot.caption(
        "Above: the predicted phase runs ahead of the gimbal by K V r^2/2, with a ripple of r in each revolution. Below: the "
        "residual of the published calibration stays within its phase error times 5 a_x tan(beta)."
    )
