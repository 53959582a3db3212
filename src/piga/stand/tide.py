"""The solid Earth tide in local gravity: direct tide of Sun and Moon, degrees 2 and 3, and the Earth's response.

Potential of a body of distance ``d`` at geocentric latitude ``s`` and radius ``r``, declination ``q`` and hour angle ``H``::

    W2 = GM r^2/d^3 [(3 sin^2 s - 1)(3 sin^2 q - 1)/4 + 3/4 sin 2s sin 2q cos H + 3/4 cos^2 s cos^2 q cos 2H]
    W3 = GM r^3/d^4 (5 c^3 - 3 c)/2,    c = sin s sin q + cos s cos q cos H

Gravity changes by ``-(2 delta W2 + 3 delta3 W3)/r``. The gravimetric factors are ``delta = 1 + 2 h/n - (n + 1) k/n`` (degree n,
Love numbers h and k). They differ between the long-period, diurnal and semidiurnal parts of degree 2, and for the wave
K1 [Wahr1981], [Dehant1999]. The positions of Sun and Moon are from the series of [Montenbruck2000], section 3.3.2.
Sidereal time is that of the IAU 1982.
"""

from __future__ import annotations

import datetime as dt
import math
from dataclasses import dataclass

import numpy as np

from piga.earth import ECCENTRICITY_SQUARED, SEMI_MAJOR_AXIS, Site
from piga.results import Array, Result
from piga.units import ARCSEC, DAY

GRAVIMETRIC_FACTORS = (1.157, 1.154, 1.162)
"""Gravimetric factors of degree 2: long-period, diurnal (that of O1) and semidiurnal part [Dehant1999]."""
GRAVIMETRIC_FACTOR_3 = 1.07
"""Gravimetric factor of degree 3 [Dehant1999]."""
K1_FACTOR = 1.135
"""Gravimetric factor of the diurnal wave K1, near the free core nutation [Dehant1999]."""
K1_POTENTIAL = 0.53050 * 2.6277
"""Amplitude of K1 in the potential at 45 deg and the mean radius [m^2/s^2]: Doodson's coefficient and constant [Doodson1921]."""
MEAN_RADIUS = 6.371e6
"""Mean radius of the Earth for this amplitude [m]."""
GM_MOON, GM_SUN = 4.902800e12, 1.32712440e20
"""Gravitational constants [m^3/s^2]."""
OBLIQUITY = math.radians(23.43929111)
"""Obliquity of the ecliptic, J2000 [rad]."""
PRECESSION = math.radians(1.3972)
"""General precession in longitude per Julian century [rad]. Positions are of date, as sidereal time is."""
TERRESTRIAL_LESS_UTC = 69.0
"""Terrestrial time minus UTC [s], rounded. The Moon moves by 0.5 arcsec per second."""

_J2000 = dt.datetime(2000, 1, 1, 12, tzinfo=dt.UTC)
_CENTURY = 36525.0 * DAY

_LONGITUDE = (
    (22640, 1, 0, 0, 0), (769, 2, 0, 0, 0), (-4586, 1, 0, 0, -2), (2370, 0, 0, 0, 2), (-668, 0, 1, 0, 0),
    (-412, 0, 0, 2, 0), (-212, 2, 0, 0, -2), (-206, 1, 1, 0, -2), (192, 1, 0, 0, 2), (-165, 0, 1, 0, -2),
    (148, 1, -1, 0, 0), (-125, 0, 0, 0, 1), (-110, 1, 1, 0, 0), (-55, 0, 0, 2, -2),
)  # fmt: skip
"""Moon: arcsec of ``sin(a l + b l' + c F + e D)`` in ecliptic longitude minus mean longitude."""
_LATITUDE = (
    (-526, 0, 0, 1, -2), (44, 1, 0, 1, -2), (-31, -1, 0, 1, -2), (-25, -2, 0, 1, 0), (-23, 0, 1, 1, -2),
    (21, -1, 0, 1, 0), (11, 0, -1, 1, -2),
)  # fmt: skip
"""Moon: arcsec of the sines in ecliptic latitude, without the main term."""
_DISTANCE = (
    (-20905, 1, 0, 0, 0), (-3699, -1, 0, 0, 2), (-2956, 0, 0, 0, 2), (-570, 2, 0, 0, 0), (246, 2, 0, 0, -2),
    (-205, 0, 1, 0, -2), (-171, 1, 0, 0, 2), (-152, 1, 1, 0, -2),
)  # fmt: skip
"""Moon: km of the cosines in the distance minus 385 000 km."""


@dataclass(frozen=True, eq=False, repr=False)
class Body(Result):
    """Position of a body: ecliptic longitude and latitude of date [rad], distance [m], (n,) each."""

    longitude: Array
    latitude: Array
    distance: Array

    def equatorial(self) -> tuple[Array, Array]:
        """Right ascension and declination [rad]."""
        sine, cosine = math.sin(OBLIQUITY), math.cos(OBLIQUITY)
        along, up = np.sin(self.longitude) * np.cos(self.latitude), np.sin(self.latitude)
        ascension = np.arctan2(along * cosine - up * sine, np.cos(self.longitude) * np.cos(self.latitude))
        return ascension, np.arcsin(along * sine + up * cosine)


