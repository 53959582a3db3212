"""Recursive calibration, and compensation with its result [Wei2024]."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from piga.instrument import propagate
from piga.records import Calibration
from piga.reports.render.figure import Figure, Plot, Role
from piga.studies.case import (
    INSTRUMENT,
    RAMP_TOP,
    RATIO,
    Chapter,
    ForceHistory,
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

Array = NDArray[np.float64]

PUBLISHED_TAN_BETA, PUBLISHED_PHASE = 4.848e-3, 0.802
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
        ("tan_beta", 1e3, "tan(beta) [1e-3]", INSTRUMENT.tan_beta, PUBLISHED_TAN_BETA),
        ("phi", 1.0, "phi [rad]", INSTRUMENT.alpha0, PUBLISHED_PHASE),
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
    published, own = published_calibration("ramp"), own_calibration("ramp")
    before, model = raw_error(log), model_residual(log, published)
    formula = compensated_error(log, with_phase(published, PUBLISHED_PHASE), "published")
    exact = compensated_error(log, own, "exact")
    largest = [float(np.abs(error).max()) for error in (before, model, formula, exact)]
    values = {
        "before": largest[0],
        "model-limit": largest[1],
        "model": largest[1],
        "formula": largest[2],
        "exact": largest[3],
    }
    return chapter_of("compensation", values, (_compensation_figure(before, model, formula, exact),))


def with_phase(calibration: Calibration, phi: float) -> Calibration:
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


def phase_walk() -> tuple[Array, Array, Array]:
    """Time [s], phase of the published model minus the true phase [rad] on the ramp, and K V r^2/2 [rad]."""
    log = record("ramp")
    alpha = propagate(INSTRUMENT, log.t, log.f, between="linear")
    predicted = model_phase(log)
    constant, lead = closed_form_phase()
    return log.t, predicted + constant - lead - alpha, 0.5 * RATIO**2 * predicted


def misread_phase_error() -> float:
    """Largest remaining error [g] if the printed 0.802 is taken as degrees."""
    degrees = with_phase(published_calibration("ramp"), math.radians(PUBLISHED_PHASE))
    return float(np.abs(compensated_error(record("ramp"), degrees, "published")).max())
