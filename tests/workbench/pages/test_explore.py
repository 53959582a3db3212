"""The figures of the page Explore."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from piga import Instrument
from piga.instrument.twin.linear import loop_poles
from piga.instrument.twin.parameters import TwinParameters
from piga.workbench.pages.explore import SETTLED, _numbers, _shown_step

TWIN = TwinParameters()


@pytest.mark.parametrize("changes", [{}, {"integral_gain": 20.0}, {"damping": 0.4}, {"proportional_gain": 5.0}])
def test_the_step_of_the_twin_fills_its_figure(changes: dict[str, float]) -> None:
    """It moves in more than a quarter of the time that is shown, and has settled at the end."""
    twin = replace(TWIN, **changes)
    t, response = _shown_step(twin, loop_poles(twin))
    seen = t[np.abs(response - 1.0) > SETTLED]
    assert seen[-1] > 0.25 * t[-1]
    assert abs(response[-1] - 1.0) < SETTLED


def test_a_zone_that_is_empty_has_no_limits() -> None:
    inst = Instrument(scale_factor="0.8884 rad/s/g", beta="1000 arcsec")
    assert dict(_numbers(inst, (9.8, 0.0, 0.0)))["locked zone of a_x"] == "none"
    assert dict(_numbers(inst, (9.8, 9.80665, 0.0)))["locked zone of a_x"] == "-4.84817 to 4.84817 mg"
