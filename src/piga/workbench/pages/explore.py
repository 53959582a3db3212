"""Explore: the regimes of the motion under constant input. Moving a slider draws them again."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from piga.errors import ArgumentError
from piga.instrument import (
    Instrument,
    closed_form,
    dead_zone,
    fixed_points,
    mean_rate,
    regime,
    revolution_period,
)
from piga.reports.render.numbers import significant
from piga.units import G0
from piga.workbench.pages.common import render
from piga.workbench.pages.later import start

POINTS = 601
DEG = 180.0 / math.pi


@dataclass(frozen=True)
class _Slider:
    """A quantity that the page lets move: name, words, unit, range, step and first value."""

    key: str
    words: str
    unit: str
    least: float
    largest: float
    step: float
    first: float


_SLIDERS = (
    _Slider("a_x", "Specific force along the input axis a_x", "g", -2.0, 2.0, 0.001, 0.02),
    _Slider("a_t", "Transverse specific force a_t", "g", 0.0, 10.0, 0.01, 5.0),
    _Slider("beta", "Non-orthogonality \u03b2", "arcsec", -3600.0, 3600.0, 1.0, 1000.0),
    _Slider("K", "Scale factor K", "rad/s/g", 0.1, 3.0, 0.0001, 0.8884),
    _Slider("time", "Time shown", "s", 1.0, 2000.0, 1.0, 200.0),
)


def show(request: Request) -> Response:
    """The page; after a moved slider the figures and numbers alone."""
    values = {}
    for slider in _SLIDERS:
        try:
            value = float(request.query_params.get(slider.key, slider.first))
        except ValueError:
            value = math.nan
        if not slider.least <= value <= slider.largest:
            limits = f"{slider.least:g} and {slider.largest:g} {slider.unit}"
            raise ArgumentError(f"{slider.words}: is not between {limits}", remedy="move the slider")
        values[slider.key] = value
    inst = Instrument(scale_factor=f"{values['K']} rad/s/g", beta=f"{values['beta']} arcsec")
    forces = (values["a_x"] * G0, values["a_t"] * G0, 0.0)
    figures = [_portrait(inst, forces), _rates(inst, forces), _motion(inst, forces, values["time"])]
    part = "explore-part.html.jinja" if request.headers.get("hx-request") else "explore.html.jinja"
    drawn = [(figure, json.dumps(figure)) for figure in figures]
    return render(request, part, sliders=_SLIDERS, values=values, figures=drawn, numbers=_numbers(inst, forces))


def _numbers(inst: Instrument, forces: tuple[float, float, float]) -> list[tuple[str, str]]:
    """Results of the library for these inputs, as label-value pairs."""
    name = regime(inst, *forces)
    low, high = (1e3 * float(edge) / G0 for edge in dead_zone(inst, forces[1], forces[2]))
    zone = f"{significant(low, 4)} to {significant(high, 4)} mg" if high > low else "none"
    rows = [
        ("regime", name),
        ("locked zone of a_x", zone),
        ("mean output rate", f"{significant(DEG * float(mean_rate(inst, *forces)), 4)} deg/s"),
        ("rate without cross-coupling", f"{significant(DEG * inst.scale_factor * forces[0], 4)} deg/s"),
    ]
    if name == "running":
        rows.append(("one revolution", f"{significant(float(revolution_period(inst, *forces)), 4)} s"))
    if name == "locked":
        rows.append(("rest angle", f"{significant(DEG * float(fixed_points(inst, *forces)[0]), 4)} deg"))
    return rows


def _figure(words: tuple[str, str, str, str], x: Any, curves: dict[str, Any], points: dict[str, Any]) -> Any:
    """A figure as plain data: title, caption and labels of the axes; curves over x; points (x, y) at the nearest x."""
    title, caption, *labels = words
    series = [{"name": name, "values": np.asarray(y).tolist(), "point": False} for name, y in curves.items()]
    for name, (at, y) in points.items():
        values: list[float | None] = [None] * len(x)
        values[int(np.abs(x - at).argmin())] = y
        series.append({"name": name, "values": values, "point": True})
    return {"title": title, "caption": caption, "x": np.asarray(x).tolist(), "labels": labels, "series": series}


def _portrait(inst: Instrument, forces: tuple[float, float, float]) -> Any:
    alpha = np.linspace(-math.pi, math.pi, POINTS)
    rate = inst.scale_factor * (forces[0] + inst.tan_beta * forces[1] * np.sin(alpha))
    points = {}
    if regime(inst, *forces) == "locked":
        names = ("stable rest", "unstable rest")
        points = {n: (float(a) * DEG, 0.0) for n, a in zip(names, fixed_points(inst, *forces), strict=True)}
    words = (
        "Rate against angle", "Where the curve crosses zero the gimbal can rest.",
        "output angle \u03b1 [deg]", "output rate [deg/s]",
    )  # fmt: skip
    return _figure(words, alpha * DEG, {"rate": rate * DEG, "at rest": np.zeros(POINTS)}, points)


def _rates(inst: Instrument, forces: tuple[float, float, float]) -> Any:
    reach = max(3.0 * float(dead_zone(inst, forces[1], forces[2])[1]), 1.3 * abs(forces[0]), 1e-3 * G0)
    grid = np.linspace(-reach, reach, POINTS)
    rate = mean_rate(inst, grid, np.full(POINTS, forces[1]), np.full(POINTS, forces[2]))
    now = (forces[0] * 1e3 / G0, DEG * float(mean_rate(inst, *forces)))
    curves = {"with cross-coupling": DEG * rate, "without": DEG * inst.scale_factor * grid}
    words = (
        "Mean rate against input", "Inside the locked zone the mean rate is zero.",
        "a_x [mg]", "mean output rate [deg/s]",
    )  # fmt: skip
    return _figure(words, grid * 1e3 / G0, curves, {"now": now})


def _motion(inst: Instrument, forces: tuple[float, float, float], time: float) -> Any:
    t = np.linspace(0.0, time, POINTS)
    alpha, _ = closed_form(inst, t, *forces)
    turn = 2.0 * math.pi
    curves = {"with cross-coupling": alpha / turn, "without": inst.scale_factor * forces[0] * t / turn}
    words = (
        "Output angle against time", "The exact closed form, from \u03b1 = 0.",
        "time [s]", "output angle \u03b1 [rev]",
    )  # fmt: skip
    return _figure(words, t, curves, {})


def reproduce(request: Request) -> Response:
    """Compute every published case and compare."""
    return start(
        request, ("reproduce", "--out", "reproduction", "--force"), "Reproduce", "publications", "reproduction"
    )


ROUTES = [Route("/explore", show), Route("/explore/reproduce", reproduce, methods=["POST"])]
