"""Double-double arithmetic and angles against 50-digit arithmetic."""

from __future__ import annotations

import math

import mpmath as mp
import numpy as np
import pytest

from piga._kernels import arithmetic as dd
from piga._kernels.arithmetic import double_arctangent

pytestmark = pytest.mark.interpreted


def exact(pair):
    return mp.mpf(float(pair[0])) + mp.mpf(float(pair[1]))


@pytest.fixture(autouse=True)
def _fifty_digits():
    with mp.workdps(50):
        yield


def test_double_double_keeps_thirty_digits():
    rng = np.random.default_rng(3)
    for a, b in rng.normal(0.0, 1e3, (50, 2)):
        x, y = dd.two_product(float(a), float(b)), dd.two_sum(float(a), float(b) * 1e-9)
        assert exact(x) == mp.mpf(float(a)) * mp.mpf(float(b))
        assert exact(y) == mp.mpf(float(a)) + mp.mpf(float(b) * 1e-9)
        assert abs(exact(dd.multiply(x, y)) / (exact(x) * exact(y)) - 1) < 1e-30
        assert abs(exact(dd.add(x, (-x[0], y[1]))) - (exact(x) - x[0] + y[1])) < 1e-30
        positive = dd.multiply(x, x)
        assert abs(exact(dd.square_root(positive)) ** 2 / exact(positive) - 1) < 1e-29


@pytest.mark.parametrize("phase", [0.3, 1e3, 1e9, 6.3e11])
def test_reduction_by_pi_at_any_phase(phase):
    n, rest = dd.remainder_pi((phase, 1e-17 * phase))
    reference = mp.mpf(phase) + mp.mpf(1e-17 * phase)
    assert n == mp.nint(reference / mp.pi)
    assert rest == pytest.approx(float(reference - mp.pi * mp.nint(reference / mp.pi)), abs=2e-16)


def test_double_arctangent_to_an_ulp():
    angles = np.concatenate([np.linspace(-np.pi, np.pi, 801)[1:-1], 10.0 ** np.arange(-300, 0, 20)])
    for half in angles:
        p, q = math.sin(half), math.cos(half)
        reference = 2 * mp.atan(mp.mpf(p) / mp.mpf(q))
        assert abs(double_arctangent(p, q) - reference) <= max(
            1.5 * np.spacing(abs(float(reference))), 2.3e-16 * (half**2 > 0.1)
        )
        assert double_arctangent(-p, -q) == double_arctangent(p, q)
    assert double_arctangent(1.0, 0.0) == math.pi
    assert double_arctangent(-1.0, 0.0) == -math.pi
    assert double_arctangent(0.0, 1.0) == 0.0
