"""Records of motion from velocity increments: interval means, their slopes from the neighbours, angles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from piga._kernels.arithmetic.trig import double_arctangent
from piga._kernels.jit import inline, kernel
from piga._kernels.motion.blocks import GOOD, run_block
from piga._kernels.motion.step import unwrapped
from piga._kernels.motion.transfer import (
    BLOCK,
    PAIR_P,
    RATE_A,
    RATE_Y,
    RATE_Z,
    SIZE,
    STEP_A,
    STEP_Y,
    STEP_Z,
)

Array = NDArray[np.float64]

LENGTH = PAIR_P
"""Interval lengths [s] while steps are made from means: the pairs come later."""


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
        ahead = (t[end + 1 :], dv[end:], alpha[end + 1 :])
        usable, turns, p, q = run_block(w, m, (turns, p, q), alpha[first + 1 : end + 1], ahead)
        if not usable:
            return first
        first += m
    state[0], state[1], state[2] = turns, p, q
    return GOOD
