r"""Exact motion of the outer gimbal: one step of the half-angle pair, of any size, and a record of samples of specific force.

With ``(P, Q) = (sin(alpha/2), cos(alpha/2))`` up to a common factor, equation (2) of the package
docstring is linear,

.. math:: \frac{d}{dt}\binom{P}{Q} = \frac12 \begin{pmatrix} y & a - z \\ -(a + z) & -y \end{pmatrix}
          \binom{P}{Q}, \qquad a = u_x,\; y = \tan\beta\, u_Y,\; z = \tan\beta\, u_Z .

The exponential of a step is ``C I + S M`` because ``M^2 = x I``, ``x = (Y^2 + Z^2 - A^2)/4``.
Derived in docs/theory/motion. Angles are kept as whole turns and a rest in [-pi, pi].

A record is worked off in blocks. Increments of the steps and their matrices are the same arithmetic for each step, so the
processor computes several of them at once. Then one loop carries the half-angle pair from step to step, and the pairs are turned
into angles and rates. Between samples the input is linear, or smooth: then its mean over an interval is that of both ends less
``h^2/12`` of the second derivative in the middle, from the samples on both sides (:mod:`piga._kernels.arithmetic`). The
calibration takes the same mean.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from piga._kernels import arithmetic as dd
from piga._kernels.arithmetic import (
    bow_inside,
    double_arctangent,
    second_derivatives,
    share_at_end,
    weigh_neighbours,
)
from piga._kernels.jit import Array, exact, inline, kernel, lean

_SMALL_STEP = 1.0
"""Largest ``A^2 + Y^2 + Z^2`` [rad^2] for which the series of :func:`step_matrix` and the count of turns are valid."""
GOOD = -1
"""Result of the kernels for whole records if all samples are usable; otherwise they return the start of a bad step."""
_TOO_LARGE = 1e150

_C1, _C2, _C3, _C4, _C5, _C6, _C7 = (1.0 / math.factorial(2 * k) for k in range(1, 8))
_S0, _S1, _S2, _S3, _S4, _S5, _S6, _S7 = (0.5 / math.factorial(2 * k + 1) for k in range(8))


@inline
def step_matrix(A: float, Y: float, Z: float) -> tuple[float, float, float, float]:
    """The matrix of a small step less the identity: rows P and Q.

    ``C - 1`` and ``S/2`` as Taylor series in ``x``, ``|x| <= 1/4``: truncation below 1e-18. The difference from the identity is
    kept apart, so that the rounding of small steps does not add up in one direction.
    """
    x = 0.25 * (Y * Y + Z * Z - A * A)
    c = x * (_C1 + x * (_C2 + x * (_C3 + x * (_C4 + x * (_C5 + x * (_C6 + x * _C7))))))
    s = _S0 + x * (_S1 + x * (_S2 + x * (_S3 + x * (_S4 + x * (_S5 + x * (_S6 + x * _S7))))))
    return c + s * Y, s * (A - Z), -s * (A + Z), c - s * Y


@inline
def _unit_pair(p: float, q: float) -> tuple[float, float]:
    """The pair at unit length with ``Q >= 0``."""
    scale = math.copysign(1.0 / math.sqrt(p * p + q * q), q)
    return p * scale, q * scale


_TWO_PI = 2.0 * math.pi
TWO_PI_HIGH = 6.283185303211212  # the leading 27 bits of 2 pi: exact times any turn count below 2^26
TWO_PI_LOW = 3.968374318722162e-09


@inline
def unwrapped(turns: float, rest: float) -> float:
    """``2 pi turns + rest`` [rad], rounded once for up to 6e7 turns (and to an ulp beyond)."""
    return turns * TWO_PI_HIGH + (turns * TWO_PI_LOW + rest)


@exact
def split_turns(alpha: float) -> tuple[float, float]:
    """Nearest whole turns of ``alpha`` [rad] and the rest in [-pi, pi], exact for any float64 angle."""
    turns, half_rest = dd.remainder_pi((0.5 * alpha, 0.0))
    return turns, 2.0 * half_rest


@kernel
def step_functions(x: float) -> tuple[float, float]:
    """``C - 1`` and ``S``, where ``C = cosh(sqrt(x))``, ``S = sinh(sqrt(x))/sqrt(x)`` up to a common factor.

    Both are entire functions of ``x`` (``cos`` and ``sin`` for ``x < 0``). Half-turns are taken out
    for ``x < 0`` and ``cosh`` for large ``x``: the pair ``(P, Q)`` has no scale. ``C - 1`` keeps the
    digits of a small step, so that rounding does not add up in one direction.
    """
    if abs(x) < 0.0625:
        c = x * (1 / 2 + x * (1 / 24 + x * (1 / 720 + x * (1 / 40320 + x * (1 / 3628800 + x / 479001600)))))
        s = 1.0 + x * (1 / 6 + x * (1 / 120 + x * (1 / 5040 + x * (1 / 362880 + x / 39916800))))
        return c, s
    if x > 0.0:
        root = math.sqrt(x)
        return 0.0, math.tanh(root) / root
    root = math.sqrt(-x)
    remainder = root - np.rint(root / math.pi) * math.pi
    return math.cos(remainder) - 1.0, math.sin(remainder) / root


@inline
def magnus_increments(
    h: float, a0: float, y0: float, z0: float, a1: float, y1: float, z1: float
) -> tuple[float, float, float]:
    """Increments ``A, Y, Z`` [rad] of a step with input linear from ``(a0, y0, z0)`` to ``(a1, y1, z1)``.

    Mean of the ends plus the commutator of the fourth-order Magnus expansion [Blanes2009].
    """
    mean, cross = 0.5 * h, h * h / 12.0
    return (
        mean * (a0 + a1) + cross * (y0 * z1 - z0 * y1),
        mean * (y0 + y1) + cross * (a0 * z1 - z0 * a1),
        mean * (z0 + z1) - cross * (a0 * y1 - y0 * a1),
    )


@kernel
def advance(
    turns: float, rest: float, p: float, q: float, A: float, Y: float, Z: float
) -> tuple[float, float, float, float]:
    """One exact step of any size: new ``(turns, rest, p, q)`` for increments ``A, Y, Z`` [rad]."""
    x = 0.25 * (Y * Y + Z * Z - A * A)
    c, s = step_functions(x)
    s *= 0.5
    p1 = p + (c * p + s * (Y * p + (A - Z) * q))
    q1 = q + (c * q - s * ((A + Z) * p + Y * q))
    increment = 2.0 * math.atan2(p1 * q - q1 * p, p1 * p + q1 * q)
    scale = 1.0 / math.sqrt(p1 * p1 + q1 * q1)
    if q1 < 0.0:
        scale = -scale
    p1, q1 = p1 * scale, q1 * scale
    rest1 = double_arctangent(p1, q1)
    turns1 = turns + np.rint((rest + increment - rest1) / _TWO_PI)
    if x < -1.0:  # the turns that step_functions takes out
        turns1 += math.copysign(np.rint(math.sqrt(-x) / math.pi), A)
    return turns1, rest1, p1, q1


@exact
def _constant_motion(
    a: tuple[float, float],
    y: tuple[float, float],
    z: tuple[float, float],
    t: float,
    turns: float,
    rest: float,
) -> tuple[float, float, float]:
    """Turns, rest [rad] and rate [rad/s] after any time ``t`` [s] of constant input.

    ``a, y, z`` [rad/s] are double-doubles, so that neither the closeness to the separatrix nor the
    number of revolutions costs digits: the phase is reduced before it is rounded.
    """
    sine, cosine = math.sin(rest), math.cos(rest)
    rate0 = a[0] + (y[0] * sine - z[0] * cosine) + a[1]
    time = dd.multiply((0.5, 0.0), (t, 0.0))
    square_a, square_y, square_z = dd.multiply(a, a), dd.multiply(y, y), dd.multiply(z, z)
    x = dd.add(dd.add(square_y, (-square_a[0], -square_a[1])), square_z)
    x = dd.multiply(dd.multiply(x, time), time)
    whole, growth = 0.0, 1.0
    if x[0] > 0.0:
        root = dd.square_root(x)[0]
        c, s = 1.0, math.tanh(root) / root
        growth = math.cosh(min(root, 350.0))
    else:
        reduced = dd.square_root((-x[0], -x[1]))
        whole, remainder = dd.remainder_pi(reduced)
        c, s = math.cos(remainder), 1.0
        if reduced[0] > 0.0:
            s = math.sin(remainder) / reduced[0]
        whole = math.copysign(whole, a[0] * t)
    numerator = s * (0.5 * t) * rate0
    denominator = c - s * (0.5 * t) * (y[0] * cosine + z[0] * sine)
    increment = 2.0 * math.atan2(numerator, denominator)
    norm = growth * math.hypot(numerator, denominator)
    rate = rate0 / norm / norm if norm > 0.0 else rate0
    total = rest + increment
    carry = np.rint(total / _TWO_PI)
    return turns + whole + carry, (total - carry * TWO_PI_HIGH) - carry * TWO_PI_LOW, rate


@exact
def constant_motions(
    t: Array, f: Array, base_rate: Array, K: float, tan_beta: float, turns: float, rest: float, onward: bool,
    result: Array,
) -> None:  # fmt: skip
    """Rows turns, rest [rad] and rate [rad/s] of ``result`` (3, n) after times ``t`` (n,) [s] of constant input.

    ``f`` and ``base_rate`` (n or 1, 3) [m/s^2], [rad/s] are taken as exact. ``onward``: each motion goes on from the last one.
    """
    for k in range(t.size):
        i = min(k, f.shape[0] - 1)
        a = dd.add(dd.two_product(K, f[i, 0]), (-base_rate[i, 0], 0.0))
        y = dd.add(dd.two_product(K, f[i, 1]), (-base_rate[i, 1], 0.0))
        z = dd.add(dd.two_product(K, f[i, 2]), (-base_rate[i, 2], 0.0))
        y, z = dd.multiply(y, (tan_beta, 0.0)), dd.multiply(z, (tan_beta, 0.0))
        ended, left, rate = _constant_motion(a, y, z, t[k], turns, rest)
        result[0, k], result[1, k], result[2, k] = ended, left, rate
        if onward:
            turns, rest = ended, left


BLOCK = 128
"""Steps of a block: its arrays fit the processor's nearest memory. At its end the pair is brought to unit length."""
ROOM = (18, BLOCK + 8)
"""Shape of the room for the fields of a block."""


