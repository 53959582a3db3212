"""The navigator: conservation, order, damping, and what it shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from piga import earth
from piga._kernels.platform import height_and_normal
from piga.frames import axis_turn, skew
from piga.platform import Start, compensator, errors, navigate, simulate, true_knowledge
from piga.platform.geometry import (
    KERNEL_EARTH,
    earth_to_geodetic,
    geodetic_to_earth,
    gimbal_attitude,
    local_axes,
)
from piga.platform.navigator import inertial_states, true_start
from piga.platform.scenario import Gyro, MotionPlan
from tests.platform.conftest import INTERPRETED, long, navigated, published, swaying, without_errors

pytestmark = pytest.mark.interpreted


@long
def test_ten_static_days_without_errors_stand_still():
    s = without_errors(published())
    run, shown = navigated(s)
    e = errors(shown, run.truth, run.readouts)
    assert e.horizontal.max() < 1e-5
    assert np.abs(e.up).max() < 1e-6
    assert np.abs(e.velocity).max() < 1e-8
    assert np.abs(e.attitude).max() < 1e-12


def _orbit(step, steps, tilt=0.7):
    """A free orbit near the ground: no specific force, gravitation alone."""
    position = np.array([7.0e6, 0.0, 0.0])
    speed = np.sqrt(earth.GM / 7.0e6) * 1.02
    velocity = speed * np.array([0.0, np.cos(tilt), np.sin(tilt)])
    start = Start(position, velocity, np.eye(3), np.zeros(3))
    return inertial_states(start, step, np.zeros((steps, 3)), np.zeros((1, 3)), np.zeros(1), damping_time=0.0)


def _energy(r, v):
    d = np.linalg.norm(r, axis=1)
    legendre = 1.5 * (r[:, 2] / d) ** 2 - 0.5
    return 0.5 * np.sum(v * v, axis=1) - earth.GM / d * (
        1.0 - earth.J2 * (earth.SEMI_MAJOR_AXIS / d) ** 2 * legendre
    )


def test_a_free_orbit_keeps_energy_and_polar_angular_momentum():
    step, steps = (10.0, 3000) if INTERPRETED else (1.0, 200000)
    r, v = _orbit(step, steps)
    energy = _energy(r, v)
    spin = np.cross(r, v)[:, 2]
    assert np.ptp(energy) / abs(energy[0]) < (2e-7 if INTERPRETED else 2e-10)
    assert np.ptp(spin) / abs(spin[0]) < (2e-7 if INTERPRETED else 2e-10)


def test_the_step_is_of_fourth_order():
    end = [_orbit(h, round(1600.0 / h))[0][-1] for h in (5.0, 10.0, 20.0, 40.0)]
    error = [np.linalg.norm(x - end[0]) for x in end[1:]]
    orders = np.log2(np.array(error[1:]) / np.array(error[:-1]))
    assert np.all(orders > 3.6)


def test_rows_can_be_thinned():
    s = published(duration=600.0, step=2.0)
    _, dense = navigated(s, "A")
    _, thin = navigated(s, "A", every=7)
    np.testing.assert_array_equal(thin.position, dense.position[6::7])
    np.testing.assert_allclose(thin.table, dense.table[6::7], rtol=0, atol=1e-15)


def test_the_vertical_channel_is_unstable_alone_and_damped_by_altitude():
    s = without_errors(published(duration=2400.0, step=4.0))
    run = simulate(s)
    made = compensator("none", true_knowledge(s), run.readouts)
    start = true_start(run.truth)
    up = start.position / np.linalg.norm(start.position)
    lifted = replace(start, position=start.position + 1.0 * up)
    free = errors(navigate(run.readouts, made, lifted, damping_time=0.0), run.truth, run.readouts).up
    held = errors(navigate(run.readouts, made, lifted), run.truth, run.readouts).up
    growth = free[-1] / free[-1 - round(570.0 / 4.0)]
    assert growth == pytest.approx(np.e, rel=0.03)
    assert abs(held[-1]) < 1e-4


def test_height_and_normal_are_those_of_the_ellipsoid():
    for lat, h in ((0.1, 0.0), (0.7, 120.0), (-1.2, 9000.0), (1.4, -50.0)):
        x, y, z = geodetic_to_earth(lat, 0.4, h)
        r = np.sqrt(x * x + y * y + z * z)
        height, *normal = height_and_normal(x, y, z, 1.0 / r, *KERNEL_EARTH[2:])
        assert abs(height - h) < 4e-5 * abs(h) / 9000.0 + 1e-8
        np.testing.assert_allclose(normal, -local_axes(lat, 0.4)[:, 2], atol=6e-6 * abs(h) / 9000.0 + 1e-12)


def test_what_is_shown_follows_from_the_matrices():
    s = published(
        duration=600.0, step=2.0, triad=(0.01, 0.02, -0.03), motion=MotionPlan(roll=0.1, pitch=0.2, heading=2.5)
    )
    run, shown = navigated(s, "B")
    made = compensator("B", true_knowledge(s), run.readouts)
    k = 250
    t = shown.times[k]
    to_earth = axis_turn(2, earth.EARTH_RATE * t)
    r = to_earth @ shown.position[k]
    lat, lon, h = earth_to_geodetic(r)
    np.testing.assert_allclose(shown.table[k, :3], [lat, lon, h], atol=3e-9)
    v = to_earth @ shown.velocity[k] - np.cross([0, 0, earth.EARTH_RATE], r)
    axes = local_axes(lat, lon)
    np.testing.assert_allclose(shown.table[k, 3:6], axes.T @ v, atol=1e-11)
    e = made.nodes[k + 1]
    triad = run.truth.triad_start
    base = axes.T @ to_earth @ triad.T @ (np.eye(3) - skew(e)).T @ gimbal_attitude(run.readouts.gimbals[k + 1])
    roll, pitch, heading = shown.table[k, 6:]
    level = axis_turn(0, roll) @ axis_turn(1, pitch) @ axis_turn(2, heading)
    np.testing.assert_allclose(level.T, base, atol=3e-6)
    np.testing.assert_allclose([roll, pitch, heading], [0.1, 0.2, 2.5], atol=5e-6)


def test_a_swaying_base_is_followed():
    motion = swaying((0.05, 9.0), (0.03, 7.0), (0.02, 13.0), (0.5, 20.0), (0.4, 16.0), (0.3, 12.0))
    s = without_errors(published(duration=600.0, step=0.5, motion=motion))
    run = simulate(s)
    readouts = replace(run.readouts, altitude=np.zeros(1))
    made = compensator("none", true_knowledge(s), readouts)
    e = errors(navigate(readouts, made, true_start(run.truth), damping_time=0.0), run.truth, readouts)
    assert np.abs(e.velocity).max() < 2e-6
    assert e.horizontal.max() < 1e-3


def test_a_known_drift_is_taken_out():
    drift = (3e-7, -2e-7)
    s = published(duration=3600.0, step=4.0, polar=Gyro(drift=drift), equatorial=Gyro(drift=(drift[1], 0.0)))
    run = simulate(s)
    made = compensator("none", true_knowledge(s), run.readouts)
    start = true_start(run.truth)
    left = errors(navigate(run.readouts, made, start), run.truth, run.readouts)
    known = replace(start, drift=np.array([*drift, 0.0]))
    taken = errors(navigate(run.readouts, made, known), run.truth, run.readouts)
    assert left.horizontal.max() > 100.0
    assert taken.horizontal.max() < 0.01
    assert np.abs(taken.attitude).max() < 1e-7
