"""The angle from a rate."""

from __future__ import annotations

import numpy as np
import pytest

from piga.records.arrays import integrated_rate


@pytest.mark.parametrize("start", [0.0, 0.7, 2.0])
def test_angle_from_rate_is_the_integral_from_the_first_sample(start: float) -> None:
    """Two stretches of a sine: ``h^3/24`` of the second derivative at both ends. Without slopes at the ends it is 8e-6 rad."""
    t = start + 0.01 * np.arange(400.0)
    begins = np.isin(np.arange(400), [0, 230])
    angle = integrated_rate(t, np.sin(t), begins)
    for part in (slice(0, 230), slice(230, 400)):
        turned = angle[part] - angle[part][0]
        assert turned == pytest.approx(np.cos(t[part][0]) - np.cos(t[part]), abs=1e-7)
