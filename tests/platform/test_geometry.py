"""The exact nulled geometry: against 50-digit solutions, the small-angle matrices, and its own conditions."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from piga.frames import matrix_to_rotation_vector, skew
from piga.platform.geometry import (
    gimbal_attitude,
    gimbals_of,
    misalignment,
    nulled_attitude,
    small_angles,
)
from piga.platform.scenario import Gyro, Harmonic
from tests.platform.conftest import ARCMIN, DEG

CASES = json.loads((Path(__file__).parent / "data" / "geometry.json").read_text())["cases"]

pytestmark = pytest.mark.interpreted


def test_matches_the_null_conditions_solved_at_fifty_digits():
    for case in CASES:
        m1, c1, m2, c2, eta = case["input"]
        attitude, ring = nulled_attitude(Gyro(m1), Gyro(m2), c1, c2, eta)
        np.testing.assert_allclose(attitude[0], case["attitude"], rtol=0, atol=5e-16)
        assert abs(ring[0] - case["ring"]) < 4e-16


@pytest.mark.parametrize(("eta", "published"), [(1.0, 0.06982), (2.4, 0.16765), (5.0, 0.34995)])
def test_z_amplitude_is_that_of_the_small_angle_matrix(eta, published):
    c = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    attitude, _ = nulled_attitude(Gyro(4.0 * ARCMIN), Gyro(), c, 0.0, eta * DEG)
    z = -matrix_to_rotation_vector(attitude)[:, 2]
    amplitude = 2.0 * abs(np.mean(z * np.exp(-1j * c))) / ARCMIN
    small, _ = small_angles(Gyro(4.0 * ARCMIN), Gyro(), c, 0.0, eta * DEG)
    assert abs(amplitude - published) < 6e-6
    assert abs(np.abs(small[:, 2]).max() / ARCMIN - amplitude) < 1e-6


def test_the_small_angle_matrices_are_wrong_by_second_order():
    c1, c2 = np.linspace(0.0, 6.0, 50), np.linspace(1.0, 9.0, 50)

    def difference(m):
        exact, ring = nulled_attitude(Gyro(m), Gyro(0.8 * m), c1, c2, 0.1)
        e, pick = small_angles(Gyro(m), Gyro(0.8 * m), c1, c2, 0.1)
        return np.abs(exact - (np.eye(3) - skew(e))).max(), np.abs(ring - pick).max()

    for whole, half in zip(difference(2e-3), difference(1e-3), strict=True):
        assert 3.9 < whole / half < 4.1
        assert whole < 2.0 * (2e-3) ** 2


def test_harmonics_follow_their_definition_whatever_the_phase():
    gyro = Gyro(4.0 * ARCMIN, 0.7, (Harmonic(1, 1e-5, 0.2), Harmonic(3, 2e-5, -1.1)))
    c = np.linspace(0.0, 7.0, 40)
    expected = 4.0 * ARCMIN + 1e-5 * np.cos(c + 0.2) + 2e-5 * np.cos(3.0 * c - 1.1)
    np.testing.assert_allclose(misalignment(gyro, c), expected, rtol=0, atol=1e-18)
    attitude, _ = nulled_attitude(gyro, Gyro(), c, 0.0, 0.0)
    np.testing.assert_allclose(attitude[:, 1, 2], np.sin(expected) * np.cos(c), rtol=0, atol=1e-18)


def test_gimbal_angles_invert_the_gimbal_attitude():
    angles = np.array([[0.4, 2.2, -1.0], [-3.0, 1.1, 3.1], [2.0, 0.3, 0.0]])
    np.testing.assert_allclose(gimbals_of(gimbal_attitude(angles)), angles, atol=1e-15)
