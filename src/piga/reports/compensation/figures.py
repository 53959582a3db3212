"""Figures of a compensated record of any length: force, correction, uncertainty, orders and flags."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from piga.compensation import FLAGS
from piga.records.calibration import Residuals
from piga.records.spool import BLOCK, trim
from piga.reports.compensation.errors import in_windows
from piga.reports.compensation.outline import CompensationOutline
from piga.reports.compensation.set_outline import SetOutline
from piga.reports.render.decimate import POINTS, envelope_rows
from piga.reports.render.figure import Axis, Figure, Panel, Role, Series
from piga.reports.render.orders import TURNS_NEEDED, order_grid, segment_slices
from piga.units import G0

Array = NDArray[np.float64]

MICRO_G = 1e-6 * G0
TIME = Axis("time since the first row", "s")
_FLAG_ROLES: dict[str, Role] = {"no_increment": "muted", "near_critical": "model", "age": "reference"}


def force_figure(found: CompensationOutline) -> Figure:
    """Indicated and compensated specific force, their difference, and the uncertainty, against time."""
    force = (_curve(found, "indicated", G0, "before"), _curve(found, "ax", G0, "after", "compensated"))
    panels = [
        Panel(TIME, Axis("specific force a_x", "g"), force),
        Panel(
            TIME,
            Axis("correction of a_x", "µg"),
            (_curve(found, "correction", MICRO_G, "data", "indicated less compensated"),),
        ),
    ]
    if found.counts["u_ax"]:
        highest = float(np.nanmax(found.outline.rows["u_ax"])) / MICRO_G
        axis = Axis("uncertainty u(a_x)", "µg", limits=(0.0, 1.15 * highest or 1.0))
        panels.append(
            Panel(TIME, axis, (_curve(found, "u_ax", MICRO_G, "model", "standard uncertainty per row"),))
        )
    shown = (
        ""
        if found.size <= POINTS
        else f"Outlines of at most {POINTS} points; lowest and highest values are kept."
    )
    return Figure(
        "compensation-force",
        "Specific force along the input axis.",
        tuple(panels),
        "Indicated: output rate over the calibrated scale factor, the base rate added where it is recorded. "
        "The correction is the cross-coupling and the error terms of the calibration; both curves carry the same "
        "noise, so it does not.",
        height=2.3,
        notes=(shown,) if shown else (),
    )


def correction_spectrum(found: CompensationOutline) -> tuple[Array, Array]:
    """Revolution orders, and the amplitude of the correction [m/s^2] at each, from the leading rows.

    The correction holds no noise to speak of, so it is demodulated by the output angle as it is: windows of at most
    ``WINDOW`` turns, each less its mean and under a raised cosine, combined as root mean square over time. Windows
    that turn less than half as far as the farthest, or show less than two cycles of an order, are left out.
    Changes of attitude leak as the inverse of the order only. Own derivation.
    """
    leading, order = in_windows(found.leading()), order_grid()
    power, time = np.zeros(order.size), np.zeros(order.size)
    parts = [part for part in segment_slices(leading.segment) if part.stop - part.start > 8]
    turns = [float(np.ptp(leading.psi[part])) / (2.0 * np.pi) for part in parts]
    for part, some in zip(parts, turns, strict=True):
        shown = order * some >= TURNS_NEEDED
        if some < 0.499 * max(turns) or not shown.any():
            continue
        amplitude, duration = _demodulated(leading, part, found.scale_factor, order)
        power[shown] += duration * amplitude[shown] ** 2
        time[shown] += duration
    with np.errstate(invalid="ignore", divide="ignore"):
        return order, np.sqrt(power / time)


def _demodulated(leading: Residuals, part: slice, scale_factor: float, order: Array) -> tuple[Array, float]:
    """Amplitude [m/s^2] at each order of the velocity increments of a window, and the time [s] they last."""
    ends = [(psi.min(), psi.max()) for _, psi, _ in _increments(leading, part, scale_factor)]
    low, high = min(low for low, _ in ends), max(high for _, high in ends)

    def weighted() -> Iterator[tuple[Array, Array, Array, Array]]:
        for h, psi, velocity in _increments(leading, part, scale_factor):
            yield h, psi, velocity, np.sin(np.pi * (psi - low) / (high - low)) ** 2

    sums = np.sum([(weight @ h, weight @ velocity) for h, _, velocity, weight in weighted()], axis=0)
    whole, mean = float(sums[0]), sums[1] / sums[0]
    total = np.zeros(order.size, dtype=np.complex128)
    for h, psi, velocity, weight in weighted():
        left, turn = weight * (velocity - h * mean), np.exp(-1j * order[0] * psi)
        phasor = np.ones_like(turn)
        for row in range(order.size):
            phasor *= turn
            total[row] += left @ phasor
    return 2.0 * np.abs(total) / whole, float(leading.t[part.stop - 1] - leading.t[part.start])


def _increments(leading: Residuals, part: slice, scale_factor: float) -> Iterator[tuple[Array, Array, Array]]:
    """Intervals [s], middle angles [rad] and velocity increments [m/s] of a window, some rows at a time."""
    for start in range(part.start, part.stop - 1, BLOCK):
        rows = slice(start, min(start + BLOCK, part.stop - 1) + 1)
        psi = leading.psi[rows]
        trim()
        yield (
            np.diff(leading.t[rows]),
            0.5 * (psi[1:] + psi[:-1]),
            np.diff(leading.before[rows]) / scale_factor,
        )


def correction_figure(order: Array, amplitude: Array) -> Figure:
    """The spectrum of the correction of one instrument."""
    return orders_figure((order_panel(order, amplitude),))


def order_panel(order: Array, amplitude: Array, title: str = "") -> Panel:
    """The spectrum of one correction, over at most six decades."""
    shown = np.maximum(amplitude, 1e-6 * float(np.nanmax(amplitude)))
    axis = Axis("amplitude of the correction", "µg", log=True)
    return Panel(Axis("revolution order", "1"), axis, (Series(order, shown / MICRO_G, "correction"),), title)


def orders_figure(panels: tuple[Panel, ...]) -> Figure:
    """Spectra of corrections."""
    return Figure(
        "compensation-orders",
        "What was taken out, by revolution order.",
        panels,
        "The cross-coupling turns with the output and stands at order 1, pulling at order 2, harmonics of the "
        "calibration at theirs.",
        height=2.8,
    )


def flag_figure(found: CompensationOutline | SetOutline) -> Figure | None:
    """Where every raised flag stands; None when no flag is raised."""
    series = []
    for name, marks in found.marks.items():
        if marks.count:
            place = FLAGS[name].bit_length() - 1
            bit = np.full(marks.t.size, float(place))
            rows = "1 row" if marks.count == 1 else f"{marks.count} rows"
            role = _FLAG_ROLES.get(name, "warning")
            series.append(
                Series(marks.t - found.start, bit, f"{place} {name}: {rows}", mark="points", role=role)
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


def _curve(found: CompensationOutline, name: str, unit: float, role: Role, title: str = "") -> Series:
    y = found.outline.rows[name]
    rows = envelope_rows(y)
    return Series(found.outline.rows["t"][rows] - found.start, y[rows] / unit, title or name, role=role)
