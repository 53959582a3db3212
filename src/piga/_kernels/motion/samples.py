"""Records of motion from samples of specific force: angles and rates."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from piga._kernels.arithmetic import double_arctangent
from piga._kernels.jit import Array, inline, kernel
from piga._kernels.motion.step import (
    BLOCK,
    GOOD,
    PAIR_P,
    PAIR_Q,
    RATE_A,
    RATE_Y,
    RATE_Z,
    SIZE,
    STEP_A,
    STEP_Y,
    STEP_Z,
    advance,
    rates,
    run_block,
    unwrapped,
)

LENGTH = PAIR_P
"""Row of interval lengths [s] during :func:`steps_from_means`; it holds the pairs later."""


@kernel
def load_means(t: Array, dv: Array, dtheta: Array, K: float, tan_beta: float, w: Array) -> int:
    """Lengths [s] and mean rates ``a, y, z`` [rad/s] of the intervals between ``t``; how many have h > 0."""
    positive = 0
    coupling = K * tan_beta
    for j in range(dv.shape[0]):
        h = t[j + 1] - t[j]
        positive += h > 0.0
        per_second = 1.0 / h
        w[LENGTH + j] = h
        w[RATE_A + j] = K * dv[j, 0] * per_second
        w[RATE_Y + j] = coupling * dv[j, 1] * per_second
        w[RATE_Z + j] = coupling * dv[j, 2] * per_second
    for j in range(dtheta.shape[0]):
        per_second = 1.0 / w[LENGTH + j]
        w[RATE_A + j] -= dtheta[j, 0] * per_second
        w[RATE_Y + j] -= tan_beta * dtheta[j, 1] * per_second
        w[RATE_Z + j] -= tan_beta * dtheta[j, 2] * per_second
    return positive


@inline
def set_step(w: Array, j: int, sa: float, sy: float, sz: float) -> None:
    """Increments of step ``j`` from the mean rates in column ``j + 1`` and their slopes [rad/s^2]."""
    h, a, y, z = w[LENGTH + j + 1], w[RATE_A + j + 1], w[RATE_Y + j + 1], w[RATE_Z + j + 1]
    cross = h * h * h * (1.0 / 12.0)
    w[STEP_A + j] = h * a + cross * (y * sz - z * sy)
    w[STEP_Y + j] = h * y + cross * (a * sz - z * sa)
    w[STEP_Z + j] = h * z - cross * (a * sy - y * sa)


@inline
def slope(w: Array, at: int, to_before: float, to_after: float) -> float:
    """Weighted rise of a mean rate from the interval before to here and from here to the one after."""
    return to_before * (w[at + 1] - w[at]) + to_after * (w[at + 2] - w[at + 1])


@kernel
def steps_from_means(w: Array, m: int) -> None:
    """Increments [rad] of ``m`` steps from the interval means in columns 0 to m + 1, order 4.

    The slope in an interval is that of the parabola with the means of the interval and its neighbours.
    """
    for j in range(m):
        h0, h1, h2 = w[LENGTH + j], w[LENGTH + j + 1], w[LENGTH + j + 2]
        lever0, lever2 = h1 + 2.0 * h0, h1 + 2.0 * h2
        per_lever = 2.0 / (lever0 + lever2)
        to_before, to_after = lever2 * per_lever / (h0 + h1), lever0 * per_lever / (h1 + h2)
        set_step(
            w, j,
            slope(w, RATE_A + j, to_before, to_after),
            slope(w, RATE_Y + j, to_before, to_after),
            slope(w, RATE_Z + j, to_before, to_after),
        )  # fmt: skip


@kernel
def fill_edges(w: Array, m: int, lead: int, follow: int) -> None:
    """Substitutes for the missing neighbours of the first and last interval of a record."""
    for row in (LENGTH, RATE_A, RATE_Y, RATE_Z):
        if lead == 0:
            w[row] = w[row + 1]
        if follow == 0:
            w[row + m + 1] = w[row + m]


@kernel
def edge_step(w: Array, edge: int, near: int, far: int) -> None:
    """Increments of the first or last step of a record: parabola through the three means next to it.

    ``edge``, ``near``, ``far`` are columns; fewer intervals lower the degree.
    """
    if near == edge:
        set_step(w, edge - 1, 0.0, 0.0, 0.0)
        return
    side = 1.0 if near > edge else -1.0
    h0, h1, h2 = w[LENGTH + edge], w[LENGTH + near], w[LENGTH + far]
    slopes = np.empty(3)
    for axis in range(3):
        row = RATE_A + axis * (RATE_Y - RATE_A)
        rise = 2.0 * side * (w[row + near] - w[row + edge]) / (h0 + h1)
        slopes[axis] = rise
        if far != near:
            rise_far = 2.0 * side * (w[row + far] - w[row + near]) / (h1 + h2)
            curvature = 3.0 * (rise_far - rise) / (h0 + h1 + h2)
            slopes[axis] = rise - curvature * (h0 + 2.0 * h1) / 6.0
    set_step(w, edge - 1, slopes[0], slopes[1], slopes[2])


@kernel
def propagate_increments(
    t: Array, dv: Array, dtheta: Array, K: float, tan_beta: float, state: Array, alpha: Array
) -> int:
    """Unwrapped angle [rad] at the ``n + 1`` times ``t`` from ``n`` velocity increments ``dv`` (n, 3) [m/s].

    ``dtheta`` (n, 3) or (0, 3): turning of the base over each interval [rad]. ``state``: turns, P, Q.
    """
    w = np.empty(SIZE)
    turns, p, q = state[0], state[1], state[2]
    alpha[0] = unwrapped(turns, double_arctangent(p, q))
    n = dv.shape[0]
    first = 0
    while first < n:
        m = min(BLOCK, n - first)
        lead, follow = min(first, 1), min(n - first - m, 1)
        end = first + m
        low, high = first - lead, end + follow
        columns = w[1 - lead :]
        if load_means(t[low : high + 1], dv[low:high], dtheta[low:high], K, tan_beta, columns) < high - low:
            return first
        if lead == 0 or follow == 0:
            fill_edges(w, m, lead, follow)
        steps_from_means(w, m)
        if lead == 0:
            edge_step(w, 1, min(2, m + follow), min(3, m + follow))
        if follow == 0:
            edge_step(w, m, max(m - 1, 1 - lead), max(m - 2, 1 - lead))
        usable, turns, p, q = run_block(w, m, (turns, p, q), alpha[first + 1 : end + 1])
        if not usable:
            return first
        first += m
    state[0], state[1], state[2] = turns, p, q
    return GOOD


PARAMETERS = 6
"""K, beta, alpha0, and biases of a_x, a_Y, a_Z: the order of the columns."""
_NO_OVERFLOW = 1e5


@inline
def unimodular_functions(x: float) -> tuple[float, float, float]:
    """``C``, ``S`` and ``S' = dS/dx = (C - S)/(2 x)``, unscaled."""
    if abs(x) < 0.5:
        c = s = slope = 0.0
        for k in range(9, -1, -1):  # Taylor: x^k/(2k)!, x^k/(2k+1)!, (k+1) x^k/(2k+3)!
            c = c * x + _TAYLOR[2 * k]
            s = s * x + _TAYLOR[2 * k + 1]
            slope = slope * x + (k + 1) * _TAYLOR[2 * k + 3]
        return c, s, slope
    root = math.sqrt(abs(x))
    c, s = (math.cosh(root), math.sinh(root) / root) if x > 0.0 else (math.cos(root), math.sin(root) / root)
    return c, s, 0.5 * (c - s) / x


