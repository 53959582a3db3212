"""The simulator: drift, case rotation, base motion, readout errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from piga import earth
from piga.errors import DataError
from piga.frames import axis_turn, matrix_to_rotation_vector, rotation_vector_to_matrix
from piga.platform import simulate
from piga.platform.geometry import (
    earth_to_geodetic,
    encoder_angle,
    geodetic_to_earth,
    gimbal_attitude,
    gravitation,
    gravity,
    local_axes,
    nulled_attitude,
    specific_force_at_rest,
)
from piga.platform.scenario import Gyro, MotionPlan, Sensors
from piga.platform.simulate import base_motion
from tests.platform.conftest import ARCSEC, DEG, published

pytestmark = pytest.mark.interpreted
SHORT = {"duration": 1200.0, "step": 2.0}


def test_gravitation_is_the_gradient_of_the_j2_potential():
    r = np.array([3.1e6, -2.2e6, 5.0e6])

    def potential(p):
        d = np.linalg.norm(p)
        legendre = 1.5 * (p[2] / d) ** 2 - 0.5
        return earth.GM / d * (1.0 - earth.J2 * (earth.SEMI_MAJOR_AXIS / d) ** 2 * legendre)

    slope = [(potential(r + 10.0 * e) - potential(r - 10.0 * e)) / 20.0 for e in np.eye(3)]
    np.testing.assert_allclose(gravitation(r), slope, rtol=0, atol=2e-9)


@pytest.mark.parametrize("latitude", [0.0, 20.0, 45.0, 70.0, 89.0])
def test_gravity_differs_from_the_closed_normal_formula_by_the_j4_term_only(latitude):
    difference = gravity(latitude * DEG) - float(earth.normal_gravity(latitude * DEG))
    s2 = np.sin(latitude * DEG) ** 2
    fourth = 5.0 * 2.37091e-6 * 9.7983 * (35.0 * s2 * s2 - 30.0 * s2 + 3.0) / 8.0
    assert abs(difference + fourth) < 3e-6
    assert abs(difference) < 1.2e-4


def test_geodetic_conversion_closes():
    lat, lon = np.radians([10.0, -52.0, 84.0]), np.radians([170.0, -3.0, 20.0])
    h = np.array([-100.0, 0.0, 9000.0])
    *angles, height = earth_to_geodetic(geodetic_to_earth(lat, lon, h))
    np.testing.assert_allclose(angles, [lat, lon], atol=1e-15)
    np.testing.assert_allclose(height, h, atol=3e-9)
    np.testing.assert_allclose(local_axes(0.0, 0.0), [[0, 0, -1], [0, 1, 0], [1, 0, 0]], atol=1e-16)


def test_readouts_follow_from_geometry_and_attitude_alone():
    s = published(**SHORT, triad=(0.02, -0.01, 0.03), motion=MotionPlan(roll=0.1, pitch=-0.2, heading=0.5))
    run = simulate(s)
    t, k = run.readouts.times, 377
    c1, c2 = (
        s.polar_rotation * t + s.polar.phase,
        s.equatorial_rotation * t + s.equatorial.phase,
    )
    eta = s.equatorial.drift[0] * t
    attitude, ring = nulled_attitude(s.polar, s.equatorial, c1, c2, eta)
    np.testing.assert_allclose(run.readouts.pickoff, ring, atol=1e-15)
    triad = rotation_vector_to_matrix(np.array(s.triad)).T
    to_inertial = axis_turn(2, -earth.EARTH_RATE * t[k])
    level = axis_turn(0, 0.1) @ axis_turn(1, -0.2) @ axis_turn(2, 0.5)
    base = local_axes(s.place.latitude, s.place.longitude) @ level.T
    np.testing.assert_allclose(
        gimbal_attitude(run.readouts.gimbals[k]), attitude[k] @ triad @ to_inertial @ base, atol=1e-14
    )
    force = specific_force_at_rest(geodetic_to_earth(s.place.latitude, s.place.longitude, 0.0))
    np.testing.assert_allclose(run.truth.force[k], attitude[k] @ triad @ to_inertial @ force, atol=1e-13)


def test_increments_are_the_integral_of_the_force():
    s = published(duration=480.0, step=4.0)
    fine = simulate(replace(s, step=0.5))
    coarse = simulate(s)
    total = fine.readouts.increments.reshape(-1, 8, 3).sum(axis=1)
    np.testing.assert_allclose(coarse.readouts.increments, total, rtol=0, atol=2e-10)


def test_drift_follows_its_differential_equation():
    polar, equatorial = (
        Gyro(drift=(2e-6, -1e-6), case_drift=(3e-6, 0.0)),
        Gyro(drift=(4e-6, 1e-6), case_drift=(0.0, 2e-6)),
    )
    s = published(duration=3000.0, step=2.0, polar=polar, equatorial=equatorial, redundancy=0.2)
    run = simulate(s)
    rate = s.polar_rotation

    def slope(t, state):
        c, si = np.cos(rate * t), np.sin(rate * t)
        w1x, w1y = 2e-6 + 3e-6 * c, -1e-6 + 3e-6 * si
        w2y, w2z = 4e-6 - 2e-6 * si, 1e-6 + 2e-6 * c
        eta = state[9]
        w = np.array([w1x, w1y, w2z / np.cos(eta) - w1x * np.tan(eta)])
        cross = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return np.append((-cross @ state[:9].reshape(3, 3)).ravel(), w2y - w1y)

    end = solve_ivp(slope, (0.0, 3000.0), np.append(np.eye(3).ravel(), 0.2), rtol=1e-12, atol=1e-14).y[:, -1]
    difference = matrix_to_rotation_vector(run.truth.triad_end @ end[:9].reshape(3, 3).T)
    assert np.abs(difference).max() < 1e-8
    assert abs(run.truth.eta[-1] - end[9]) < 1e-8


def test_case_rotation_averages_the_case_fixed_drift():
    gyro = Gyro(case_drift=(1e-6, 0.0))
    for rotation, reversal in ((2.0 * np.pi / 480.0, 0), (2.0 * np.pi / 480.0, 1), (0.0, 0)):
        turning = {"polar_rotation": rotation, "reversal": reversal}
        s = published(duration=4800.0, step=4.0, polar=gyro, equatorial=Gyro(), **turning)
        turned = np.linalg.norm(matrix_to_rotation_vector(simulate(s).truth.triad_end))
        if rotation == 0.0:
            assert turned == pytest.approx(4.8e-3, rel=1e-6)
        else:
            assert turned < 1e-6


def test_reversal_turns_back_after_so_many_turns():
    angle = encoder_angle(2.0 * np.pi / 100.0, 2, [0.0, 50.0, 200.0, 250.0, 400.0, 450.0]) / np.pi
    np.testing.assert_allclose(angle, [0.0, 1.0, 4.0, 3.0, 0.0, 1.0], atol=1e-12)


def test_sway_gives_the_force_of_its_acceleration():
    plan = MotionPlan("sway", north_sway=(0.5, 20.0), down_sway=(0.3, 8.0))
    s = published(duration=60.0, step=0.5, motion=plan)
    motion = base_motion(s)
    h = 0.5 * s.step
    still = specific_force_at_rest(geodetic_to_earth(s.place.latitude, s.place.longitude, 0.0))
    level = (motion.force - still) @ local_axes(s.place.latitude, s.place.longitude)
    t = np.arange(len(level)) * h
    np.testing.assert_allclose(level[:, 0], -0.5 * (np.pi / 10) ** 2 * np.sin(np.pi / 10 * t), atol=3e-5)
    np.testing.assert_allclose(level[:, 2], -0.3 * (np.pi / 4) ** 2 * np.sin(np.pi / 4 * t), atol=3e-5)
    np.testing.assert_allclose(motion.velocity[:, 0], 0.05 * np.pi * np.cos(np.pi / 10 * t[::2]), atol=1e-6)


HEAD = "time_s,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg\n"


def test_track_is_read_and_felt(tmp_path):
    rows = [HEAD.strip()]
    rows += [f"{t},{40.0 + 1e-4 * t},116.0,{0.1 * t},0,0,0" for t in range(0, 700, 50)]
    (tmp_path / "track.csv").write_text("\n".join([*rows, ""]))
    s = published(duration=600.0, step=2.0, motion=MotionPlan("track", file=tmp_path / "track.csv"))
    motion = base_motion(s)
    radius = (
        6378137.0
        * (1 - earth.ECCENTRICITY_SQUARED)
        / (1 - earth.ECCENTRICITY_SQUARED * np.sin(40.03 * DEG) ** 2) ** 1.5
    )
    assert motion.velocity[150, 0] == pytest.approx(1e-4 * DEG * (radius + 30.0), rel=1e-6)
    assert motion.velocity[150, 2] == pytest.approx(-0.1, abs=1e-6)
    assert motion.place[150, 0] == pytest.approx(40.03 * DEG, abs=1e-10)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "time_s,latitude_deg\n0,1\n1,1\n2,1\n3,1\n4,1\n",
            "no column 'longitude_deg'(?s:.*)roll_deg, pitch_deg",
        ),
        ("x\n", "a header but no data(?s:.*)time_s, latitude_deg"),
        (HEAD + "0,1,1,1,1,1,1\n" * 3, "3 rows(?s:.*)4 rows or more"),
        (HEAD + "0,1,1,1,1,1,1\n" * 4 + "0,1,x,1,1,1,1\n", "row 6, column 'longitude_deg'(?s:.*)'x'"),
        (HEAD + "0,1,1,1,1,1,1\n" * 4 + "0,1,,1,1,1,1\n", "row 6, column 'longitude_deg' is empty"),
        (HEAD + "0,1,1,1,1,1,1\n" * 5, "row 3: the time does not increase"),
        (HEAD + "".join(f"{t},1,1,1,1,1,1\n" for t in range(5)), "covers 0 s to 4 s(?s:.*)needs 0 to 600 s"),
    ],
)
def test_a_bad_track_is_refused_by_row_and_column(tmp_path, text, message):
    (tmp_path / "track.csv").write_text(text)
    with pytest.raises(DataError, match=message):
        base_motion(published(duration=600.0, motion=MotionPlan("track", file=tmp_path / "track.csv")))


def test_noise_depends_on_the_seed_alone_and_has_the_size_asked_for():
    s = published(
        **SHORT, sensors=Sensors(gimbal_noise=2 * ARCSEC, pickoff_noise=ARCSEC, velocity_random_walk=1e-4)
    )
    quiet, first, again, other = (
        simulate(x).readouts for x in (replace(s, sensors=Sensors()), s, s, replace(s, seed=2))
    )
    np.testing.assert_array_equal(first.gimbals, again.gimbals)
    assert np.abs(first.gimbals - other.gimbals).max() > 0.0
    assert (first.gimbals - quiet.gimbals).std() == pytest.approx(2 * ARCSEC, rel=0.1)
    assert (first.pickoff - quiet.pickoff).std() == pytest.approx(ARCSEC, rel=0.15)
    assert (first.increments - quiet.increments).std() == pytest.approx(1e-4 * np.sqrt(2.0), rel=0.1)


def test_quantised_increments_lose_no_velocity():
    s = published(**SHORT)
    exact = simulate(s).readouts.increments
    pulses = simulate(replace(s, sensors=Sensors(increment_quantisation=1e-3))).readouts.increments
    assert np.abs(np.cumsum(pulses - exact, axis=0)).max() <= 0.5001e-3
    np.testing.assert_allclose(np.round(pulses / 1e-3), pulses / 1e-3, atol=1e-6)
