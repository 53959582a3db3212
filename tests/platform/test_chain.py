"""Three gyro accelerometers solved together; the drift that the navigator is told; the error budget."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from piga import earth
from piga.errors import ArgumentError
from piga.platform import error_budget, load_scenario
from piga.platform.chain import _drift, standard_sources
from piga.platform.scenario import PigaSensors
from piga.platform.simulate import TRIPOD, gimbal_angles, locked, read_increments
from tests.platform.conftest import DEG, EXAMPLES, alignment, published

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


# -- error budget ------------------------------------------------------------------------------------------

SOURCES = list(standard_sources().items())


def test_the_budget_lists_every_source_and_their_sum():
    sources = dict(SOURCES[:2])
    s = published(duration=3600.0, step=10.0)
    rows = error_budget(s, sources)
    assert [r.source for r in rows] == [*sources, "all together"]
    one, two = sources.values()
    (both, _) = error_budget(s, {"both": {"attitude": one["attitude"] + two["attitude"]}})
    assert rows[2].position_linear_m == pytest.approx(both.position_linear_m, rel=1e-4)
    assert rows[2].velocity_linear_m_s == pytest.approx(both.velocity_linear_m_s, rel=1e-4)


def test_the_budget_has_the_size_of_the_schuler_oscillation():
    """A level bias b moves by ``2 b / w_s^2`` and ``b / w_s``, a velocity v by ``v / w_s``."""
    s, bias, schuler2 = published(duration=7200.0, step=10.0), 9.80665e-6, earth.GM / earth.SEMI_MAJOR_AXIS**3
    z, north = error_budget(s, {"z": {"bias": (0.0, 0.0, bias)}, "north": {"velocity": (1e-3, 0.0, 0.0)}})[:2]
    level = bias * np.cos(40 * DEG)
    assert z.position_linear_m == pytest.approx(2.0 * level / schuler2, rel=0.01)
    assert z.velocity_linear_m_s == pytest.approx(level / np.sqrt(schuler2), rel=0.01)
    assert north.position_linear_m == pytest.approx(1e-3 / np.sqrt(schuler2), rel=0.01)


def test_sources_of_the_budget_act_on_one_axis_each() -> None:
    std = (1e-6, 2e-6, 3e-6, 4e-9, 5e-9, 6e-9, 7e-6, 8e-6, 9e-6)
    sources = list(standard_sources(alignment(std=std)).values())
    np.testing.assert_allclose([s["attitude"] for s in sources[:3]], np.diag(std[:3]))
    np.testing.assert_allclose([s["drift"] for s in sources[3:6]], np.eye(3) * np.radians(1e-5) / 3600.0)
    np.testing.assert_allclose([s["bias"] for s in sources[6:9]], np.eye(3) * 9.80665e-6)
