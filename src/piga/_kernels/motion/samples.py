"""Records of motion from samples of specific force, or from its increments: angles and rates. One loop over the samples.

Between samples the input is linear, or smooth: then its mean over an interval is that of both ends less ``h^2/12`` of the second
derivative in the middle, from the samples on both sides (:mod:`piga._kernels.arithmetic`). The calibration takes the same mean.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from piga._kernels.arithmetic import bow_of, double_arctangent, limited
from piga._kernels.jit import Array, inline, kernel
from piga._kernels.motion.step import (
    GOOD,
    SMALL_STEP,
    TOO_LARGE,
    advance,
    magnus_increments,
    small_step,
    unit_pair,
    unwrapped,
)

Three = tuple[float, float, float]
NONE = (0.0, 0.0, 0.0)
BLOCK = 256
"""Samples whose pairs are read together."""
NORMALISED = 64
"""Steps after which a pair is brought to unit length. A small step lets it grow by less than ``exp(1/2)``."""


class MotionSamples(NamedTuple):
    """A record of specific force, and the instrument's constants.

    Times ``t`` (n,) [s], ``f`` (n, 3) [m/s^2], ``base_rate`` (n, 3) or (0, 3) [rad/s]; ``extra`` (n,) or (0,) [rad/s] is
    added to ``u_x`` at the samples, and ``extra_mean`` (n - 1,) or (0,) to its mean over each step if the input is linear. The
    offsets [rad/s] are added to the transverse rates. ``smooth``: how the input goes between samples.
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
    smooth: bool


@inline
def rates_at(samples: MotionSamples, k: int) -> Three:
    """Effective rates ``a, y, z`` [rad/s] at a sample."""
    f, K, tan_beta = samples.f, samples.K, samples.tan_beta
    a, y, z = K * f[k, 0], K * tan_beta * f[k, 1] + samples.offset_y, K * tan_beta * f[k, 2] + samples.offset_z
    if samples.base_rate.shape[0]:
        a -= samples.base_rate[k, 0]
        y -= tan_beta * samples.base_rate[k, 1]
        z -= tan_beta * samples.base_rate[k, 2]
    return a + (samples.extra[k] if samples.extra.size else 0.0), y, z


@inline
def second_derivatives(before: Three, here: Three, after: Three, h0: float, h1: float) -> Three:
    """Second derivatives of three inputs [rad/s^3] from a sample and its neighbours, ``h0`` and ``h1`` [s] away."""
    weight, per0, per1 = 2.0 / (h0 + h1), 1.0 / h0, 1.0 / h1
    return (
        weight * ((after[0] - here[0]) * per1 - (here[0] - before[0]) * per0),
        weight * ((after[1] - here[1]) * per1 - (here[1] - before[1]) * per0),
        weight * ((after[2] - here[2]) * per1 - (here[2] - before[2]) * per0),
    )


@inline
def bows(h: float, share: float, near: Three, far: Three) -> Three:
    """Means of three smooth inputs over an interval ``h`` less the means of both ends [rad/s].

    The second derivatives ``near`` and ``far`` are taken ``share`` of the way from the one to the other.
    """
    return (
        bow_of(h, limited(near[0] + share * (far[0] - near[0]), near[0], far[0])),
        bow_of(h, limited(near[1] + share * (far[1] - near[1]), near[1], far[1])),
        bow_of(h, limited(near[2] + share * (far[2] - near[2]), near[2], far[2])),
    )


@kernel
def bows_at_end(samples: MotionSamples, k: int, near: Three) -> Three:
    """Bows of the first or last interval, that begins at sample ``k``: second derivatives go on from the two next to it.

    ``near``: the nearest second derivatives. A record of less than four samples is linear.
    """
    t, n = samples.t, samples.t.size
    if n < 4:
        return NONE
    i, j = (0, 1) if k == 0 else (k, k - 1)  # the interval, and the middle one of the three next to the end
    h, far_h = t[i + 1] - t[i], (t[3] - t[2] if k == 0 else t[k - 1] - t[k - 2])
    near_h, at = t[j + 1] - t[j], (2 if k == 0 else k - 1)
    far = second_derivatives(
        rates_at(samples, at - 1), rates_at(samples, at), rates_at(samples, at + 1),
        t[at] - t[at - 1], t[at + 1] - t[at],
    )  # fmt: skip
    return bows(h, -(h + 2.0 * near_h) / (2.0 * (h + near_h + far_h)), near, far)


