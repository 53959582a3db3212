"""Three gyro accelerometers on the platform, solved together; the drift that the navigator is told."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from piga.errors import ArgumentError
from piga.platform import load_scenario
from piga.platform.chain import _drift
from piga.platform.scenario import PigaSensors
from piga.platform.simulate import TRIPOD, gimbal_angles, locked, read_increments
from tests.platform.conftest import DEG, EXAMPLES, alignment

pytestmark = pytest.mark.interpreted

PIGA = PigaSensors(0.8884 / 9.80665, np.arctan(3.6e-4), mounting="skewed", cone=TRIPOD)


def _sweep(n=400, step=1.0):
    t = np.arange(n + 1) * step
    angle = 2e-4 * t
    force = 9.8 * np.stack([np.cos(angle), 0.02 - np.sin(angle) * 0.7, 0.6 * np.ones_like(t)], axis=1)
    return t, force


@pytest.mark.parametrize("mounting", [{"mounting": "orthogonal"}, {"cone": TRIPOD}, {"cone": 0.5}])
@pytest.mark.parametrize("tan_beta", [3.6e-4, 5e-3])
def test_the_solved_force_is_the_true_one(mounting, tan_beta):
    t, force = _sweep()
    sensors = msgspec.structs.replace(PIGA, beta=np.arctan(tan_beta), **mounting)
    alpha = gimbal_angles(sensors, t, force, np.zeros((len(t) - 1, 3)))
    solved = read_increments(sensors, t, alpha)
    raw = read_increments(msgspec.structs.replace(sensors, output="raw"), t, alpha)
    mean = 0.5 * (force[1:] + force[:-1])
    assert np.abs(solved - mean).max() < 3e-6 * (tan_beta / 3.6e-4)
    assert np.abs(raw - mean).max() > 1.5 * tan_beta


def test_axes_within_the_latitude_of_the_pole_never_lock():
    angle = np.linspace(0.0, 2 * np.pi, 20001)
    gravity = 9.8 * np.stack(
        [np.cos(40 * DEG) * np.cos(angle), np.cos(40 * DEG) * np.sin(angle), np.sin(40 * DEG) + 0 * angle],
        axis=1,
    )
    assert locked(msgspec.structs.replace(PIGA, beta=np.arctan(5e-3)), gravity).any(axis=0).all()
    assert not locked(msgspec.structs.replace(PIGA, cone=35 * DEG, beta=np.arctan(5e-3)), gravity).any()
    share = locked(PIGA, gravity).mean()
    expected = (
        2
        * 2
        * 3.6e-4
        / (2 * np.pi)
        / (np.cos(40 * DEG) * np.sin(TRIPOD))
        / np.sqrt(1 - (np.tan(40 * DEG) / np.tan(TRIPOD)) ** 2)
    )
    assert share == pytest.approx(expected, rel=0.15)


def test_the_platforms_own_turn_is_read_and_known():
    t, force = _sweep()
    turn = np.tile([1e-6, -2e-6, 3e-6], (len(t) - 1, 1))
    still, turned = (read_increments(PIGA, t, gimbal_angles(PIGA, t, force, s)) for s in (0 * turn, turn))
    np.testing.assert_allclose(turned - still, -turn / PIGA.scale_factor, atol=3e-8)


def test_counting_loses_no_velocity():
    t, force = _sweep()
    counted = msgspec.structs.replace(PIGA, counts_per_revolution=72000.0)
    alpha = gimbal_angles(PIGA, t, force, np.zeros((len(t) - 1, 3)))
    off = read_increments(
        counted, t, gimbal_angles(counted, t, force, np.zeros((len(t) - 1, 3)))
    ) - read_increments(PIGA, t, alpha)
    assert np.abs(np.cumsum(off, axis=0)).max() < 2.0 * 2 * np.pi / 72000 / PIGA.scale_factor


def test_a_step_too_long_is_refused():
    t, force = _sweep(n=20, step=3.0)
    with pytest.raises(ArgumentError, match="third of a turn"):
        read_increments(PIGA, t, gimbal_angles(PIGA, t, force, np.zeros((20, 3))))


def test_the_drift_that_the_navigator_is_told() -> None:
    """None, that of the alignment, or the true one of the triad: ``w1x, w1y, w2z/cos(eta) - w1x tan(eta)`` [He2014]."""
    s = load_scenario(EXAMPLES / "platform-published.toml")
    w1x, w1y, w2z, eta = 3e-8, -2e-8, 5e-8, 0.3
    s = replace(
        s,
        polar=msgspec.structs.replace(s.polar, drift=(w1x, w1y)),
        equatorial=msgspec.structs.replace(s.equatorial, drift=(7e-8, w2z)),
        redundancy=eta,
    )
    aligned = alignment(drift=(1e-8, 2e-8, 3e-8))
    told = {
        kind: _drift(replace(s, compensation=msgspec.structs.replace(s.compensation, drift=kind)), aligned)
        for kind in ("none", "aligned", "true")
    }
    assert told["none"].tolist() == [0.0, 0.0, 0.0]
    assert told["aligned"].tolist() == [1e-8, 2e-8, 3e-8]
    np.testing.assert_allclose(told["true"], [w1x, w1y, w2z / np.cos(eta) - w1x * np.tan(eta)], rtol=1e-14)