_TAYLOR = np.array([1.0 / math.factorial(k) for k in range(22)])


@inline
def sample_rates(f: Array, omega: Array, k: int, K: float, tan_beta: float, r: Array, d: Array) -> None:
    """Effective rates ``r = (a, y, z)`` at sample ``k`` and their derivatives ``d`` (3, PARAMETERS)."""
    secant2 = 1.0 + tan_beta * tan_beta
    for axis in range(3):
        gain = 1.0 if axis == 0 else tan_beta
        u = K * f[k, axis] - omega[k, axis]
        r[axis] = gain * u
        d[axis, 0] = gain * f[k, axis]
        d[axis, 1] = 0.0 if axis == 0 else secant2 * u
        d[axis, 3 + axis] = gain * K


@inline
def cross_term(i: int, j: int, r0: Array, r1: Array) -> float:
    """``r0_i r1_j - r0_j r1_i``."""
    return r0[i] * r1[j] - r0[j] * r1[i]


@kernel
def step_increments(h: float, r0: Array, r1: Array, d0: Array, d1: Array, step: Array, ds: Array) -> None:
    """Magnus increments ``step`` (3,) and their derivatives ``ds`` (3, PARAMETERS)."""
    mean, cross = 0.5 * h, h * h / 12.0
    for axis in range(3):
        i, j = (1, 2) if axis == 0 else ((0, 2) if axis == 1 else (0, 1))
        sign = -cross if axis == 2 else cross
        step[axis] = mean * (r0[axis] + r1[axis]) + sign * cross_term(i, j, r0, r1)
        for n in range(PARAMETERS):
            change = d0[i, n] * r1[j] - d0[j, n] * r1[i] + r0[i] * d1[j, n] - r0[j] * d1[i, n]
            ds[axis, n] = mean * (d0[axis, n] + d1[axis, n]) + sign * change


