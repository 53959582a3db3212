"""Earth tide: places of Sun and Moon and waves of the potential against published values; its way into a simulated test."""

from __future__ import annotations

import datetime as dt
from pathlib import Path

import numpy as np
import pytest

from piga.earth import Site
from piga.errors import ArgumentError, RunFileError
from piga.stand import DividingHead, read_scenario, run_scenario, sample_stand
from piga.stand import tide as tides
from piga.stand.tide import EarthTide

SITE = Site(np.radians(40.0), np.radians(116.0))
START = dt.datetime(2026, 11, 1, tzinfo=dt.UTC)


def centuries(*date: int) -> np.ndarray:
    since = dt.datetime(*date, tzinfo=dt.UTC) - dt.datetime(2000, 1, 1, 12, tzinfo=dt.UTC)
    return np.array([since.total_seconds() / (36525.0 * 86400.0)])


def test_places_of_sun_and_moon_against_worked_examples() -> None:
    """Meeus, Astronomical Algorithms, examples 47.a (Moon, 1992 April 12) and 25.a (Sun, 1992 October 13)."""
    moon, sun = tides.moon(centuries(1992, 4, 12)), tides.sun(centuries(1992, 10, 13))
    assert np.degrees(moon.longitude) % 360.0 == pytest.approx(133.162655, abs=5.0 / 60.0)
    assert np.degrees(moon.latitude) == pytest.approx(-3.229126, abs=5.0 / 60.0)
    assert moon.distance == pytest.approx(368_409_700.0, abs=500e3)
    assert np.degrees(sun.longitude) % 360.0 == pytest.approx(199.90988, abs=2.0 / 60.0)
    assert sun.distance == pytest.approx(0.99766 * 149_597_870_700.0, rel=1e-3)


def test_sidereal_time_against_a_worked_example() -> None:
    """Meeus, example 12.a: 1987 April 10, 0h UT, 13h 10m 46.3668s."""
    hours = np.degrees(tides.sidereal_time(centuries(1987, 4, 10))) / 15.0
    assert hours == pytest.approx(13.0 + 10.0 / 60.0 + 46.3668 / 3600.0, abs=1e-7)


S, H, P = 13.1763965268, 0.9856473354, 0.1114040803
TAU = 360.0 + H - S
WAVES = {
    "M2": (2 * TAU, 2, 0.90812), "S2": (2 * (TAU + S - H), 2, 0.42286), "N2": (2 * TAU - S + P, 2, 0.17387),
    "O1": (TAU - S, 1, 0.37689), "K1": (TAU + S, 1, 0.53050), "Mf": (2 * S, 0, 0.15642),
}  # fmt: skip
"""Speed [deg/day], order, and Doodson's coefficient [Doodson1921] of the greatest waves."""
DOODSON = 2.6277
"""Doodson's constant [m^2/s^2]."""


@pytest.fixture(scope="module")
def years() -> tuple[np.ndarray, np.ndarray]:
    """Times [s] over one turn of the Moon's node, and the tide at 30 deg."""
    t = np.arange(0.0, 6798.4 * 86400.0, 4.0 * 3600.0)
    return t, EarthTide(Site(np.radians(30.0)), dt.datetime(1997, 1, 1, tzinfo=dt.UTC)).gravity(t)


@pytest.mark.parametrize("name", list(WAVES))
def test_waves_have_the_published_size(name: str, years: tuple[np.ndarray, np.ndarray]) -> None:
    """``2 delta D C G(latitude)/r``: factors of O1, M2 and Mf, and that of K1, after [Dehant1999], to 1 %."""
    t, gravity = years
    rate, order, coefficient = WAVES[name]
    latitude = np.arctan((1.0 - 1.0 / 298.257223563) ** 2 * np.tan(np.radians(30.0)))
    radius = 6372824.0
    shape = [0.5 * (1.0 - 3.0 * np.sin(latitude) ** 2), np.sin(2 * latitude), np.cos(latitude) ** 2][order]
    factor = 1.135 if name == "K1" else (1.157, 1.154, 1.162)[order]
    expected = 2.0 * factor * DOODSON * (radius / 6.371e6) ** 2 * coefficient * shape / radius
    wave = np.exp(-1j * np.radians(rate) * t / 86400.0)
    amplitude = 2.0 * abs(np.mean((gravity - gravity.mean()) * wave))
    assert amplitude == pytest.approx(abs(expected), rel=0.01)


def test_gravity_is_least_under_the_moon() -> None:
    """A new moon overhead lifts the ground and takes weight away; a place a quarter of a turn away gains half of that."""
    when = dt.datetime(2026, 3, 19, 1, 23, tzinfo=dt.UTC)  # new moon near the equator
    here = np.array(
        [EarthTide(Site(0.0, angle), when).gravity(np.zeros(1))[0] for angle in np.linspace(-np.pi, np.pi, 73)]
    )
    assert here.min() == pytest.approx(-2.0 * here.max(), rel=0.1)
    overhead = float(np.degrees(tides.moon(centuries(2026, 3, 19, 1, 23)).equatorial()[0][0]))
    hour = (
        np.degrees(tides.sidereal_time(centuries(2026, 3, 19, 1, 23))[0])
        + np.linspace(-180.0, 180.0, 73)
        - overhead
    )
    assert abs(np.sin(np.radians(hour[np.argmin(here)]))) < 0.1


def test_the_instrument_feels_it_and_the_reference_may_have_it() -> None:
    head = DividingHead(SITE, (0.0, 1.0), 60.0, 30.0)
    plain = sample_stand(head, 1.0)
    for in_reference in (False, True):
        result = sample_stand(head, 1.0, tide=EarthTide(SITE, START, in_reference))
        change = np.linalg.norm(result.force, axis=1) - np.linalg.norm(plain.force, axis=1)
        np.testing.assert_allclose(change, EarthTide(SITE, START).gravity(result.t), atol=1e-14)
        assert np.array_equal(result.reference, plain.reference) != in_reference


def scenario(folder: Path, line: str) -> Path:
    text = (Path(__file__).parents[2] / "examples" / "dividing-head.toml").read_text()
    path = folder / "tide.toml"
    path.write_text(
        text.replace("[run]\n", f"[run]\n{line}\n").replace('"0:360:15 deg"', '["0 deg", "30 deg"]')
    )
    return path


def test_from_a_scenario(tmp_path: Path) -> None:
    plain = run_scenario(read_scenario(scenario(tmp_path, "")))
    tidal = run_scenario(read_scenario(scenario(tmp_path, "earth_tide = { start = 2026-11-21T08:00:00Z }")))
    assert np.abs(tidal.profile.force - plain.profile.force).max() > 1e-7
    np.testing.assert_array_equal(tidal.profile.reference, plain.profile.reference)
    with pytest.raises((ArgumentError, RunFileError), match="no time zone"):
        run_scenario(read_scenario(scenario(tmp_path, "earth_tide = { start = 2026-11-21T08:00:00 }")))
