"""Uncertainty of the velocity: coefficients act on all rows together, noise of the angle at the ends of the stretches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import piga
from piga.compensation import Mounted, SetCompensator
from piga.records import Run
from piga.units import G0
from tests.compensation.triads import SKEWED, rotation
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of, constant_force, run_of

H, ROWS = 0.01, 400
VALUES = {"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.3, "k0": 1e-3, "k2": 2e-5}
STD = {"scale_factor": 2e-5, "tan_beta": 3e-5, "phi": 2e-3, "k0": 3e-5, "k2": 4e-6}
WHITE, WALK = 2e-4, 3e-4


def correlated(cal):
    """Correlation -0.6 of scale factor and bias."""
    names, matrix = [c.name for c in cal.coefficients], cal.covariance.copy()
    i, j = names.index("scale_factor"), names.index("k0")
    matrix[i, j] = matrix[j, i] = -0.6 * np.sqrt(matrix[i, i] * matrix[j, j])
    return replace(cal, covariance=matrix)


def moved(cal, rng):
    """The calibration with coefficients drawn from its covariance."""
    drawn = rng.multivariate_normal([c.value for c in cal.coefficients], cal.covariance)
    pairs = zip(cal.coefficients, drawn, strict=True)
    return replace(cal, coefficients=tuple(replace(c, value=float(v)) for c, v in pairs))


def noise(rng, t):
    steps = np.diff(t, prepend=t[0])
    return WHITE * rng.standard_normal(t.size) + WALK * np.cumsum(
        np.sqrt(np.abs(steps)) * rng.standard_normal(t.size)
    )


def gapped(kind="angle"):
    """A record of two stretches with a gap of 2 s."""
    t = np.arange(ROWS) * H
    run = run_of(t, constant_force(t, 1.1, 2.0, -0.5), phi=0.3, kind=kind)
    return Run.from_arrays(
        np.where(np.arange(ROWS) < 150, t, t + 2.0),
        run.output,
        run.f,
        scale_factor=K_G / G0,
        kind=kind,
        units="SI",
    )


CAL = correlated(calibration_of(VALUES, STD, angle_rms=WHITE, angle_random_walk=WALK))


@pytest.mark.parametrize("kind", ["angle", "rate"])
@pytest.mark.long
def test_scatter_of_the_velocity_is_its_uncertainty(kind):
    """Coefficients and noise drawn 300 times; the standard deviation of 300 draws has a standard error of 4 %."""
    run, rng, velocities = gapped(kind), np.random.default_rng(1), []
    whole = piga.compensate(run, CAL)
    for _ in range(300):
        noisy = noise(rng, run.t)
        output = run.output + (noisy if kind == "angle" else 0.0)
        drawn = piga.compensate(replace(run, output=output), moved(CAL, rng), uncertainty=False)
        velocities.append(drawn.dv.sum())
    expected = np.hypot(
        np.std(velocities), 0.0 if kind == "angle" else np.hypot(2 * WHITE, WALK * 2) / (K_G / G0)
    )
    assert whole.u_velocity == pytest.approx(expected, rel=0.15)
    assert np.isnan(piga.compensate(run, CAL, uncertainty=False).u_velocity)


def test_each_part_alone():
    """Scale factor: in proportion to the velocity. Noise: at the ends of two stretches of 3.97 s together."""
    run = gapped()
    scale = calibration_of(VALUES, {"scale_factor": 1e-3 * K_G})
    result = piga.compensate(run, scale)
    bias = 1e-3 * G0 * (result.dv != 0.0).sum() * H
    squares = 2e-5 / G0 * (result.ax[result.dv != 0.0] ** 2).sum() * H
    gain = 1.0 / (1.0 + 2.0 * 2e-5 * 1.1)
    assert result.u_velocity == pytest.approx(
        1e-3 * (result.dv.sum() + bias + squares) * gain, rel=5e-3
    )  # less the mean coupling, 2.5e-3
    quiet = piga.compensate(run, calibration_of(VALUES, angle_rms=WHITE, angle_random_walk=WALK))
    time = (ROWS - 2) * H
    assert quiet.u_velocity == pytest.approx(np.sqrt(4 * WHITE**2 + WALK**2 * time) / (K_G / G0), rel=1e-4)


def test_a_force_that_is_zero_within_the_dead_zone():
    """Any force in the zone holds the output still: half-width ``a_t tan(beta)``, a rectangular distribution."""
    locked = piga.Compensator(calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.0}))
    locked.push({"t": H * np.arange(6), "output": np.zeros(6), "f": np.tile([0.0, G0, 0.0], (6, 1))})
    assert locked.u_velocity() == pytest.approx(5 * H * G0 * TAN_BETA / np.sqrt(3), abs=1e-12)


def test_phases_of_segments_are_coefficients_of_their_own():
    t = np.arange(ROWS) * H
    f = constant_force(t, 1.1, 4.0, -0.5)
    labels = np.where(t < 1.0, "a", "b")
    run = run_of(t, f, phi=0.3)
    run = Run.from_arrays(t, run.output, f, scale_factor=K_G / G0, segment=labels, units="SI")
    values = {"scale_factor": K_G, "tan_beta": TAN_BETA, "phi[a]": 0.3, "phi[b]": 0.3}
    each = [
        piga.compensate(run, calibration_of(values, {"phi[a]": a, "phi[b]": b})).u_velocity
        for a, b in ((1e-2, 0.0), (0.0, 1e-2), (1e-2, 1e-2))
    ]
    sums = [
        piga.compensate(run, calibration_of(values | moved)).dv.sum()
        for moved in ({}, {"phi[a]": 0.3001}, {"phi[b]": 0.3001})
    ]
    assert each[0] == pytest.approx(100.0 * abs(sums[1] - sums[0]), rel=1e-3)
    assert each[1] == pytest.approx(100.0 * abs(sums[2] - sums[0]), rel=1e-3)
    assert each[2] == pytest.approx(np.hypot(each[0], each[1]), rel=1e-9)


def test_noise_alone_of_a_skewed_set():
    """Noise of each angle at both ends, by the inverse of the axes, some of whose parts are negative."""
    t, axes = np.arange(ROWS) * H, [rotation(angles) for angles in SKEWED[:3]]
    cal = calibration_of(VALUES, angle_rms=WHITE, angle_random_walk=WALK)
    psi = [run_of(t, np.tile(one @ [9.0, 5.0, 7.0], (t.size, 1)), phi=0.3).output for one in axes]
    stream = SetCompensator([Mounted(cal, one) for one in axes])
    stream.push(t, psi)
    single = np.sqrt(2 * WHITE**2 + WALK**2 * t[-1]) / (K_G / G0)
    inverse = np.linalg.inv([one[0] for one in axes])
    assert stream.u_velocity() == pytest.approx(single * np.linalg.norm(inverse, axis=1), rel=2e-2)


@pytest.mark.parametrize("count", [3, 4])
@pytest.mark.long
def test_scatter_of_the_velocity_of_a_set(count):
    t, rng = np.arange(ROWS) * H, np.random.default_rng(2)
    force = np.array([0.9, 0.5, 0.7]) * G0
    skew = np.array([[1, 1, 1], [1, -1, 0], [1, 1, -2]]) / np.sqrt([[3], [2], [6]])
    axes = [*(np.roll(np.eye(3), -i, axis=0) for i in range(3)), skew][:count]
    psi = [run_of(t, np.tile(one @ force, (t.size, 1)), phi=0.3).output for one in axes]

    def solve(calibrations, angles, uncertainty):
        mounted = [Mounted(cal, one) for cal, one in zip(calibrations, axes, strict=True)]
        stream = SetCompensator(mounted, uncertainty=uncertainty)
        return stream.push(t, np.array(angles)).dv.sum(axis=0), stream

    _, stream = solve([CAL] * count, psi, True)
    drawn = [
        solve([moved(CAL, rng) for _ in axes], [one + noise(rng, t) for one in psi], False)[0]
        for _ in range(200)
    ]
    assert stream.u_velocity() == pytest.approx(np.std(drawn, axis=0), rel=0.2)
