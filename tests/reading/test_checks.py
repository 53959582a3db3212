"""The angle from a rate."""

from __future__ import annotations

import numpy as np
import pytest

from piga.reading.checks import integrated_rate
from piga.records import arrays


@pytest.mark.parametrize("start", [0.0, 0.7, 2.0])
def test_angle_from_rate_is_the_integral_from_the_first_sample(start: float) -> None:
    """Two stretches of a sine: ``h^3/24`` of the second derivative at both ends. Without slopes at the ends it is 8e-6 rad."""
    t = start + 0.01 * np.arange(400.0)
    begins = np.isin(np.arange(400), [0, 230])
    angle = integrated_rate(t, np.sin(t), begins)
    for part in (slice(0, 230), slice(230, 400)):
        turned = angle[part] - angle[part][0]
        assert turned == pytest.approx(np.cos(t[part][0]) - np.cos(t[part]), abs=1e-7)


def test_angle_from_rate_does_not_depend_on_the_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(2)
    t = np.cumsum(0.01 + 1e-3 * rng.random(200))
    rate, begins = np.sin(t), np.zeros(200, dtype=bool)
    begins[[0, 90, 91, 150]] = True
    whole = integrated_rate(t, rate, begins)
    for rows in (1, 2, 3, 90, 151):
        monkeypatch.setattr(arrays, "BLOCK_ROWS", rows)
        assert integrated_rate(t, rate, begins).tobytes() == whole.tobytes()
