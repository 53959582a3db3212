"""Rate table: a turning base in the gravity field, with its axis vertical, horizontal or between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga.earth import Site
from piga.stand.imperfections import Imperfections
from piga.stand.machines.geometry import (
    horizontal_axis_frame,
    in_axes,
    mount,
    small_turn,
    turned,
    vertical_axis_frame,
)
from piga.stand.machines.spin import SpinPlan
from piga.stand.profile import Segment

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RateTable:
    """A table turning about one axis.

    With the axis vertical the instrument feels gravity, constant in its axes, and the rate: the term
    ``-Omega_x`` of the output shows alone. With the axis horizontal gravity turns in the base.

    Parameters
    ----------
    site:
        Place and local gravity.
    spin:
        Rates, dwell and ramps.
    along:
        Base axis that lies along the table's axis: ``X0``, ``Y0``, ``Z0``, or with ``-``.
    horizontal:
        Whether the table's axis is horizontal, pointing at ``azimuth`` [rad] from north; else vertical up.
    azimuth:
        Direction of a horizontal axis [rad].
    offset:
        Distance of the instrument from the axis, along the table's own first axis [m].
    """

    site: Site
    spin: SpinPlan
    along: str = "X0"
    horizontal: bool = False
    azimuth: float = 0.0
    offset: float = 0.0

    kind = "rate-table"
    accepted = ("gravity", "levelling", "arm_radius", "rate_error", "rate_ripple")

    def __post_init__(self) -> None:
        mount(self.along, "rate-table along")

    @property
    def fastest(self) -> float:
        """Step [s] that resolves a ramp and, with a horizontal axis, a revolution."""
        return self.spin.resolution

    def segments(self) -> tuple[Segment, ...]:
        """Rates held, recorded, and ramps."""
        return self.spin.segments()

    def motion(self, t: Array, errors: Imperfections) -> tuple[Array, Array]:
        """Specific force and base rate in base axes, (n, 3) each."""
        spin = self.spin.true(t, errors)
        frame = (
            horizontal_axis_frame(self.site, self.azimuth)
            if self.horizontal
            else vertical_axis_frame(self.site)
        )
        tilt = (
            small_turn(*errors.levelling) if not self.horizontal else small_turn(0.0, *errors.levelling[::-1])
        )
        up, earth = (tilt @ v for v in frame)
        arm = self.offset + errors.arm_radius
        force = (self.site.local_gravity + errors.gravity) * turned(up, spin.angle)
        force[:, 0] -= arm * spin.rate**2
        force[:, 1] += arm * spin.acceleration
        rate = turned(earth, spin.angle)
        rate[:, 2] += spin.rate
        turn = mount(self.along)
        return in_axes(turn, force), in_axes(turn, rate)
