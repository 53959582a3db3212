"""Stands of every kind: recorded values, kinematics in inertial space, imperfections, composites, logged profiles."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import csv, parquet

from piga.earth import EARTH_RATE
from piga.errors import ArgumentError, DataError
from piga.records.run_file import Columns, ColumnTable
from piga.stand import (
    Centrifuge,
    Composite,
    DividingHead,
    Drive,
    Imperfections,
    LoggedProfile,
    RateTable,
    SpinPlan,
    VibrationTable,
    force_change,
    sample_stand,
)
from piga.stand.machines import angles_of_range, rates_for_levels
from piga.stand.profile import NONE, read_profile
from piga.stand.scenario import head_positions
from piga.units import ARCSEC, G0
from tests.stand.simulated import SITE

HEAD = DividingHead(SITE, head_positions("0:360:15 deg"))
SPIN = SpinPlan((1.0, 4.0, 2.0), 2.0, 1.0)


def derivative(function, t, h=1e-4):
    return (function(t + h) - function(t - h)) / (2 * h)


@pytest.mark.parametrize(
    ("position", "force", "rate"),
    [
        (0, (0.99949116161, 0.0, 0.0), (4.687281170e-05, 0.0, 5.586084174e-05)),
        (1, (0.965434326146, -0.258687348036, 0.0), (4.527565938e-05, -1.213157637e-05, 5.586084174e-05)),
        (6, (0.0, -0.99949116161, 0.0), (0.0, -4.687281170e-05, 5.586084174e-05)),
        (15, (-0.70674697811, 0.70674697811, 0.0), (-3.314408301e-05, 3.314408301e-05, 5.586084174e-05)),
    ],
)
def test_positions_are_those_of_a_recorded_tumble_test(position, force, rate):
    """Values as a lab's log of this stand states them (g, rad/s)."""
    f, omega = HEAD.motion(np.array([90.0 * position + 30.0]), NONE)
    assert f[0] / G0 == pytest.approx(force, abs=1e-11)
    assert omega[0] == pytest.approx(rate, abs=1e-13)


def test_moves_turn_the_base_by_what_they_say():
    """The recorded base rate along Z0 integrates to the angle that the specific force shows."""
    t = np.arange(59.0, 92.0, 1e-3)
    f, omega = HEAD.motion(t, Imperfections(settling=20 * ARCSEC, angle_error=3 * ARCSEC))
    angle = np.unwrap(np.arctan2(-f[:, 1], f[:, 0]))
    turned = (
        np.concatenate([[0.0], np.cumsum(0.5 * (omega[1:, 2] + omega[:-1, 2]) * 1e-3)])
        - (t - t[0]) * 5.586084174e-05
    )
    assert angle - angle[0] == pytest.approx(turned, abs=1e-6)


def test_roll_turns_the_transverse_axes():
    f, omega = replace(HEAD, roll=math.pi / 2).motion(np.array([100.0]), NONE)
    plain_f, plain_omega = HEAD.motion(np.array([100.0]), NONE)
    assert f[0] == pytest.approx([plain_f[0, 0], 0.0, -plain_f[0, 1]], abs=1e-12)
    assert omega[0] == pytest.approx([plain_omega[0, 0], plain_omega[0, 2], -plain_omega[0, 1]], abs=1e-18)


@pytest.mark.parametrize(
    ("errors", "expected"),
    [
        (Imperfections(angle_error=ARCSEC), lambda x: -ARCSEC * np.sin(x)),
        (Imperfections(levelling=(ARCSEC, 0.0)), lambda x: -ARCSEC * np.sin(x)),
        (
            Imperfections(angle_harmonics=((2, ARCSEC, 0.3),)),
            lambda x: -ARCSEC * np.sin(2 * x + 0.3) * np.sin(x),
        ),
        (Imperfections(gravity=1e-5 * G0), lambda x: 1e-5 * G0 / 9.80166 * np.cos(x)),
        (Imperfections(reference_scale=1e-6), lambda x: 1e-6 * np.cos(x)),
        (Imperfections(reference_bias=(1e-5, 0, 0)), lambda x: 1e-5 / 9.80166 + 0 * x),
        (Imperfections(reference_misalignment=(0, 0, ARCSEC)), lambda x: -ARCSEC * np.sin(x)),
    ],
)
def test_imperfections_of_the_head_to_first_order(errors, expected):
    """Change of the specific force along the input axis, over g, by position angle."""
    t = np.arange(24) * 90.0 + 40.0
    change = force_change(HEAD, t, errors)[:, 0] / 9.80166
    assert change == pytest.approx(expected(np.array(HEAD.positions)), abs=2e-10)


