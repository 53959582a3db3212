"""Three instruments sampled in angle and rate, no error terms, no base rate: the 3 x 3 system in one pass.

``(1, tan_beta sin alpha, -tan_beta cos alpha) . f = rate/K`` for each instrument (package docstring), solved by
cross products; flags in a second pass over the force while it is still in the fast caches.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels import compensate_layout as at
from piga._kernels.compensate_set import FORCE_X, FORCE_Y, FORCE_Z
from piga._kernels.compensate_uncertainty import NEAR
from piga._kernels.jit import exact, kernel
from piga._kernels.sine_cosine import LIMIT, fast_sine_cosine

Array = NDArray[np.float64]


SINE, COSINE, INDICATED = 0, at.STRIDE, 2 * at.STRIDE
"""Rows of one instrument."""
INSTRUMENT = 3 * at.STRIDE
"""Numbers of one instrument."""


@kernel
def find_angles(psi: Array, rate: Array, q: Array, w: Array) -> None:
    """Sine and cosine of the effective angle and the indication [m/s^2] at the samples; whole tiles only."""
    phi, y, z, inverse = q[at.P_PHI], q[at.P_OFFSET_Y], q[at.P_OFFSET_Z], 1.0 / q[at.P_K]
    far = 0
    for j in range(psi.size):
        alpha = phi + psi[j]
        sine, cosine = fast_sine_cosine(alpha)
        w[SINE + j], w[COSINE + j] = sine, cosine
        w[INDICATED + j] = (rate[j] - (y * sine - z * cosine)) * inverse
        far |= abs(alpha) > LIMIT
    if far:
        for j in range(psi.size):
            if abs(phi + psi[j]) > LIMIT:
                sine, cosine = math.sin(phi + psi[j]), math.cos(phi + psi[j])
                w[SINE + j], w[COSINE + j] = sine, cosine
                w[INDICATED + j] = (rate[j] - (y * sine - z * cosine)) * inverse


@kernel
def mounting(q: Array, axes: Array) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Axes X0, Y0 tan_beta, Z0 tan_beta of an instrument."""
    k = q[at.P_TAN_BETA]
    return (
        axes[0, 0], axes[0, 1], axes[0, 2], k * axes[1, 0], k * axes[1, 1], k * axes[1, 2],
        k * axes[2, 0], k * axes[2, 1], k * axes[2, 2],
    )  # fmt: skip


@kernel
def solve_three(rows: int, p: Array, axes: Array, w: Array, c: Array) -> None:
    """Force at the samples into the rows FORCE of ``c``; ``w`` holds the rows of the three instruments."""
    X0, X1, X2, Y0, Y1, Y2, Z0, Z1, Z2 = mounting(p[0], axes[0])
    U0, U1, U2, V0, V1, V2, W0, W1, W2 = mounting(p[1], axes[1])
    L0, L1, L2, M0, M1, M2, N0, N1, N2 = mounting(p[2], axes[2])
    for j in range(rows):
        sine, cosine, e = w[SINE + j], w[COSINE + j], w[INDICATED + j]
        a0, a1, a2 = X0 + Y0 * sine - Z0 * cosine, X1 + Y1 * sine - Z1 * cosine, X2 + Y2 * sine - Z2 * cosine
        sine, cosine = w[INSTRUMENT + SINE + j], w[INSTRUMENT + COSINE + j]
        f = w[INSTRUMENT + INDICATED + j]
        b0, b1, b2 = U0 + V0 * sine - W0 * cosine, U1 + V1 * sine - W1 * cosine, U2 + V2 * sine - W2 * cosine
        sine, cosine = w[2 * INSTRUMENT + SINE + j], w[2 * INSTRUMENT + COSINE + j]
        g = w[2 * INSTRUMENT + INDICATED + j]
        d0, d1, d2 = L0 + M0 * sine - N0 * cosine, L1 + M1 * sine - N1 * cosine, L2 + M2 * sine - N2 * cosine
        x0, x1, x2 = b1 * d2 - b2 * d1, b2 * d0 - b0 * d2, b0 * d1 - b1 * d0
        inverse = 1.0 / (a0 * x0 + a1 * x1 + a2 * x2)
        c[FORCE_X + 1 + j] = inverse * (e * x0 + f * (d1 * a2 - d2 * a1) + g * (a1 * b2 - a2 * b1))
        c[FORCE_Y + 1 + j] = inverse * (e * x1 + f * (d2 * a0 - d0 * a2) + g * (a2 * b0 - a0 * b2))
        c[FORCE_Z + 1 + j] = inverse * (e * x2 + f * (d0 * a1 - d1 * a0) + g * (a0 * b1 - a1 * b0))