@kernel
def advance_derivatives(p: float, q: float, step: Array, ds: Array, d_alpha: Array) -> None:
    """Carry ``d_alpha`` (PARAMETERS,) over one step from the unit pair ``(p, q)``."""
    A, Y, Z = step[0], step[1], step[2]
    c, s, slope = unimodular_functions(0.25 * (Y * Y + Z * Z - A * A))
    mp, mq = 0.5 * (Y * p + (A - Z) * q), -0.5 * ((A + Z) * p + Y * q)
    p1, q1 = c * p + s * mp, c * q + s * mq
    square = p1 * p1 + q1 * q1
    for n in range(PARAMETERS):
        dA, dY, dZ = ds[0, n], ds[1, n], ds[2, n]
        dx = 0.5 * (Y * dY + Z * dZ - A * dA)
        dp = dx * (0.5 * s * p + slope * mp) + 0.5 * s * (dY * p + (dA - dZ) * q)
        dq = dx * (0.5 * s * q + slope * mq) - 0.5 * s * ((dA + dZ) * p + dY * q)
        d_alpha[n] = (d_alpha[n] + 2.0 * (dp * q1 - dq * p1)) / square


@kernel
def propagate_sensitivities(
    samples: MotionSamples, state: Array, alpha: Array, rate: Array, d_alpha: Array, d_rate: Array
) -> int:
    """Angle, rate (n,) and their derivatives (n, PARAMETERS) at the samples; ``state``: turns, P, Q.

    Of the samples, ``base_rate`` is (n, 3), and what an error model adds is left out.
    """
    t, f, omega, K, tan_beta = samples.t, samples.f, samples.base_rate, samples.K, samples.tan_beta
    turns, p, q = state[0], state[1], state[2]
    rest = double_arctangent(p, q)
    r0, r1, step, carried = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(PARAMETERS)
    d0, d1, ds = np.zeros((3, PARAMETERS)), np.zeros((3, PARAMETERS)), np.zeros((3, PARAMETERS))
    carried[2] = 1.0
    for k in range(t.size):
        sample_rates(f, omega, k, K, tan_beta, r1, d1)
        if k:
            h = t[k] - t[k - 1]
            step_increments(h, r0, r1, d0, d1, step, ds)
            if not (h > 0.0 and abs(step[0]) + abs(step[1]) + abs(step[2]) < _NO_OVERFLOW):
                return k - 1
            advance_derivatives(p, q, step, ds, carried)
            turns, rest, p, q = advance(turns, rest, p, q, step[0], step[1], step[2])
        sine, cosine = 2.0 * p * q, q * q - p * p
        alpha[k] = unwrapped(turns, rest)
        rate[k] = r1[0] + r1[1] * sine - r1[2] * cosine
        stiffness = r1[1] * cosine + r1[2] * sine
        for n in range(PARAMETERS):
            d_alpha[k, n] = carried[n]
            d_rate[k, n] = d1[0, n] + d1[1, n] * sine - d1[2, n] * cosine + stiffness * carried[n]
        r0[:], d0[:, :] = r1, d1
    return GOOD


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
    t = samples.t
    turns, p, q = state[0], state[1], state[2]
    n = t.size
    if alpha.size:
        alpha[0] = unwrapped(turns, double_arctangent(p, q))
    if n == 1:
        load_rates(samples, 0, 1, w)
        w[PAIR_P], w[PAIR_Q] = p, q
        rates(w, rate)
    first = 0
    while first < n - 1:
        m = min(BLOCK, n - 1 - first)
        stop = first + m + 1
        load_rates(samples, first, stop, w)
        if steps_from_samples(t[first:stop], samples.extra_mean[first : stop - 1], w, m) < m:
            return first
        usable, turns, p, q = run_block(w, m, (turns, p, q), alpha[first + 1 : stop])
        if not usable:
            return first
        rates(w, rate[first:stop])
        first += m
    state[0], state[1], state[2] = turns, p, q
    return GOOD
