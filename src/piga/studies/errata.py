"""Errors in the publications, shown by numbers computed here."""

from __future__ import annotations

import math

import numpy as np

from piga.instrument import closed_form, published_closed_form
from piga.reports.render.figure import Figure, Plot
from piga.studies.case import (
    INSTRUMENT,
    RAMP_TOP,
    TRANSVERSE,
    Chapter,
    Value,
    chapter_of,
    closed_form_phase,
    example_force,
    model_residual,
    published_calibration,
    raw_state,
    record,
)
from piga.studies.constant import EXAMPLES
from piga.studies.platform import CASE_RATE, CHANNELS, GRAVITY_OF_TABLE, compared, formula, last_lines
from piga.studies.recursion import misread_phase_error, phase_walk
from piga.units import ARCMIN

_T = np.linspace(0.0, 60.0, 1201)


def chapter() -> Chapter:
    """All errata with their numbers."""
    values = {**_forms(), **_phase(), **_platform()}
    computed = {key: value.computed if isinstance(value, Value) else value for key, value in values.items()}
    signs = [computed[f"sign-{number}"] for number in (2, 3, 4)]
    return chapter_of(
        "errata",
        values,
        (_sign_figure(), _square_figure(), _phase_figure()),
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
    _, walk, predicted = phase_walk()
    calibration, (constant, lead) = published_calibration("ramp"), closed_form_phase()
    bound = TRANSVERSE * RAMP_TOP * INSTRUMENT.tan_beta * float(np.abs(model_phase_error()).max())
    left = float(np.abs(model_residual(record("ramp"), calibration)).max())
    return {
        "phase-walk": float(np.polyfit(predicted, walk, 1)[0]),
        "phase-shift": raw_state(calibration)[1] - (constant - lead),
        "phase-residual": Value(left, words={"bound": bound}),
        "degrees": math.degrees(constant - lead),
        "degrees-effect": misread_phase_error(),
    }


def model_phase_error() -> np.ndarray:
    """Phase of the published model, with its estimated phi, minus the true angle [rad]."""
    _, walk, _ = phase_walk()
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


def _square_figure() -> Figure:
    with_square, without, exact = _critical_rates()
    plot = Plot("errata-square", "The lost square in form 2", "time [s]", "output rate [deg/s]", height=2.6)
    plot.line(_T, np.degrees(exact), "exact motion", "after")
    plot.points(_T[::30], np.degrees(with_square[::30]), "form 2 with the square", "model")
    plot.dashed(_T, np.degrees(without), "form 2 without the square", "before")
    return plot.caption(
        "Critical input. Without the square the rate starts at twice its value and falls too slowly."
    )


def _phase_figure() -> Figure:
    residual = model_residual(record("ramp"), published_calibration("ramp"))[::20]
    t, walk, predicted = (values[::20] for values in phase_walk())
    envelope = 1e3 * TRANSVERSE * INSTRUMENT.tan_beta * RAMP_TOP * t / t[-1] * np.abs(model_phase_error()[::20])
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
