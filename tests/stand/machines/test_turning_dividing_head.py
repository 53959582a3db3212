"""Dividing head: values of a recorded tumble test, moves, imperfections to first order."""

import math
from dataclasses import replace

import numpy as np
import pytest

from piga.earth import EARTH_RATE
from piga.errors import ArgumentError
from piga.stand import (
    DividingHead,
    Imperfections,
    force_change,
    sample_stand,
)
from piga.stand.imperfections import NONE
from piga.stand.machines.turning import position_range
from piga.units import ARCSEC, G0
from tests.stand.stands import HEAD, SITE


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


def test_positions_and_moves_alternate():
    segments = HEAD.segments()
    assert [s.label for s in segments[:3]] == ["0", "move to 1", "1"]
    assert sum(s.recorded for s in segments) == 24
    assert segments[-1].stop == 24 * 60 + 23 * 30
    profile = sample_stand(HEAD, 0.5)
    rows = profile.recorded
    assert rows.sum() == 24 * 121
    assert profile.t[rows][120] == 60.0
    assert profile.t[rows][121] == 90.0


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


def test_gravity_and_earth_rate_keep_their_size_and_angle():
    for azimuth in (0.0, 0.7):
        f, omega = replace(HEAD, azimuth=azimuth, roll=0.3).motion(
            np.arange(24) * 90.0 + 1.0, Imperfections(levelling=(0.01, -0.02))
        )
        assert np.linalg.norm(f, axis=1) == pytest.approx(9.80166, abs=1e-12)
        assert np.linalg.norm(omega, axis=1) == pytest.approx(EARTH_RATE, rel=1e-12)
        assert (f * omega).sum(axis=1) == pytest.approx(
            9.80166 * EARTH_RATE * math.sin(math.radians(40)), rel=1e-9
        )


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


def test_bad_positions_are_refused():
    with pytest.raises(ArgumentError, match="range is empty"):
        position_range(0.0, 1.0, -0.1)
    with pytest.raises(ArgumentError, match="none given"):
        DividingHead(SITE, ())
    with pytest.raises(ArgumentError, match="must be positive"):
        DividingHead(SITE, (0.0,), dwell=-1.0)


def test_times_of_a_head_are_positive():
    assert DividingHead(SITE, (0.0,), dwell=0.5, move=0.5).segments()[0].duration == 0.5
    for name in ("dwell", "move", "settling_time"):
        with pytest.raises(ArgumentError, match="must be positive"):
            DividingHead(SITE, (0.0,), **{name: 0.0})
