"""Records of motion: blocks of steps from samples or increments, to angles, rates or one matrix.

Every input form fills the same rows of increments ``A, Y, Z`` (see :mod:`piga._kernels.transfer`); a
block with a step too large for the fast path is worked off step by step (:func:`piga._kernels.motion.advance`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels import transfer as block
from piga._kernels.jit import inline, kernel
from piga._kernels.motion import advance, unwrapped
from piga._kernels.transfer import (
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
from piga._kernels.trig import double_arctangent

Array = NDArray[np.float64]

LENGTH = PAIR_P
"""Interval lengths [s] while steps are made from means: the pairs come later."""
_TOO_LARGE = 1e150
GOOD = -1
"""What the record kernels return when all samples were usable; else the index where a bad block starts."""


@kernel
def load_rates(
    f: Array,
    base_rate: Array,
    extra: Array,
    K: float,
    tan_beta: float,
    offset_y: float,
    offset_z: float,
    w: Array,
) -> None:
    """Effective rates ``a, y, z`` [rad/s] at the samples of a block."""
    coupling = K * tan_beta
    for j in range(f.shape[0]):
        w[RATE_A + j] = K * f[j, 0]
        w[RATE_Y + j] = coupling * f[j, 1] + offset_y
        w[RATE_Z + j] = coupling * f[j, 2] + offset_z
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
    """Stand-ins for the neighbours that the first and last interval of a record do not have."""
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
def stepwise(
    w: Array, m: int, turns: float, p: float, q: float, alpha: Array
) -> tuple[bool, float, float, float]:
    """The block one step of any size after the other; False when an increment is not a usable number."""
    rest = double_arctangent(p, q)
    w[PAIR_P], w[PAIR_Q] = p, q
    for j in range(m):
        A, Y, Z = w[STEP_A + j], w[STEP_Y + j], w[STEP_Z + j]
        if not abs(A) + abs(Y) + abs(Z) < _TOO_LARGE:
            return False, turns, p, q
        turns, rest, p, q = advance(turns, rest, p, q, A, Y, Z)
        w[PAIR_P + 1 + j], w[PAIR_Q + 1 + j] = p, q
        if alpha.size:
            alpha[j] = unwrapped(turns, rest)
    return True, turns, p, q


@kernel
def close_block(w: Array, m: int, turns: float, alpha: Array) -> tuple[float, float, float]:
    """Angles (unless ``alpha`` is empty) from the pairs of a block; turns and unit pair at its end."""
    if alpha.size:
        turns = block.angles(w, m, turns, alpha)
    p, q = w[PAIR_P + m], w[PAIR_Q + m]
    scale = 1.0 / math.sqrt(p * p + q * q)
    if q < 0.0:
        scale = -scale
    return turns, p * scale, q * scale


@kernel
def run_block(
    w: Array, m: int, turns: float, p: float, q: float, alpha: Array, t: Array, f: Array, out: Array
) -> tuple[bool, float, float, float]:
    """Pairs and angles (unless ``alpha`` is empty) of a block whose increments stand in ``w``.

    ``t``, ``f`` and ``out`` begin where the next block does, to be fetched meanwhile.
    """
    if block.matrices(w, m) < m:
        return stepwise(w, m, turns, p, q, alpha)
    block.chain(w, m, p, q, t, f, out)
    turns, p, q = close_block(w, m, turns, alpha)
    return True, turns, p, q


@kernel
def propagate_samples(
    state: Array,
    alpha: Array,
    rate: Array,
    t: Array,
    f: Array,
    base_rate: Array,
    extra: Array,
    extra_mean: Array,
    K: float,
    tan_beta: float,
    offset_y: float,
    offset_z: float,
) -> int:
    """Unwrapped angle [rad] and rate [rad/s] at each sample; input linear between samples.

    ``base_rate`` (n, 3) or (0, 3); ``extra`` (n,) [rad/s] is added to ``u_x`` at the samples and
    ``extra_mean`` (n - 1,) [rad/s] to its mean over each step; ``alpha`` and ``rate`` (n,): each of
    these may be empty. ``state``: turns, P, Q; updated (the turns only if ``alpha`` is wanted).
    """
    w = np.empty(SIZE)
    turns, p, q = state[0], state[1], state[2]
    n = t.size
    if alpha.size:
        alpha[0] = unwrapped(turns, double_arctangent(p, q))
    if n == 1:
        load_rates(f, base_rate, extra, K, tan_beta, offset_y, offset_z, w)
        w[PAIR_P], w[PAIR_Q] = p, q
        block.rates(w, rate)
    first = 0
    while first < n - 1:
        m = min(BLOCK, n - 1 - first)
        stop = first + m + 1
        load_rates(f[first:stop], base_rate[first:stop], extra[first:stop], K, tan_beta, offset_y, offset_z, w)
        if steps_from_samples(t[first:stop], extra_mean[first : stop - 1], w, m) < m:
            return first
        ahead = alpha[stop:] if alpha.size else rate[stop:]
        usable, turns, p, q = run_block(w, m, turns, p, q, alpha[first + 1 : stop], t[stop:], f[stop:], ahead)
        if not usable:
            return first
        block.rates(w, rate[first:stop])
        first += m
    state[0], state[1], state[2] = turns, p, q
    return GOOD


@kernel
def multiply_steps(w: Array, m: int) -> tuple[bool, float, float, float, float]:
    """Scaled product of ``m`` steps of any size; False when an increment is not a usable number."""
    u, v, x, y = 1.0, 0.0, 0.0, 1.0
    for j in range(m):
        A, Y, Z = w[STEP_A + j], w[STEP_Y + j], w[STEP_Z + j]
        if not abs(A) + abs(Y) + abs(Z) < _TOO_LARGE:
            return False, u, v, x, y
        one = block.any_matrix(A, Y, Z)
        u, v, x, y = block.scaled(block.multiply(one[0], one[1], one[2], one[3], u, v, x, y))
    return True, u, v, x, y


@kernel
def prepare_samples(
    product: Array,
    prefix: Array,
    stepped: Array,
    t: Array,
    f: Array,
    base_rate: Array,
    extra: Array,
    extra_mean: Array,
    K: float,
    tan_beta: float,
    offset_y: float,
    offset_z: float,
) -> int:
    """What a stretch does to any pair: all products of its blocks, and of the stretch as a whole.

    ``prefix`` (blocks, PREFIX): see :func:`~piga._kernels.transfer.prefixes`; ``stepped`` (blocks,) is 1
    where a step is too large for it; ``product`` (2, 2), scaled. Other arguments: :func:`propagate_samples`.
    """
    w = np.empty(SIZE)
    u, v, x, y = 1.0, 0.0, 0.0, 1.0
    first = 0
    while first < t.size - 1:
        m = min(BLOCK, t.size - 1 - first)
        stop = first + m + 1
        load_rates(f[first:stop], base_rate[first:stop], extra[first:stop], K, tan_beta, offset_y, offset_z, w)
        if steps_from_samples(t[first:stop], extra_mean[first : stop - 1], w, m) < m:
            return first
        number = first // BLOCK
        stepped[number] = 0.0 if block.matrices(w, m) == m else 1.0
        if stepped[number]:
            usable, r, s, i, k = multiply_steps(w, m)
            if not usable:
                return first
        else:
            r, s, i, k = block.prefixes(w, m, prefix[number], t[stop:], f[stop:])
        u, v, x, y = block.scaled(block.multiply(r, s, i, k, u, v, x, y))
        first += m
    product[0, 0], product[0, 1], product[1, 0], product[1, 1] = u, x, v, y
    return GOOD


@kernel
def finish_samples(
    state: Array,
    alpha: Array,
    rate: Array,
    prefix: Array,
    stepped: Array,
    t: Array,
    f: Array,
    base_rate: Array,
    extra: Array,
    extra_mean: Array,
    K: float,
    tan_beta: float,
    offset_y: float,
    offset_z: float,
) -> None:
    """Output of a stretch from what :func:`prepare_samples` left; else as :func:`propagate_samples`.

    ``alpha[0]`` is left alone: it belongs to the stretch before.
    """
    w = np.empty(SIZE)
    turns, p, q = state[0], state[1], state[2]
    first = 0
    while first < t.size - 1:
        m = min(BLOCK, t.size - 1 - first)
        stop = first + m + 1
        number = first // BLOCK
        part = alpha[first + 1 : stop]
        if rate.size or stepped[number]:
            load_rates(
                f[first:stop], base_rate[first:stop], extra[first:stop], K, tan_beta, offset_y, offset_z, w
            )
        if stepped[number]:
            steps_from_samples(t[first:stop], extra_mean[first : stop - 1], w, m)
            _, turns, p, q = stepwise(w, m, turns, p, q, part)
        else:
            block.pairs_from_prefixes(w, m, prefix[number], p, q)
            turns, p, q = close_block(w, m, turns, part)
        block.rates(w, rate[first:stop])
        first += m
    state[0], state[1], state[2] = turns, p, q


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
        usable, turns, p, q = run_block(
            w, m, turns, p, q, alpha[first + 1 : end + 1], t[end + 1 :], dv[end:], alpha[end + 1 :]
        )
        if not usable:
            return first
        first += m
    state[0], state[1], state[2] = turns, p, q
    return GOOD
