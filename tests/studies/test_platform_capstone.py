"""Ten days with gyro accelerometers on the platform: the story in numbers, and one passage against stationary phase."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from piga.errors import ArgumentError
from piga.platform.scenario import Compensation, Gyro, PigaSensors, Sensors
from piga.platform.simulate import TRIPOD, gimbal_angles, locked, mounting_axes, read_increments, simulate
from piga.studies.platform import capstone
from tests.platform.conftest import DEG, long, published

pytestmark = pytest.mark.interpreted

PIGA = PigaSensors(0.8884 / 9.80665, np.arctan(3.6e-4), mounting="skewed", cone=TRIPOD)


def _capstone_scenario(**changes):
    values = {
        "polar": Gyro(1e-3, 0.3),
        "equatorial": Gyro(1e-3, 1.3),
        "sensors": Sensors("piga", piga=msgspec.structs.replace(PIGA, cone=35 * DEG)),
        "compensation": Compensation(misalignment="true", attitude="true"),
    }  # fmt: skip
    return published(**(values | changes))


@long
def test_the_story_of_the_capstone():
    result = capstone(_capstone_scenario(duration=2 * 86400.0))
    o = {name: outcome.position for name, outcome in result.outcomes.items()}
    assert o["raw tripod"] > 500.0
    assert o["raw skewed"] < 0.05 * o["raw tripod"]
    assert abs(o["triad"] - o["ideal"]) < 0.2
    assert o["triad, calibrated"] < 3.0 * o["ideal"]
    assert result.outcomes["raw tripod"].locked_per_day.min() > 10.0
    assert result.outcomes["raw skewed"].locked_per_day.max() == 0.0


@long
def test_a_passage_leaves_what_stationary_phase_says():
    """The starting angle is one for which the phase at the passage is near its worst."""
    sensors = Sensors("piga", piga=msgspec.structs.replace(PIGA, cone=35 * DEG, alpha0=(2.0, 0.1, 0.5)))
    outcome = capstone(_capstone_scenario(duration=7200.0, polar=Gyro(), equatorial=Gyro(), sensors=sensors))
    p = outcome.passage
    run = simulate(replace(outcome.scenario, sensors=Sensors()))
    tripod = msgspec.structs.replace(sensors.pigas, cone=TRIPOD, tan_beta_error=0.0, phase_error=0.0)
    times, force = run.readouts.times[: p.part.stop], run.truth.force[: p.part.stop]
    alpha = gimbal_angles(tripod, times, force, np.zeros((times.size - 1, 3)))[:, p.part]
    axis = mounting_axes(tripod)[p.instrument, 0]
    along = force[p.part] @ axis
    true = 0.5 * (along[1:] + along[:-1]) * run.readouts.step
    raw, triad = (
        read_increments(msgspec.structs.replace(tripod, output=output), times[p.part], alpha) @ axis - true
        for output in ("raw", "triad")
    )
    assert np.abs(triad).max() < 1e-3 * np.abs(raw).max()
    assert 0.9 * p.velocity_error < abs(raw.sum()) < 1.05 * p.velocity_error
    assert p.lock_time > 20.0 * locked(tripod, force[p.part])[:, p.instrument].sum() * run.readouts.step


def test_the_capstone_needs_gyro_accelerometers():
    with pytest.raises(ArgumentError, match="accelerometers = 'piga'"):
        capstone(published(duration=1200.0, step=4.0))