def inertial(spindle, arm, t, h=2e-3):
    """Specific force of a point on an arm, in axes (north, west, up), from its place in inertial space.

    ``spindle(t)`` is the arm's angle from north over west; the Earth turns under the stand. The
    centripetal acceleration of the Earth is in gravity, so that of a point at rest is taken off.
    """
    axis = np.array([math.cos(SITE.latitude), 0.0, math.sin(SITE.latitude)])

    def place(time):
        local = (
            np.column_stack([np.cos(spindle(time)), np.sin(spindle(time)), np.zeros(time.size)])
            * arm(time)[:, None]
        )
        turn = EARTH_RATE * time
        cross = np.cross(axis, local)
        return local + np.sin(turn)[:, None] * cross + (1 - np.cos(turn))[:, None] * np.cross(axis, cross)

    # fourth-order second derivative, then back to local axes at each time
    steps = [place(t + k * h) for k in (-2, -1, 0, 1, 2)]
    second = (-steps[0] + 16 * steps[1] - 30 * steps[2] + 16 * steps[3] - steps[4]) / (12 * h * h)
    turn = -EARTH_RATE * t
    cross = np.cross(axis, second)
    local = second + np.sin(turn)[:, None] * cross + (1 - np.cos(turn))[:, None] * np.cross(axis, cross)
    return local + np.array([0.0, 0.0, 9.80166])


@pytest.mark.parametrize("counter_rotating", [False, True])
def test_centrifuge_force_is_the_second_derivative_of_its_place(counter_rotating):
    stand = Centrifuge(SITE, 1.3, SPIN, counter_rotating=counter_rotating)
    t = np.linspace(0.1, 7.9, 79)
    t = t[np.abs(t - np.round(t)) > 0.05]
    f, omega = stand.motion(t, NONE)
    # the arm points away from X0: at angle 0 the instrument is south of the spindle
    angle = SPIN.at(t, NONE)[0]
    truth = inertial(lambda s: SPIN.at(s, NONE)[0] + math.pi, lambda s: np.full(s.size, 1.3), t)
    c, s = np.cos(angle), np.sin(angle)
    if not counter_rotating:
        truth = np.column_stack(
            [c * truth[:, 0] + s * truth[:, 1], c * truth[:, 1] - s * truth[:, 0], truth[:, 2]]
        )
    assert f == pytest.approx(truth, abs=3e-7)
    spinning = 0.0 if counter_rotating else SPIN.at(t, NONE)[1]
    assert omega[:, 2] - spinning == pytest.approx(EARTH_RATE * math.sin(SITE.latitude), abs=1e-12)


def test_centrifuge_levels_come_out():
    levels = tuple(np.array([1.0, 5.0, 20.0]) * G0)
    for stretch in (0.0, 1e-5):
        spin = SpinPlan(rates_for_levels(levels, 0.8, stretch), 4.0, 2.0)
        f, _ = Centrifuge(SITE, 0.8, spin, stretch).motion(np.array([2.0, 8.0, 14.0]), NONE)
        assert f[:, 0] == pytest.approx(levels, rel=2e-4)
        f, _ = Centrifuge(SITE, 0.8, spin, stretch, outward=True).motion(np.array([2.0]), NONE)
        assert f[0, 0] == pytest.approx(-levels[0], rel=2e-4)
    with pytest.raises(ArgumentError, match="negative"):
        rates_for_levels((-1.0,), 1.0)


@pytest.mark.parametrize(
    ("errors", "relative"),
    [
        (Imperfections(arm_radius=1e-5), 1e-5 / 1.3),
        (Imperfections(arm_stretch=1e-7), 16e-7),
        (Imperfections(rate_error=1e-6), 2e-6),
    ],
)
def test_imperfections_of_the_centrifuge(errors, relative):
    stand = Centrifuge(SITE, 1.3, SPIN)
    t = np.linspace(3.0, 5.0, 20)
    assert force_change(stand, t, errors)[:, 0] / (1.3 * 16) == pytest.approx(relative, rel=1e-3)


