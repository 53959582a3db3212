"""Records of motion from samples of specific force, or from its increments: angles and rates.

A record is worked off in blocks. Increments of the steps and their matrices are the same arithmetic for each step, so the
processor computes several of them at once. Then one loop carries the half-angle pair from step to step, and the pairs are turned
into angles and rates.

Between samples the input is linear, or smooth: then its mean over an interval is that of both ends less ``h^2/12`` of the second
derivative in the middle, from the samples on both sides (:mod:`piga._kernels.arithmetic`). The calibration takes the same mean.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba
import numpy as np

from piga._kernels.arithmetic import (
    bow_at_end,
    bow_inside,
    double_arctangent,
    second_derivatives,
    weigh_neighbours,
)
from piga._kernels.jit import Array, inline, kernel, parallel_kernel
from piga._kernels.motion.step import (
    GOOD,
    SMALL_STEP,
    TOO_LARGE,
    advance,
    magnus_increments,
    step_matrix,
    unit_pair,
    unwrapped,
)

BLOCK = 256
"""Steps of a block. At its end the pair is brought to unit length: a small step lets it grow by less than ``exp(1/2)``."""
ROWS, _ROOM = 19, BLOCK + 8
prange: Any = numba.prange


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


class Block(NamedTuple):
    """A block of steps; each field (_ROOM,).

    Effective rates ``a, y, z`` [rad/s] at the samples around it, or over its intervals. Increments ``A, Y, Z`` [rad] of the steps;
    their matrices less the identity ``pp, pq, qp, qq``; ``size``: ``A^2 + Y^2 + Z^2`` [rad^2], infinite if time does not increase.
    ``turns`` and pair ``p, q`` at the beginning of each step.
    """

    a: Array
    y: Array
    z: Array
    A: Array
    Y: Array
    Z: Array
    pp: Array
    pq: Array
    qp: Array
    qq: Array
    size: Array
    turns: Array
    p: Array
    q: Array


class Weights(NamedTuple):
    """Intervals around a block [s], weights of :func:`.arithmetic.weigh_neighbours`, and room for second derivatives."""

    h: Array
    before: Array
    after: Array
    share: Array
    bend: Array


@inline
def _block_in(r: Array) -> Block:
    """The block in room (ROWS, _ROOM). The room is made by each kernel: its shape is known to the compiler there."""
    return Block(r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], r[8], r[9], r[10], r[11], r[12], r[13])


@inline
def _read_rates(samples: MotionSamples, first: int, stop: int, b: Block) -> None:
    """Effective rates at the samples from ``first`` to ``stop``."""
    f, K, coupling, count = samples.f[first:stop], samples.K, samples.K * samples.tan_beta, stop - first
    for i in range(count):
        b.a[i] = K * f[i, 0]
        b.y[i] = coupling * f[i, 1] + samples.offset_y
        b.z[i] = coupling * f[i, 2] + samples.offset_z
    if samples.base_rate.shape[0]:
        omega, tan_beta = samples.base_rate[first:stop], samples.tan_beta
        for i in range(count):
            b.a[i] -= omega[i, 0]
            b.y[i] -= tan_beta * omega[i, 1]
            b.z[i] -= tan_beta * omega[i, 2]
    if samples.extra.size:
        extra = samples.extra[first:stop]
        for i in range(count):
            b.a[i] += extra[i]


@inline
def _turn_linear(samples: MotionSamples, first: int, count: int, skipped: int, b: Block) -> None:
    """Increments of ``count`` steps from sample ``first`` on, for input that is linear between samples."""
    t, a, y, z = samples.t[first:], b.a[skipped:], b.y[skipped:], b.z[skipped:]
    for j in range(count):
        h = t[j + 1] - t[j]
        b.A[j], b.Y[j], b.Z[j] = magnus_increments(h, a[j], y[j], z[j], a[j + 1], y[j + 1], z[j + 1])
    if samples.extra_mean.size and not samples.smooth:
        extra = samples.extra_mean[first:]
        for j in range(count):
            b.A[j] += (t[j + 1] - t[j]) * extra[j]


@inline
def _add_bows(x: Array, skipped: int, edges: tuple[bool, bool], w: Weights, turn: Array) -> None:
    """Add to the increments ``turn`` what a smooth input ``x`` turns more than a straight one.

    ``skipped`` of the intervals around the block lie before its first step. ``edges``: the record begins, or ends, with them.
    """
    n, first = w.h.size, max(skipped, 1)
    second_derivatives(x[: n + 1], w.before, w.after, w.bend)
    turns, h, share, bend = turn[first - skipped :], w.h[first:], w.share[first:], w.bend[first:]
    for i in range(n - 1 - first):
        turns[i] += h[i] * bow_inside(h[i], share[i], bend[i], bend[i + 1])
    if edges[0]:
        turn[0] += w.h[0] * bow_at_end(w.h[0], w.h[1], w.h[2], w.bend[1], w.bend[2])
    if edges[1]:
        turn[n - 1 - skipped] += w.h[n - 1] * bow_at_end(
            w.h[n - 1], w.h[n - 2], w.h[n - 3], w.bend[n - 1], w.bend[n - 2]
        )


@inline
def _make_matrices(t: Array, count: int, b: Block) -> None:
    """Matrices of the steps between times ``t`` (count + 1,) from their increments."""
    for j in range(count):
        A, Y, Z = b.A[j], b.Y[j], b.Z[j]
        b.pp[j], b.pq[j], b.qp[j], b.qq[j] = step_matrix(A, Y, Z)
        b.size[j] = A * A + Y * Y + Z * Z if t[j + 1] > t[j] else math.inf


@inline
def _carry_pair(count: int, b: Block, turns: float, p: float, q: float) -> tuple[int, float, float, float]:
    """Carry turns and pair through ``count`` steps. Returns the number of steps done (fewer: the next one is unusable)."""
    for j in range(count):
        b.turns[j], b.p[j], b.q[j] = turns, p, q
        if b.size[j] <= SMALL_STEP:
            p, q = (p + b.pp[j] * p) + b.pq[j] * q, (q + b.qq[j] * q) + b.qp[j] * p
            if q < 0.0:  # a turn is completed: upwards if P has the sign that Q had
                turns += 1.0 if p > 0.0 else -1.0
                p, q = -p, -q
        else:
            A, Y, Z = b.A[j], b.Y[j], b.Z[j]
            if not (b.size[j] < math.inf and abs(A) + abs(Y) + abs(Z) < TOO_LARGE):
                return j, turns, p, q
            p, q = unit_pair(p, q)
            turns, _, p, q = advance(turns, double_arctangent(p, q), p, q, A, Y, Z)
    b.turns[count], b.p[count], b.q[count] = turns, p, q
    p, q = unit_pair(p, q)
    return count, turns, p, q


@inline
def _read_angles(b: Block, alpha: Array) -> None:
    """Unwrapped angles [rad] of turns and pairs."""
    for j in range(alpha.size):
        alpha[j] = unwrapped(b.turns[j], double_arctangent(b.p[j], b.q[j]))


@kernel
def propagate_samples(state: Array, alpha: Array, rate: Array, samples: MotionSamples) -> int:
    """Unwrapped angle [rad] and rate [rad/s] at each sample.

    ``alpha`` and ``rate`` (n,): each of these may be empty. ``state``: turns, P, Q; updated. Returns ``GOOD``, or the sample at
    which an unusable step begins. A smooth record of less than four samples is linear.
    """
    t, n = samples.t, samples.t.size
    room = np.empty((ROWS, _ROOM))
    b = _block_in(room)
    turns, p, q = state[0], state[1], state[2]
    for first in range(0, n, BLOCK):
        last = min(first + BLOCK, n)  # of the samples of this block
        count = min(last, n - 1) - first  # of its steps
        around, stop = max(first - 2, 0), min(first + count + 2, n)
        skipped = first - around
        _read_rates(samples, around, stop, b)
        _turn_linear(samples, first, count, skipped, b)
        if samples.smooth and n > 3 and count > 0:
            steps, edges = stop - around - 1, (first == 0, first + count == n - 1)
            w = Weights(room[14][:steps], room[15], room[16], room[17], room[18])
            for i in range(steps):
                w.h[i] = t[around + i + 1] - t[around + i]
            weigh_neighbours(w.h, w.before, w.after, w.share)
            _add_bows(b.a, skipped, edges, w, b.A)
            _add_bows(b.y, skipped, edges, w, b.Y)
            _add_bows(b.z, skipped, edges, w, b.Z)
        _make_matrices(t[first:], count, b)
        done, turns, p, q = _carry_pair(count, b, turns, p, q)
        if done < count:
            return first + done
        if alpha.size:
            _read_angles(b, alpha[first:last])
        if rate.size:
            a, y, z, out = b.a[skipped:], b.y[skipped:], b.z[skipped:], rate[first:last]
            for j in range(out.size):  # a + y sin(alpha) - z cos(alpha)
                pj, qj = b.p[j], b.q[j]
                out[j] = a[j] + (2.0 * pj * qj * y[j] - (qj * qj - pj * pj) * z[j]) / (pj * pj + qj * qj)
    state[0], state[1], state[2] = turns, p, q
    return GOOD


@parallel_kernel
def propagate_many(
    t: Array, f: Array, base_rate: Array, constants: Array, smooth: bool, states: Array, angles: bool, out: Array,
    status: Array,
) -> None:  # fmt: skip
    """Angle [rad] or rate [rad/s] of each of m motions over the same times, in ``out`` (m, n).

    Force (m or 1, n, 3); base rate (m or 1, n, 3), or (1, 0, 3). ``constants`` (m, 2): K [rad/s/(m/s^2)] and tan(beta).
    ``states`` (m, 3): turns, P, Q. ``status`` (m,): see :func:`propagate_samples`.
    """
    for i in prange(out.shape[0]):
        k: Any = np.int64(i)  # prange counts in unsigned integers
        status[i] = _propagate_one(t, f, base_rate, constants[k], smooth, states[k], angles, k, out[k])


@kernel
def _propagate_one(
    t: Array, f: Array, base_rate: Array, constants: Array, smooth: bool, state: Array, angles: bool, i: int, out: Array
) -> int:  # fmt: skip
    """Angle or rate of motion ``i``; see :func:`propagate_many`."""
    none = np.empty(0)
    force, omega = f[min(i, f.shape[0] - 1)], base_rate[min(i, base_rate.shape[0] - 1)]
    samples = MotionSamples(t, force, omega, none, none, constants[0], constants[1], 0.0, 0.0, smooth)
    return propagate_samples(state, out if angles else none, none if angles else out, samples)


@inline
def _neighbours_of(t: Array, i: int) -> tuple[int, float, float, float]:
    """The three intervals from which the slope in the middle of interval ``i`` follows: the first, and what it takes of them."""
    n = t.size - 1
    if n < 3:
        return 0, (2.0 / (t[2] - t[0]) if n == 2 else 0.0), 0.0, 0.0
    k = min(max(i - 1, 0), n - 3)
    h0, h1, h2 = t[k + 1] - t[k], t[k + 2] - t[k + 1], t[k + 3] - t[k + 2]
    place = (
        0.5 * h1 if i == k + 1 else (-0.5 * h0 if i == k else h1 + 0.5 * h2)
    )  # from the end of the first one
    return k, 2.0 / (h0 + h1), 2.0 / (h1 + h2), (3.0 * place + h0 - h1) / (h0 + h1 + h2)


@inline
def _slope_in(x: Array, k: int, per: float, per_next: float, share: float) -> float:
    """Slope of the parabola whose means over three intervals from ``k`` on are those of ``x``."""
    rise = per * (x[k + 1] - x[k])
    return rise + share * (per_next * (x[k + 2] - x[k + 1]) - rise)


@kernel
def propagate_increments(
    t: Array, dv: Array, dtheta: Array, K: float, tan_beta: float, state: Array, alpha: Array
) -> int:
    """Unwrapped angle [rad] at the ``n + 1`` times ``t`` from ``n`` velocity increments ``dv`` (n, 3) [m/s].

    ``dtheta`` (n, 3) or (0, 3): turning of the base over each interval [rad]. ``state``: turns, P, Q. Order 4: the slope in an
    interval is that of the parabola with the means of the interval and its neighbours.
    """
    turns, p, q = state[0], state[1], state[2]
    n, turning = dv.shape[0], dtheta.shape[0] > 0
    b = _block_in(np.zeros((ROWS, _ROOM)))
    for first in range(0, n + 1, BLOCK):
        last = min(first + BLOCK, n + 1)
        count, around = min(last, n) - first, max(first - 2, 0)
        for j in range(around, min(first + count + 2, n)):
            i, per = j - around, 1.0 / (t[j + 1] - t[j])
            b.a[i] = per * (K * dv[j, 0] - (dtheta[j, 0] if turning else 0.0))
            b.y[i] = per * tan_beta * (K * dv[j, 1] - (dtheta[j, 1] if turning else 0.0))
            b.z[i] = per * tan_beta * (K * dv[j, 2] - (dtheta[j, 2] if turning else 0.0))
        for i in range(count):
            j = first + i
            k, per, per_next, share = _neighbours_of(t, j)
            sa = _slope_in(b.a, k - around, per, per_next, share)
            sy = _slope_in(b.y, k - around, per, per_next, share)
            sz = _slope_in(b.z, k - around, per, per_next, share)
            h, a, y, z = t[j + 1] - t[j], b.a[j - around], b.y[j - around], b.z[j - around]
            cross = h * h * h * (1.0 / 12.0)
            b.A[i] = h * a + cross * (y * sz - z * sy)
            b.Y[i], b.Z[i] = h * y + cross * (a * sz - z * sa), h * z - cross * (a * sy - y * sa)
        _make_matrices(t[first:], count, b)
        done, turns, p, q = _carry_pair(count, b, turns, p, q)
        if done < count:
            return first + done
        _read_angles(b, alpha[first:last])
    state[0], state[1], state[2] = turns, p, q
    return GOOD
