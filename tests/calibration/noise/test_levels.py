"""Noise levels are found, and the spline that finds them is the natural one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from piga.calibration.noise import levels
from piga.calibration.noise.levels import Noise, find_noise, natural_spline
from piga.calibration.noise.settings import NOISE

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
    noise = find_noise(np.diff(angle), np.full(n, step), step, 0, 1e-15)
    if white > 1e-8:
        assert noise.angle_rms == pytest.approx(white, rel=0.02)
    if walk > 0.0:
        corner = walk * np.sqrt(step) / white
        assert noise.angle_random_walk == pytest.approx(walk, rel=4.0 / np.sqrt(2.0 * n * min(corner, 1.0)))
    else:
        assert noise.angle_random_walk < 2e-7
    assert noise.close_to(Noise(white**2, walk**2), step, n, tolerance=0.5) or walk in (0.0, 1e-6)


def test_natural_spline() -> None:
    rng = np.random.default_rng(3)
    x, at = np.cumsum(rng.uniform(0.5, 2.0, 9)), np.linspace(-1.0, 14.0, 400)
    y = rng.standard_normal(9)
    expected = CubicSpline(x, y, bc_type="natural")(at)
    np.testing.assert_allclose(
        natural_spline(x, y)(at), expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max()
    )


@pytest.mark.only_compiled
@pytest.mark.parametrize(("white", "walk"), [(3e-5, 0.0), (3e-5, 1e-7), (3e-5, 1e-5), (1e-9, 1e-4)])
def test_the_first_rows_of_a_long_record_do_not_decide(
    white: float, walk: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The levels are those of a search over all rows; faint walks are not seen in the first rows."""
    rng = np.random.default_rng(3)
    n, step = 4 * NOISE.first_rows + 1, 0.01
    walked = np.cumsum(walk * np.sqrt(step) * rng.standard_normal(n))
    d, h = (
        np.diff(white * rng.standard_normal(n + 1), prepend=0.0)[1:] + np.diff(walked, prepend=0.0),
        np.full(n, step),
    )
    short = find_noise(d, h, step, 0, 1e-15)
    near = find_noise(d, h, step, 0, 1e-15, near=Noise(short.white, 30.0 * short.walk + 1e-20))
    monkeypatch.setattr(levels, "is_long", lambda _: False)
    whole = find_noise(d, h, step, 0, 1e-15)
    for one in (short, near):
        if white > 1e-8:  # else the walk hides it
            assert one.angle_rms == pytest.approx(whole.angle_rms, rel=1e-4)
        assert one.angle_random_walk == pytest.approx(whole.angle_random_walk, rel=0.01, abs=0.01 * 3e-8)


def test_the_walk_of_a_long_record_has_to_settle() -> None:
    """A walk of 1e-8 of the white noise in a step is most of what a mean rate over a million rows is uncertain by."""
    one, other = Noise(1.0, 1e-8), Noise(1.0, 1.2e-8)
    assert one.close_to(other, 1.0, 1000)
    assert not one.close_to(other, 1.0, 1_000_000)
    assert one.close_to(Noise(1.0, 1.01e-8), 1.0, 1_000_000)
    assert Noise(1.0, 1e-14).close_to(Noise(1.0, 2e-13), 1.0, 1_000_000)
