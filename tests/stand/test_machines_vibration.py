"""Vibration table: drives, their levels and frequencies, motion added to gravity."""

import numpy as np
import pytest

from piga.earth import EARTH_RATE
from piga.errors import ArgumentError
from piga.stand import (
    Drive,
    Imperfections,
    VibrationTable,
    force_change,
)
from piga.stand.profile import NONE
from tests.stand.stands import SITE, derivative


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


def test_bad_drives_are_refused():
    with pytest.raises(ArgumentError, match="does not fit twice"):
        Drive("sine", 0.5, 1.0)
    with pytest.raises(ArgumentError, match="above"):
        Drive("random", 5.0, 2.0, 1.0)
    with pytest.raises(ArgumentError, match="positive"):
        Drive("sine", -5.0)
    with pytest.raises(ArgumentError, match="none given"):
        VibrationTable(SITE, ())
