"""Precision centrifuge: centripetal specific force at set rates, up and down."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga.earth import Site
from piga.errors import ArgumentError
from piga.frames import axis_turn
from piga.stand.imperfections import Imperfections
from piga.stand.machines.geometry import in_axes, small_turn, turned, turned_back, vertical_axis_frame
from piga.stand.machines.spin import SpinPlan
from piga.stand.profile import Segment

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Centrifuge:
    """A vertical spindle with an arm; the input axis points to the spindle (or away from it).

    On the arm (``counter_rotating`` false): ``X0`` inward, ``Z0`` up, ``Y0`` against the motion for
    positive rates; the specific force is ``(r w^2, -r w', g)`` plus the Coriolis force of the Earth's
    rotation, and the base turns with the arm. On a counter-rotating platform the base keeps the
    direction it has at angle 0, and the specific force turns in the base.

    Parameters
    ----------
    site:
        Place and local gravity.
    radius:
        Arm radius at rest [m].
    spin:
        Levels, dwell and ramps.
    stretch:
        Known relative growth of the radius per squared rate [s^2/rad^2].
    counter_rotating:
        Whether the instrument stands on a platform that turns back against the arm.
    outward:
        Whether ``X0`` points away from the spindle: negative specific force.
    roll:
        Turn of the instrument about its input axis [rad].
    """

    site: Site
    radius: float
    spin: SpinPlan
    stretch: float = 0.0
    counter_rotating: bool = False
    outward: bool = False
    roll: float = 0.0

    kind = "centrifuge"
    accepted = ("gravity", "levelling", "arm_radius", "arm_stretch", "rate_error", "rate_ripple")

    def __post_init__(self) -> None:
        if self.radius <= 0.0:
            raise ArgumentError(f"centrifuge radius: {self.radius:g} m is not positive")

    @property
    def fastest(self) -> float:
        """Step [s] that resolves a ramp, and a revolution where the force turns in the base."""
        return self.spin.resolution

    def segments(self) -> tuple[Segment, ...]:
        """Levels, recorded, and ramps."""
        return self.spin.segments()

    def motion(self, t: Array, errors: Imperfections) -> tuple[Array, Array]:
        """Specific force and base rate in base axes, (n, 3) each."""
        spin = self.spin.true(t, errors)
        up, earth = (small_turn(*errors.levelling) @ v for v in vertical_axis_frame(self.site))
        squared = spin.rate**2
        radius = (self.radius + errors.arm_radius) * (1.0 + (self.stretch + errors.arm_stretch) * squared)
        earth_on_arm = turned(earth, spin.angle)
        coriolis = 2.0 * radius * spin.rate
        force = np.zeros((t.size, 3))
        force[:, 0] = radius * squared + coriolis * earth_on_arm[:, 2]
        force[:, 1] = -radius * spin.acceleration
        force[:, 2] = -coriolis * earth_on_arm[:, 0]
        force += (self.site.local_gravity + errors.gravity) * turned(up, spin.angle)
        rate = earth_on_arm.copy()
        rate[:, 2] += spin.rate
        if self.counter_rotating:
            force, rate = turned_back(force, spin.angle), np.tile(earth, (t.size, 1))
        turn = axis_turn(0, self.roll) @ axis_turn(2, math.pi if self.outward else 0.0)
        return in_axes(turn, force), in_axes(turn, rate)


def rates_for_levels(levels: tuple[float, ...], radius: float, stretch: float = 0.0) -> tuple[float, ...]:
    """Rates [rad/s] that give centripetal specific forces ``levels`` [m/s^2] at ``radius`` [m].

    Solves ``r (1 + stretch w^2) w^2 = a``.
    """
    rates = []
    for level in levels:
        if level < 0.0:
            raise ArgumentError(
                f"centrifuge levels: {level:g} m/s^2 is negative", remedy="turn the instrument outward"
            )
        ratio = level / radius
        root = math.sqrt(1.0 + 4.0 * stretch * ratio)
        rates.append(math.sqrt(2.0 * ratio / (1.0 + root)))
    return tuple(rates)
