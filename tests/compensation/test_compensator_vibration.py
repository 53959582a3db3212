"""Vibration near the Nyquist frequency: an interval hides part of it, and k2 rectifies what it hides.

The truth is a force on a grid 64 times finer than the samples, with own sums.
"""

from __future__ import annotations

import numpy as np
import pytest

import piga
from piga.compensation import Mounted, SetCompensator
from piga.records import Run
from piga.units import G0, MICRO_G
from tests.compensation.twin_data import K_G, calibration_of

H, FINE, ROWS = 0.01, 64, 1200
K2 = 6e-6


def white(seed, band, rms):
    """White force [g] up to ``band`` times the Nyquist frequency on the fine grid."""
    rng, count = np.random.default_rng(seed), ROWS * FINE + 1
    spectrum = rng.standard_normal((count // 2 + 1, 2)) @ np.array([1.0, 1.0j])
    frequency = np.fft.rfftfreq(count, H / FINE)
    spectrum[(frequency > 0.5 * band / H) | (frequency == 0.0)] = 0.0
    force = np.fft.irfft(spectrum, count)
    return force * (rms / force.std())


def means(fine):
    """Means over the intervals, by the trapezoidal rule."""
    return (0.5 * (fine[1:] + fine[:-1])).reshape(ROWS, FINE).mean(axis=1)


def record(force, indicated, transverse=None, noise=0.0, seed=0):
    """Record of angles that an indicated force [g] turns."""
    psi = K_G * np.concatenate(([0.0], np.cumsum(means(indicated)))) * H
    psi += noise * np.random.default_rng(seed + 99).standard_normal(psi.size)
    f = np.zeros((psi.size, 3))
    f[:, 0] = force[::FINE] * G0
    if transverse is not None:
        f[:, 1] = transverse[::FINE] * G0
    return Run.from_arrays(np.arange(psi.size) * H, psi, f, scale_factor=K_G / G0, units="SI")


def with_k2(k2=K2, **more):
    return calibration_of({"scale_factor": K_G, "k2": k2}, **more)


def shaken(seed, band, rms=5.0):
    force = 1.0 + white(seed, band, rms)
    return force, record(force, force + K2 * force**2)


@pytest.mark.long
@pytest.mark.parametrize("band", [0.6, 2.0, 6.0])
def test_hidden_variance_stands_in_the_uncertainty(band):
    """Without the term u is zero, and the mean up to 106 micro-g wrong: more than twice u in 1 of 20 records at most."""
    misses = 0
    for seed in range(20):
        force, run = shaken(seed, band)
        result = piga.compensate(run, with_k2())
        error = result.ax[1:].mean() / G0 - means(force).mean()
        u = np.sqrt(np.mean(result.u_ax[200:] ** 2)) / G0
        misses += abs(error) > 2.0 * u
        assert 1e-6 < u < 3e-4
        assert result.flagged("vibration")[200:].mean() > 0.95
        assert any("Nyquist" in note for note in result.notes)
    assert misses <= 1


def test_smooth_vibration_and_quiet_force_are_not_flagged():
    for samples in (12, 30):
        t = np.arange(ROWS * FINE + 1) * H / FINE
        force = 1.0 + 5.0 * np.sin(2.0 * np.pi * t / (samples * H))
        run = record(force, force + K2 * force**2)
        assert not piga.compensate(run, with_k2()).flagged("vibration").any()
    quiet = 1.0 + white(3, 2.0, 0.05)
    assert not piga.compensate(record(quiet, quiet + K2 * quiet**2), with_k2()).flagged("vibration").any()


def test_stated_noise_of_the_angle_is_no_vibration():
    force = np.ones(ROWS * FINE + 1)
    run = record(force, force + K2, noise=2e-3)
    assert not piga.compensate(run, with_k2(angle_rms=2e-3)).flagged("vibration").any()
    assert piga.compensate(run, with_k2(angle_rms=2e-4)).flagged("vibration")[100:].all()


@pytest.mark.long
def test_shaken_reference_is_rectified_by_k_YY():
    """Samples of a white reference hide a third of its variance."""
    k_YY, misses = 2e-5, 0
    for seed in range(10):
        across = white(seed, 1.0, 3.0)
        force = np.ones(across.size)
        run = record(force, force + k_YY * across**2, across)
        result = piga.compensate(run, calibration_of({"scale_factor": K_G, "k_YY": k_YY}))
        error = result.ax[1:].mean() / G0 - 1.0
        u = np.sqrt(np.mean(result.u_ax[200:] ** 2)) / G0
        assert 2e-5 < abs(error) < 1e-4
        misses += abs(error) > 2.0 * u or u > 2e-4
        assert result.flagged("vibration")[200:].all()
    assert misses == 0


@pytest.mark.long
@pytest.mark.parametrize("count", [3, 4])
def test_set_has_the_flag_and_the_uncertainty_of_each_component(count):
    force = 1.0 + white(5, 3.0, 5.0)
    still = np.full(force.size, 0.5)
    skew = np.array([[1, 1, 1], [1, -1, 0], [1, 1, -2]]) / np.sqrt([[3], [2], [6]])
    axes = [*(np.roll(np.eye(3), -i, axis=0) for i in range(3)), skew][:count]
    field = np.array([force, still, still])
    psi = []
    for one in axes:
        along = one[0] @ field
        psi.append(record(along, along + K2 * along**2).output)
    stream = SetCompensator([Mounted(with_k2(), one) for one in axes])
    result = stream.push(np.arange(ROWS + 1) * H, np.array(psi))
    u = np.sqrt(np.mean(result.u_f[200:] ** 2, axis=0)) / MICRO_G
    assert abs(result.f[1:, 0].mean() / G0 - means(force).mean()) < 2e-6 * u[0]
    assert 50.0 < u[0] < 300.0
    assert count > 3 or u[1] < 1.0
    assert result.flagged("vibration")[200:].all()
    assert "Nyquist" in stream.remarks()[0]


def test_rate_samples_hide_nothing_but_are_flagged():
    force = 1.0 + white(6, 1.0, 5.0)
    rate = K_G * (force + K2 * force**2)[::FINE]
    f = np.zeros((rate.size, 3))
    run = Run.from_arrays(np.arange(rate.size) * H, rate, f, scale_factor=K_G / G0, kind="rate", units="SI")
    result = piga.compensate(run, with_k2())
    assert np.abs(result.ax / G0 - force[::FINE]).max() < 1e-9
    assert np.nanmax(result.u_ax) < 1e-9
    assert result.flagged("vibration")[200:].all()
    assert "between the samples" in result.notes[-1]
