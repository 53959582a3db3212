"""The Earth as the instruments feel it: WGS-84 shape, normal gravity and rotation rate.

Constants are those of NIMA TR8350.2 (WGS-84, third edition). All angles in radians, SI units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError

SEMI_MAJOR_AXIS = 6378137.0
"""WGS-84 equatorial radius a [m]."""
FLATTENING = 1.0 / 298.257223563
"""WGS-84 flattening f [1]."""
ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)
"""First eccentricity squared e^2 [1]."""
GM = 3.986004418e14
"""Geocentric gravitational constant, atmosphere included [m^3/s^2]."""
EARTH_RATE = 7.292115e-5
"""Earth's inertial rotation rate [rad/s]."""
J2 = 1.082629821e-3
"""Second zonal harmonic of the WGS-84 normal field [1]."""
GRAVITY_EQUATOR = 9.7803253359
"""Normal gravity on the ellipsoid at the equator [m/s^2]."""
GRAVITY_POLE = 9.8321849379
"""Normal gravity on the ellipsoid at the poles [m/s^2]."""


def normal_gravity(latitude: float | NDArray[np.float64], height: float | NDArray[np.float64] = 0.0) -> Any:
    """Normal gravity [m/s^2] at geodetic ``latitude`` [rad] and ellipsoidal ``height`` [m].

    Somigliana's closed formula on the ellipsoid with the second-order expansion in height
    (WGS-84, NIMA TR8350.2 eq. 4-1 and 4-3); valid to 1e-6 m/s^2 below 20 km. Scalars or arrays.
    """
    sin2 = np.sin(latitude) ** 2
    k = (1.0 - FLATTENING) * GRAVITY_POLE / GRAVITY_EQUATOR - 1.0
    surface = GRAVITY_EQUATOR * (1.0 + k * sin2) / np.sqrt(1.0 - ECCENTRICITY_SQUARED * sin2)
    semi_minor = SEMI_MAJOR_AXIS * (1.0 - FLATTENING)
    m = EARTH_RATE**2 * SEMI_MAJOR_AXIS**2 * semi_minor / GM
    ratio = height / SEMI_MAJOR_AXIS
    return surface * (1.0 - 2.0 * ratio * (1.0 + FLATTENING + m - 2.0 * FLATTENING * sin2) + 3.0 * ratio**2)


@dataclass(frozen=True)
class Site:
    """A place on the Earth: geodetic latitude and longitude [rad], height [m], gravity [m/s^2].

    ``gravity`` left out (None) means normal gravity at that place.
    """

    latitude: float
    longitude: float = 0.0
    height: float = 0.0
    gravity: float | None = None

    def __post_init__(self) -> None:
        if not abs(self.latitude) <= 0.5 * math.pi + 1e-9:
            raise ArgumentError(
                f"latitude: {math.degrees(self.latitude):.6g} deg is beyond a pole",
                remedy="write it with its unit: latitude = '48 deg'",
            )

    @property
    def local_gravity(self) -> float:
        """Gravity at the site [m/s^2]: as given, else WGS-84 normal gravity."""
        return float(normal_gravity(self.latitude, self.height)) if self.gravity is None else self.gravity

    @property
    def earth_rate_ned(self) -> NDArray[np.float64]:
        """Earth rate in local north-east-down axes [rad/s], shape (3,)."""
        return EARTH_RATE * np.array([math.cos(self.latitude), 0.0, -math.sin(self.latitude)])