def test_rate_ripple_and_tilt_go_round_once():
    stand = Centrifuge(SITE, 1.3, SPIN)
    t = np.linspace(3.0, 3.0 + 2 * math.pi / 4, 41)[:-1]
    angle = SPIN.at(t, NONE)[0]
    change = force_change(stand, t, Imperfections(rate_ripple=1e-6))[:, 0]
    assert change == pytest.approx(1.3 * 16 * 2e-6 * np.cos(angle), abs=1e-9)
    tilted = force_change(stand, t, Imperfections(levelling=(0.0, 1e-6)))[:, 0]
    assert np.abs(np.fft.fft(tilted)[1]) * 2 / t.size == pytest.approx(9.80166e-6, rel=1e-3)


def test_spin_integrates_and_differentiates():
    t = np.linspace(0.0, 8.0, 81)
    t = t[np.abs(t - np.round(t)) > 0.02]
    for errors in (NONE, Imperfections(rate_error=1e-2, rate_ripple=1e-2)):
        _, rate, acceleration = SPIN.at(t, errors)
        assert rate == pytest.approx(derivative(lambda s, e=errors: SPIN.at(s, e)[0], t), abs=1e-6)
        assert acceleration == pytest.approx(derivative(lambda s, e=errors: SPIN.at(s, e)[1], t), abs=1e-5)


def test_rate_table_turns_gravity_or_not():
    t = np.linspace(0.0, 2.0, 21)
    up, rate = RateTable(SITE, SPIN, along="X0").motion(t, NONE)
    assert up[:, 0] == pytest.approx(9.80166)
    assert rate[:, 0] == pytest.approx(1.0 + EARTH_RATE * math.sin(SITE.latitude))
    f, rate = RateTable(SITE, SPIN, along="Z0", horizontal=True).motion(t, NONE)
    assert f[:, 0] == pytest.approx(9.80166 * np.cos(t), abs=1e-12)
    assert f[:, 1] == pytest.approx(-9.80166 * np.sin(t), abs=1e-12)
    assert rate[:, 2] == pytest.approx(1.0 + EARTH_RATE * math.cos(SITE.latitude))
    away, _ = RateTable(SITE, SPIN, along="-X0").motion(t, NONE)
    assert away[:, 0] == pytest.approx(-9.80166)
    arm, _ = RateTable(SITE, SPIN, along="Z0", offset=0.2).motion(t, NONE)
    assert arm[:, 0] == pytest.approx(-0.2)
    with pytest.raises(ArgumentError, match="is not a base axis"):
        RateTable(SITE, SPIN, along="X1")


def test_an_error_of_gravity_is_felt_along_the_vertical():
    t = np.array([3.5, 4.5])
    for stand, axis in ((Centrifuge(SITE, 1.3, SPIN), 2), (RateTable(SITE, SPIN, along="X0"), 0)):
        change = force_change(stand, t, Imperfections(gravity=1e-3))
        assert change[:, axis] == pytest.approx(1e-3, rel=1e-9)
        assert np.delete(change, axis, axis=1) == pytest.approx(0.0, abs=1e-12)


def test_an_arm_on_the_table_feels_the_ramp():
    """Tangential force r w' on an offset arm, besides the centripetal one."""
    t = np.array([2.3, 2.5, 2.7])  # in the first ramp
    _, rate, acceleration = SPIN.at(t, NONE)
    f, _ = RateTable(SITE, SPIN, along="Z0", offset=0.2).motion(t, NONE)
    assert np.abs(acceleration).min() > 1.0
    assert f == pytest.approx(np.column_stack([-0.2 * rate**2, 0.2 * acceleration, np.full(3, 9.80166)]))


@pytest.mark.parametrize(
    "drive",
    [
        Drive("sine", 4.0, 3.0, amplitude=2.0),
        Drive("sweep", 4.0, 2.0, 8.0, amplitude=2.0),
        Drive("random", 4.0, 2.0, 8.0, amplitude=2.0, seed=3),
        Drive("rest", 4.0),
    ],
)
def test_drives_start_and_end_smoothly_and_differentiate(drive):
    t = np.linspace(0.01, 3.99, 200)
    value, rate = drive.acceleration(t)
    assert rate == pytest.approx(derivative(lambda s: drive.acceleration(s)[0], t, 1e-6), abs=1e-2)
    assert drive.acceleration(np.array([0.0, 4.0]))[0] == pytest.approx(0.0, abs=1e-12)
    assert np.abs(value).max() <= 4.5 * max(drive.amplitude, 1e-9)


