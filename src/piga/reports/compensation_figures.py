"""Figures of a compensated record of any length: force, correction, uncertainty, orders and flags."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from piga.compensation import FLAGS
from piga.reports.compensation_outline import CompensationOutline
from piga.reports.decimate import envelope_rows
from piga.reports.figure import Axis, Figure, Panel, Role, Series
from piga.reports.orders import OrderSpectrum, order_spectrum
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
            Axis("indicated less compensated", "µg"),
            (_curve(found, "correction", MICRO_G, "data", "correction"),),
        ),
    ]
    if found.counts["u_ax"]:
        highest = float(np.nanmax(found.outline.rows["u_ax"])) / MICRO_G
        axis = Axis("standard uncertainty u(a_x)", "µg", limits=(0.0, 1.15 * highest or 1.0))
        panels.append(Panel(TIME, axis, (_curve(found, "u_ax", MICRO_G, "model", "u(a_x) per row"),)))
    bucket = found.outline.bucket
    shown = "Every row is in it." if bucket == 1 else f"Lowest and highest of every {bucket} rows are in it."
    return Figure(
        "compensation-force",
        "Specific force along the input axis.",
        tuple(panels),
        "Indicated: output rate over the calibrated scale factor, the base rate added where it is recorded. "
        "The correction is the cross-coupling and the error terms of the calibration; both curves carry the same "
        "noise, so it does not.",
        height=2.3,
        notes=(shown,),
    )


def correction_spectrum(found: CompensationOutline) -> OrderSpectrum:
    """Amplitude of the correction by revolution order, from the leading rows."""
    return order_spectrum(found.leading(), found.scale_factor)


def correction_figure(spectrum: OrderSpectrum) -> Figure:
    """The spectrum of the correction."""
    shown = np.maximum(spectrum.before, 1e-6 * float(np.nanmax(spectrum.before)))
    series = Series(spectrum.order, shown / MICRO_G, "correction")
    axis = Axis("amplitude of the correction", "µg", log=True)
    return Figure(
        "compensation-orders",
        "What was taken out, by revolution order.",
        (Panel(Axis("revolution order", "1"), axis, (series,)),),
        "The cross-coupling turns with the output and stands at order 1, pulling at order 2, harmonics of the "
        "calibration at theirs. A line at another order is a correction that this record did not need.",
        height=2.8,
    )


def flag_figure(found: CompensationOutline) -> Figure | None:
    """Where every raised flag stands; None when no flag is raised."""
    series = []
    for name, marks in found.marks.items():
        if marks.count:
            bit = np.full(marks.t.size, np.log2(FLAGS[name]))
            rows = "1 row" if marks.count == 1 else f"{marks.count} rows"
            role = _FLAG_ROLES.get(name, "warning")
            series.append(Series(marks.t - found.start, bit, f"{name}: {rows}", mark="points", role=role))
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
