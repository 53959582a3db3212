"""Explore: the regimes of the motion under constant input. Moving a slider draws them again."""

from __future__ import annotations

import json
import math
from typing import Any, NamedTuple

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

_POINTS = 601
_DEG = 180.0 / math.pi
_Forces = tuple[float, float, float]
_Figure = dict[str, Any]


class _Slider(NamedTuple):
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


def _show(request: Request) -> Response:
    """Figures and numbers for the values of the sliders."""
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
    drawn = [(figure, json.dumps(figure)) for figure in figures]
    numbers = _numbers(inst, forces)
    return render(
        request, "explore.html.jinja", sliders=_SLIDERS, values=values, figures=drawn, numbers=numbers
    )


def _numbers(inst: Instrument, forces: _Forces) -> dict[str, str]:
    """Results of the library for these inputs."""
    name, (low, high) = regime(inst, *forces), np.array(dead_zone(inst, *forces[1:])) * 1e3 / G0
    rows = {
        "regime": name,
        "locked zone of a_x": f"{significant(low, 4)} to {significant(high, 4)} mg" if high > low else "none",
        "mean output rate": f"{significant(_DEG * float(mean_rate(inst, *forces)), 4)} deg/s",
        "rate without cross-coupling": f"{significant(_DEG * inst.scale_factor * forces[0], 4)} deg/s",
    }
    if name == "running":
        rows["one revolution"] = f"{significant(float(revolution_period(inst, *forces)), 4)} s"
    if name == "locked":
        rows["rest angle"] = f"{significant(_DEG * float(fixed_points(inst, *forces)[0]), 4)} deg"
    return rows


def _figure(
    title: str, caption: str, labels: tuple[str, str], x: Any, curves: dict[str, Any], points: dict[str, Any]
) -> _Figure:
    """A figure as plain data: curves over x; points (x, y) at the nearest x."""
    series = [{"name": name, "values": np.asarray(y).tolist(), "point": False} for name, y in curves.items()]
    for name, (at, y) in points.items():
        values: list[float | None] = [None] * _POINTS
        values[int(np.abs(x - at).argmin())] = y
        series.append({"name": name, "values": values, "point": True})
    return {"title": title, "caption": caption, "x": x.tolist(), "labels": labels, "series": series}


def _portrait(inst: Instrument, forces: _Forces) -> _Figure:
    alpha = np.linspace(-math.pi, math.pi, _POINTS)
    rate = inst.scale_factor * (forces[0] + inst.tan_beta * forces[1] * np.sin(alpha))
    rests = fixed_points(inst, *forces) if regime(inst, *forces) == "locked" else ()
    points = {
        name: (float(at) * _DEG, 0.0) for name, at in zip(("stable rest", "unstable rest"), rests, strict=False)
    }
    curves = {"rate": rate * _DEG, "at rest": np.zeros(_POINTS)}
    labels = ("output angle \u03b1 [deg]", "output rate [deg/s]")
    caption = "Where the curve crosses zero the gimbal can rest."
    return _figure("Rate against angle", caption, labels, alpha * _DEG, curves, points)


def _rates(inst: Instrument, forces: _Forces) -> _Figure:
    reach = max(3.0 * float(dead_zone(inst, *forces[1:])[1]), 1.3 * abs(forces[0]), 1e-3 * G0)
    grid = np.linspace(-reach, reach, _POINTS)
    rate = mean_rate(inst, grid, np.full(_POINTS, forces[1]), np.full(_POINTS, forces[2]))
    curves = {"with cross-coupling": _DEG * rate, "without": _DEG * inst.scale_factor * grid}
    now = {"now": (forces[0] * 1e3 / G0, _DEG * float(mean_rate(inst, *forces)))}
    labels, caption = ("a_x [mg]", "mean output rate [deg/s]"), "Inside the locked zone the mean rate is zero."
    return _figure("Mean rate against input", caption, labels, grid * 1e3 / G0, curves, now)


def _motion(inst: Instrument, forces: _Forces, time: float) -> _Figure:
    t, turn = np.linspace(0.0, time, _POINTS), 2.0 * math.pi
    alpha, _ = closed_form(inst, t, *forces)
    curves = {"with cross-coupling": alpha / turn, "without": inst.scale_factor * forces[0] * t / turn}
    labels, caption = ("time [s]", "output angle \u03b1 [rev]"), "The exact closed form, from \u03b1 = 0."
    return _figure("Output angle against time", caption, labels, t, curves, {})


ROUTES = [Route("/explore", _show)]
