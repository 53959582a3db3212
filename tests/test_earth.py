"""Normal gravity against the theory of the level ellipsoid in 40 digits; Earth rate and site."""

from __future__ import annotations

import math

import mpmath as mp
import numpy as np
import pytest

from piga import earth
from piga.earth import Site, normal_gravity
from piga.errors import ArgumentError


def exact_gravity(pole: bool, height: float) -> float:
    """Derivative of the potential of the level ellipsoid along the axis, or along the equator."""
    with mp.workdps(40):
        a, gm, w = mp.mpf(6378137), mp.mpf("3.986004418e14"), mp.mpf("7.292115e-5")
        b = a * (1 - 1 / mp.mpf("298.257223563"))
        focal = mp.sqrt(a * a - b * b)

        def q(u: mp.mpf) -> mp.mpf:
            return ((1 + 3 * u * u / focal**2) * mp.atan(focal / u) - 3 * u / focal) / 2

        def potential(r: mp.mpf) -> mp.mpf:
            u = r if pole else mp.sqrt(r * r - focal**2)
            turned = 0 if pole else w * w * r * r / 2
            share = mp.mpf(2) / 3 if pole else -mp.mpf(1) / 3
            return gm / focal * mp.atan(focal / u) + w * w * a * a / 2 * q(u) / q(b) * share + turned

        return float(-mp.diff(potential, (b if pole else a) + height))


@pytest.mark.parametrize("pole", [True, False])
@pytest.mark.parametrize(("height", "tolerance"), [(0.0, 1e-9), (500.0, 1e-7), (10e3, 1e-6), (20e3, 5e-6)])
def test_gravity_is_that_of_the_level_ellipsoid(pole: bool, height: float, tolerance: float) -> None:
    latitude = math.pi / 2 if pole else 0.0
    assert normal_gravity(latitude, height) == pytest.approx(exact_gravity(pole, height), abs=tolerance)


def test_gravity_between_equator_and_pole() -> None:
    """Somigliana's form in semi-axes [m/s^2]."""
    latitude = np.radians([20.0, 45.0, 70.0])
    a, b = 6378137.0, 6378137.0 * (1 - 1 / 298.257223563)
    c2, s2 = np.cos(latitude) ** 2, np.sin(latitude) ** 2
    literal = (a * 9.7803253359 * c2 + b * 9.8321849379 * s2) / np.sqrt(a * a * c2 + b * b * s2)
    assert normal_gravity(latitude) == pytest.approx(literal, abs=1e-13)
    assert normal_gravity(-latitude, 100.0) == pytest.approx(normal_gravity(latitude, 100.0), abs=0)
    slope = (normal_gravity(latitude, 1.0) - normal_gravity(latitude, -1.0)) / 2
    m = earth.EARTH_RATE**2 * a**2 * b / earth.GM
    flattening = 1 - b / a
    assert slope == pytest.approx(-2 * literal / a * (1 + flattening + m - 2 * flattening * s2), rel=1e-8)


def test_shape_constants() -> None:
    """Derived constants as NIMA TR8350.2 prints them (table 3.3, 3.4)."""
    assert pytest.approx(6.69437999014e-3, abs=5e-15) == earth.ECCENTRICITY_SQUARED
    assert pytest.approx(9.7803253359, abs=0) == earth.GRAVITY_EQUATOR
    assert pytest.approx(9.8321849379, abs=0) == earth.GRAVITY_POLE


def test_second_zonal_harmonic_follows_from_the_shape() -> None:
    """``J2 = e^2/3 (1 - 2/15 m e'/q0)`` of the level ellipsoid."""
    with mp.workdps(40):
        e2 = mp.mpf(2) / mp.mpf("298.257223563") - 1 / mp.mpf("298.257223563") ** 2
        second = mp.sqrt(e2 / (1 - e2))
        q0 = ((1 + 3 / second**2) * mp.atan(second) - 3 / second) / 2
        a = mp.mpf(6378137)
        m = mp.mpf("7.292115e-5") ** 2 * a**3 * mp.sqrt(1 - e2) / mp.mpf("3.986004418e14")
        literal = e2 / 3 * (1 - 2 * m * second / (15 * q0))
    assert pytest.approx(float(literal), abs=2e-11) == earth.J2


def test_site() -> None:
    site = Site(math.radians(40.0), height=100.0)
    assert site.local_gravity == normal_gravity(math.radians(40.0), 100.0)
    assert Site(0.3, gravity=9.8) == Site(0.3, 0.0, 0.0, 9.8)
    assert Site(0.3, gravity=9.8).local_gravity == 9.8
    north, east, down = site.earth_rate_ned
    assert math.hypot(north, down) == pytest.approx(7.292115e-5, rel=1e-15)
    assert east == 0.0
    assert (north, down) == pytest.approx(
        (7.292115e-5 * math.cos(math.radians(40)), -7.292115e-5 * math.sin(math.radians(40))), rel=1e-15
    )


@pytest.mark.parametrize("latitude", [48.0, math.radians(-91.0), math.nan])
def test_a_latitude_beyond_a_pole_is_refused(latitude: float) -> None:
    with pytest.raises(ArgumentError, match="is beyond a pole"):
        Site(latitude)
    assert Site(-0.5 * math.pi).local_gravity == pytest.approx(9.8321849, abs=1e-6)