@exact
def solve_block(
    first: int, n: int, psi: Array, rate: Array, p: Array, axes: Array, w: Array, c: Array
) -> None:  # fmt: skip
    """Force of ``n`` samples from ``first`` on into the rows FORCE; a part of a tile repeats the last sample."""
    whole = n // at.TILE * at.TILE
    rest = np.empty((2, at.TILE))
    for i in range(3):
        start, stop = i * INSTRUMENT, (i + 1) * INSTRUMENT
        find_angles(psi[i, first : first + whole], rate[i, first : first + whole], p[i], w[start:stop])
        if n > whole:
            for j in range(at.TILE):
                k = first + min(whole + j, n - 1)
                rest[0, j], rest[1, j] = psi[i, k], rate[i, k]
            find_angles(rest[0], rest[1], p[i], w[start + whole : stop])
    solve_three(whole + at.TILE if n > whole else whole, p, axes, w, c)


@exact
def write_forces(t: Array, begins: NDArray[np.bool_], time: float, c: Array, force: Array, dv: Array) -> None:
    """Force and increments of a block, ``time`` that of the sample before."""
    x0, y0, z0 = c[FORCE_X], c[FORCE_Y], c[FORCE_Z]
    for j in range(t.size):
        x, y, z = c[FORCE_X + 1 + j], c[FORCE_Y + 1 + j], c[FORCE_Z + 1 + j]
        step = 0.0 if begins[j] else t[j] - time
        force[j, 0], force[j, 1], force[j, 2] = x, y, z
        dv[j, 0] = 0.5 * (x0 + x) * step + 0.0  # never a negative zero
        dv[j, 1], dv[j, 2] = 0.5 * (y0 + y) * step + 0.0, 0.5 * (z0 + z) * step + 0.0
        x0, y0, z0, time = x, y, z, t[j]


@exact
def add_flags(
    psi: Array, before: float, tangent: float, limits: Array, axes: Array, c: Array, flags: NDArray[np.int32]
) -> None:
    """Flags of one instrument, as :func:`piga._kernels.compensate_terms.find_flags` gives them."""
    dead, near, most = tangent**2, (NEAR * tangent) ** 2, limits[2] ** 2
    low, high = limits[0], limits[1]

    for j in range(flags.size):
        x, y, z = c[FORCE_X + 1 + j], c[FORCE_Y + 1 + j], c[FORCE_Z + 1 + j]
        a = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z
        b = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z
        d = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z
        square, across = a * a, b * b + d * d
        flag = at.LOCKED if square < dead * across else 0
        flag |= at.NEAR_CRITICAL if (square >= dead * across) & (square < near * across) else 0
        flag |= at.OUT_OF_RANGE if (a < low) | (a > high) | (across > most) else 0
        flags[j] |= flag
    if abs(psi[0] - before) > 1.0:
        flags[0] |= at.COARSE
    start, stop, inside = psi[:-1], psi[1:], flags[1:]
    for j in range(inside.size):
        inside[j] |= at.COARSE if abs(stop[j] - start[j]) > 1.0 else 0


@exact
def compensate_triad(
    t: Array, psi: Array, rate: Array, begins: NDArray[np.bool_], p: Array, axes: Array, limits: Array,
    base_flag: int, states: Array, set_state: Array, c: Array, force: Array, dv: Array, residual: Array,
    flags: NDArray[np.int32],
) -> None:  # fmt: skip
    """Samples (3, n) to force and increments (n, 3); empty ``flags``: not wanted. State in and out."""
    w = np.empty(3 * INSTRUMENT)
    for start in range(0, t.size, at.BLOCK):
        stop = min(start + at.BLOCK, t.size)
        new = states[0, at.S_VALID] == 0.0
        solve_block(start, stop - start, psi, rate, p, axes, w, c)
        c[FORCE_X], c[FORCE_Y], c[FORCE_Z] = set_state[3], set_state[4], set_state[5]
        time = t[start] if new else states[0, at.S_TIME]
        write_forces(t[start:stop], begins[start:stop], time, c, force[start:stop], dv[start:stop])
        residual[start:stop] = 0.0
        flags[start:stop] = base_flag
        for i in range(3):
            if flags.size:
                before = psi[i, start] if new else states[i, at.S_PSI]
                add_flags(
                    psi[i, start:stop], before, p[i, at.P_TAN_BETA], limits[i], axes[i], c, flags[start:stop]
                )
            states[i, at.S_VALID], states[i, at.S_TIME] = 1.0, t[stop - 1]
            states[i, at.S_PSI] = psi[i, stop - 1]
        for j in range(start, stop if flags.size else start):
            if begins[j] or (new and j == start):
                flags[j] = (flags[j] & ~at.COARSE) | at.NO_INCREMENT
        set_state[3], set_state[4], set_state[5] = force[stop - 1, 0], force[stop - 1, 1], force[stop - 1, 2]
