"""Records of motion from samples of specific force: angles and rates."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from piga._kernels.arithmetic.trig import double_arctangent
from piga._kernels.jit import kernel
from piga._kernels.motion import transfer as block
from piga._kernels.motion.blocks import GOOD, run_block
from piga._kernels.motion.step import unwrapped
from piga._kernels.motion.transfer import (
    BLOCK,
    PAIR_P,
    PAIR_Q,
    RATE_A,
    RATE_Y,
    RATE_Z,
    SIZE,
    STEP_A,
    STEP_Y,
    STEP_Z,
)

Array = NDArray[np.float64]


class MotionSamples(NamedTuple):
    """A record of specific force, linear between samples, and the instrument's constants.

    Times ``t`` (n,) [s], ``f`` (n, 3) [m/s^2], ``base_rate`` (n, 3) or (0, 3) [rad/s]; ``extra`` (n,) or (0,) [rad/s] is
    added to ``u_x`` at the samples and ``extra_mean`` (n - 1,) or (0,) to its mean over each step; the offsets [rad/s]
    are added to the transverse rates.
    """

    t: Array
    f: Array
    base_rate: Array
    extra: Array
    extra_mean: Array
    K: float
    tan_beta: float
    offset_y: float
    offset_z: float


@kernel
def load_rates(samples: MotionSamples, start: int, stop: int, w: Array) -> None:
    """Effective rates ``a, y, z`` [rad/s] at the samples ``start`` to ``stop - 1``, a block."""
    f, K, tan_beta = samples.f[start:stop], samples.K, samples.tan_beta
    base_rate, extra = samples.base_rate[start:stop], samples.extra[start:stop]
    coupling = K * tan_beta
    for j in range(f.shape[0]):
        w[RATE_A + j] = K * f[j, 0]
        w[RATE_Y + j] = coupling * f[j, 1] + samples.offset_y
        w[RATE_Z + j] = coupling * f[j, 2] + samples.offset_z
    for j in range(base_rate.shape[0]):
        w[RATE_A + j] -= base_rate[j, 0]
        w[RATE_Y + j] -= tan_beta * base_rate[j, 1]
        w[RATE_Z + j] -= tan_beta * base_rate[j, 2]
    for j in range(extra.size):
        w[RATE_A + j] += extra[j]


@kernel
def steps_from_samples(t: Array, extra_mean: Array, w: Array, m: int) -> int:
    """Increments [rad] of ``m`` steps with input linear between samples; returns how many have h > 0.

    Mean of the ends plus the commutator of the fourth-order Magnus expansion [Blanes2009].
    """
    positive = 0
    for j in range(m):
        h = t[j + 1] - t[j]
        positive += h > 0.0
        a0, y0, z0 = w[RATE_A + j], w[RATE_Y + j], w[RATE_Z + j]
        a1, y1, z1 = w[RATE_A + j + 1], w[RATE_Y + j + 1], w[RATE_Z + j + 1]
        mean, cross = 0.5 * h, h * h * (1.0 / 12.0)
        w[STEP_A + j] = mean * (a0 + a1) + cross * (y0 * z1 - z0 * y1)
        w[STEP_Y + j] = mean * (y0 + y1) + cross * (a0 * z1 - z0 * a1)
        w[STEP_Z + j] = mean * (z0 + z1) - cross * (a0 * y1 - y0 * a1)
    for j in range(extra_mean.size):
        w[STEP_A + j] += (t[j + 1] - t[j]) * extra_mean[j]
    return positive


@kernel
def propagate_samples(state: Array, alpha: Array, rate: Array, samples: MotionSamples) -> int:
    """Unwrapped angle [rad] and rate [rad/s] at each sample; input linear between samples.

    ``alpha`` and ``rate`` (n,): each of these may be empty. ``state``: turns, P, Q; updated (the turns only if
    ``alpha`` is wanted).
    """
    w = np.empty(SIZE)
    t, f = samples.t, samples.f
    turns, p, q = state[0], state[1], state[2]
    n = t.size
    if alpha.size:
        alpha[0] = unwrapped(turns, double_arctangent(p, q))
    if n == 1:
        load_rates(samples, 0, 1, w)
        w[PAIR_P], w[PAIR_Q] = p, q
        block.rates(w, rate)
    first = 0
    while first < n - 1:
        m = min(BLOCK, n - 1 - first)
        stop = first + m + 1
        load_rates(samples, first, stop, w)
        if steps_from_samples(t[first:stop], samples.extra_mean[first : stop - 1], w, m) < m:
            return first
        ahead = (t[stop:], f[stop:], alpha[stop:] if alpha.size else rate[stop:])
        usable, turns, p, q = run_block(w, m, (turns, p, q), alpha[first + 1 : stop], ahead)
        if not usable:
            return first
        block.rates(w, rate[first:stop])
        first += m
    state[0], state[1], state[2] = turns, p, q
    return GOOD
