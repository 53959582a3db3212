"""Explore: the regimes of the motion under constant input. Moving a slider draws them again."""

from __future__ import annotations

import json
import math
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

_POINTS = 601
_DEG, _TURN, _MG = 180.0 / math.pi, 2.0 * math.pi, 1e-3 * G0
_SLIDERS = (
    ("a_x", "Specific force along the input axis a_x", "g", -2.0, 2.0, 0.001, 0.02),
    ("a_t", "Transverse specific force a_t", "g", 0.0, 10.0, 0.01, 5.0),
    ("beta", "Non-orthogonality \u03b2", "arcsec", -3600.0, 3600.0, 1.0, 1000.0),
    ("K", "Scale factor K", "rad/s/g", 0.1, 3.0, 0.0001, 0.8884),
    ("time", "Time shown", "s", 1.0, 2000.0, 1.0, 200.0),
)
"""Name, words, unit, range, step and first value of the quantities that the page lets move."""


def _show(request: Request) -> Response:
    """Figures and numbers for the values of the sliders."""
    values = {}
    for key, words, unit, least, largest, _, first in _SLIDERS:
        try:
            value = float(request.query_params.get(key, first))
        except ValueError:
            value = math.nan
        if not least <= value <= largest:
            limits = f"{least:g} and {largest:g} {unit}"
            raise ArgumentError(f"{words}: is not between {limits}", remedy="move the slider")
        values[key] = value
    inst = Instrument(scale_factor=f"{values['K']} rad/s/g", beta=f"{values['beta']} arcsec")
    forces = (values["a_x"] * G0, values["a_t"] * G0, 0.0)
    name, (low, high) = regime(inst, *forces), map(float, dead_zone(inst, *forces[1:]))
    rests = [float(at) for at in fixed_points(inst, *forces)] if name == "locked" else []
    mean = _DEG * float(mean_rate(inst, *forces))

    alpha = np.linspace(-math.pi, math.pi, _POINTS)
    rate = inst.scale_factor * (forces[0] + inst.tan_beta * forces[1] * np.sin(alpha))
    portrait = {"rate": _DEG * rate, "at rest": 0.0 * alpha}
    at_rest = {
        words: (_DEG * at, 0.0) for words, at in zip(("stable rest", "unstable rest"), rests, strict=False)
    }
    reach = max(3.0 * high, 1.3 * abs(forces[0]), _MG)
    grid = np.linspace(-reach, reach, _POINTS)
    over = mean_rate(inst, grid, np.full(_POINTS, forces[1]), np.full(_POINTS, forces[2]))
    rates = {"with cross-coupling": _DEG * over, "without": _DEG * inst.scale_factor * grid}
    t = np.linspace(0.0, values["time"], _POINTS)
    motion, _ = closed_form(inst, t, *forces)
    angles = {"with cross-coupling": motion / _TURN, "without": inst.scale_factor * forces[0] * t / _TURN}
    figures = [
        _figure(
            "Rate against angle", "Where the curve crosses zero the gimbal can rest.",
            ("output angle \u03b1 [deg]", "output rate [deg/s]"), _DEG * alpha, portrait, at_rest,
        ),
        _figure(
            "Mean rate against input", "Inside the locked zone the mean rate is zero.",
            ("a_x [mg]", "mean output rate [deg/s]"), grid / _MG, rates, {"now": (forces[0] / _MG, mean)},
        ),
        _figure(
            "Output angle against time", "The exact closed form, from \u03b1 = 0.",
            ("time [s]", "output angle \u03b1 [rev]"), t, angles, {},
        ),
    ]  # fmt: skip
    zone = f"{significant(low / _MG, 4)} to {significant(high / _MG, 4)} mg" if high > low else "none"
    numbers = {
        "regime": name,
        "locked zone of a_x": zone,
        "mean output rate": f"{significant(mean, 4)} deg/s",
        "rate without cross-coupling": f"{significant(_DEG * inst.scale_factor * forces[0], 4)} deg/s",
    }
    if name == "running":
        numbers["one revolution"] = f"{significant(float(revolution_period(inst, *forces)), 4)} s"
    if name == "locked":
        numbers["rest angle"] = f"{significant(_DEG * rests[0], 4)} deg"
    return render(
        request, "explore.html.jinja", sliders=_SLIDERS, values=values, figures=figures, numbers=numbers
    )


def _figure(
    title: str, caption: str, labels: tuple[str, str], x: Any, curves: dict[str, Any], points: dict[str, Any]
) -> dict[str, str]:
    """Title, caption and drawing of a figure: curves over x; points (x, y) at the nearest x."""
    series = [{"name": name, "values": np.asarray(y).tolist(), "point": False} for name, y in curves.items()]
    for name, (at, y) in points.items():
        values: list[float | None] = [None] * _POINTS
        values[int(np.abs(x - at).argmin())] = y
        series.append({"name": name, "values": values, "point": True})
    drawn = json.dumps({"x": x.tolist(), "labels": labels, "series": series})
    return {"title": title, "caption": caption, "drawn": drawn}


ROUTES = [Route("/explore", _show)]
