"""Records of motion from samples of specific force, or from its increments: angles and rates.

A record is worked off in blocks. Increments of the steps and their matrices are the same arithmetic for each step, so the
processor computes several of them at once. Then one loop carries the half-angle pair from step to step, and the pairs are turned
into angles and rates.

Between samples the input is linear, or smooth: then its mean over an interval is that of both ends less ``h^2/12`` of the second
derivative in the middle, from the samples on both sides (:mod:`piga._kernels.arithmetic`). The calibration takes the same mean.
Increments give the means themselves; the slope in an interval is that of the parabola with the means of the interval and its
neighbours, so both are of fourth order.
"""

from __future__ import annotations

from typing import NamedTuple

from piga._kernels.arithmetic import (
    bow_inside,
    double_arctangent,
    second_derivatives,
    share_at_end,
    weigh_neighbours,
)
from piga._kernels.jit import Array, inline, lean
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

BLOCK = 128
"""Steps of a block: its arrays fit the processor's nearest memory. At its end the pair is brought to unit length."""
ROOM = (18, BLOCK + 8)
"""Shape of the room for the fields of a block."""


class MotionSamples(NamedTuple):
    """A record of specific force, and the instrument's constants.

    Times ``t`` (n,) [s], ``f`` (n, 3) [m/s^2], ``base_rate`` (n, 3) or (0, 3) [rad/s]. If ``f`` has one row less than ``t``, both
    are integrals over the intervals ([m/s], [rad]). ``extra`` (n,) or (0,) [rad/s] is added to ``u_x`` at the samples, and
    ``extra_mean`` (n - 1,) or (0,) to its mean over each step if the input is linear. The offsets [rad/s] are added to the
    transverse rates. ``smooth``: how the input goes between samples.
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
    """A block of steps; each field (BLOCK + 8,).

    Around it: intervals ``h`` [s], weights of :func:`.arithmetic.weigh_neighbours`, second derivatives ``bend`` of one input, and
    effective rates ``a, y, z`` [rad/s] at the samples, or means over the intervals. Of its steps: increments ``A, Y, Z`` [rad];
    matrices less the identity ``pp, pq, qp, qq``; ``turns`` and pair ``p, q`` at the beginning of each.
    """

    h: Array
    before: Array
    after: Array
    share: Array
    bend: Array
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
    turns: Array
    p: Array
    q: Array


@inline
def _block_in(r: Array) -> Block:
    """The block in its room."""
    return Block(
        r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], r[8], r[9], r[10], r[11], r[12], r[13], r[14], r[15], r[16], r[17]
    )  # fmt: skip


@inline
def _read_rates(samples: MotionSamples, first: int, stop: int, b: Block) -> None:
    """Effective rates of the rows from ``first`` to ``stop``; of increments they are the turn of each interval [rad]."""
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
def _turn_samples(samples: MotionSamples, first: int, count: int, skipped: int, b: Block) -> None:
    """Increments of ``count`` steps from sample ``first`` on, for input that is linear between samples."""
    h, a, y, z = b.h[skipped:], b.a[skipped:], b.y[skipped:], b.z[skipped:]
    for j in range(count):
        b.A[j], b.Y[j], b.Z[j] = magnus_increments(h[j], a[j], y[j], z[j], a[j + 1], y[j + 1], z[j + 1])
    if samples.extra_mean.size and not samples.smooth:
        extra = samples.extra_mean[first:]
        for j in range(count):
            b.A[j] += h[j] * extra[j]


@inline
def _add_bows(x: Array, steps: int, skipped: int, edges: tuple[bool, bool], b: Block, turn: Array) -> None:
    """Add to the increments ``turn`` what a smooth input ``x`` turns more than a straight one.

    ``skipped`` of the ``steps`` intervals around the block lie before it. ``edges``: the record begins, or ends, with them.
    """
    first, last, h, bend = max(skipped, 1), steps - 1, b.h, b.bend
    second_derivatives(x[: steps + 1], b.before, b.after, bend)
    inside, each, share = turn[first - skipped :], h[first:], b.share[first:]
    early, late = bend[first:], bend[first + 1 :]
    for i in range(last - first):
        inside[i] += each[i] * bow_inside(each[i], share[i], early[i], late[i])
    if edges[0]:
        turn[0] += h[0] * bow_inside(h[0], share_at_end(h[0], h[1], h[2]), bend[1], bend[2])
    if edges[1]:
        beyond = share_at_end(h[last], h[last - 1], h[last - 2])
        turn[last - skipped] += h[last] * bow_inside(h[last], beyond, bend[last], bend[last - 1])


@inline
def _slope(x: Array, k: int, rise: float, next_rise: float, share: float) -> float:
    """Slope of the parabola whose means over three intervals from ``k`` on are those of ``x``."""
    first = rise * (x[k + 1] - x[k])
    return first + share * (next_rise * (x[k + 2] - x[k + 1]) - first)


@inline
def _turn_means(count: int, steps: int, skipped: int, b: Block) -> None:
    """Increments of ``count`` steps from the turns over the ``steps`` intervals around them, which become mean rates."""
    h, a, y, z = b.h, b.a, b.y, b.z
    for i in range(steps):
        per = 1.0 / h[i]
        a[i], y[i], z[i] = per * a[i], per * y[i], per * z[i]
    for j in range(count):
        i = skipped + j
        k, rise, next_rise, share = 0, 2.0 / (h[0] + h[1]) if steps == 2 else 0.0, 0.0, 0.0
        if steps > 2:
            k = min(max(i - 1, 0), steps - 3)
            h0, h1, h2 = h[k], h[k + 1], h[k + 2]
            rise, next_rise = 2.0 / (h0 + h1), 2.0 / (h1 + h2)
            middle = (
                0.5 * h1 if i == k + 1 else (-0.5 * h0 if i == k else h1 + 0.5 * h2)
            )  # from the first one's end
            share = (3.0 * middle + h0 - h1) / (h0 + h1 + h2)
        sa = _slope(a, k, rise, next_rise, share)
        sy = _slope(y, k, rise, next_rise, share)
        sz = _slope(z, k, rise, next_rise, share)
        cross = h[i] * h[i] * h[i] * (1.0 / 12.0)
        b.A[j] = h[i] * a[i] + cross * (y[i] * sz - z[i] * sy)
        b.Y[j] = h[i] * y[i] + cross * (a[i] * sz - z[i] * sa)
        b.Z[j] = h[i] * z[i] - cross * (a[i] * sy - y[i] * sa)


@inline
def _carry_pair(
    count: int, h: Array, b: Block, turns: float, p: float, q: float
) -> tuple[int, float, float, float]:
    """Carry turns and pair through ``count`` steps. Returns the number of steps done (fewer: the next one is unusable)."""
    for j in range(count):
        b.pp[j], b.pq[j], b.qp[j], b.qq[j] = step_matrix(b.A[j], b.Y[j], b.Z[j])
    for j in range(count):
        b.turns[j], b.p[j], b.q[j] = turns, p, q
        A, Y, Z = b.A[j], b.Y[j], b.Z[j]
        if A * A + Y * Y + Z * Z <= SMALL_STEP and h[j] > 0.0:
            p, q = (p + b.pp[j] * p) + b.pq[j] * q, (q + b.qq[j] * q) + b.qp[j] * p
            if q < 0.0:  # a turn is completed: upwards if P has the sign that Q had
                turns += 1.0 if p > 0.0 else -1.0
                p, q = -p, -q
        else:
            if not (h[j] > 0.0 and abs(A) + abs(Y) + abs(Z) < TOO_LARGE):
                return j, turns, p, q
            p, q = unit_pair(p, q)
            turns, _, p, q = advance(turns, double_arctangent(p, q), p, q, A, Y, Z)
    b.turns[count], b.p[count], b.q[count] = turns, p, q
    p, q = unit_pair(p, q)
    return count, turns, p, q


@lean
def propagate_samples(state: Array, alpha: Array, rate: Array, samples: MotionSamples, room: Array) -> int:
    """Unwrapped angle [rad] and rate [rad/s] at each sample.

    ``alpha`` and ``rate`` (n,): each of these may be empty. ``state``: turns, P, Q; updated. ``room`` has the shape ``ROOM``.
    Returns ``GOOD``, or the sample at which an unusable step begins. A smooth record of less than four samples is linear.
    """
    t, n, rows, b = samples.t, samples.t.size, samples.f.shape[0], _block_in(room)
    turns, p, q = state[0], state[1], state[2]
    for first in range(0, n, BLOCK):
        last = min(first + BLOCK, n)  # of the samples of this block
        count = min(last, n - 1) - first  # of its steps
        around = max(first - 2, 0)
        skipped, times = first - around, t[around : first + count + 3]
        steps = times.size - 1
        for i in range(steps):
            b.h[i] = times[i + 1] - times[i]
        _read_rates(samples, around, min(around + steps + 1, rows), b)
        if rows < n:
            _turn_means(count, steps, skipped, b)
        else:
            _turn_samples(samples, first, count, skipped, b)
            if samples.smooth and n > 3 and count > 0:
                edges = (first == 0, first + count == n - 1)
                weigh_neighbours(b.h[:steps], b.before, b.after, b.share)
                _add_bows(b.a, steps, skipped, edges, b, b.A)
                _add_bows(b.y, steps, skipped, edges, b, b.Y)
                _add_bows(b.z, steps, skipped, edges, b, b.Z)
        done, turns, p, q = _carry_pair(count, b.h[skipped:], b, turns, p, q)
        if done < count:
            return first + done
        if alpha.size:
            out = alpha[first:last]
            for j in range(out.size):
                out[j] = unwrapped(b.turns[j], double_arctangent(b.p[j], b.q[j]))
        if rate.size:
            a, y, z, out = b.a[skipped:], b.y[skipped:], b.z[skipped:], rate[first:last]
            for j in range(out.size):  # a + y sin(alpha) - z cos(alpha)
                pj, qj = b.p[j], b.q[j]
                out[j] = a[j] + (2.0 * pj * qj * y[j] - (qj * qj - pj * pj) * z[j]) / (pj * pj + qj * qj)
    state[0], state[1], state[2] = turns, p, q
    return GOOD
