"""Output electronics: counts, roll-over, clock, noise levels, interpolation."""

import math

import numpy as np
import pytest

from piga.errors import ArgumentError
from piga.instrument.electronics import (
    Electronics,
    held_noise,
    interpolate,
    output_phases,
    random_walk,
    read_output,
    sampling_times,
)

RNG = np.random.default_rng


def test_counts_are_the_nearest_and_wrap_at_the_width():
    e = Electronics(counts_per_revolution=1000, counter_bits=8, zero=0.5)
    alpha = RNG(3).uniform(0.5, 0.5 + 20 * math.pi, 4001)
    counts = read_output(e, alpha, alpha, RNG(0))
    assert counts.dtype == np.int64
    assert counts.min() == 0
    assert counts.max() == 255
    open_counts = read_output(Electronics(counts_per_revolution=1000, zero=0.5), alpha, alpha, RNG(0))
    assert np.all(counts == open_counts % 256)
    error = alpha - 0.5 - open_counts * 2 * math.pi / 1000
    assert np.abs(error).max() <= math.pi / 1000 * (1 + 1e-9)
    assert error.std() == pytest.approx(2 * math.pi / 1000 / math.sqrt(12), rel=0.02)


def test_phase_of_a_wrapping_counter_is_that_of_its_reading():
    e = Electronics(counts_per_revolution=1000, counter_bits=9, zero=0.2, sample_rate=100.0)
    alpha = np.linspace(5.0, 40.0, 3000) + np.repeat([0.0, 10.0, 17.0], 1000)
    counts = read_output(e, alpha, alpha, RNG(0))
    segment = np.repeat(np.arange(3, dtype=np.int32), 1000)
    phases = output_phases(e, alpha, counts, segment)
    psi = np.unwrap(counts, period=512) * 2 * math.pi / 1000
    for k in range(3):
        difference = alpha[1000 * k : 1000 * (k + 1)] - psi[1000 * k : 1000 * (k + 1)] - phases[k]
        assert np.abs(np.remainder(difference + math.pi, 2 * math.pi) - math.pi).max() < 2 * math.pi / 1000


def test_angle_and_rate_outputs():
    alpha, rate = np.linspace(0, 1, 1000), np.ones(1000)
    angle = read_output(Electronics(kind="angle", zero=0.3, angle_noise=1e-3), alpha, rate, RNG(1))
    assert (angle - alpha + 0.3).std() == pytest.approx(1e-3, rel=0.1)
    noisy = read_output(Electronics(kind="rate", angle_random_walk=1e-4, sample_rate=25.0), alpha, rate, RNG(1))
    assert noisy.std() == pytest.approx(5e-4, rel=0.1)
    assert np.all(read_output(Electronics(kind="rate"), alpha, rate, RNG(1)) == 1.0)


def test_noise_levels():
    ends = [random_walk(RNG(k), 101, 0.01, 2e-3)[-1] for k in range(1000)]
    assert np.std(ends) == pytest.approx(2e-3, rel=0.08)
    assert held_noise(RNG(0), 100000, 0.01, 2e-3).std() == pytest.approx(2e-3 / math.sqrt(0.02), rel=0.02)
    e = Electronics(clock_offset=1e-3, clock_jitter=1e-4)
    times = sampling_times(e, np.full(5000, 100.0), 1e-6, RNG(0))
    assert times.mean() == pytest.approx(100.0011, abs=1e-5)
    assert times.std() == pytest.approx(1e-4, rel=0.05)


def test_interpolation_is_exact_for_cubics_and_at_nodes():
    t = np.arange(11) * 0.1
    cubic, slope = 1 + 2 * t - t**2 + 3 * t**3, 2 - 2 * t + 9 * t**2
    at = np.array([0.0, 0.05, 0.33, 0.3, 1.0, 1.02])
    assert interpolate(t, 0.0, 0.1, cubic, slope) == pytest.approx(cubic, abs=0.0)
    assert interpolate(at, 0.0, 0.1, cubic, slope) == pytest.approx(1 + 2 * at - at**2 + 3 * at**3, abs=1e-14)


@pytest.mark.parametrize(
    "values", [{"sample_rate": 0.0}, {"counter_bits": 0}, {"angle_noise": -1.0}, {"clock_jitter": -1.0}]
)
def test_bad_electronics_are_refused(values):
    with pytest.raises(ArgumentError):
        Electronics(**values)


def test_the_phase_of_the_zero_lies_within_half_a_turn():
    segment = np.zeros(3, dtype=np.int32)
    for zero, phase in ((0.5, 0.5), (4.0, 4.0 - 2 * math.pi), (-10.0, -10.0 + 4 * math.pi)):
        phases = output_phases(Electronics(kind="angle", zero=zero), np.zeros(3), np.zeros(3), segment)
        assert phases == (pytest.approx(phase, abs=1e-15),)
    assert output_phases(Electronics(kind="rate", zero=0.5), np.zeros(3), np.zeros(3), segment) == (0.0,)