def test_drive_levels_and_frequencies():
    t = np.arange(0, 40, 1e-3)
    random, _ = Drive("random", 40.0, 2.0, 8.0, amplitude=2.0).acceleration(t)
    assert random.std() == pytest.approx(2.0, rel=0.1)
    power = np.abs(np.fft.rfft(random)) ** 2
    frequency = np.fft.rfftfreq(t.size, 1e-3)
    assert power[(frequency > 1.9) & (frequency < 8.1)].sum() > 0.99 * power.sum()
    sweep, _ = Drive("sweep", 40.0, 2.0, 8.0, amplitude=1.0, taper=0.0).acceleration(t)
    crossings = t[1:][np.diff(np.signbit(sweep)) != 0]
    assert 0.5 / np.diff(crossings[:3]).mean() == pytest.approx(2.0, rel=0.05)
    assert 0.5 / np.diff(crossings[-3:]).mean() == pytest.approx(8.0, rel=0.05)


def test_vibration_table_adds_motion_to_gravity():
    stand = VibrationTable(
        SITE, (Drive("rest", 1.0), Drive("sine", 4.0, 5.0, amplitude=3.0)), axis="Y0", up="X0"
    )
    t = np.linspace(0.0, 5.0, 501)
    f, omega = stand.motion(t, NONE)
    assert f[:, 0] == pytest.approx(9.80166)
    assert f[:, 1].max() == pytest.approx(3.0, rel=1e-3)
    assert np.all(f[t < 1.0, 1] == 0.0)
    assert np.linalg.norm(omega, axis=1) == pytest.approx(EARTH_RATE)
    for up, axis in (("X0", 0), ("Y0", 1), ("Z0", 2)):
        still, _ = VibrationTable(SITE, (Drive("rest", 1.0),), up=up).motion(t[:3], NONE)
        assert still[:, axis] == pytest.approx(9.80166)
    across = force_change(stand, t, Imperfections(transverse_motion=1e-3))
    assert np.abs(across).max() == pytest.approx(3e-3, rel=1e-3)
    assert np.all(across[:, 1] == 0.0)
    rocking = force_change(stand, t, Imperfections(rocking=1e-5))
    assert np.abs(rocking).max() == pytest.approx(9.80166e-5, rel=1e-3)


def test_composite_is_its_parts_in_order():
    stand = Composite((replace(HEAD, positions=(0.0, 1.0)), Centrifuge(SITE, 1.0, SPIN)), pause=10.0)
    labels = [s.label for s in stand.segments()]
    assert labels[:4] == ["0.0", "0.move to 1", "0.1", "pause before 1"]
    f, _ = stand.motion(np.array([120.0, 165.0, 161.0]), NONE)
    first, _ = HEAD.motion(np.array([30.0]), NONE)
    second, _ = Centrifuge(SITE, 1.0, SPIN).motion(np.array([1.0]), NONE)
    assert f[2] == pytest.approx(second[0])
    assert np.linalg.norm(first) == pytest.approx(9.80166)
    start, _ = stand.motion(np.array([150.0, 155.0, 160.0]), NONE)
    assert start[1] == pytest.approx(0.5 * (start[0] + start[2]))
    assert {"arm_radius", "angle_error"} <= set(stand.accepted)
    only_arm = force_change(stand, np.array([30.0, 161.0]), Imperfections(arm_radius=1e-3))
    assert np.all(only_arm[0] == 0.0)
    assert only_arm[1, 0] == pytest.approx(1e-3, rel=1e-2)


FORCE = Columns(("fx", "fy", "fz"), "g")


