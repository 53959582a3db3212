"""Ten days with gyro accelerometers on the platform: the story in numbers."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from piga.errors import ArgumentError
from piga.platform.scenario import Compensation, Gyro, PigaSensors, Sensors
from piga.platform.simulate import TRIPOD
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


def test_the_capstone_needs_gyro_accelerometers():
    with pytest.raises(ArgumentError, match="accelerometers = 'piga'"):
        capstone(published(duration=1200.0, step=4.0))