def moon(centuries: Array) -> Body:
    """The Moon at Julian centuries of terrestrial time since J2000 (n,), accurate to 5 arcmin and 500 km."""
    T = centuries
    mean = np.radians(218.31617 + 481267.88088 * T)
    arguments = (
        np.radians(134.96292 + 477198.86753 * T),
        np.radians(357.52543 + 35999.04944 * T),
        np.radians(93.27283 + 483202.01873 * T),
        np.radians(297.85027 + 445267.11135 * T),
    )
    off = ARCSEC * _series(_LONGITUDE, arguments, np.sin)
    _, sun, node, _ = arguments
    main = 18520.0 * np.sin(node + off + ARCSEC * (412.0 * np.sin(2.0 * node) + 541.0 * np.sin(sun)))
    latitude = ARCSEC * (main + _series(_LATITUDE, arguments, np.sin))
    return Body(mean + off, latitude, 1e3 * (385000.0 + _series(_DISTANCE, arguments, np.cos)))


def sun(centuries: Array) -> Body:
    """The Sun at Julian centuries of terrestrial time since J2000 (n,), accurate to 2 arcmin and 0.1 %."""
    T = centuries
    anomaly = np.radians(357.5256 + 35999.049 * T)
    longitude = math.radians(282.9400) + anomaly + PRECESSION * T
    longitude = longitude + ARCSEC * (6892.0 * np.sin(anomaly) + 72.0 * np.sin(2.0 * anomaly))
    distance = 1e9 * (149.619 - 2.499 * np.cos(anomaly) - 0.021 * np.cos(2.0 * anomaly))
    return Body(longitude, np.zeros_like(T), distance)


def _series(terms: tuple[tuple[int, ...], ...], arguments: tuple[Array, ...], wave: np.ufunc) -> Array:
    total = np.zeros_like(arguments[0])
    for amplitude, *factors in terms:
        angle = sum(k * a for k, a in zip(factors, arguments, strict=True) if k)
        total += amplitude * wave(angle)
    return total


def sidereal_time(centuries: Array) -> Array:
    """Greenwich mean sidereal time [rad] at Julian centuries of universal time since J2000 (n,)."""
    T = centuries
    seconds = 67310.54841 + (876600.0 * 3600.0 + 8640184.812866) * T + 0.093104 * T**2
    return np.asarray(np.mod(seconds, DAY) * (2.0 * math.pi / DAY))


@dataclass(frozen=True)
class EarthTide:
    """Tidal gravity of a test that begins at ``start`` (UTC). ``in_reference``: the lab's reference includes it."""

    site: Site
    start: dt.datetime
    in_reference: bool = False

    def gravity(self, t: Array) -> Array:
        """Change of gravity [m/s^2] at times ``t`` [s] of the test, (n,), including its permanent part.

        Accurate to 1 % of a tide of 1e-6 m/s^2 (docs/twin.md), without ocean loading (some percent near coasts).
        """
        universal = ((self.start - _J2000).total_seconds() + np.asarray(t, dtype=float)) / _CENTURY
        terrestrial = universal + TERRESTRIAL_LESS_UTC / _CENTURY
        latitude, radius = self._geocentric()
        local = sidereal_time(universal) + self.site.longitude
        change = np.zeros_like(universal)
        for body, gm in ((moon(terrestrial), GM_MOON), (sun(terrestrial), GM_SUN)):
            parts, third = _potentials(body, gm, local, latitude, radius)
            second = sum(factor * part for factor, part in zip(GRAVIMETRIC_FACTORS, parts, strict=True))
            change -= (2.0 * second + 3.0 * GRAVIMETRIC_FACTOR_3 * third) / radius
        k1 = K1_POTENTIAL * (radius / MEAN_RADIUS) ** 2 * math.sin(2.0 * latitude) * np.sin(local)
        return np.asarray(change - 2.0 * (K1_FACTOR - GRAVIMETRIC_FACTORS[1]) * k1 / radius)

    def _geocentric(self) -> tuple[float, float]:
        """Geocentric latitude [rad] and distance from the Earth's centre [m]."""
        sine, cosine = math.sin(self.site.latitude), math.cos(self.site.latitude)
        normal = SEMI_MAJOR_AXIS / math.sqrt(1.0 - ECCENTRICITY_SQUARED * sine**2)
        out = (normal + self.site.height) * cosine
        up = (normal * (1.0 - ECCENTRICITY_SQUARED) + self.site.height) * sine
        return math.atan2(up, out), math.hypot(up, out)


def _potentials(
    body: Body, gm: float, local: Array, latitude: float, radius: float
) -> tuple[tuple[Array, Array, Array], Array]:
    """Potential [m^2/s^2]: long-period, diurnal and semidiurnal parts of degree 2, and degree 3. ``local`` is sidereal time."""
    ascension, declination = body.equatorial()
    hour = local - ascension
    sine, cosine = math.sin(latitude), math.cos(latitude)
    up, out = np.sin(declination), np.cos(declination)
    size = gm * radius**2 / body.distance**3
    long = 0.25 * size * (3.0 * sine**2 - 1.0) * (3.0 * up**2 - 1.0)
    diurnal = 3.0 * size * sine * cosine * up * out * np.cos(hour)
    semidiurnal = 0.75 * size * (cosine * out) ** 2 * np.cos(2.0 * hour)
    angle = sine * up + cosine * out * np.cos(hour)
    third = gm * radius**3 / body.distance**4 * 0.5 * (5.0 * angle**3 - 3.0 * angle)
    return (long, diurnal, semidiurnal), third