@kernel
def propagate_samples(state: Array, alpha: Array, rate: Array, samples: MotionSamples) -> int:
    """Unwrapped angle [rad] and rate [rad/s] at each sample.

    ``alpha`` and ``rate`` (n,): each of these may be empty. ``state``: turns, P, Q; updated. Returns ``GOOD``, or the sample at
    which an unusable step begins. Pairs are turned into angles and rates by the block, for the vector registers.
    """
    t, n = samples.t, samples.t.size
    pairs = np.empty((3, BLOCK))
    turns, p, q = state[0], state[1], state[2]
    here, bend, bend_after = rates_at(samples, 0), NONE, NONE
    for k in range(n):
        j = k % BLOCK
        pairs[0, j], pairs[1, j], pairs[2, j] = turns, p, q
        if j == BLOCK - 1 or k == n - 1:
            first, stop = k - j, k + 1
            if alpha.size:
                read_angles(pairs, alpha[first:stop])
            if rate.size:
                read_rates(samples, pairs, first, rate[first:stop])
        if k == n - 1:
            break
        h, after = t[k + 1] - t[k], rates_at(samples, k + 1)
        A, Y, Z = magnus_increments(h, here[0], here[1], here[2], after[0], after[1], after[2])
        if samples.smooth:
            bend, bend_after = bend_after, NONE
            if k < n - 2:
                bend_after = second_derivatives(here, after, rates_at(samples, k + 2), h, t[k + 2] - t[k + 1])
            if 0 < k < n - 2:
                h0 = t[k] - t[k - 1]
                a, y, z = bows(h, (h + 2.0 * h0) / (2.0 * (t[k + 2] - t[k - 1])), bend, bend_after)
            else:
                a, y, z = bows_at_end(samples, k, bend_after if k == 0 else bend)
            A, Y, Z = A + h * a, Y + h * y, Z + h * z
        elif samples.extra_mean.size:
            A += h * samples.extra_mean[k]
        if not (h > 0.0 and abs(A) + abs(Y) + abs(Z) < TOO_LARGE):
            return k
        turns, p, q = moved(turns, p, q, A, Y, Z, k)
        here = after
    state[0] = turns
    state[1], state[2] = unit_pair(p, q)
    return GOOD


@kernel
def read_angles(pairs: Array, alpha: Array) -> None:
    """Unwrapped angles [rad] of turns and pairs."""
    for j in range(alpha.size):
        alpha[j] = unwrapped(pairs[0, j], double_arctangent(pairs[1, j], pairs[2, j]))


@kernel
def read_rates(samples: MotionSamples, pairs: Array, first: int, rate: Array) -> None:
    """Rates ``a + y sin(alpha) - z cos(alpha)`` [rad/s] of pairs from sample ``first`` on."""
    for j in range(rate.size):
        p, q = pairs[1, j], pairs[2, j]
        a, y, z = rates_at(samples, first + j)
        rate[j] = a + (2.0 * p * q * y - (q * q - p * p) * z) / (p * p + q * q)


@inline
def moved(turns: float, p: float, q: float, A: float, Y: float, Z: float, k: int) -> tuple[float, float, float]:
    """Turns and pair after step ``k``, of any size; the pair has ``Q >= 0`` and is not normalised."""
    if A * A + Y * Y + Z * Z > SMALL_STEP:
        p, q = unit_pair(p, q)
        turns, _, p, q = advance(turns, double_arctangent(p, q), p, q, A, Y, Z)
        return turns, p, q
    p, q = small_step(p, q, A, Y, Z)
    if q < 0.0:  # a turn is completed: upwards if P has the sign that Q had
        turns += 1.0 if p > 0.0 else -1.0
        p, q = -p, -q
    if k % NORMALISED == 0:
        p, q = unit_pair(p, q)
    return turns, p, q


@inline
def mean_rates(t: Array, dv: Array, dtheta: Array, K: float, tan_beta: float, j: int) -> Three:
    """Mean rates ``a, y, z`` [rad/s] of an interval, from its increments of velocity and of the base's angle."""
    per = 1.0 / (t[j + 1] - t[j])
    a, y, z = K * dv[j, 0], K * dv[j, 1], K * dv[j, 2]
    if dtheta.shape[0]:
        a, y, z = a - dtheta[j, 0], y - dtheta[j, 1], z - dtheta[j, 2]
    return a * per, tan_beta * y * per, tan_beta * z * per


