"""Explore: the regimes of the motion under constant input. Moving a slider draws them again."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from piga.errors import ArgumentError
from piga.instrument import (
    Instrument,
    closed_form,
    dead_zone,
    fixed_points,
    locking_time,
    mean_rate,
    regime,
    revolution_period,
)
from piga.instrument.twin.linear import LoopAnalysis, analyse_loop, loop_poles, servo_terms, step_response
from piga.instrument.twin.parameters import TwinParameters
from piga.records.terms import si_factor
from piga.reports.render.figure import Axis, Figure, Panel, Series
from piga.units import G0
from piga.workbench.pages.common import render, start_job

POINTS = 601
SETTLED = 0.02
"""Largest deviation of a step response that is not seen in its figure."""
SHORTEST_STEP = 1e-3
"""Shortest time [s] of a step response."""
NARROW = 4.2
"""Width [inch] of a figure for a narrow window; its text is then as large as that of the page."""
DEG = 180.0 / math.pi


@dataclass(frozen=True)
class Slider:
    """A quantity that the page lets move: name, words, unit, range, step and first value."""

    key: str
    words: str
    unit: str
    least: float
    largest: float
    step: float
    first: float


SLIDERS = (
    Slider("a_x", "Specific force along the input axis a_x", "g", -2.0, 2.0, 0.001, 0.02),
    Slider("a_t", "Transverse specific force a_t", "g", 0.0, 10.0, 0.01, 5.0),
    Slider("beta", "Non-orthogonality β", "arcsec", -3600.0, 3600.0, 1.0, 1000.0),
    Slider("K", "Scale factor K", "rad/s/g", 0.1, 3.0, 0.0001, 0.8884),
    Slider("time", "Time shown", "s", 1.0, 2000.0, 1.0, 200.0),
    Slider("k_p", "Servo: proportional gain k_p", "N m/rad", 0.0, 200.0, 0.1, 30.0),
    Slider("k_i", "Servo: integral gain k_i", "N m/(rad s)", 1.0, 5000.0, 1.0, 600.0),
    Slider("k_d", "Servo: rate gain k_d", "N m s/rad", 0.0, 1.0, 0.001, 0.0),
    Slider("c", "Damping of the float c", "N m s/rad", 0.0, 0.5, 0.001, 0.05),
)


def _values(request: Request) -> dict[str, float]:
    values = {}
    for slider in SLIDERS:
        try:
            value = float(request.query_params.get(slider.key, slider.first))
        except ValueError:
            value = math.nan
        if not slider.least <= value <= slider.largest:
            raise ArgumentError(
                f"{slider.words}: is not between {slider.least:g} and {slider.largest:g} {slider.unit}",
                remedy="move the slider",
            )
        values[slider.key] = value
    return values


def show(request: Request) -> Response:
    """The page, with the figures of its first values or of those in the address."""
    return _rendered(request, "explore/explore.html.jinja")


def picture(request: Request) -> Response:
    """The figures and numbers alone."""
    return _rendered(request, "explore/explore-part.html.jinja")


def _rendered(request: Request, template: str) -> Response:
    from piga.reports.render.axes import figure_svg

    values = _values(request)
    inst = Instrument(scale_factor=f"{values['K']} rad/s/g", beta=f"{values['beta']} arcsec")
    forces = (values["a_x"] * G0, values["a_t"] * G0, 0.0)
    twin = _twin(values)
    poles = loop_poles(twin)
    with np.errstate(all="ignore"):  # a servo at the edge of its ranges may have no margin
        loop = analyse_loop(twin) if poles.real.max() < 0.0 else None
    drawn = [_portrait(inst, forces), _rates(inst, forces), _motion(inst, forces, values["time"])]
    drawn += [_step(twin, poles)] if loop is not None else []
    figures = [
        (figure, figure_svg(figure), figure_svg(replace(figure, key=f"{figure.key}-narrow"), width=NARROW))
        for figure in drawn
    ]
    return render(
        request, template, sliders=SLIDERS, values=values, figures=figures,
        numbers=_numbers(inst, forces), servo=_servo_numbers(twin, poles, loop),
    )  # fmt: skip


def _twin(values: dict[str, float]) -> TwinParameters:
    """The twin of the sliders: its example rotor and float, with this scale factor and this servo."""
    plain = TwinParameters()
    return replace(
        plain, pendulosity=values["K"] * plain.angular_momentum / G0, proportional_gain=values["k_p"],
        integral_gain=values["k_i"], rate_gain=values["k_d"], damping=values["c"],
    )  # fmt: skip


def _servo_numbers(
    twin: TwinParameters, poles: NDArray[np.complex128], loop: LoopAnalysis | None
) -> list[tuple[str, str]]:
    """What the library says about this servo, in words."""
    if loop is None:
        worst = poles[int(np.argmax(poles.real))]
        return [("servo loop", "unstable"), ("worst pole", f"{worst:.4g} 1/s")]
    terms, cube = servo_terms(twin), si_factor("servo")
    return [
        ("servo loop", "stable"),
        ("bandwidth of the rate", f"{loop.bandwidth / (2.0 * math.pi):.4g} Hz"),
        ("phase margin", f"{DEG * loop.phase_margin:.4g} deg"),
        ("nutation", f"{loop.nutation / (2.0 * math.pi):.4g} Hz, damping {loop.nutation_damping:.3g}"),
        ("term servo", f"{1e6 * terms.servo / cube:.4g} ug/g^3"),
        ("term servo_damping", f"{1e6 * terms.servo_damping / cube:.4g} ug/g^3"),
    ]


def _step(twin: TwinParameters, poles: NDArray[np.complex128]) -> Figure:
    t, response = _shown_step(twin, poles)
    panel = Panel(
        Axis("time after the step", "s"),
        Axis("output rate over K a_x", "1"),
        (
            Series(t, response, "twin", role="after"),
            Series(t[[0, -1]], np.ones(2), "without servo dynamics", role="muted"),
        ),
    )
    return Figure(
        "step",
        "Step of specific force",
        (panel,),
        "The servo of the twin answers a step of a_x, linear analysis.",
    )


def _shown_step(
    twin: TwinParameters, poles: NDArray[np.complex128]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times and response to a step, until it has settled.

    The slowest pole may hardly be excited. So the time is halved as long as nothing is seen in its second half.
    """
    time = min(max(6.0 / float(np.abs(poles.real).min()), SHORTEST_STEP), 100.0)
    while True:
        t = np.linspace(0.0, time, POINTS)
        response = step_response(twin, t)
        if time <= SHORTEST_STEP or np.abs(response[POINTS // 2 :] - 1.0).max() > SETTLED:
            return t, response
        time *= 0.5


def _numbers(inst: Instrument, forces: tuple[float, float, float]) -> list[tuple[str, str]]:
    """Results of the library for these inputs, as label-value pairs."""
    name = regime(inst, *forces)
    low, high = dead_zone(inst, forces[1], forces[2])
    zone = f"{1e3 * float(low) / G0:.6g} to {1e3 * float(high) / G0:.6g} mg" if high > low else "none"
    rows = [
        ("regime", name),
        ("locked zone of a_x", zone),
        ("mean output rate", f"{DEG * float(mean_rate(inst, *forces)):.6g} deg/s"),
        ("rate without cross-coupling", f"{DEG * inst.scale_factor * forces[0]:.6g} deg/s"),
    ]
    if name == "running":
        rows.append(("one revolution", f"{float(revolution_period(inst, *forces)):.6g} s"))
    if name == "locked":
        rows.append(("rest angle", f"{DEG * float(fixed_points(inst, *forces)[0]):.6g} deg"))
        rows.append(("locking time constant", f"{float(locking_time(inst, *forces)):.6g} s"))
    return rows


def _portrait(inst: Instrument, forces: tuple[float, float, float]) -> Figure:
    alpha = np.linspace(-math.pi, math.pi, POINTS)
    K = inst.scale_factor
    rate = K * (forces[0] + inst.tan_beta * (forces[1] * np.sin(alpha) - forces[2] * np.cos(alpha)))
    series = [
        Series(alpha * DEG, rate * DEG, "rate", role="after"),
        Series(np.array([-180.0, 180.0]), np.zeros(2), "at rest", role="muted"),
    ]
    if regime(inst, *forces) == "locked":
        stable, unstable = fixed_points(inst, *forces)
        series.append(
            Series(np.array([float(stable) * DEG]), np.zeros(1), "stable", mark="points", role="model")
        )
        series.append(
            Series(np.array([float(unstable) * DEG]), np.zeros(1), "unstable", mark="points", role="warning")
        )
    panel = Panel(Axis("output angle α", "deg"), Axis("output rate", "deg/s"), tuple(series))
    return Figure(
        "portrait", "Rate against angle", (panel,), "Where the curve crosses zero the gimbal can rest."
    )


def _rates(inst: Instrument, forces: tuple[float, float, float]) -> Figure:
    low, high = dead_zone(inst, forces[1], forces[2])
    reach = max(3.0 * float(high), 1.3 * abs(forces[0]), 1e-3 * G0)
    grid = np.unique(np.concatenate((np.linspace(-reach, reach, POINTS), [float(low), float(high)])))
    rate = mean_rate(inst, grid, np.full(grid.size, forces[1]), np.full(grid.size, forces[2]))
    here = np.array([forces[0]])
    panel = Panel(
        Axis("a_x", "mg"),
        Axis("mean output rate", "deg/s"),
        (
            Series(grid * 1e3 / G0, DEG * rate, "with cross-coupling", role="after"),
            Series(grid * 1e3 / G0, DEG * inst.scale_factor * grid, "without", role="muted"),
            Series(
                here * 1e3 / G0,
                DEG * mean_rate(inst, here, forces[1:2], forces[2:]),
                "now",
                mark="points",
                role="warning",
            ),
        ),
    )
    return Figure("rates", "Mean rate against input", (panel,), "Inside the locked zone the mean rate is zero.")


def _motion(inst: Instrument, forces: tuple[float, float, float], time: float) -> Figure:
    t = np.linspace(0.0, time, POINTS)
    alpha, _ = closed_form(inst, t, *forces)
    panel = Panel(
        Axis("time", "s"),
        Axis("output angle α", "rev"),
        (
            Series(t, alpha / (2.0 * math.pi), "with cross-coupling", role="after"),
            Series(t, inst.scale_factor * forces[0] * t / (2.0 * math.pi), "without", role="muted"),
        ),
    )
    return Figure("motion", "Output angle against time", (panel,), "The exact closed form, from α = 0.")


async def reproduce(request: Request) -> Response:
    """Compute every published case and compare."""
    command = ("reproduce", "--out", "reproduction", "--force")
    return await start_job(request, command, "Reproduce", "publications", "reproduction")


ROUTES = [
    Route("/explore", show),
    Route("/explore/picture", picture),
    Route("/explore/reproduce", reproduce, methods=["POST"]),
]
