"""Steps of the motion against 50-digit arithmetic and their own definitions."""

import math

import mpmath as mp
import numpy as np
import pytest

from piga._kernels.motion import samples as increments
from piga._kernels.motion import step as block
from piga._kernels.motion.samples import unimodular_functions
from piga._kernels.motion.step import TWO_PI_HIGH, TWO_PI_LOW, advance, split_turns, step_functions, unwrapped

pytestmark = pytest.mark.compiled


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
    if abs(x) < 100:
        for computed, reference in zip(
            unimodular_functions(x), (c, s, (c - s) / (2 * x) if x else mp.mpf(1) / 6), strict=True
        ):
            assert abs(computed - reference) < 2e-15 * max(1, abs(reference))


def _filled(m, size, seed=1):
    w = np.zeros(block.SIZE)
    rng = np.random.default_rng(seed)
    for row in (block.STEP_A, block.STEP_Y, block.STEP_Z):
        w[row : row + m] = rng.uniform(-size, size, m)
    return w


@pytest.mark.parametrize(("m", "size"), [(256, 0.02), (256, 0.5), (100, 0.5), (1, 0.1)])
def test_chain_is_the_product_of_the_exponentials(m, size):
    w = _filled(m, size)
    assert block.matrices(w, m) == m
    state = mp.matrix([mp.sin(mp.mpf("0.4")), mp.cos(mp.mpf("0.4"))])
    p, q = float(state[0]), float(state[1])
    state = mp.matrix([mp.mpf(p), mp.mpf(q)])
    pairs = [state]
    for j in range(m):
        A, Y, Z = (mp.mpf(w[row + j]) / 2 for row in (block.STEP_A, block.STEP_Y, block.STEP_Z))
        pairs.append(mp.expm(mp.matrix([[Y, A - Z], [-(A + Z), -Y]])) * pairs[-1])
    none, rows = np.empty(0), np.empty((0, 3))
    block.chain(w, m, p, q, none, rows, none)
    for j in (1, m // 2, m // 2 + 1, m):
        norm = mp.norm(pairs[j])
        assert abs(w[block.PAIR_P + j] - pairs[j][0]) < 2e-16 * (m + 9) * norm
        assert abs(w[block.PAIR_Q + j] - pairs[j][1]) < 2e-16 * (m + 9) * norm


def test_large_steps_are_counted_out():
    w = _filled(256, 0.1)
    w[block.STEP_A + 17] = 1.5
    w[block.STEP_Y + 200] = math.nan
    assert block.matrices(w, 256) == 254


@pytest.mark.parametrize("A", [1.9, -1.9, 0.4, 3.0, -7.5, 40.0])
def test_a_step_of_pure_turning_turns_by_it(A):
    """Without transverse input the angle grows by the increment, whatever its size and where it begins."""
    for start in (-3.0, -0.2, 0.0, 2.9):
        turns, rest, p, q = 0.0, start, math.sin(0.5 * start), math.cos(0.5 * start)
        for count in range(1, 6):
            turns, rest, p, q = advance(turns, rest, p, q, A, 0.0, 0.0)
            assert 2.0 * math.pi * turns + rest == pytest.approx(start + count * A, abs=1e-12)


def test_a_record_of_one_interval_has_no_slope():
    w = np.zeros(block.SIZE)
    increments.load_means(np.array([1.0, 3.0]), np.array([[0.5, -0.7, 0.9]]), np.empty((0, 3)), 1.0, 1.0, w[1:])
    increments.edge_step(w, 1, 1, 1)
    assert (w[block.STEP_A], w[block.STEP_Y], w[block.STEP_Z]) == pytest.approx((0.5, -0.7, 0.9), rel=1e-15)


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_angles_count_turns_both_ways(direction):
    half = 0.3 + direction * 0.2 * np.arange(257)
    w = np.zeros(block.SIZE)
    w[block.PAIR_P : block.PAIR_P + 257] = np.sin(half)
    w[block.PAIR_Q : block.PAIR_Q + 257] = np.cos(half)
    alpha = np.empty(256)
    turns = block.angles(w, 256, 5.0, alpha)
    assert alpha == pytest.approx(10 * math.pi + 2 * half[1:], abs=1e-12)
    assert turns == 5 + round(2 * half[-1] / (2 * math.pi))


@pytest.mark.parametrize("m", [3, 5])
def test_slopes_of_a_parabola_are_exact_in_every_interval(m):
    """Mean rates of quadratic input over uneven intervals give the increments with the true slopes."""
    t = np.cumsum(np.r_[0.3, np.random.default_rng(m).uniform(0.5, 2.0, m)])
    c = np.array([[1.0, 0.4, -0.3], [0.2, -0.7, 0.9], [0.5, 0.1, -0.2]])
    integral = t[:, None] * c[0] + t[:, None] ** 2 / 2 * c[1] + t[:, None] ** 3 / 3 * c[2]
    w = np.zeros(block.SIZE)
    increments.load_means(t, np.diff(integral, axis=0), np.empty((0, 3)), 1.0, 1.0, w[1:])
    increments.fill_edges(w, m, 0, 0)
    increments.steps_from_means(w, m)
    increments.edge_step(w, 1, 2, 3)
    increments.edge_step(w, m, m - 1, m - 2)
    h = np.diff(t)[:, None]
    mean = np.diff(integral, axis=0) / h
    (a, y, z), (sa, sy, sz) = mean.T, (c[1] + (t[1:] + t[:-1])[:, None] * c[2]).T
    cross = h[:, 0] ** 3 / 12
    for row, expected in (
        (block.STEP_A, h[:, 0] * a + cross * (y * sz - z * sy)),
        (block.STEP_Y, h[:, 0] * y + cross * (a * sz - z * sa)),
        (block.STEP_Z, h[:, 0] * z - cross * (a * sy - y * sa)),
    ):
        assert w[row : row + m] == pytest.approx(expected, abs=1e-13)
