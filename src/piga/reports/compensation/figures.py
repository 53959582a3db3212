"""Figures of a compensation: force, correction, uncertainty, orders, flags and the error against a reference.

The force, the misfit and the orders of a set of instruments have figures of their own.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from piga.calibration.orders import ORDERS, order_grid, order_spectrum, segment_slices
from piga.compensation import FLAGS, Compensated, CompensatedSet
from piga.records.calibration import Residuals
from piga.records.run import Run
from piga.reports.compensation.outline import (
    CORRECTION,
    FORCE,
    RAW,
    CompensationOutline,
    SetOutline,
    outline_of,
)
from piga.reports.render.envelope import POINTS, envelope_rows, leading_part
from piga.reports.render.figure import XYZ, Axis, Figure, Panel, Role, Series
from piga.units import G0, MICRO_G

Array = NDArray[np.float64]

ERROR_POINTS = 1500
WINDOW = 16
"""Turns of the output that a spectrum looks at together."""


def error_figures(
    record: Run, result: Compensated, scale_factor: float, noise: tuple[float, float] = (0.0, 0.0)
) -> tuple[Figure, ...]:
    """Error figures of a record whose reference holds ``a_x`` too: in time, and in revolution order.

    Parameters
    ----------
    record, result:
        The record and its compensation.
    scale_factor:
        K [(rad/s)/(m/s^2)] that turns the output rate into the indicated force.
    noise:
        White noise of the angle [rad, rms] and angle random walk [rad/sqrt(s)], as the calibration found them.
    """
    errors = compensation_errors(record, result, scale_factor)
    return error_figure(errors), error_spectrum_figure(leading_part(errors), scale_factor, noise)


def compensation_errors(record: Run, result: Compensated, scale_factor: float) -> Residuals:
    """Error of the velocity as an angle [rad], indicated (``before``) and compensated (``after``)."""
    h = np.diff(record.t)
    h[record.begins[1:]] = 0.0
    force = 0.5 * h * (record.f[1:, 0] + record.f[:-1, 0])
    rate = record.kind == "rate"
    turn = (
        0.5 * h * (record.output[1:] + record.output[:-1])
        if rate
        else np.where(h > 0.0, np.diff(record.output), 0.0)
    )
    if record.base_rate is not None:
        turn = turn + 0.5 * h * (record.base_rate[1:, 0] + record.base_rate[:-1, 0])
    psi = np.concatenate(([0.0], np.cumsum(turn))) if rate else record.output
    errors = turn / scale_factor - force, result.dv[1:] - force
    before, after = (np.concatenate(([0.0], np.cumsum(scale_factor * error))) for error in errors)
    rows, nothing = np.arange(1, record.size + 1), np.zeros(record.size)
    return Residuals(rows, record.t, psi, nothing, before, after, nothing, record.segment_index)


def in_windows(residuals: Residuals) -> Residuals:
    """The residuals with every segment cut into windows of ``WINDOW`` turns: where the force changes, so does the drift.

    A spectrum of revolution orders takes out one drift per segment; over a moving record that is not enough.
    """
    psi = residuals.psi
    change = np.diff(residuals.segment, prepend=-1) != 0
    starts = psi[change][np.cumsum(change) - 1]
    window = np.floor((psi - starts) / (2.0 * np.pi * WINDOW))
    segment = np.cumsum(change | (np.diff(window, prepend=0.0) != 0.0))
    return replace(residuals, segment=segment.astype(np.int32))


def error_figure(errors: Residuals) -> Figure:
    """Error of the velocity against time before and after."""
    time = Axis("time since the first row", "s")
    rows = {name: envelope_rows(getattr(errors, name), ERROR_POINTS) for name in ("before", "after")}
    t = errors.t - errors.t[0]
    velocity = Panel(
        time,
        Axis("velocity error as output angle", "mrad"),
        (
            Series(t[rows["before"]], 1e3 * errors.before[rows["before"]], "as indicated", role="before"),
            Series(t[rows["after"]], 1e3 * errors.after[rows["after"]], "compensated", role="after"),
        ),
    )
    return Figure(
        "compensation-error",
        "Error before and after compensation.",
        (velocity,),
        "The running error of the velocity against the reference, in units of the output angle: the cross-coupling "
        "ripples once a revolution and drifts; what is left after compensation is the noise of the output.",
    )


def error_spectrum_figure(errors: Residuals, scale_factor: float, noise: tuple[float, float]) -> Figure:
    """Amplitude of the error in revolution order; a line at an order is a missed term."""
    spectrum = order_spectrum(in_windows(errors), scale_factor, noise)
    curves = [
        Series(spectrum.order, spectrum.before / MICRO_G, "as indicated", role="before"),
        Series(spectrum.order, spectrum.after / MICRO_G, "compensated", role="after"),
    ]
    if any(noise):
        curves.append(
            Series(spectrum.order, spectrum.noise / MICRO_G, "noise alone", role="muted", dashed=True)
        )
    amplitude = Axis("amplitude of the error of a_x", "µg", log=True)
    return Figure(
        "compensation-spectrum",
        "Error in revolution order.",
        (Panel(Axis("revolution order", "1"), amplitude, tuple(curves)),),
        "Lines at whole orders are errors that turn with the output: the cross-coupling at order 1, its pulling and "
        "the servo at order 2. After a good compensation no order stands out of the noise.",
    )


TIME = Axis("time since the first row", "s")
_FLAG_ROLES: dict[str, Role] = {"no_increment": "muted", "near_critical": "model", "age": "reference"}


def force_figure(outline: CompensationOutline) -> Figure:
    """Indicated and compensated specific force, their difference, and the uncertainty, against time."""
    force = (_curve(outline, "indicated", G0, "before"), _curve(outline, "ax", G0, "after", "compensated"))
    panels = [
        Panel(TIME, Axis("specific force a_x", "g"), force),
        Panel(
            TIME,
            Axis("correction of a_x", "µg"),
            (_curve(outline, "correction", MICRO_G, "data", "indicated less compensated"),),
        ),
    ]
    if outline.counts["u_ax"]:
        highest = float(np.nanmax(outline.outline.rows["u_ax"])) / MICRO_G
        axis = Axis("uncertainty u(a_x)", "µg", limits=(0.0, 1.15 * highest or 1.0))
        panels.append(
            Panel(TIME, axis, (_curve(outline, "u_ax", MICRO_G, "model", "standard uncertainty per row"),))
        )
    note = f"Outlines of at most {POINTS} points; lowest and highest values are kept."
    return Figure(
        "compensation-force",
        "Specific force along the input axis.",
        tuple(panels),
        "Indicated: output rate over the calibrated scale factor, the base rate added where it is recorded. "
        "The correction is the cross-coupling and the error terms of the calibration; both curves carry the same "
        "noise, so it does not.",
        height=2.3,
        notes=() if outline.size <= POINTS else (note,),
    )


def result_figure(result: Compensated) -> Figure:
    """Force, correction and uncertainty; without its record the compensated force alone."""
    if result.made_from is None:
        return plain_force_figure(result)
    run, calibration = result.made_from
    outline = outline_of(run.kind, calibration)
    outline.record(run, result)
    return force_figure(outline)


def plain_force_figure(result: Compensated) -> Figure:
    """Compensated force and its uncertainty, without the record that they come from."""
    t = result.t - result.t[0]
    panels = [
        Panel(TIME, Axis("specific force a_x", "g"), (Series(t, result.ax / G0, "compensated", role="after"),))
    ]
    if result.u_ax.size:
        u = Series(t, result.u_ax / MICRO_G, "standard uncertainty per row", role="model")
        panels.append(Panel(TIME, Axis("uncertainty u(a_x)", "µg"), (u,)))
    return Figure(
        "compensated-force",
        "Specific force along the input axis.",
        tuple(panels),
        "Compensated force, and its standard uncertainty.",
        height=2.3,
    )


def plain_set_figure(result: CompensatedSet) -> Figure:
    """Force of a set in the common frame, and its uncertainty."""
    t = result.t - result.t[0]
    force = tuple(Series(t, result.f[:, i] / G0, f"f{role}", role=role) for i, role in enumerate(XYZ))
    panels = [Panel(TIME, Axis("specific force", "g"), force)]
    if result.u_f.size:
        u = tuple(Series(t, result.u_f[:, i] / MICRO_G, f"u(f{role})", role=role) for i, role in enumerate(XYZ))
        panels.append(Panel(TIME, Axis("standard uncertainty", "µg"), u))
    return Figure(
        "set-force",
        "Specific force in the common frame.",
        tuple(panels),
        "Solved together, row by row.",
        height=2.3,
    )


def correction_spectrum(outline: CompensationOutline) -> tuple[Array, Array]:
    """Revolution orders, and the amplitude of the correction [m/s^2] at each, from the leading rows.

    The correction holds no noise to speak of, so it is demodulated by the output angle as it is: windows of at most
    ``WINDOW`` turns, each less its mean and under a raised cosine, combined as root mean square over time. Windows
    that turn less than half as far as the farthest, or show less than two cycles of an order, are left out.
    Changes of attitude leak as the inverse of the order only. Own derivation.
    """
    leading, order = in_windows(outline.leading()), order_grid()
    power, time = np.zeros(order.size), np.zeros(order.size)
    parts = [part for part in segment_slices(leading.segment) if part.stop - part.start > 8]
    turns = [float(np.ptp(leading.psi[part])) / (2.0 * np.pi) for part in parts]
    for part, some in zip(parts, turns, strict=True):
        shown = order * some >= ORDERS.turns
        if some < 0.499 * max(turns) or not shown.any():
            continue
        amplitude, duration = _demodulated(leading, part, outline.scale_factor, order)
        power[shown] += duration * amplitude[shown] ** 2
        time[shown] += duration
    with np.errstate(invalid="ignore", divide="ignore"):
        return order, np.sqrt(power / time)


def _demodulated(leading: Residuals, part: slice, scale_factor: float, order: Array) -> tuple[Array, float]:
    """Amplitude [m/s^2] at each order of the velocity increments of a window, and the time [s] they last."""
    h, psi = np.diff(leading.t[part]), leading.psi[part]
    psi = 0.5 * (psi[1:] + psi[:-1])
    velocity = np.diff(leading.before[part]) / scale_factor
    weight = np.sin(np.pi * (psi - psi.min()) / np.ptp(psi)) ** 2
    whole = float(weight @ h)
    left, turn = weight * (velocity - h * float(weight @ velocity) / whole), np.exp(-1j * order[0] * psi)
    total, phasor = np.zeros(order.size, dtype=np.complex128), np.ones_like(turn)
    for row in range(order.size):
        phasor *= turn
        total[row] = left @ phasor
    return 2.0 * np.abs(total) / whole, float(leading.t[part.stop - 1] - leading.t[part.start])


def orders_figure(instruments: Iterable[tuple[str, CompensationOutline]]) -> Figure | None:
    """Spectrum of the correction of each instrument in its own revolution order, over at most six decades.

    ``instruments`` have the titles of their panels. None if no output turns far enough.
    """
    axes, panels = (Axis("revolution order", "1"), Axis("amplitude of the correction", "µg", log=True)), []
    for title, outline in instruments:
        order, amplitude = correction_spectrum(outline)
        if (amplitude > 0.0).any():
            shown = np.maximum(amplitude, 1e-6 * float(np.nanmax(amplitude)))
            panels.append(Panel(*axes, (Series(order, shown / MICRO_G, "correction"),), title))
    if not panels:
        return None
    return Figure(
        "compensation-orders",
        "What was taken out, by revolution order.",
        tuple(panels),
        "The cross-coupling turns with the output and stands at order 1, pulling at order 2, harmonics of the "
        "calibration at theirs.",
        height=2.8,
    )


def flag_figure(outline: CompensationOutline | SetOutline) -> Figure | None:
    """Times of every raised flag; None if no flag is raised."""
    series = []
    for name, marks in outline.marks.items():
        if marks.count:
            place = FLAGS[name].bit_length() - 1
            bit = np.full(marks.t.size, float(place))
            rows = "1 row" if marks.count == 1 else f"{marks.count} rows"
            role = _FLAG_ROLES.get(name, "warning")
            series.append(
                Series(marks.t - outline.start, bit, f"{place} {name}: {rows}", mark="points", role=role)
            )
    if not series:
        return None
    axis = Axis("bit position of flag", "1", limits=(-0.5, 8.5))
    return Figure(
        "compensation-flags",
        "Flags against time.",
        (Panel(TIME, axis, tuple(series)),),
        "One mark per flagged row, in long records per bucket of rows that holds one; the counts are of all rows.",
        height=2.8,
    )


def _curve(
    outline: CompensationOutline | SetOutline, name: str, unit: float, role: Role, title: str = ""
) -> Series:
    t, y = outline.curve(name)
    rows = envelope_rows(np.nan_to_num(y) if np.isnan(y).all() else y)
    return Series(t[rows], y[rows] / unit, title or name, role=role)


def set_force_figure(outline: SetOutline) -> Figure:
    """Indicated and compensated components, and their difference."""
    panels = [
        Panel(
            TIME,
            Axis(f"specific force f_{axis}", "g"),
            (
                _curve(outline, raw, G0, "before", "as indicated"),
                _curve(outline, force, G0, "after", "compensated"),
            ),
        )
        for axis, raw, force in zip(XYZ, RAW, FORCE, strict=True)
    ]
    lines = tuple(
        _curve(outline, name, MICRO_G, axis, axis) for axis, name in zip(XYZ, CORRECTION, strict=True)
    )
    panels.append(Panel(TIME, Axis("correction", "µg"), lines))
    return Figure(
        "set-force",
        "Specific force in the common frame.",
        tuple(panels),
        "As indicated: output rates over the calibrated scale factors, taken as force along the input axes (least squares "
        "for more than three). The correction, indicated less compensated, is the cross-coupling and the error terms of all "
        "instruments.",
        height=2.1,
        notes=() if outline.size <= POINTS else (f"Outlines of at most {POINTS} points; extremes are kept.",),
    )


def misfit_figure(outline: SetOutline, names: tuple[str, ...]) -> Figure:
    """Residual of a redundant set, and how far each instrument is from the force that fits all."""
    panels = [
        Panel(
            TIME,
            Axis("residual of the set", "µg"),
            (_curve(outline, "residual", MICRO_G, "data", "residual: root of the summed squares"),),
        )
    ]
    panels += [
        Panel(TIME, Axis(f"misfit of {name}", "µg"), (_curve(outline, misfit, MICRO_G, "model", "misfit"),))
        for name, misfit in zip(names, outline.misfits, strict=True)
        if outline.counts[misfit]
    ]
    return Figure(
        "set-misfit",
        "What the instruments say against each other.",
        tuple(panels),
        "Indication of an instrument less the force that fits all, along its effective input axis. Noise is good; a line, "
        "a step or a drift in one of them points at its calibration, its mounting, its phase or a fault.",
        height=1.7,
    )
