"""Dividing head (tumble test): known positions in the local gravity field."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga.earth import Site
from piga.errors import ArgumentError
from piga.frames import axis_turn
from piga.stand.imperfections import Imperfections
from piga.stand.machines.geometry import horizontal_axis_frame, in_axes, small_turn, smooth_step, turned
from piga.stand.profile import Segment, plan_holds

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DividingHead:
    """A horizontal axis with the instrument's input axis across it.

    At position angle ``x`` the specific force is ``g (cos x, -sin x, 0)`` (with ``roll = 0``): the base is
    turned by ``+x`` about ``Z0``, which lies along the head's axis.

    Parameters
    ----------
    site:
        Place and local gravity.
    positions:
        Position angles [rad] in the order taken; the head turns by the plain difference between them.
    dwell, move:
        Recorded time in a position and time of a move [s].
    roll:
        Turn of the instrument about its input axis on the head [rad].
    azimuth:
        Direction of the head's axis from north over east [rad].
    settling_time:
        Time constant of the imperfection ``settling`` [s].
    """

    site: Site
    positions: tuple[float, ...]
    dwell: float = 60.0
    move: float = 30.0
    roll: float = 0.0
    azimuth: float = 0.0
    settling_time: float = 5.0

    kind = "dividing-head"
    accepted = ("gravity", "levelling", "angle_error", "angle_harmonics", "settling")

    def __post_init__(self) -> None:
        if not self.positions:
            raise ArgumentError("dividing-head positions: none given", remedy="e.g. '0:360:15 deg'")
        if self.dwell <= 0.0 or self.move <= 0.0 or self.settling_time <= 0.0:
            raise ArgumentError("dividing-head dwell, move and settling_time must be positive")

    @property
    def fastest(self) -> float:
        """Step [s] that resolves a move."""
        return self.move / 100.0

    def segments(self) -> tuple[Segment, ...]:
        """Positions ``0, 1, ...``, recorded, with moves between them, not recorded."""
        return plan_holds(len(self.positions), self.dwell, "move", self.move)

    def angle(self, t: Array, errors: Imperfections) -> tuple[Array, Array]:
        """Angle [rad] and rate [rad/s] of the head at ``t`` [s], (n,)."""
        x = np.array(self.positions)
        x = x + errors.angle_error + sum(a * np.sin(n * x + phase) for n, a, phase in errors.angle_harmonics)
        residue = np.where(np.arange(x.size) > 0, errors.settling, 0.0)
        cycle = self.dwell + self.move
        k = np.clip(np.floor(t / cycle).astype(int), 0, x.size - 1)
        inside = t - k * cycle
        decay = residue[k] * np.exp(-np.minimum(inside, self.dwell) / self.settling_time)
        following = np.minimum(k + 1, x.size - 1)
        start = x[k] + decay
        way = x[following] + residue[following] - start
        s, ds, _ = smooth_step((inside - self.dwell) / self.move)
        moving = (inside > self.dwell) & (following > k)
        angle = np.where(moving, start + way * s, start)
        rate = np.where(moving, way * ds / self.move, -decay / self.settling_time)
        return angle, rate

    def motion(self, t: Array, errors: Imperfections) -> tuple[Array, Array]:
        """Specific force and base rate in base axes, (n, 3) each."""
        angle, rate = self.angle(t, errors)
        up, earth = horizontal_axis_frame(self.site, self.azimuth)
        tilt = small_turn(0.0, errors.levelling[1], errors.levelling[0])
        roll = axis_turn(0, self.roll)
        force = (self.site.local_gravity + errors.gravity) * turned(tilt @ up, angle)
        base_rate = turned(tilt @ earth, angle)
        base_rate[:, 2] += rate
        return in_axes(roll, force), in_axes(roll, base_rate)


def position_range(first: float, last: float, step: float) -> tuple[float, ...]:
    """Angles [rad] from ``first`` to before ``last``: a full circle does not repeat its start."""
    count = round((last - first) / step) if step != 0.0 else 0
    if count < 1:
        raise ArgumentError(
            "positions: the range is empty", remedy="write start:stop:step, e.g. '0:360:15 deg'"
        )
    return tuple(first + step * k for k in range(count))
