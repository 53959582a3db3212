"""Increments and constant segments against exact and independent motion."""

from __future__ import annotations

import math

import numpy as np
import pytest

import piga
from piga.instrument import (
    Instrument,
    closed_form,
    propagate_increments,
    propagate_segments,
)
from piga.units import G0
from tests.instrument.references import constant_cases
from tests.instrument.test_sampled_motion import dop853

pytestmark = pytest.mark.interpreted

INST = Instrument("0.8884 rad/s/g", "1 deg", 0.4)


@pytest.mark.parametrize("n", [1, 2, 3, 300])
def test_constant_increments_are_exact(n):
    t = np.cumsum(np.r_[0.0, np.random.default_rng(n).uniform(0.01, 0.3, n)])
    f, omega = np.array([0.2, 4.0, -3.0]), np.array([1e-3, 2e-3, -1e-3])
    dv, dtheta = np.diff(t)[:, None] * f, np.diff(t)[:, None] * omega
    reference, _ = closed_form(INST, t, *f, base_rate=omega)
    assert propagate_increments(INST, t, dv, dtheta) == pytest.approx(reference, abs=1e-12)


def test_segments_are_exact_whatever_their_length():
    for case in constant_cases():
        if case.t < 0.0:
            continue
        alpha, rate = propagate_segments(case.inst, [case.t], [case.force])
        exact = closed_form(case.inst, case.t, *case.force)
        assert (alpha[0], rate[0]) == exact
    cut = propagate_segments(INST, [1e5, 0.0, 3e5], [[0.3, 9.0, 2.0]] * 3)[0]
    whole, _ = closed_form(INST, [1e5, 1e5, 4e5], 0.3, 9.0, 2.0)
    assert cut == pytest.approx(whole, abs=2e-11)


def test_segments_agree_with_dop853_across_jumps():
    rng = np.random.default_rng(11)
    lengths, f = rng.uniform(0.5, 2.0, 6), rng.normal(0.0, 2 * G0, (6, 3))
    omega = rng.normal(0.0, 0.1, (6, 3))
    alpha, rate = propagate_segments(INST, lengths, f, omega)
    start = INST.alpha0
    for k in range(6):
        run = dop853(
            Instrument(INST.scale_factor, INST.beta, start),
            np.array([0.0, lengths[k]]),
            f[[k, k]],
            omega=omega[[k, k]],
        )
        assert alpha[k] == pytest.approx(run[-1], abs=1e-11)
        start = float(alpha[k])
        u = INST.scale_factor * f[k] - omega[k]
        expected = u[0] + INST.tan_beta * (u[1] * math.sin(start) - u[2] * math.cos(start))
        assert rate[k] == pytest.approx(expected, abs=1e-13)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: propagate_increments(INST, [0.0], np.zeros((0, 3))), "t: shape"),
        (
            lambda: propagate_increments(INST, [0.0, 1.0], np.zeros((2, 3))),
            r"dv: shape \(2, 3\) instead of \(1, 3\)",
        ),
        (lambda: propagate_increments(INST, [0.0, 1.0, 1.0], np.zeros((2, 3))), "t: 1.0 s at index 2"),
        (
            lambda: propagate_increments(INST, [0, 1, 2], [[0, 0, 0], [0, math.nan, 0]]),
            r"dv: nan at index \(1, 1\)",
        ),
        (lambda: propagate_increments(INST, [0, 1], np.zeros((1, 3)), [[0, 0, math.inf]]), "base_angle: inf"),
        (lambda: propagate_segments(INST, [1.0, -2.0], np.zeros((2, 3))), "durations: -2.0 s at index 1"),
        (lambda: propagate_segments(INST, [1.0, math.nan], np.zeros((2, 3))), "durations: nan at index 1"),
        (lambda: propagate_segments(INST, [], np.zeros((0, 3))), "durations: shape"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(piga.ArgumentError, match=message):
        call()
