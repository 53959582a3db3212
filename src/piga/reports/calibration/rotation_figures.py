"""Figures of residuals against the rotation of the output: revolution orders, and the ripple over one turn."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga.reports.render.figure import Axis, Figure, Panel, Series
from piga.reports.render.orders import OrderSpectrum, Ripple
from piga.units import G0

Array = NDArray[np.float64]

MICRO_G = G0 * 1e-6


def spectrum_figure(spectrum: OrderSpectrum) -> Figure:
    """Ripple amplitude against revolution order."""
    y = Axis("ripple amplitude", "µg", log=True)
    series = (
        Series(spectrum.order, spectrum.before / MICRO_G, name="before", role="before"),
        Series(spectrum.order, spectrum.after / MICRO_G, name="after", role="after"),
        Series(
            spectrum.order,
            spectrum.noise / MICRO_G,
            name="expected of the noise",
            role="reference",
            dashed=True,
        ),
    )
    return Figure(
        key="residual-order",
        title="Residual against revolution order.",
        panels=(Panel(Axis("revolution order", "cycles/rev"), y, series),),
        caption="Specific-force ripple that would leave these residuals, by how often it repeats in one turn "
        "of the output. Good: after calibration no line stands out of the expected noise. A line at a whole "
        "order is a harmonic that the model lacks (order 1: cross-coupling; 2: servo stiffness, unequal "
        "inertia; others: encoder and bearings).",
        height=2.9,
        notes=(f"From {_segments_that_turn(spectrum.segments)}.",),
    )


def ripple_figure(turned: Ripple) -> Figure:
    """Ripple against output angle: polar, and unrolled on its own scale."""
    before, after = turned.before / MICRO_G, turned.after / MICRO_G
    scatter = turned.scatter / MICRO_G
    step = _nice(float(np.nanmax(np.abs(np.concatenate((before, after))))))
    degrees = np.degrees(turned.psi)
    error = scatter if np.isfinite(scatter).all() and scatter.size else None
    outer = 3.2 * step
    scattered = "" if error is None else " Error bars: standard uncertainty from the scatter between segments."
    turned_note = (
        f"Mean over {_segments_that_turn(turned.segments)}, each turned so that its own ripple before "
        "calibration points to ψ = 0."
    )
    polar = Panel(
        Axis("radius × cos ψ", "µg", limits=(-outer, outer)),
        Axis("radius × sin ψ", "µg", limits=(-outer, outer)),
        (
            *_polar_grid(step),
            _closed(turned.psi, before, 2.0 * step, "before", "before"),
            _closed(turned.psi, after, 2.0 * step, "after", "after"),
        ),
        title="Polar",
        equal=True,
    )
    flat = Panel(
        Axis("output angle ψ", "deg", limits=(0.0, 360.0)),
        Axis("residual specific force", "µg"),
        (
            Series(degrees, degrees * 0.0, role="reference", dashed=True),
            Series(degrees, after, name="after", mark="line+points", role="after", error=error),
        ),
        title="After, enlarged",
    )
    return Figure(
        key="ripple-polar",
        title="Cross-coupling ripple in one turn of the output.",
        panels=(polar, flat),
        caption="Residual specific force around the turn, drawn outwards from the ring of "
        f"{2 * step:g} µg, which means zero; grid rings lie {step:g} µg apart. Cross-coupling shifts the curve "
        "sideways. Good: after calibration the curve lies on the ring, and on the enlarged scale only scatter "
        "is left.",
        columns=2,
        height=3.4,
        notes=(turned_note + scattered,),
    )


def _segments_that_turn(number: int) -> str:
    return "the one segment that turns far enough" if number == 1 else f"{number} segments that turn far enough"


def _nice(size: float) -> float:
    """The next of 1, 2, 5 times a power of ten above ``size``."""
    if not size > 0.0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(size))
    return next(power * factor for factor in (1.0, 2.0, 5.0, 10.0) if power * factor >= size * 0.999)


def _polar_grid(step: float) -> tuple[Series, ...]:
    turn = np.linspace(0.0, 2.0 * math.pi, 181)
    rings = [Series(r * np.cos(turn), r * np.sin(turn), role="muted") for r in (step, 3.0 * step)]
    zero = Series(
        2 * step * np.cos(turn), 2 * step * np.sin(turn), role="reference", dashed=True, name="zero ripple"
    )
    spokes_x, spokes_y = [], []
    for angle in np.arange(0.0, 2.0 * math.pi - 1e-9, math.pi / 6.0):
        spokes_x += [step * math.cos(angle), 3.0 * step * math.cos(angle), math.nan]
        spokes_y += [step * math.sin(angle), 3.0 * step * math.sin(angle), math.nan]
    return (*rings, Series(np.array(spokes_x), np.array(spokes_y), role="muted"), zero)


def _closed(psi: Array, values: Array, radius: float, name: str, role: str) -> Series:
    psi, values = np.append(psi, psi[:1]), np.append(values, values[:1])
    text = tuple(f"ψ {np.degrees(p):.0f}°, ripple {v:.3g} µg" for p, v in zip(psi, values, strict=True))
    x, y = (radius + values) * np.cos(psi), (radius + values) * np.sin(psi)
    return Series(x, y, name=name, role="before" if role == "before" else "after", text=text)
