"""Figures of a compensation: error against a reference before and after, in time and in revolution order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from piga.compensation import Compensated
from piga.records.calibration import Residuals
from piga.records.run import Run
from piga.records.spool import spans
from piga.reports.render.decimate import envelope_rows
from piga.reports.render.figure import Axis, Figure, Panel, Series
from piga.reports.render.long_record import leading_part
from piga.reports.render.orders import order_spectrum
from piga.units import G0

Array = NDArray[np.float64]

MICRO_G = 1e-6 * G0
POINTS = 1500
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
    return (
        error_figure(errors),
        error_spectrum_figure({"a_x": leading_part(errors)}, scale_factor, noise),
    )


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
    return error_record(
        record.t, psi, turn / scale_factor - force, result.dv[1:] - force, scale_factor, record.segment
    )


def error_record(
    t: Array,
    psi: Array,
    before: Array,
    after: Array,
    scale_factor: float,
    segment: NDArray[np.int32] | None = None,
) -> Residuals:
    """Errors of velocity increments [m/s] (n - 1,) as running angles [rad] at the times ``t`` (n,) [s].

    ``psi`` (n,) [rad] is the output angle of the instrument whose revolutions are looked for.
    """
    running = [np.concatenate(([0.0], np.cumsum(scale_factor * error))) for error in (before, after)]
    index = np.zeros(t.size, np.int32) if segment is None else segment
    nothing = np.zeros(t.size)
    return Residuals(np.arange(1, t.size + 1), t, psi, nothing, running[0], running[1], nothing, index)


def in_windows(residuals: Residuals) -> Residuals:
    """The same with every segment cut into windows of ``WINDOW`` turns: where the force changes, so does the drift.

    A spectrum of revolution orders takes out one drift per segment; over a moving record that is not enough.
    """
    segment = np.empty(residuals.psi.size, dtype=np.int32)
    index_before, window_before, start, count = -1, 0.0, 0.0, 0
    for part in spans(segment.size):
        index, psi = residuals.segment[part], residuals.psi[part]
        change = np.diff(index, prepend=index_before) != 0
        starts = np.concatenate(([start], psi[change]))
        window = np.floor((psi - starts[np.cumsum(change)]) / (2.0 * np.pi * WINDOW))
        segment[part] = count + np.cumsum(change | (np.diff(window, prepend=window_before) != 0.0))
        index_before, window_before = int(index[-1]), float(window[-1])
        start, count = float(starts[-1]), int(segment[part][-1])
    return replace(residuals, segment=segment)


def error_figure(errors: Residuals) -> Figure:
    """Error of the velocity against time before and after."""
    time = Axis("time since the first row", "s")
    rows = {name: envelope_rows(getattr(errors, name), POINTS) for name in ("before", "after")}
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


def error_spectrum_figure(
    errors: dict[str, Residuals], scale_factor: float, noise: tuple[float, float] = (0.0, 0.0)
) -> Figure:
    """Amplitude of the error in revolution order, one panel per component; a line at an order is a missed term."""
    panels = []
    for name, residuals in errors.items():
        found = order_spectrum(in_windows(residuals), scale_factor, noise=noise)
        curves: tuple[Series, ...] = (
            Series(found.order, found.before / MICRO_G, "as indicated", role="before"),
            Series(found.order, found.after / MICRO_G, "compensated", role="after"),
        )
        if any(noise):
            expected = Series(found.order, found.noise / MICRO_G, "noise alone", role="muted", dashed=True)
            curves = (*curves, expected)
        amplitude = Axis(f"amplitude of the error of {name}", "µg", log=True)
        panels.append(Panel(Axis("revolution order", "1"), amplitude, curves))
    return Figure(
        "compensation-spectrum",
        "Error in revolution order.",
        tuple(panels),
        "Lines at whole orders are errors that turn with the output: the cross-coupling at order 1, its pulling and "
        "the servo at order 2. After a good compensation no order stands out of the noise.",
    )
