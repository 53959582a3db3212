"""Scenarios and runs shared by the platform tests."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest

from piga.platform import (
    Alignment,
    Navigation,
    PlatformRun,
    PlatformScenario,
    compensator,
    load_scenario,
    navigate,
    simulate,
    true_knowledge,
)
from piga.platform.navigator import true_start
from piga.platform.observation import tip_of
from piga.platform.scenario import Gyro, Harmonic, MotionPlan, Place, Sensors

DEG = np.pi / 180.0
ARCMIN = DEG / 60.0
ARCSEC = DEG / 3600.0
EXAMPLES = Path(__file__).parents[2] / "examples"
INTERPRETED = bool(numba.config.DISABLE_JIT)

long = pytest.mark.long
"""Days of one-second steps."""


def published(**changes) -> PlatformScenario:
    """The published case; ten days at 1 Hz unless changed."""
    turning = 2.0 * np.pi / 480.0
    values = {
        "place": Place(40.0 * DEG, 116.0 * DEG),
        "duration": 864000.0,
        "polar_rotation": turning,
        "equatorial_rotation": turning,
        "polar": Gyro(4.0 * ARCMIN, 20.0 * DEG),
        "equatorial": Gyro(4.0 * ARCMIN, 75.0 * DEG, drift=(0.01 * DEG / 3600.0, 0.0)),
    }
    return PlatformScenario(**(values | changes))


def wobbling(**changes) -> PlatformScenario:
    """The published case with wobble and readout noise."""
    polar = (Harmonic(2, 0.3 * ARCMIN, 60.0 * DEG), Harmonic(3, 0.05 * ARCMIN, 130.0 * DEG))
    equatorial = (Harmonic(2, 0.3 * ARCMIN, 100.0 * DEG), Harmonic(3, 0.05 * ARCMIN, 10.0 * DEG))
    noise = Sensors(gimbal_noise=ARCSEC, pickoff_noise=ARCSEC, velocity_random_walk=1e-5)
    values = {
        "polar": Gyro(4.0 * ARCMIN, 20.0 * DEG, polar),
        "equatorial": Gyro(4.0 * ARCMIN, 75.0 * DEG, equatorial, drift=(0.01 * DEG / 3600.0, 0.0)),
        "sensors": noise,
    }
    return published(**(values | changes))


HARMONICS = (Harmonic(1, 0.2 * ARCMIN, 0.3), Harmonic(2, 0.25 * ARCMIN, 1.0), Harmonic(3, 0.05 * ARCMIN, 2.0))


def swaying(*waves) -> MotionPlan:
    """A base that sways in roll, pitch, heading, north, east and down with these amplitudes and periods."""
    names = [f"{name}_sway" for name in ("roll", "pitch", "heading", "north", "east", "down")]
    return MotionPlan("sway", **dict(zip(names, waves, strict=True)))


AT_SEA = swaying((0.03, 9.0), (0.02, 7.0), (0.02, 11.0), (0.3, 9.0), (0.3, 12.0), (0.3, 8.0))
NOISE = Sensors(gimbal_noise=ARCSEC, pickoff_noise=ARCSEC, velocity_random_walk=1e-4)


def calibration(**changes) -> PlatformScenario:
    """A short static run with harmonics in both gyros, for identification."""
    values = {
        "duration": 3600.0 if INTERPRETED else 7200.0,
        "step": 8.0 if INTERPRETED else 1.0,
        "polar": Gyro(4.0 * ARCMIN, 20.0 * DEG, HARMONICS),
        "equatorial": Gyro(4.0 * ARCMIN, 75.0 * DEG, HARMONICS[::-1], drift=(0.01 * DEG / 3600.0, 0.0)),
        "triad": (0.02, -0.03, 0.01),
    }
    return published(**(values | changes))


def truth(s, orders=3):
    """The Cartesian unknowns that an identification should find."""
    known = true_knowledge(s)
    tips = [tip_of(known.polar, orders), tip_of(known.equatorial, orders)]
    return np.concatenate([*tips, [known.eta0, known.eta_rate]])


def without_errors(s: PlatformScenario) -> PlatformScenario:
    """The scenario with perfect gyros and sensors: what the navigator alone does."""
    return replace(s, polar=Gyro(), equatorial=Gyro(), sensors=Sensors())


def navigated(s: PlatformScenario, model="none", **options) -> tuple[PlatformRun, Navigation]:
    """A run, and its navigation with this model from the true start."""
    run = simulate(s)
    made = compensator(model, true_knowledge(s), run.readouts)
    return run, navigate(run.readouts, made, true_start(run.truth), **options)


def alignment(drift: tuple[float, ...] = (0.0, 0.0, 0.0), std: tuple[float, ...] = (1.0,) * 9) -> Alignment:
    """An alignment at the place of the published case, with this drift and these standard uncertainties."""
    place = load_scenario(EXAMPLES / "platform-published.toml").place
    return Alignment(place, np.eye(3), np.array(drift), np.eye(3), np.diag(np.square(std)), {}, 1.0)
