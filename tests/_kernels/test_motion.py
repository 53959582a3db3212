"""Steps of the motion against 50-digit arithmetic and their own definitions."""

import math

import mpmath as mp
import numpy as np
import pytest

from piga._kernels.motion import (
    TWO_PI_HIGH,
    TWO_PI_LOW,
    advance,
    split_turns,
    step_functions,
    step_matrix,
    unwrapped,
)

pytestmark = pytest.mark.interpreted


@pytest.fixture(autouse=True)
def _fifty_digits():
    with mp.workdps(50):
        yield


@pytest.mark.parametrize("turns", [0.0, 1.0, -7.0, 1e6, 6e7, 1e9, 1e12])
def test_turns_and_rest(turns):
    alpha = unwrapped(turns, 1.25)
    ulp = np.spacing(abs(alpha))
    assert abs(alpha - (2 * mp.pi * int(turns) + mp.mpf(1.25))) <= (0.51 if turns < 2**26 else 1.5) * ulp
    whole, rest = split_turns(alpha)
    assert whole == turns
    assert abs(rest - (mp.mpf(alpha) - 2 * mp.pi * int(turns))) < 3e-16
    assert abs(mp.mpf(TWO_PI_HIGH) + mp.mpf(TWO_PI_LOW) - 2 * mp.pi) < 1e-24


@pytest.mark.parametrize("x", [-90.0, -2.0, -0.4, -0.0624, -1e-9, 0.0, 1e-9, 0.0624, 0.0626, 0.4, 30.0, 1e4])
def test_step_functions(x):
    root = mp.sqrt(mp.mpf(x))
    c, s = mp.re(mp.cosh(root)), mp.re(mp.sinh(root) / root if x else mp.mpf(1))
    low, part = step_functions(x)
    assert abs((1 + mp.mpf(low)) * s - part * c) < 3e-16 * mp.sqrt(c * c + s * s) * max(1, abs(part))


@pytest.mark.parametrize(("m", "size"), [(256, 0.02), (256, 0.5), (100, 0.5), (1, 0.1)])
def test_small_steps_are_the_product_of_the_exponentials(m, size):
    increments = np.random.default_rng(1).uniform(-size, size, (m, 3))
    p, q = math.sin(0.4), math.cos(0.4)
    pair = mp.matrix([mp.mpf(p), mp.mpf(q)])
    for j, step in enumerate(increments, start=1):
        A, Y, Z = (mp.mpf(value) / 2 for value in step)
        pair = mp.expm(mp.matrix([[Y, A - Z], [-(A + Z), -Y]])) * pair
        pp, pq, qp, qq = step_matrix(*step)
        p, q = (p + pp * p) + pq * q, (q + qq * q) + qp * p
        norm = mp.norm(pair)
        assert abs(p - pair[0]) < 2e-16 * (j + 9) * norm
        assert abs(q - pair[1]) < 2e-16 * (j + 9) * norm


@pytest.mark.parametrize("A", [1.9, -1.9, 0.4, 3.0, -7.5, 40.0])
def test_a_step_of_pure_turning_turns_by_it(A):
    """Without transverse input the angle grows by the increment, whatever its size and where it begins."""
    for start in (-3.0, -0.2, 0.0, 2.9):
        turns, rest, p, q = 0.0, start, math.sin(0.5 * start), math.cos(0.5 * start)
        for count in range(1, 6):
            turns, rest, p, q = advance(turns, rest, p, q, A, 0.0, 0.0)
            assert 2.0 * math.pi * turns + rest == pytest.approx(start + count * A, abs=1e-12)