@inline
def slope_inside(before: float, here: float, after: float, h0: float, h1: float, h2: float) -> float:
    """Slope in an interval ``h1`` [s] of the parabola with the means of the interval and its neighbours."""
    lever0, lever2 = h1 + 2.0 * h0, h1 + 2.0 * h2
    per_lever = 2.0 / (lever0 + lever2)
    return per_lever * (lever2 / (h0 + h1) * (here - before) + lever0 / (h1 + h2) * (after - here))


@inline
def slope_at_end(here: float, near: float, far: float, h0: float, h1: float, h2: float) -> float:
    """Slope towards the neighbours in an interval ``h0`` [s] at an end of the record, from the means of the next two."""
    rise = 2.0 * (near - here) / (h0 + h1)
    rise_far = 2.0 * (far - near) / (h1 + h2)
    return rise - (rise_far - rise) * (h0 + 2.0 * h1) / (2.0 * (h0 + h1 + h2))


@inline
def slopes_of(
    t: Array, dv: Array, dtheta: Array, K: float, tan_beta: float, j: int, around: tuple[Three, Three, Three]
) -> Three:
    """Slopes of the rates in interval ``j`` [rad/s^2]; ``around``: means of the interval before, of it and of the one after."""
    n, (before, here, after) = dv.shape[0], around
    h = t[j + 1] - t[j]
    if n == 1:
        return NONE
    if 0 < j < n - 1:
        h0, h2 = t[j] - t[j - 1], t[j + 2] - t[j + 1]
        return (
            slope_inside(before[0], here[0], after[0], h0, h, h2),
            slope_inside(before[1], here[1], after[1], h0, h, h2),
            slope_inside(before[2], here[2], after[2], h0, h, h2),
        )
    side, near = (1.0, after) if j == 0 else (-1.0, before)
    i = 1 if j == 0 else j - 1
    if n == 2:
        per = side * 2.0 / (t[2] - t[0])
        return per * (near[0] - here[0]), per * (near[1] - here[1]), per * (near[2] - here[2])
    k = 2 if j == 0 else j - 2
    far, h1, h2 = mean_rates(t, dv, dtheta, K, tan_beta, k), t[i + 1] - t[i], t[k + 1] - t[k]
    return (
        side * slope_at_end(here[0], near[0], far[0], h, h1, h2),
        side * slope_at_end(here[1], near[1], far[1], h, h1, h2),
        side * slope_at_end(here[2], near[2], far[2], h, h1, h2),
    )


@kernel
def propagate_increments(
    t: Array, dv: Array, dtheta: Array, K: float, tan_beta: float, state: Array, alpha: Array
) -> int:
    """Unwrapped angle [rad] at the ``n + 1`` times ``t`` from ``n`` velocity increments ``dv`` (n, 3) [m/s].

    ``dtheta`` (n, 3) or (0, 3): turning of the base over each interval [rad]. ``state``: turns, P, Q. Order 4: the slope in an
    interval is that of the parabola with the means of the interval and its neighbours.
    """
    turns, p, q = state[0], state[1], state[2]
    n, before = dv.shape[0], NONE
    pairs = np.empty((3, BLOCK))
    here = mean_rates(t, dv, dtheta, K, tan_beta, 0)
    for j in range(n + 1):
        i = j % BLOCK
        pairs[0, i], pairs[1, i], pairs[2, i] = turns, p, q
        if i == BLOCK - 1 or j == n:
            read_angles(pairs, alpha[j - i : j + 1])
        if j == n:
            break
        h = t[j + 1] - t[j]
        after = mean_rates(t, dv, dtheta, K, tan_beta, j + 1) if j < n - 1 else NONE
        (a, y, z), (sa, sy, sz) = here, slopes_of(t, dv, dtheta, K, tan_beta, j, (before, here, after))
        cross = h * h * h * (1.0 / 12.0)
        A = h * a + cross * (y * sz - z * sy)
        Y, Z = h * y + cross * (a * sz - z * sa), h * z - cross * (a * sy - y * sa)
        if not (h > 0.0 and abs(A) + abs(Y) + abs(Z) < TOO_LARGE):
            return j
        turns, p, q = moved(turns, p, q, A, Y, Z, j)
        before, here = here, after
    state[0] = turns
    state[1], state[2] = unit_pair(p, q)
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
