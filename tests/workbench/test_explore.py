"""The figures of the page Explore."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from piga.instrument.twin.linear import loop_poles
from piga.instrument.twin.parameters import TwinParameters
from piga.workbench.pages.explore import SETTLED, _shown_step

TWIN = TwinParameters()


@pytest.mark.parametrize("changes", [{}, {"integral_gain": 20.0}, {"damping": 0.4}, {"proportional_gain": 5.0}])
def test_the_step_of_the_twin_fills_its_figure(changes: dict[str, float]) -> None:
    """It moves in more than a quarter of the time that is shown, and has settled at the end."""
    twin = replace(TWIN, **changes)
    t, response = _shown_step(twin, loop_poles(twin))
    seen = t[np.abs(response - 1.0) > SETTLED]
    assert seen[-1] > 0.25 * t[-1]
    assert abs(response[-1] - 1.0) < SETTLED