class MotionSamples(NamedTuple):
    """A record of specific force, and the instrument's constants.

    Times ``t`` (n,) [s], ``f`` (n, 3) [m/s^2], ``base_rate`` (n, 3) or (0, 3) [rad/s]. ``extra`` (n,) or (0,) [rad/s] is added to
    ``u_x`` at the samples, and ``extra_mean`` (n - 1,) or (0,) to its mean over each step if the input is linear. The offsets
    [rad/s] are added to the transverse rates. ``smooth``: how the input goes between samples.
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
    effective rates ``a, y, z`` [rad/s] at the samples. Of its steps: increments ``A, Y, Z`` [rad];
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
    """Effective rates of the rows from ``first`` to ``stop``."""
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
def _carry_pair(
    count: int, h: Array, b: Block, turns: float, p: float, q: float
) -> tuple[int, float, float, float]:
    """Carry turns and pair through ``count`` steps. Returns the number of steps done (fewer: the next one is unusable)."""
    for j in range(count):
        b.pp[j], b.pq[j], b.qp[j], b.qq[j] = step_matrix(b.A[j], b.Y[j], b.Z[j])
    for j in range(count):
        b.turns[j], b.p[j], b.q[j] = turns, p, q
        A, Y, Z = b.A[j], b.Y[j], b.Z[j]
        if A * A + Y * Y + Z * Z <= _SMALL_STEP and h[j] > 0.0:
            p, q = (p + b.pp[j] * p) + b.pq[j] * q, (q + b.qq[j] * q) + b.qp[j] * p
            if q < 0.0:  # a turn is completed: upwards if P has the sign that Q had
                turns += 1.0 if p > 0.0 else -1.0
                p, q = -p, -q
        else:
            if not (h[j] > 0.0 and abs(A) + abs(Y) + abs(Z) < _TOO_LARGE):
                return j, turns, p, q
            p, q = _unit_pair(p, q)
            turns, _, p, q = advance(turns, double_arctangent(p, q), p, q, A, Y, Z)
    b.turns[count], b.p[count], b.q[count] = turns, p, q
    p, q = _unit_pair(p, q)
    return count, turns, p, q


@lean
def propagate_samples(state: Array, alpha: Array, rate: Array, samples: MotionSamples, room: Array) -> int:
    """Unwrapped angle [rad] and rate [rad/s] at each sample.

    ``alpha`` (n,); ``rate`` (n,) may be empty. ``state``: turns, P, Q; updated. ``room`` has the shape ``ROOM``.
    Returns ``GOOD``, or the sample at which an unusable step begins. A smooth record of less than four samples is linear.
    """
    t, n, b = samples.t, samples.t.size, _block_in(room)
    turns, p, q = state[0], state[1], state[2]
    for first in range(0, n, BLOCK):
        last = min(first + BLOCK, n)  # of the samples of this block
        count = min(last, n - 1) - first  # of its steps
        around = max(first - 2, 0)
        skipped, times = first - around, t[around : first + count + 3]
        steps = times.size - 1
        for i in range(steps):
            b.h[i] = times[i + 1] - times[i]
        _read_rates(samples, around, around + steps + 1, b)
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