def test_logged_profile_is_linear_between_samples(tmp_path):
    path = tmp_path / "profile.csv"
    path.write_text("t,fx,fy,fz,wx,wy,wz\n0,1,0,0,0,0,0\n1000,2,0,1,0.1,0,0\n3000,0,0,0,0,0,0\n")
    stand = read_profile(path, ColumnTable("t", "ms"), FORCE, Columns(("wx", "wy", "wz"), "rad/s"))
    f, omega = stand.motion(np.array([0.5, 2.0]), NONE)
    assert f / G0 == pytest.approx(np.array([[1.5, 0, 0.5], [1, 0, 0.5]]))
    assert omega[:, 0] == pytest.approx([0.05, 0.05])
    with pytest.raises(DataError, match="no column 'fq'"):
        read_profile(path, ColumnTable("t", "s"), Columns(("fq", "fy", "fz"), "g"))
    with pytest.raises(DataError, match="No such file"):
        read_profile(tmp_path / "none.csv", ColumnTable("t", "s"), FORCE)
    path.write_text("t,fx,fy,fz\n0,1,0,0\n1,,0,1\n")
    with pytest.raises(DataError, match="row 3, column 'fx' is empty"):
        read_profile(path, ColumnTable("t", "s"), FORCE)
    path.write_text("t,fx,fy,fz\n0,1,0,0\n1,0,0,1\n2,0,0,1")
    with pytest.raises(DataError, match="row 4 has no line end"):
        read_profile(path, ColumnTable("t", "s"), FORCE)
    with pytest.raises(ArgumentError, match="fewer than two, or do not increase"):
        LoggedProfile(np.array([0.0, 0.0]), np.zeros((2, 3)), np.zeros((2, 3)))


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_a_profile_is_read_from_both_formats(tmp_path, kind):
    """Times before the first and behind the last sample, on samples and between them; whole numbers before others."""
    t = np.cumsum(np.random.default_rng(1).uniform(0.5, 1.5, 3000))
    table = pa.table({"t": t, "x": np.sin(t), "y": np.arange(3000), "z": 0.1 * t, "note": ["-"] * 3000})
    path = tmp_path / f"profile.{kind}"
    (csv.write_csv if kind == "csv" else parquet.write_table)(table, path)
    read = read_profile(
        path, ColumnTable("t", "s"), Columns(("x", "y", "z"), "g"), Columns(("z", "z", "x"), "deg/s")
    )
    times = np.concatenate([t[[2999, 0, 1, 1700]] - t[0], [-5.0, 1e9, 7.7, 800.1]])
    force, rate = read.motion(times, NONE)
    assert force[:, 0] == pytest.approx(np.interp(times + t[0], t, np.sin(t)) * G0, abs=1e-12)
    assert rate[:, 1] == pytest.approx(np.radians(np.interp(times + t[0], t, 0.1 * t)), abs=1e-12)


def test_table_says_what_the_lab_assumes_and_what_is_felt():
    errors = Imperfections(reference_scale=1e-3, gravity=1e-3)
    profile = sample_stand(HEAD, 1.0, errors=errors)
    assert profile.reference[0] == pytest.approx([9.80166, 0, 0])
    assert profile.force[0, 0] == pytest.approx((9.80166 + 1e-3) * 1.001)
    fine = sample_stand(HEAD, 1.0, oversample=4, extra=3)
    assert fine.t[4] == 1.0
    assert fine.t.size == 4 * (profile.t.size - 1) + 1 + 3
    with pytest.raises(ArgumentError, match="not a multiple"):
        sample_stand(HEAD, 0.7)
    with pytest.raises(ArgumentError, match=r"\[imperfections\] arm_radius does not exist on a dividing-head"):
        sample_stand(HEAD, 1.0, errors=Imperfections(arm_radius=1e-3))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: angles_of_range("0:10:-1 deg", "positions", "0:360:15 deg"), "range is empty"),
        (lambda: DividingHead(SITE, ()), "none given"),
        (lambda: DividingHead(SITE, (0.0,), dwell=-1.0), "must be positive"),
        (lambda: SpinPlan((1.0,), 0.0, 1.0), "must be positive"),
        (lambda: Centrifuge(SITE, 0.0, SPIN), "radius"),
        (lambda: Composite(()), "no parts"),
        (lambda: Composite((HEAD,), pause=0.0), "pause"),
        (
            lambda: LoggedProfile(np.array([0.0, 1.0]), np.zeros((2, 3)), np.full((2, 3), np.nan)),
            "2 rows of three finite numbers",
        ),
        (lambda: Drive("sine", 0.5, 1.0), "does not fit twice"),
        (lambda: Drive("random", 5.0, 2.0, 1.0), "above"),
        (lambda: VibrationTable(SITE, ()), "none given"),
    ],
)
def test_machines_that_cannot_be_are_refused(make, words: str) -> None:
    with pytest.raises(ArgumentError, match=words):
        make()
