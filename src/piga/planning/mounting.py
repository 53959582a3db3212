"""The mounting question: which skew keeps the instrument out of the lock zone over a profile.

With ``u = K f - Omega`` the instrument runs where ``u_x^2 > u_t^2 tan^2(beta)`` [Wei2024]. Turning the
instrument by a skew ``sigma`` towards the direction at ``clock`` about the platform's X axis makes
``u_x = u . (cos sigma, sin sigma cos clock, sin sigma sin clock)``; the margin of a mounting is the
least ``|u_x|/(u_t tan(beta))`` of the profile, and it must exceed 1 (own formulation).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from piga.errors import ArgumentError, CalibrationError
from piga.planning.plan_file import PlanRequest
from piga.results import Array, Result
from piga.stand.machines import angles_of_range
from piga.stand.profile import NONE
from piga.threads import one_thread


@dataclass(frozen=True, eq=False, repr=False)
class Mounting(Result):
    """Margins of all mountings (skews, clocks). ``limit`` is the wanted one.

    ``best`` is the index of the best one. ``margin_history`` (n,) is its ``|u_x|/(u_t tan(beta))`` at times ``t`` [s];
    ``unskewed_history`` is that of the instrument without skew.
    """

    skews: Array
    clocks: Array
    margins: Array
    limit: float
    t: Array
    margin_history: Array
    unskewed_history: Array
    best: tuple[int, int]

    @property
    def skew(self) -> float:
        """Best skew [rad]."""
        return float(self.skews[self.best[0]])

    @property
    def clock(self) -> float:
        """Direction of the best skew about X, from Y towards Z [rad]."""
        return float(self.clocks[self.best[1]])

    @property
    def margin(self) -> float:
        """Least ``|u_x|/(u_t tan(beta))`` of the best mounting."""
        return float(self.margins[self.best])

    @property
    def acceptable(self) -> Array:
        """Skews [rad] that reach the wanted margin at their best direction."""
        return self.skews[self.margins.max(axis=1) >= self.limit]


@one_thread()
def plan_mounting(request: PlanRequest) -> Mounting | None:
    """Best skew for the profile of ``[mounting]``; None when the plan has none.

    Raises
    ------
    CalibrationError
        If tan_beta is zero: there is no lock zone.
    ArgumentError
        If a range of angles is empty.
    """
    table = request.table.mounting
    if table is None:
        return None
    instrument = request.scenario.specimen.instrument
    tangent = abs(instrument.tan_beta)
    if tangent == 0.0:
        raise CalibrationError(
            "[mounting] needs [truth] beta: without it there is no lock zone",
            remedy="add the expected size, e.g. beta = '20 arcsec'",
        )
    stand = table.profile.build(request.path.parent)
    segments = stand.segments()
    step = table.in_si("[mounting] ")["step"]
    if not step > 0.0:
        raise ArgumentError("[mounting] step: must be positive", remedy="e.g. '0.1 s'")
    t = np.arange(segments[0].start, segments[-1].stop + 0.5 * step, step)
    force, rate = stand.motion(np.minimum(t, segments[-1].stop), NONE)
    u = instrument.scale_factor * force - rate
    skews, clocks = (
        np.array(angles_of_range(getattr(table, name), f"[mounting] {name}", "0:91:1 deg"))
        for name in ("skew", "clock")
    )
    margins = np.array([_ratios(u, _axes(skew, clocks), tangent).min(axis=0) for skew in skews.tolist()])
    best = int(np.argmax(margins) // clocks.size), int(np.argmax(margins) % clocks.size)
    axes = _axes(skews[best[0]], clocks[[best[1]]])
    return Mounting(
        skews=skews,
        clocks=clocks,
        margins=margins,
        limit=table.margin,
        t=t,
        margin_history=_ratios(u, axes, tangent)[:, 0],
        unskewed_history=_ratios(u, np.array([[1.0], [0.0], [0.0]]), tangent)[:, 0],
        best=best,
    )


def _axes(skew: float, clocks: Array) -> Array:
    """Input axes in platform axes for one skew, (3, clocks)."""
    s = math.sin(skew)
    return np.array([np.full(clocks.size, math.cos(skew)), s * np.cos(clocks), s * np.sin(clocks)])


def _ratios(u: Array, axes: Array, tangent: float) -> Array:
    """``|u_x|/(u_t tan(beta))`` per row and axis; infinite without transverse input.

    0 if ``u_x`` changed its sign since the previous row: the profile crossed the lock zone.
    """
    signed = u @ axes
    along = np.abs(signed)
    across = np.sqrt(np.maximum(np.sum(u * u, axis=1)[:, None] - along**2, 0.0)) * tangent
    ratios = np.divide(along, across, out=np.full(along.shape, np.inf), where=across > 0.0)
    ratios[1:][signed[1:] * signed[:-1] < 0.0] = 0.0
    return ratios
