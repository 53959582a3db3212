"""Figures of a compensated set: force, corrections, misfit of the instruments, and what was taken out of each."""

from __future__ import annotations

import numpy as np

from piga.reports.compensation.figures import MICRO_G, TIME, correction_spectrum, order_panel, orders_figure
from piga.reports.compensation.set_outline import AXES, CORRECTION, FORCE, RAW, SetOutline
from piga.reports.render.decimate import POINTS, envelope_rows
from piga.reports.render.figure import Axis, Figure, Panel, Role, Series
from piga.units import G0

ROLES: dict[str, Role] = {"x": "x", "y": "y", "z": "z"}


def set_force_figure(found: SetOutline) -> Figure:
    """Indicated and compensated components, and what lies between them."""
    panels = [
        Panel(
            TIME,
            Axis(f"specific force f_{axis}", "g"),
            (
                _curve(found, raw, G0, "before", "as indicated"),
                _curve(found, force, G0, "after", "compensated"),
            ),
        )
        for axis, raw, force in zip(AXES, RAW, FORCE, strict=True)
    ]
    lines = tuple(
        _curve(found, name, MICRO_G, ROLES[axis], axis) for axis, name in zip(AXES, CORRECTION, strict=True)
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
        notes=() if found.size <= POINTS else (f"Outlines of at most {POINTS} points; extremes are kept.",),
    )


def misfit_figure(found: SetOutline, names: tuple[str, ...]) -> Figure:
    """Residual of a redundant set, and how far each instrument is from the force that fits all."""
    panels = [
        Panel(
            TIME,
            Axis("residual of the set", "µg"),
            (_curve(found, "residual", MICRO_G, "data", "residual: root of the summed squares"),),
        )
    ]
    panels += [
        Panel(TIME, Axis(f"misfit of {name}", "µg"), (_curve(found, misfit, MICRO_G, "model", "misfit"),))
        for name, misfit in zip(names, found.misfits, strict=True)
        if found.counts[misfit]
    ]
    return Figure(
        "set-misfit",
        "What the instruments say against each other.",
        tuple(panels),
        "Indication of an instrument less the force that fits all, along its effective input axis. Noise is good; a line, "
        "a step or a drift in one of them points at its calibration, its mounting, its phase or a fault.",
        height=1.7,
    )


def set_orders_figure(found: SetOutline, names: tuple[str, ...]) -> Figure | None:
    """What was taken out of every instrument, by the order of its own revolution; None when nothing turns far enough."""
    panels = []
    for name, single in zip(names, found.instruments, strict=True):
        order, amplitude = correction_spectrum(single)
        if (amplitude > 0.0).any():
            panels.append(order_panel(order, amplitude, name))
    return orders_figure(tuple(panels)) if panels else None


def _curve(found: SetOutline, name: str, unit: float, role: Role, title: str) -> Series:
    rows = found.outlines[name].rows
    shown = (
        envelope_rows(np.nan_to_num(rows[name])) if np.isnan(rows[name]).all() else envelope_rows(rows[name])
    )
    return Series(rows["t"][shown] - found.start, rows[name][shown] / unit, title, role=role)
