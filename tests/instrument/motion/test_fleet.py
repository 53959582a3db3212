"""Batches: the same numbers as one motion at a time."""

import math

import numpy as np
import pytest

import piga
from piga.instrument import Instrument, propagate, propagate_fleet, propagate_rate
from piga.units import G0

pytestmark = pytest.mark.compiled

RNG = np.random.default_rng(7)
FLEET = [Instrument(0.09 + 0.001 * k, 0.01 * (k - 1), 0.5 * k) for k in range(3)]
T = np.arange(400) * 0.02
INPUTS = RNG.normal(0.0, 2 * G0, (3, T.size, 3))
OMEGA = RNG.normal(0.0, 0.1, (3, T.size, 3))


@pytest.mark.parametrize("workers", [None, 1, 3])
def test_rows_are_single_runs_to_the_bit(workers):
    shared = propagate_fleet(FLEET, T, INPUTS[0], workers=workers)
    assert np.array_equal(shared, [propagate(inst, T, INPUTS[0]) for inst in FLEET])
    inputs = propagate_fleet(FLEET[1], T, INPUTS, workers=workers)
    assert np.array_equal(inputs, [propagate(FLEET[1], T, f) for f in INPUTS])
    paired = propagate_fleet(FLEET, T, INPUTS, OMEGA, output="rate", workers=workers)
    single = [propagate_rate(inst, T, f, w) for inst, f, w in zip(FLEET, INPUTS, OMEGA, strict=True)]
    assert np.array_equal(paired, single)


def test_one_base_rate_for_all():
    rows = propagate_fleet(FLEET, T, INPUTS[0], [1e-4, 0.0, 5e-5])
    assert np.array_equal(rows[2], propagate(FLEET[2], T, INPUTS[0], [1e-4, 0.0, 5e-5]))
    assert np.array_equal(propagate_fleet(FLEET[:1], T, INPUTS[0]), [propagate(FLEET[0], T, INPUTS[0])])


def test_faults_name_motion_and_index():
    bad = INPUTS.copy()
    bad[2, 5, 1] = math.nan
    with pytest.raises(piga.ArgumentError, match=r"motion 2: f: nan at index \(5, 1\)"):
        propagate_fleet(FLEET, T, bad)
    with pytest.raises(piga.ArgumentError, match=r"do not match: .*'instruments': 2, 'f': 3"):
        propagate_fleet(FLEET[:2], T, INPUTS)
    with pytest.raises(piga.ArgumentError, match="do not match"):
        propagate_fleet([], T, INPUTS[0])
    with pytest.raises(piga.ArgumentError, match="output"):
        propagate_fleet(FLEET, T, INPUTS[0], output="velocity")


@pytest.mark.parametrize("scale", [0.01, 0.3])
def test_rate_is_the_same_with_and_without_the_angle(scale):
    """Small steps take the block path, large ones the step-by-step path."""
    t = T * scale / 0.02
    alpha, rate = propagate(FLEET[2], t, INPUTS[1], with_rate=True)
    assert np.array_equal(rate, propagate_rate(FLEET[2], t, INPUTS[1]))
    u = FLEET[2].scale_factor * INPUTS[1]
    expected = u[:, 0] + FLEET[2].tan_beta * (u[:, 1] * np.sin(alpha) - u[:, 2] * np.cos(alpha))
    assert rate == pytest.approx(expected, abs=1e-13)
