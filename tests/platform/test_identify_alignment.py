"""Alignment on the gravity cone and the gimbal angles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from piga.frames import matrix_to_rotation_vector
from piga.platform import align, compensator, errors, identify, navigate, simulate, true_knowledge
from piga.platform.scenario import Gyro, MotionPlan, Sensors
from tests.platform.conftest import ARCSEC, DEG, INTERPRETED, long, published

pytestmark = pytest.mark.interpreted


def _scenario(**changes):
    values = {
        "duration": 7200.0,
        "step": 8.0 if INTERPRETED else 2.0,
        "triad": (0.2, -0.3, 0.1),
        "motion": MotionPlan(roll=0.02, pitch=-0.03, heading=2.0),
    }
    return published(**(values | changes))


def test_without_noise_attitude_drift_and_base_are_found():
    polar = Gyro(1e-3, 0.3, drift=(2e-9, -1e-9))
    equatorial = Gyro(1e-3, 1.3, drift=(-1e-9, 3e-9))
    s = _scenario(polar=polar, equatorial=equatorial)
    run = simulate(s)
    alignment = align(run.readouts, s.place, true_knowledge(s))
    assert np.abs(matrix_to_rotation_vector(alignment.triad @ run.truth.triad_start)).max() < 2e-9
    np.testing.assert_allclose(alignment.drift, [2e-9, -1e-9, 3e-9], rtol=0, atol=2e-13)
    np.testing.assert_allclose(alignment.base_angles, [0.02, -0.03, 2.0], rtol=0, atol=2e-9)


def test_noise_levels_come_from_the_record():
    s = _scenario(sensors=Sensors(gimbal_noise=2 * ARCSEC, velocity_random_walk=3e-5))
    alignment = align(simulate(s).readouts, s.place, true_knowledge(s))
    assert alignment.noise["gimbals"] == pytest.approx(2 * ARCSEC, rel=0.08)
    assert alignment.noise["force"] == pytest.approx(3e-5 / np.sqrt(s.step), rel=0.08)


@long
def test_the_covariance_is_that_of_repeated_alignments():
    s = _scenario(sensors=Sensors(gimbal_noise=ARCSEC, velocity_random_walk=1e-5), step=8.0)
    scores = []
    for seed in range(60):
        run = simulate(replace(s, seed=seed))
        alignment = align(run.readouts, s.place, true_knowledge(s))
        off = matrix_to_rotation_vector(alignment.triad.T @ run.truth.triad_start.T)
        base = (alignment.base_angles - [0.02, -0.03, 2.0]) / alignment.base_stds
        scores.append(np.concatenate([off / alignment.std[:3], alignment.drift / alignment.std[3:6], base]))
    scores = np.array(scores)
    assert np.all(np.abs(scores.std(axis=0) - 1.0) < 0.35)
    assert 0.90 < np.mean(np.abs(scores) < 1.96) < 0.99


def test_the_aligned_triad_starts_the_navigation():
    s = _scenario(
        duration=7200.0, sensors=Sensors(gimbal_noise=ARCSEC, pickoff_noise=ARCSEC, velocity_random_walk=1e-6)
    )
    run = simulate(s)
    known = identify(run.readouts, s.place).knowledge
    alignment = align(run.readouts, s.place, known)
    made = compensator("B", known, run.readouts)
    e = errors(navigate(run.readouts, made, alignment.start(with_drift=True)), run.truth, run.readouts)
    assert e.horizontal.max() < (200.0 if INTERPRETED else 60.0)
    assert abs(np.median(e.attitude[:, 2])) < 10 * ARCSEC
    assert alignment.std[:3].max() < DEG
