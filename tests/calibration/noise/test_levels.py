"""Noise levels are found, and the spline that finds them is the natural one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from piga.calibration.noise.levels import Noise, find_noise, natural_spline

pytestmark = pytest.mark.compiled


@pytest.mark.only_compiled
@pytest.mark.parametrize(("white", "walk"), [(3e-5, 0.0), (3e-5, 1e-6), (3e-5, 1e-4), (1e-9, 1e-4)])
def test_noise_levels_are_found(white: float, walk: float) -> None:
    """Levels of 40 000 samples within four standard deviations of what such a record can tell."""
    rng = np.random.default_rng(7)
    n, step = 40_000, 0.01
    angle = white * rng.standard_normal(n + 1) + np.concatenate(
        ([0.0], np.cumsum(walk * np.sqrt(step) * rng.standard_normal(n)))
    )
    noise = find_noise(np.diff(angle), np.full(n, step), 0, 1e-15)
    if white > 1e-8:
        assert noise.angle_rms == pytest.approx(white, rel=0.02)
    if walk > 0.0:
        corner = walk * np.sqrt(step) / white
        assert noise.angle_random_walk == pytest.approx(walk, rel=4.0 / np.sqrt(2.0 * n * min(corner, 1.0)))
    else:
        assert noise.angle_random_walk < 2e-7
    assert noise.close_to(Noise(white**2, walk**2), step, tolerance=0.5) or walk in (0.0, 1e-6)


def test_natural_spline() -> None:
    rng = np.random.default_rng(3)
    x, at = np.cumsum(rng.uniform(0.5, 2.0, 9)), np.linspace(-1.0, 14.0, 400)
    y = rng.standard_normal(9)
    expected = CubicSpline(x, y, bc_type="natural")(at)
    np.testing.assert_allclose(
        natural_spline(x, y)(at), expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max()
    )
