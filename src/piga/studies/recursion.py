"""Recursive calibration, and compensation with its result [Wei2024]."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from piga.instrument import propagate
from piga.records import Calibration
from piga.reports.render.figure import Axis, Figure, Panel, Role, Series
from piga.studies.case import (
    INSTRUMENT,
    RAMP_TOP,
    RATIO,
    Case,
    Chapter,
    ForceHistory,
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

Array = NDArray[np.float64]

PUBLISHED_TAN_BETA, PUBLISHED_PHASE = 4.848e-3, 0.802
_LATE = 20.0


def recursion() -> Chapter:
    """[tan_beta, phi] from x0 = [4.5e-3, 0.4], P0 = 1e10 I, and wrong convergence with a constant input."""
    text = (
        "The published recursion, started at x0 = [4.5e-3, 0.4] with P0 = 1e10 I on the run of the chapter before, "
        "beside the product's linear estimator, which takes the phase from the measured output and needs no first "
        "guess. From a constant input the recursion converges to a wrong solution."
    )
    cases = (*_published_cases(), *_own_cases(), *_constant_cases())
    figures = (_history_figure(), _constant_figure())
    return Chapter("recursion", "Recursive calibration", "[Wei2024] eq. 12-18", text, cases, figures)


def _published_cases() -> list[Case]:
    tan_beta, phi = raw_state(published_calibration("ramp"))
    walk = model_phase(record("ramp"))[-1] * 0.5 * RATIO**2
    constant, lead = closed_form_phase()
    source = "[Wei2024] eq. 12-18"
    second_order = 0.5 * RATIO**2 * INSTRUMENT.tan_beta
    return [
        Case(
            "recursion.tan_beta",
            source,
            "tan(beta) by the published recursion",
            "1",
            PUBLISHED_TAN_BETA,
            tan_beta,
            0.5e-6 + second_order,
            "half of the printed digit (0.5e-6), plus r^2/2 = 2.9e-4 of tan(beta), which the published model neglects",
        ),
        Case(
            "recursion.phi",
            source,
            "phi by the published recursion",
            "rad",
            PUBLISHED_PHASE,
            phi,
            walk,
            f"the model's phase walks by K V r^2/2 = {walk:.3f} rad over this record and the estimate settles inside "
            "that walk; the published input, on which V depends, is not printed",
        ),
        Case(
            "recursion.phase-constant",
            "[Wei2024] eq. 5-11, 19-21",
            "C - asin(r), the phase that the published model has at the start",
            "rad",
            PUBLISHED_PHASE,
            constant - lead,
            1e-3,
            "printed 0.802 (there called degrees); one unit of the last digit, as it may be cut off instead of rounded",
        ),
    ]


def _own_cases() -> list[Case]:
    calibration = own_calibration("ramp")
    source = "[Wei2024] eq. 12-18, our estimator"
    return [
        Case(
            "recursion.own-tan_beta",
            source,
            "tan(beta) by the linear estimator",
            "1",
            PUBLISHED_TAN_BETA,
            calibration["tan_beta"].value,
            0.5e-6,
            "half of the printed digit",
        ),
        Case(
            "recursion.own-truth",
            source,
            "tan(beta) by the linear estimator less tan(1000 arcsec)",
            "1",
            0.0,
            calibration["tan_beta"].value - INSTRUMENT.tan_beta,
            1e-12,
            "the record is free of noise and the model exact: rounding of 10 001 samples is left",
        ),
        Case(
            "recursion.own-phi",
            source,
            "phi by the linear estimator less alpha0 = pi/4",
            "rad",
            0.0,
            calibration["phi"].value - INSTRUMENT.alpha0,
            1e-9,
            "measured angle as phase: no walk; rounding of 10 001 samples is left",
        ),
    ]


def _constant_cases() -> list[Case]:
    tan_beta, phi = raw_state(published_calibration("constant"))
    own = own_calibration("constant")
    source = "[Wei2024] eq. 12-18, constant input 2.06 g"
    reason = "the publication does not show this run: the wrong solution to which its recursion converges"
    return [
        Case(
            "recursion.constant-tan_beta",
            source,
            "tan(beta) by the published recursion",
            "1",
            None,
            tan_beta,
            None,
            reason,
        ),
        Case(
            "recursion.constant-phi", source, "phi by the published recursion", "rad", None, phi, None, reason
        ),
        Case(
            "recursion.constant-own",
            source + ", our estimator",
            "tan(beta) by the linear estimator less tan(1000 arcsec)",
            "1",
            0.0,
            own["tan_beta"].value - INSTRUMENT.tan_beta,
            1e-12,
            "there is one optimum and no first guess: rounding is left for the constant input too",
        ),
    ]


def _history_panels(profile: ForceHistory) -> tuple[Panel, ...]:
    """Panels: whole run on the left, from 20 s on the right; tan(beta) above, phi below."""
    t = record(profile).t
    estimate: tuple[tuple[Calibration, str, Role], ...] = (
        (published_calibration(profile), "published recursion", "before"),
        (own_calibration(profile), "linear estimator, no first guess", "after"),
    )
    rows = (
        ("tan_beta", 1e3, Axis("tan(beta)", "1e-3"), INSTRUMENT.tan_beta, PUBLISHED_TAN_BETA),
        ("phi", 1.0, Axis("phi", "rad"), INSTRUMENT.alpha0, PUBLISHED_PHASE),
    )
    panels = []
    for name, scale, axis, true, printed in rows:
        for begin in (0.0, _LATE):
            series = [
                Series([begin, t[-1]], [scale * true] * 2, "true", role="reference", dashed=True),
                Series([begin, t[-1]], [scale * printed] * 2, "published result", role="warning", dashed=True),
            ]
            for calibration, label, role in estimate:
                history = calibration.history or {}
                when = t[history["sample"].astype(int) - 1]
                shown = when >= begin
                series.append(Series(when[shown], scale * history[name][shown], label, role=role))
            title = "Whole run" if begin == 0.0 else f"From {_LATE:g} s on"
            panels.append(Panel(Axis("time", "s"), axis, tuple(series), title if name == "tan_beta" else ""))
    return tuple(panels)


def _history_figure() -> Figure:
    return Figure(
        "recursion-history",
        "Recursive calibration: history of the estimates",
        _history_panels("ramp"),
        "The published recursion settles within 20 s; its phase then drifts with the run, through the printed 0.802 rad, and "
        "would go on below the truth in a longer one. The linear estimator is at "
        "the truth as soon as there are more samples than unknowns (noiseless data).",
        columns=2,
        height=2.3,
    )


def _constant_figure() -> Figure:
    return Figure(
        "recursion-constant",
        "The wrong convergence from a constant input",
        _history_panels("constant"),
        "a_x = 2.06 g throughout: the recursion ends at a negative tan(beta) of about half the true size, more than half a turn "
        "away in phase, and stays there. The linear estimator has one optimum.",
        columns=2,
        height=2.3,
    )


def compensation() -> Chapter:
    """The published compensation (under 0.002 g) against the exact one (rounding)."""
    log = record("ramp")
    published, own = published_calibration("ramp"), own_calibration("ramp")
    before, model = raw_error(log), model_residual(log, published)
    formula = compensated_error(log, with_phase(published, PUBLISHED_PHASE), "published")
    exact = compensated_error(log, own, "exact")
    text = (
        "The error of the chapter before the last (0.05 g), after the published calibration and compensation, and after the "
        "exact one, a_x = alpha'/K - tan(beta) (a_Y sin(alpha) - a_Z cos(alpha)), which takes the measured angle."
    )
    source = "[Wei2024] eq. 19-21"
    largest = [float(np.abs(error).max()) for error in (before, model, formula, exact)]
    cases = _compensation_cases(source, *largest)
    figure = _compensation_figure(before, model, formula, exact)
    return Chapter("compensation", "Compensation", source, text, cases, (figure,))


def _compensation_cases(
    source: str, before: float, model: float, formula: float, own: float
) -> tuple[Case, ...]:
    limit = "printed as 'under 0.002 g': an upper limit, anything from zero up to it agrees"
    curve = "read from the published curve as about 0.0015 g, which is below 0.002 g: reading accuracy 0.0005 g"
    rounding = (
        "noiseless data and an exact model: rounding of the rate (1e-16 of 2 g) and of the calibration is left"
    )
    predicted = "largest error after, phase predicted from the input"
    measured = "largest error after, phase from the output, phi = 0.802 rad as printed"
    exact = "largest error after, measured angle and linear estimator"
    digit = "printed to one digit: half of the next"
    ours = source + ", our exact form"
    return (
        Case("compensation.before", source, "largest error before", "g", 0.05, before, 0.005, digit),
        Case("compensation.model-limit", source, predicted, "g", 0.002, model, 0.002, limit, limit=True),
        Case("compensation.model", source, predicted, "g", 0.0015, model, 0.0005, curve),
        Case("compensation.formula", source, measured, "g", 0.002, formula, 0.002, limit, limit=True),
        Case("compensation.exact", ours, exact, "g", 0.0, own, 1e-12, rounding),
    )


def with_phase(calibration: Calibration, phi: float) -> Calibration:
    """The calibration with another phase [rad], as the phase of the output."""
    changed = tuple(replace(c, value=phi) if c.name == "phi" else c for c in calibration.coefficients)
    return replace(calibration, coefficients=changed, phase_source="output")


def _compensation_figure(before: Array, model: Array, formula: Array, exact: Array) -> Figure:
    t = record("ramp").t
    rows: tuple[tuple[Array, float, str, Role, str], ...] = (
        (before, 1.0, "g", "before", "Before"),
        (model, 1e3, "mg", "warning", "Published, phase from the input"),
        (formula, 1e3, "mg", "z", "Published, phase from the output"),
        (exact, 1e15, "1e-15 g", "after", "Exact"),
    )
    panels = tuple(
        Panel(Axis("time", "s"), Axis("error", unit), (Series(t[::20], scale * y[::20], role=role),), title)
        for y, scale, unit, role, title in rows
    )
    return Figure(
        "compensation-errors",
        "What compensation leaves of the error",
        panels,
        "Four scales: g, mg twice, and 1e-15 g. Above right the phase is the integral of K a_x, below left that of the output "
        "plus the printed 0.802 rad. The published compensation takes the error from 0.05 g to "
        f"1 or 2 mg at {RAMP_TOP:g} g; the exact one to rounding.",
        columns=2,
        height=2.3,
    )


def phase_walk() -> tuple[Array, Array, Array]:
    """Time [s], phase of the published model minus the true phase [rad] on the ramp, and K V r^2/2 [rad]."""
    log = record("ramp")
    alpha = propagate(INSTRUMENT, log.t, log.f)
    predicted = model_phase(log)
    constant, lead = closed_form_phase()
    return log.t, predicted + constant - lead - alpha, 0.5 * RATIO**2 * predicted


def misread_phase_error() -> float:
    """Largest remaining error [g] if the printed 0.802 is taken as degrees."""
    degrees = with_phase(published_calibration("ramp"), math.radians(PUBLISHED_PHASE))
    return float(np.abs(compensated_error(record("ramp"), degrees, "published")).max())
