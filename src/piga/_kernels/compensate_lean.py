"""Samples of angle and rate to force, increments, uncertainty and flags: one pass over the memory.

One loop over tiles of constant size reads the caller's columns and writes the caller's results; nothing lies between.
Tiles that hold a rare row (an angle beyond the fast reduction, a flag, the beginning of a stretch) are done by the same loop and
mended row by row behind it, so that a sample is computed alike wherever it stands in a chunk.
For calibrations whose only error term is ``k0``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels import compensate_layout as at
from piga._kernels import compensate_uncertainty as known
from piga._kernels.jit import exact, inline, kernel, prefetch
from piga._kernels.sine_cosine import LIMIT, fast_sine_cosine, sine_cosine

Array = NDArray[np.float64]
Marks = NDArray[np.bool_]
Flags = NDArray[np.int32]
Weights = tuple[float, float, float, float, float, float, float, float, float, float]

TILE = at.TILE
LINE = 8
"""Numbers in a line of the fast caches."""
AHEAD = 128
"""Samples by which the columns are asked for before they are used."""
SAFE = 1e-9
"""Relative width around a limit of validity in which a row is looked at again."""


@exact
def is_lean(p: Array, codes: NDArray[np.int64]) -> bool:
    """True when ``k0`` is the only error term, and no other coefficients than the four basic ones are uncertain."""
    found = True
    for i in range(1, len(at.TERMS)):
        found &= p[at.P_TERMS + i] == 0.0
    for code in codes:
        found &= code in (at.PHI, at.TAN_BETA, at.SCALE_FACTOR, at.P_TERMS)
    return found


@exact
def basic_weights(p: Array, codes: NDArray[np.int64], factor: Array) -> Weights:
    """Triangular factor of :func:`variance`: phi, tan_beta, scale factor, k0; the last one squared.

    The codes fall in this order, so that the factor stays triangular with the columns that are not there.
    """
    m = np.zeros((4, 4))
    inverse = 1.0 / p[at.P_K]
    for k in range(codes.size):
        code = codes[k]
        column = 3 if code == at.P_TERMS else at.PHI - code
        scale = inverse if code == at.PHI else (inverse * inverse if code == at.SCALE_FACTOR else 1.0)
        for i in range(factor.shape[0]):
            m[i, column] = factor[i, k] * scale
    return (
        m[0, 0], m[0, 1], m[0, 2], m[0, 3], m[1, 1], m[1, 2], m[1, 3], m[2, 2], m[2, 3], m[3, 3] * m[3, 3],
    )  # fmt: skip


@inline
def variance(turn: float, swing: float, rate: float, m: Weights) -> float:
    """Variance of ``a_x`` by the basic coefficients [(m/s^2)^2] from the derivatives by phi, tan_beta, scale factor."""
    one = (m[0] * turn + m[1] * swing) + (m[2] * rate + m[3])
    two, three = m[4] * swing + (m[5] * rate + m[6]), m[7] * rate + m[8]
    return (one * one + two * two) + (three * three + m[9])


@exact
def coupled(factor: float, force: float, offset: float) -> float:
    """``tan_beta u_Y`` [rad/s] with both roundings."""
    return factor * force + offset


@inline
def force_of(
    rate: float, u_y: float, u_z: float, sine: float, cosine: float, inverse: float, bias: float
) -> float:
    """``a_x`` [m/s^2] by the effective input axis."""
    return (rate - (u_y * sine - u_z * cosine)) * inverse - bias


@inline
def mean_increment(step: float, before: float, force: float) -> float:
    """Increment [m/s] of a force that is linear in an interval."""
    return 0.5 * step * (before + force)


@inline
def with_noise(square: float, per: float, white: float, walk: float) -> float:
    """Standard uncertainty from the variance by the coefficients and the noise of a row; ``per`` 1 over its time."""
    return math.sqrt(square + (white * per + walk) * per)


@kernel
def bare_tiles(
    t: Array, psi: Array, rate: Array, y: Array, z: Array, begins: Marks, p: Array, limits: Array, base_flag: int,
    ax: Array, dv: Array, flags: Flags,
) -> int:  # fmt: skip
    """Force and increments of whole tiles up to the first that holds a rare row (included); returns the rows before it.

    Entry 0 of every array is the sample before the tiles.
    """
    phi, coupling = p[at.P_PHI], p[at.P_K] * p[at.P_TAN_BETA]
    offset_y, offset_z, inverse, bias = p[at.P_OFFSET_Y], p[at.P_OFFSET_Z], 1.0 / p[at.P_K], p[at.P_TERMS]
    near, most = (known.NEAR * p[at.P_TAN_BETA]) ** 2 * (1.0 + SAFE), limits[2] * limits[2] * (1.0 - SAFE)
    low, high, force = limits[0], limits[1], ax[0]
    for tile in range((t.size - 1) // TILE):
        start = tile * TILE + 1
        for line in range(TILE // LINE):
            ahead = start + AHEAD + LINE * line
            prefetch(t, ahead)
            prefetch(psi, ahead)
            prefetch(rate, ahead)
            prefetch(y, ahead)
            prefetch(z, ahead)
        far = flag = 0
        for j in range(start, start + TILE):
            alpha, across = phi + psi[j], y[j] * y[j] + z[j] * z[j]
            sine, cosine = fast_sine_cosine(alpha)
            u_y, u_z = coupled(coupling, y[j], offset_y), coupled(coupling, z[j], offset_z)
            a = force_of(rate[j], u_y, u_z, sine, cosine, inverse, bias)
            step = t[j] - t[j - 1]
            ax[j], dv[j] = a, mean_increment(step, force, a)
            far |= (abs(alpha) > LIMIT) | (step == 0.0)
            flag |= (a * a < near * across) | (a < low) | (a > high) | (across > most)
            flag |= abs(psi[j] - psi[j - 1]) > 1.0
            force = a
        for j in range(start, start + (TILE if begins.size else 0)):
            far |= begins[j]
        for j in range(start, start + (TILE if flags.size else 0)):
            flags[j] = base_flag
        if far | (flag & (flags.size > 0)):
            return start - 1
    return t.size - 1


@kernel
def full_tiles(
    t: Array, psi: Array, rate: Array, y: Array, z: Array, begins: Marks, p: Array, m: Weights, limits: Array,
    base_flag: int, ax: Array, dv: Array, u: Array, flags: Flags,
) -> int:  # fmt: skip
    """The same with the standard uncertainty of every row."""
    phi, coupling = p[at.P_PHI], p[at.P_K] * p[at.P_TAN_BETA]
    offset_y, offset_z, inverse, bias = p[at.P_OFFSET_Y], p[at.P_OFFSET_Z], 1.0 / p[at.P_K], p[at.P_TERMS]
    white, walk = 2.0 * p[at.P_WHITE] * (inverse * inverse), p[at.P_WALK] * (inverse * inverse)
    near, most = (known.NEAR * p[at.P_TAN_BETA]) ** 2 * (1.0 + SAFE), limits[2] * limits[2] * (1.0 - SAFE)
    low, high, force = limits[0], limits[1], ax[0]
    for tile in range((t.size - 1) // TILE):
        start = tile * TILE + 1
        for line in range(TILE // LINE):
            ahead = start + AHEAD + LINE * line
            prefetch(t, ahead)
            prefetch(psi, ahead)
            prefetch(rate, ahead)
            prefetch(y, ahead)
            prefetch(z, ahead)
        rare = 0
        for j in range(start, start + TILE):
            alpha, across = phi + psi[j], y[j] * y[j] + z[j] * z[j]
            sine, cosine = fast_sine_cosine(alpha)
            u_y, u_z = coupled(coupling, y[j], offset_y), coupled(coupling, z[j], offset_z)
            a, step = force_of(rate[j], u_y, u_z, sine, cosine, inverse, bias), t[j] - t[j - 1]
            ax[j], dv[j] = a, mean_increment(step, force, a)
            square = variance(u_y * cosine + u_z * sine, y[j] * sine - z[j] * cosine, rate[j], m)
            u[j] = with_noise(square, 1.0 / step if step != 0.0 else 0.0, white, walk)
            rare |= (abs(alpha) > LIMIT) | (step == 0.0) | (a * a < near * across) | (a < low) | (a > high)
            rare |= (across > most) | (abs(psi[j] - psi[j - 1]) > 1.0)
            force = a
        for j in range(start, start + (TILE if begins.size else 0)):
            rare |= begins[j]
        for j in range(start, start + (TILE if flags.size else 0)):
            flags[j] = base_flag
        if rare:
            return start - 1
    return t.size - 1


@exact
def mend_row(
    j: int, per: float, rate: Array, psi: Array, y: Array, z: Array, p: Array, m: Weights, ax: Array, u: Array
) -> None:
    """A row beyond the fast reduction or that begins a stretch, ``per`` 1 over the time that it stands for."""
    coupling, inverse = p[at.P_K] * p[at.P_TAN_BETA], 1.0 / p[at.P_K]
    alpha = p[at.P_PHI] + psi[j]
    sine, cosine = sine_cosine(alpha)
    u_y, u_z = coupled(coupling, y[j], p[at.P_OFFSET_Y]), coupled(coupling, z[j], p[at.P_OFFSET_Z])
    if abs(alpha) > LIMIT:
        ax[j] = force_of(rate[j], u_y, u_z, sine, cosine, inverse, p[at.P_TERMS])
    if u.size:
        square = variance(u_y * cosine + u_z * sine, y[j] * sine - z[j] * cosine, rate[j], m)
        white, walk = 2.0 * p[at.P_WHITE] * (inverse * inverse), p[at.P_WALK] * (inverse * inverse)
        u[j] = with_noise(square, per, white, walk)


@exact
def mend_tile(
    first: int, t: Array, psi: Array, rate: Array, y: Array, z: Array, begins: Marks, typical: float, p: Array,
    m: Weights, limits: Array, base_flag: int, ax: Array, dv: Array, u: Array, flags: Flags,
) -> None:  # fmt: skip
    """The tile behind entry ``first``, which has rare rows."""
    tangent = p[at.P_TAN_BETA]
    for j in range(first + 1, first + 1 + TILE):
        step = t[j] - t[j - 1]
        starts = step == 0.0 or (begins.size > 0 and begins[j])
        if starts or abs(p[at.P_PHI] + psi[j]) > LIMIT:
            mend_row(j, 1.0 / (typical if starts else step), rate, psi, y, z, p, m, ax, u)
        dv[j] = 0.0 if starts else mean_increment(step, ax[j - 1], ax[j])
        if u.size:
            u[j] = known.widened(u[j], ax[j], y[j], z[j], tangent)
        if flags.size:
            coarse = at.COARSE if abs(psi[j] - psi[j - 1]) > 1.0 and not starts else 0
            flag = known.flag_of(
                ax[j], y[j], z[j], tangent * tangent, limits[0], limits[1], limits[2] * limits[2]
            )
            flags[j] = base_flag | flag | coarse | (at.NO_INCREMENT if starts else 0)


@exact
def whole_tiles(
    t: Array, psi: Array, rate: Array, y: Array, z: Array, begins: Marks, typical: float, p: Array, m: Weights,
    limits: Array, base_flag: int, ax: Array, dv: Array, u: Array, flags: Flags,
) -> None:  # fmt: skip
    """Whole tiles behind entry 0 of every array, the sample before them."""
    first = 0
    while first < t.size - 1:
        if u.size:
            first += full_tiles(
                t[first:], psi[first:], rate[first:], y[first:], z[first:], begins[first:], p, m, limits, base_flag,
                ax[first:], dv[first:], u[first:], flags[first:],
            )  # fmt: skip
        else:
            first += bare_tiles(
                t[first:], psi[first:], rate[first:], y[first:], z[first:], begins[first:], p, limits, base_flag,
                ax[first:], dv[first:], flags[first:],
            )  # fmt: skip
        if first < t.size - 1:
            mend_tile(
                first, t, psi, rate, y, z, begins, typical, p, m, limits, base_flag, ax, dv, u, flags
            )  # fmt: skip
            first += TILE


@exact
def first_rows(
    rows: int, t: Array, psi: Array, rate: Array, y: Array, z: Array, begins: Marks, typical: float, p: Array,
    m: Weights, limits: Array, base_flag: int, state: Array, ax: Array, dv: Array, u: Array, flags: Flags,
) -> None:  # fmt: skip
    """The first ``rows`` of a chunk, a tile at most: in arrays of a tile, the last one repeated, behind the state."""
    c, marks = np.zeros((8, TILE + 1)), np.zeros(TILE + 1, dtype=np.bool_)
    signs = np.zeros(TILE + 1 if flags.size else 0, dtype=np.int32)
    marks[1] = state[at.S_VALID] == 0.0
    c[0, 0], c[1, 0], c[5, 0] = state[at.S_TIME], state[at.S_PSI], state[at.S_FORCE]
    for j in range(TILE):
        k = min(j, rows - 1)
        c[0, 1 + j], c[1, 1 + j], c[2, 1 + j] = t[k] + (j - k), psi[k], rate[k]
        c[3, 1 + j], c[4, 1 + j] = y[k], z[k]
    for j in range(rows if begins.size else 0):
        marks[1 + j] |= begins[j]
    whole_tiles(
        c[0], c[1], c[2], c[3], c[4], marks, typical, p, m, limits, base_flag, c[5], c[6],
        c[7, : TILE + 1 if u.size else 0], signs,
    )  # fmt: skip
    for j in range(rows):
        ax[j], dv[j] = c[5, 1 + j], c[6, 1 + j]
    for j in range(rows if u.size else 0):
        u[j] = c[7, 1 + j]
    for j in range(rows if flags.size else 0):
        flags[j] = signs[1 + j]


@exact
def compensate_samples(
    t: Array, rate: Array, y: Array, z: Array, begins: Marks, psi: Array, typical: float, p: Array,
    codes: NDArray[np.int64], factor: Array, limits: Array, base_flag: int, state: Array, ax: Array, dv: Array,
    u: Array, flags: Flags,
) -> None:  # fmt: skip
    """Samples (n,) to ``ax``, ``dv``, ``u`` and ``flags`` (empty: not wanted); state in and out."""
    n = t.size
    if n == 0:
        return
    m = basic_weights(p, codes, factor)
    rows = (n - 1) % TILE + 1
    first_rows(
        rows, t, psi, rate, y, z, begins, typical, p, m, limits, base_flag, state, ax, dv, u, flags
    )  # fmt: skip
    k = rows - 1
    whole_tiles(
        t[k:], psi[k:], rate[k:], y[k:], z[k:], begins[k:], typical, p, m, limits, base_flag, ax[k:], dv[k:], u[k:],
        flags[k:],
    )  # fmt: skip
    state[at.S_VALID], state[at.S_TIME], state[at.S_PSI] = 1.0, t[n - 1], psi[n - 1]
    state[at.S_FORCE_Y], state[at.S_FORCE_Z], state[at.S_FORCE] = y[n - 1], z[n - 1], ax[n - 1]
