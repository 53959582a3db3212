"""Earth tide: size and periods of the known constituents, and its way into a simulated test."""

from __future__ import annotations

import datetime as dt
from pathlib import Path

import numpy as np
import pytest

from piga.earth import Site
from piga.errors import ArgumentError, RunFileError
from piga.stand import DividingHead, read_scenario, run_scenario, sample_stand
from piga.stand.tide import EarthTide

pytest.importorskip("pysolid")

SITE = Site(np.radians(40.0), np.radians(116.0))
START = dt.datetime(2026, 11, 1, tzinfo=dt.UTC)
HOURS = 3600.0


def amplitude(t: np.ndarray, gravity: np.ndarray, period: float) -> float:
    phase = 2.0 * np.pi * t / period
    return 2.0 * abs(np.mean((gravity - gravity.mean()) * np.hanning(t.size) * 2.0 * np.exp(1j * phase)))


def test_the_tide_has_the_known_size_and_lines() -> None:
    """M2 in gravity is 0.743 um/s^2 delta cos^2(latitude) at most: 0.50 here; O1 and K1 are of like size."""
    t = np.arange(0.0, 59.06 * 24 * HOURS, 600.0)
    gravity = EarthTide(SITE, START).gravity(t)
    assert 1.0e-6 < np.abs(gravity).max() < 2.2e-6
    m2 = amplitude(t, gravity, 12.4206012 * HOURS)
    assert m2 == pytest.approx(0.743e-6 * 1.16 * np.cos(SITE.latitude) ** 2, rel=0.15)
    assert amplitude(t, gravity, 25.8193417 * HOURS) == pytest.approx(
        0.310e-6 * 1.16 * np.sin(2.0 * SITE.latitude), rel=0.2
    )
    assert amplitude(t, gravity, 17.0 * HOURS) < 0.05 * m2


def test_gravity_is_less_when_the_ground_is_lifted() -> None:
    tide = EarthTide(SITE, START)
    times, up = tide._displacement(0.0, 24 * HOURS)
    inside = (times >= 0.0) & (times <= 24 * HOURS)
    gravity = tide.gravity(times[inside])
    assert np.corrcoef(gravity, up[inside])[0, 1] == pytest.approx(-1.0, abs=1e-12)


def test_the_instrument_feels_it_and_the_reference_may_have_it() -> None:
    head = DividingHead(SITE, (0.0, 1.0), 60.0, 30.0)
    plain = sample_stand(head, 1.0)
    for in_reference in (False, True):
        found = sample_stand(head, 1.0, tide=EarthTide(SITE, START, in_reference))
        change = np.linalg.norm(found.force, axis=1) - np.linalg.norm(plain.force, axis=1)
        np.testing.assert_allclose(change, EarthTide(SITE, START).gravity(found.t), atol=1e-14)
        assert np.array_equal(found.reference, plain.reference) != in_reference


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
