"""Figures of a compensation: force, correction, uncertainty, misfits, orders, flags and the error against a reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from piga.calibration.orders import TURNS, order_grid, order_spectrum, segment_slices
from piga.compensation import FLAGS, Compensated, CompensatedSet
from piga.records.calibration import Residuals
from piga.records.run import Run
from piga.reports.compensation.outline import CompensationOutline, Indication, of_record
from piga.reports.render.envelope import POINTS, leading_part
from piga.reports.render.figure import XYZ, Axis, Figure, Plot, Role
from piga.units import G0, MICRO_G

Array = NDArray[np.float64]

_WINDOW = 16
"""Turns of the output that a spectrum looks at together."""
TIME = "time since the first row [s]"
_FLAG_ROLES: dict[str, Role] = {"no_increment": "muted", "near_critical": "model", "age": "reference"}


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
    if record.direct:
        return (error_figure(errors),)
    return error_figure(errors), _error_spectrum_figure(leading_part(errors), scale_factor, noise)


def compensation_errors(record: Run, result: Compensated, scale_factor: float) -> Residuals:
    """Error of the velocity as an angle [rad; a direct instrument: m/s], indicated (``before``) and compensated (``after``)."""
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
    before, after = (
        np.concatenate(([0.0], np.cumsum((1.0 if record.direct else scale_factor) * error))) for error in errors
    )
    rows, nothing = np.arange(1, record.size + 1), np.zeros(record.size)
    unit = "m/s" if record.direct else "rad"
    return Residuals(rows, record.t, psi, nothing, before, after, nothing, record.segment_index, unit=unit)


def in_windows(residuals: Residuals) -> Residuals:
    """The residuals with every segment cut into windows of ``_WINDOW`` turns: where the force changes, so does the drift.

    A spectrum of revolution orders takes out one drift per segment; over a moving record that is not enough.
    """
    psi = residuals.psi
    change = np.diff(residuals.segment, prepend=-1) != 0
    starts = psi[change][np.cumsum(change) - 1]
    window = np.floor((psi - starts) / (2.0 * np.pi * _WINDOW))
    segment = np.cumsum(change | (np.diff(window, prepend=0.0) != 0.0))
    return replace(residuals, segment=segment.astype(np.int32))


def error_figure(errors: Residuals) -> Figure:
    """Error of the velocity against time before and after."""
    plot = Plot(
        "compensation-error",
        "Error before and after compensation.",
        TIME,
        "velocity error as output angle [mrad]" if errors.unit == "rad" else "velocity error [mm/s]",
    )
    roles: tuple[tuple[Role, str], ...] = (("before", "as indicated"), ("after", "compensated"))
    for role, name in roles:
        plot.line(errors.t - errors.t[0], 1e3 * getattr(errors, role), name, role)
    if errors.unit != "rad":
        return plot.caption("The running error of the velocity against the reference.")
    return plot.caption(
        "The running error of the velocity against the reference, in units of the output angle: the cross-coupling "
        "ripples once a revolution and drifts; what is left after compensation is the noise of the output."
    )


def _error_spectrum_figure(errors: Residuals, scale_factor: float, noise: tuple[float, float]) -> Figure:
    """Amplitude of the error in revolution order; a line at an order is a missed term."""
    spectrum = order_spectrum(in_windows(errors), scale_factor, noise)
    plot = Plot(
        "compensation-spectrum",
        "Error in revolution order.",
        "revolution order",
        "log amplitude of the error of a_x [µg]",
    )
    plot.line(spectrum.order, spectrum.before / MICRO_G, "as indicated", "before")
    plot.line(spectrum.order, spectrum.after / MICRO_G, "compensated", "after")
    if any(noise):
        plot.dashed(spectrum.order, spectrum.noise / MICRO_G, "noise alone", "muted")
    return plot.caption(
        "Lines at whole orders are errors that turn with the output: the cross-coupling at order 1, its pulling and "
        "the servo at order 2. After a good compensation no order stands out of the noise."
    )


def force_figure(outline: CompensationOutline) -> Figure:
    """Indicated and compensated specific force, their difference, and the uncertainty, against time."""
    components = outline.components
    roles: tuple[Role, ...] = ("data",) if len(components) == 1 else XYZ
    where = "along the input axis" if len(components) == 1 else "in the common frame"
    plot = Plot("compensation-force", f"Specific force {where}.", height=2.3)
    for name in components:
        plot.panel(TIME, f"specific force {name} [g]")
        plot.line(*_curve(outline, f"indicated {name}", G0), "indicated", "before")
        plot.line(*_curve(outline, name, G0), "compensated", "after")
    plot.panel(TIME, "correction [µg]")
    for name, role in zip(components, roles, strict=True):
        plot.line(*_curve(outline, f"correction {name}", MICRO_G), f"correction of {name}", role)
    if outline.has(f"u {components[0]}"):
        curves = [_curve(outline, f"u {name}", MICRO_G) for name in components]
        highest = max(float(np.nanmax(u)) for _, u in curves)
        plot.panel(TIME, Axis("standard uncertainty", "µg", limits=(0.0, 1.15 * highest or 1.0)))
        for (t, u), name, role in zip(curves, components, roles, strict=True):
            plot.line(t, u, f"u({name}) of a row", "model" if role == "data" else role)
    along = (
        ""
        if len(components) == 1
        else " Several instruments: taken as force along the input axes, by least squares."
    )
    note = f"Outlines of at most {POINTS} points; lowest and highest values are kept."
    return plot.caption(
        f"Indicated: output rate over the calibrated scale factor, the base rate added where it is recorded.{along} "
        "The correction, indicated less compensated, is the cross-coupling and the error terms of the calibration; both "
        "curves carry the same noise, so it does not.",
        *([] if outline.size <= POINTS else [note]),
    )


def _curve(outline: CompensationOutline, name: str, unit: float) -> tuple[Array, Array]:
    t, y = outline.curve(name)
    return t, y / unit


def misfit_figure(outline: CompensationOutline, names: Sequence[str]) -> Figure:
    """Residual of a redundant set, and how far each instrument is from the force that fits all."""
    plot = Plot("compensation-misfit", "What the instruments say against each other.", height=1.7)
    plot.panel(TIME, "residual of the set [µg]")
    plot.line(*_curve(outline, "residual", MICRO_G), "residual: root of the summed squares")
    for i, name in enumerate(names):
        plot.panel(TIME, f"misfit of {name} [µg]")
        plot.line(*_curve(outline, f"misfit {i}", MICRO_G), "misfit", "model")
    return plot.caption(
        "Indication of an instrument less the force that fits all, along its effective input axis. Noise is good; a line, "
        "a step or a drift in one of them points at its calibration, its mounting, its phase or a fault."
    )


def result_figure(result: Compensated | CompensatedSet) -> Figure:
    """Force, correction and uncertainty; without its record the compensated force alone."""
    if isinstance(result, Compensated) and result.made_from is not None:
        run, calibration = result.made_from
        return force_figure(of_record(run, calibration, result))
    single = isinstance(result, Compensated)
    force, u = (
        (result.ax[:, None], result.u_ax[:, None])
        if isinstance(result, Compensated)
        else (result.f, result.u_f)
    )
    names: tuple[tuple[str, Role], ...] = (("a_x", "after"),) if single else tuple((f"f{k}", k) for k in XYZ)
    t = result.t - result.t[0]
    where = "along the input axis" if single else "in the common frame"
    plot = Plot("compensation-force", f"Specific force {where}.", TIME, "specific force [g]", height=2.3)
    for k, (name, role) in enumerate(names):
        plot.line(t, force[:, k] / G0, name, role)
    if u.size:
        plot.panel(TIME, "standard uncertainty [µg]")
        for k, (name, role) in enumerate(names):
            plot.line(t, u[:, k] / MICRO_G, f"u({name}) of a row", role)
    return plot.caption("Compensated specific force, and its standard uncertainty.")


def correction_spectrum(instrument: Indication) -> tuple[Array, Array]:
    """Revolution orders, and the amplitude of the correction [m/s^2] at each, from the leading rows.

    The correction holds no noise to speak of, so it is demodulated by the output angle as it is: windows of at most
    ``_WINDOW`` turns, each less its mean and under a raised cosine, combined as root mean square over time. Windows
    that turn less than half as far as the farthest, or show less than two cycles of an order, are left out.
    Changes of attitude leak as the inverse of the order only. Own derivation.
    """
    leading, order = in_windows(instrument.leading), order_grid()
    power, time = np.zeros(order.size), np.zeros(order.size)
    parts = [part for part in segment_slices(leading.segment) if part.stop - part.start > 8]
    turns = [float(np.ptp(leading.psi[part])) / (2.0 * np.pi) for part in parts]
    for part, some in zip(parts, turns, strict=True):
        shown = order * some >= TURNS
        if some < 0.499 * max(turns) or not shown.any():
            continue
        amplitude, duration = _demodulated(leading, part, instrument.scale_factor, order)
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


def orders_figure(outline: CompensationOutline, names: Sequence[str]) -> Figure | None:
    """Spectrum of the correction of each instrument in its own revolution order, over at most six decades.

    None if no output turns far enough.
    """
    plot = Plot("compensation-orders", "What was taken out, by revolution order.", height=2.8)
    drawn = False
    for name, instrument in zip(names, outline.instruments, strict=True):
        order, amplitude = correction_spectrum(instrument)
        if (amplitude > 0.0).any():
            shown = np.maximum(amplitude, 1e-6 * float(np.nanmax(amplitude)))
            title = name if len(names) > 1 else ""
            plot.panel("revolution order", "log amplitude of the correction [µg]", title)
            plot.line(order, shown / MICRO_G, "correction")
            drawn = True
    if not drawn:
        return None
    return plot.caption(
        "The cross-coupling turns with the output and stands at order 1, pulling at order 2, harmonics of the "
        "calibration at theirs."
    )


def flag_figure(outline: CompensationOutline) -> Figure | None:
    """Times of every raised flag; None if no flag is raised."""
    raised = {name: marks for name, marks in outline.marks.items() if marks.count}
    if not raised:
        return None
    axis = Axis("bit position of flag", "1", limits=(-0.5, 9.5))
    plot = Plot("compensation-flags", "Flags against time.", TIME, axis, height=2.8)
    for name, marks in raised.items():
        bit = FLAGS[name].bit_length() - 1
        rows = "1 row" if marks.count == 1 else f"{marks.count} rows"
        role = _FLAG_ROLES.get(name, "warning")
        plot.points(marks.t - outline.start, np.full(marks.t.size, float(bit)), f"{bit} {name}: {rows}", role)
    return plot.caption("One mark per flagged row, or fewer in long records; the counts are of all rows.")
