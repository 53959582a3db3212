"""Live: a stream as it comes, indicated against compensated."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from piga.compensation.model import MEANING
from piga.errors import ArgumentError
from piga.units import G0
from piga.workbench.pages.common import bench_of, render
from piga.workbench.signals import MOST_WIDTH

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response


def show(request: Request) -> Response:
    """The page of the stream, or how to connect one."""
    return render(request, "live/live.html.jinja", live=bench_of(request).live)


def status(request: Request) -> Response:
    """State, rows and alarms; the page asks for them every second."""
    return render(request, "live/live-part.html.jinja", live=bench_of(request).live, meaning=MEANING)


def data(request: Request) -> Response:
    """The last seconds as 64-bit floats, in g."""
    from starlette.responses import Response

    live = bench_of(request).live
    try:
        seconds, width = float(request.query_params["seconds"]), int(request.query_params["width"])
    except (KeyError, ValueError):
        seconds, width = 0.0, 0
    if live is None or not (0.0 < seconds < 1e9 and 0 < width <= MOST_WIDTH):
        raise ArgumentError("the span of the picture is not valid", remedy="reload the page")
    rows = live.latest(seconds, width)
    rows[:, 1:] /= G0
    return Response(np.ascontiguousarray(rows, dtype="<f8").tobytes(), media_type="application/octet-stream")


def routes() -> list[Any]:
    """Routes of this page."""
    from starlette.routing import Route

    return [Route("/live", show), Route("/live/status", status), Route("/live/data", data)]
