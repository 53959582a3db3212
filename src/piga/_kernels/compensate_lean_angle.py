"""Angle records to force, increments, uncertainty and flags: tile by tile, from column to column.

Three loops over tiles of constant size: sine and cosine of the angles read, the interval mean of
:mod:`piga._kernels.compensate_near` for constant input, the force (one loop for both is slower: its rows wait
longer than the processor looks ahead). Tiles that hold a rare row (an interval that turns far or differs from the one
before, a flag, the beginning of a stretch) are done by the same loops and mended row by row behind them, so that a row
is computed alike wherever it stands in a chunk. For calibrations whose only error term is ``k0``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels import compensate as angle
from piga._kernels import compensate_layout as at
from piga._kernels import compensate_near as near
from piga._kernels import compensate_uncertainty as known
from piga._kernels.compensate_lean import (
    LINE,
    SAFE,
    Flags,
    Marks,
    Weights,
    basic_weights,
    coupled,
    variance,
    with_noise,
)
from piga._kernels.jit import exact, inline, kernel, prefetch
from piga._kernels.sine_cosine import LIMIT, fast_sine_cosine

Array = NDArray[np.float64]

TILE = at.TILE
AHEAD = 128
"""Samples by which the columns are asked for before they are used."""
PAST = 2
"""Samples before the first row that every array holds."""


@exact
def less(indicated: float, bias: float) -> float:
    """Compensated force [m/s^2], never contracted."""
    return indicated - bias


@exact
def rate_of(turn: float, inverse: float) -> float:
    """Output rate [rad/s], never contracted: the uncertainty needs it, too, and must not change the force."""
    return turn * inverse


@inline
def early_mean(
    output: float, turn: float, h: float, swing: float, g0: float, g1: float, q0: float, q1: float
) -> float:
    """Mean ``u_x`` of an interval if it is constant there; ``swing``: of the transverse input, times ``h``."""
    mean = output - 0.5 * (g0 + g1)
    ends = swing + h * ((mean + g0) * q0 - (mean + g1) * q1)
    return mean - ends * (1 / 12 + turn * turn * (1 / 720) - (1 / 144) * (h * (q0 - q1)))


@inline
def change_of(x: float, u0: float, u1: float, u2: float, u3: float) -> float:
    """Change of ``u_x`` over an interval by backward differences of its means, see ``invert_near``."""
    change, before = u0 - u1, u1 - u2
    second = change - before
    return change - change * x + 0.5 * second + 0.25 * (second - (before - (u2 - u3)))


@inline
def bent_mean(early: float, turn: float, bend: float, g0: float, g1: float, q0: float, q1: float) -> float:
    """Mean of ``u_x`` whose integral from the beginning bends by ``bend``, its change over the interval times ``h``."""
    share = (q0 + q1) * (1 / 24 + (1 / 240) * (turn * turn))
    return early + bend * (share + (1 / 480) * bend * (g0 + g1))


@kernel
def tiles(  # noqa: C901, PLR0915 - loops over one tile; calls would keep their constants out of registers
    t: Array, psi: Array, y: Array, z: Array, begins: Marks, p: Array, m: Weights, limits: Array, base_flag: int,
    w: Array, ax: Array, dv: Array, u: Array | None, flags: Flags | None,
) -> int:  # fmt: skip
    """Whole tiles up to the first that holds a rare row (included); returns the rows before it.

    Entries 0 and 1 of every array are the samples before the tiles; in ``w`` the past stands at the end of a tile.
    ``flags`` may be empty where ``u`` is wanted; with neither, a row is rare by its interval only.
    """
    phi, coupling = p[at.P_PHI], p[at.P_K] * p[at.P_TAN_BETA]
    offset_y, offset_z, inverse_K, bias = p[at.P_OFFSET_Y], p[at.P_OFFSET_Z], 1.0 / p[at.P_K], p[at.P_TERMS]
    white, walk = 2.0 * p[at.P_WHITE] * (inverse_K * inverse_K), p[at.P_WALK] * (inverse_K * inverse_K)
    critical = (
        0.25 * (known.NEAR * p[at.P_TAN_BETA]) ** 2 * (1.0 + SAFE)
    )  # of sums over both ends, as the next ones
    most, low, high = 4.0 * limits[2] * limits[2] * (1.0 - SAFE), limits[0], limits[1]
    of_sums = (0.5 * m[0], 0.25 * m[1], m[2], m[3], 0.25 * m[4], m[5], m[6], m[7], m[8], m[9])
    for tile in range((t.size - PAST) // TILE):
        base = tile * TILE + PAST - 1
        for line in range(TILE // LINE):
            ahead = base + AHEAD + LINE * line
            prefetch(t, ahead)
            prefetch(psi, ahead)
            prefetch(y, ahead)
            prefetch(z, ahead)
        for k in range(3):
            w[at.EARLY - k], w[at.STEP - k] = w[at.EARLY + TILE - k], w[at.STEP + TILE - k]
        w[at.NODE_SINE], w[at.NODE_COSINE] = w[at.NODE_SINE + TILE], w[at.NODE_COSINE + TILE]
        w[at.COUPLING], w[at.ACROSS] = w[at.COUPLING + TILE], w[at.ACROSS + TILE]
        rare = (w[at.STEP] == 0.0) | (w[at.STEP - 1] == 0.0) | (w[at.STEP - 2] == 0.0)
        far = False
        for i in range(1, TILE + 1):
            alpha = phi + psi[base + i]
            w[at.NODE_SINE + i], w[at.NODE_COSINE + i] = fast_sine_cosine(alpha)
            far |= abs(alpha) > LIMIT
        for i in range(1, TILE + 1 if far else 1):
            alpha = phi + psi[base + i]
            if abs(alpha) > LIMIT:
                w[at.NODE_SINE + i], w[at.NODE_COSINE + i] = math.sin(alpha), math.cos(alpha)
        g0, q0 = w[at.COUPLING], w[at.ACROSS]
        for i in range(1, TILE + 1):
            j = base + i
            sine, cosine = w[at.NODE_SINE + i], w[at.NODE_COSINE + i]
            before_sine, before_cosine = w[at.NODE_SINE + i - 1], w[at.NODE_COSINE + i - 1]
            y1, z1 = coupled(coupling, y[j], offset_y), coupled(coupling, z[j], offset_z)
            h, turn = t[j] - t[j - 1], psi[j] - psi[j - 1]
            inverse = 1.0 / h if h != 0.0 else 0.0
            g1, q1 = y1 * sine - z1 * cosine, y1 * cosine + z1 * sine
            output = rate_of(turn, inverse)
            swing = (y[j] - y[j - 1]) * (before_sine - sine) - (z[j] - z[j - 1]) * (before_cosine - cosine)
            early = early_mean(output, turn, h, coupling * swing, g0, g1, q0, q1)
            w[at.EARLY + i], w[at.STEP + i], w[at.COUPLING + i], w[at.ACROSS + i] = early, h, g1, q1
            w[at.INVERSE + i] = inverse
            rare |= (abs(turn) > near.NEAR_TURN) | (abs(h) * (abs(y1) + abs(z1)) > near.NEAR_COUPLING)
            if u is not None:
                s, c = before_sine + sine, before_cosine + cosine
                square = variance(
                    y1 * c + z1 * s, (y[j - 1] + y[j]) * s - (z[j - 1] + z[j]) * c, output, of_sums
                )
                u[j] = with_noise(square, inverse, white, walk)
            g0, q0 = g1, q1
        e1, e2, e3, h1, g0, q0 = (
            w[at.EARLY], w[at.EARLY - 1], w[at.EARLY - 2], w[at.STEP], w[at.COUPLING], w[at.ACROSS],
        )  # fmt: skip
        for i in range(1, TILE + 1):
            j = base + i
            early, h, g1, q1 = w[at.EARLY + i], w[at.STEP + i], w[at.COUPLING + i], w[at.ACROSS + i]
            x, turn = 0.5 * (h1 * w[at.INVERSE + i] - 1.0), psi[j] - psi[j - 1]
            bent = bent_mean(early, turn, h * change_of(x, early, e1, e2, e3), g0, g1, q0, q1)
            a = less(bent * inverse_K, bias)
            ax[j], dv[j] = a, a * h + 0.0  # never a negative zero
            rare |= abs(x) > near.EVEN
            if flags is not None:
                sum_y, sum_z = y[j - 1] + y[j], z[j - 1] + z[j]
                across = sum_y * sum_y + sum_z * sum_z
                rare |= (a * a < critical * across) | (a < low) | (a > high) | (across > most)
            e3, e2, e1, h1, g0, q0 = e2, e1, early, h, g1, q1
        for j in range(base + 1, base + 1 + (TILE if begins.size else 0)):
            rare |= begins[j]
        if flags is not None:
            for j in range(base + 1, base + 1 + (TILE if flags.size else 0)):
                flags[j] = base_flag
        if rare:
            return tile * TILE
    return t.size - PAST


@exact
def prepare(base: int, psi: Array, y: Array, z: Array, begins: Marks, p: Array, w: Array) -> bool:
    """Rows of the work array for the tile behind entry ``base``; True when an interval in it turns far."""
    coupling, offset_y, offset_z = p[at.P_K] * p[at.P_TAN_BETA], p[at.P_OFFSET_Y], p[at.P_OFFSET_Z]
    for i in range(1, TILE + 1 if begins.size else 1):
        if begins[base + i]:
            w[at.STEP + i] = 0.0
    for i in range(-2, TILE + 1):
        step = w[at.STEP + i]
        w[at.INVERSE + i] = 1.0 / step if step != 0.0 else 0.0
    far = False
    for i in range(-1, TILE + 1):
        j = base + i
        y1, z1 = coupled(coupling, y[j], offset_y), coupled(coupling, z[j], offset_z)
        w[at.PSI + i], w[at.RATE_Y + i], w[at.RATE_Z + i] = psi[j], y1, z1
        if i > 0 and w[at.STEP + i] != 0.0:
            far |= not near.is_near(psi[j] - psi[j - 1], w[at.STEP + i], y1, z1)
    return far


@exact
def invert_far(p: Array, w: Array) -> None:
    """The exact inverse for all intervals of a tile; the loops run over whole tiles."""
    for i in range(TILE + 1, 2 * TILE):
        w[at.PSI + i] = w[at.RATE_Y + i] = w[at.RATE_Z + i] = w[at.STEP + i] = w[at.INVERSE + i] = 0.0
    angle.find_angles(0, 2 * TILE, p[at.P_PHI], w)
    angle.estimate_first(0, 2 * TILE, w)
    angle.invert_motion(TILE + 1, p[at.P_K], w)
    near.take_far(TILE + 1, w)


@exact
def mend_tile(
    base: int, psi: Array, y: Array, z: Array, begins: Marks, p: Array, m: Weights, limits: Array,
    base_flag: int, w: Array, ax: Array, dv: Array, u: Array, flags: Flags,
) -> None:  # fmt: skip
    """The tile behind entry ``base``, which has rare rows."""
    tangent, inverse_K = p[at.P_TAN_BETA], 1.0 / p[at.P_K]
    white, walk = 2.0 * p[at.P_WHITE] * (inverse_K * inverse_K), p[at.P_WALK] * (inverse_K * inverse_K)
    some_far = prepare(base, psi, y, z, begins, p, w)
    near.invert_odd(TILE + 1, p[at.P_K], w)
    if some_far:
        invert_far(p, w)
    for i in range(1, TILE + 1):
        j, h = base + i, w[at.STEP + i]
        turn, y1, z1 = psi[j] - psi[j - 1], w[at.RATE_Y + i], w[at.RATE_Z + i]
        mean_y, mean_z = 0.5 * (y[j - 1] + y[j]), 0.5 * (z[j - 1] + z[j])
        far = not near.is_near(turn, h, y1, z1)
        if h == 0.0:
            ax[j], dv[j] = math.nan, 0.0
        elif far or near.is_odd(i, w):
            ax[j] = less(w[at.INPUT + i], p[at.P_TERMS])
            dv[j] = ax[j] * h + 0.0
        if u.size:
            if far and h != 0.0:
                s, c = w[at.SINE + i], w[at.COSINE + i]
                square = variance(y1 * c + z1 * s, mean_y * s - mean_z * c, turn * w[at.INVERSE + i], m)
                u[j] = with_noise(square, w[at.INVERSE + i], white, walk)
            u[j] = known.widened(u[j], ax[j], mean_y, mean_z, tangent) if h != 0.0 else math.nan
        if flags.size:
            coarse = at.COARSE if abs(turn) > 1.0 else 0
            flag = known.flag_of(
                ax[j], mean_y, mean_z, tangent * tangent, limits[0], limits[1], limits[2] * limits[2]
            )
            flags[j] = base_flag | flag | coarse if h != 0.0 else at.NO_INCREMENT


@exact
def whole_tiles(
    t: Array, psi: Array, y: Array, z: Array, begins: Marks, p: Array, m: Weights, limits: Array, base_flag: int,
    w: Array, ax: Array, dv: Array, u: Array, flags: Flags,
) -> None:  # fmt: skip
    """Whole tiles behind entries 0 and 1 of every array, the samples before them."""
    first = 0
    while first < t.size - PAST:
        if u.size:
            first += tiles(
                t[first:], psi[first:], y[first:], z[first:], begins[first:], p, m, limits, base_flag, w, ax[first:],
                dv[first:], u[first:], flags[first:],
            )  # fmt: skip
        elif flags.size:
            first += tiles(
                t[first:], psi[first:], y[first:], z[first:], begins[first:], p, m, limits, base_flag, w, ax[first:],
                dv[first:], None, flags[first:],
            )  # fmt: skip
        else:
            first += tiles(
                t[first:], psi[first:], y[first:], z[first:], begins[first:], p, m, limits, base_flag, w, ax[first:],
                dv[first:], None, None,
            )  # fmt: skip
        if first < t.size - PAST:
            mend_tile(
                first + PAST - 1, psi, y, z, begins, p, m, limits, base_flag, w, ax, dv, u, flags
            )  # fmt: skip
            first += TILE


@exact
def few_rows(
    rows: int, t: Array, psi: Array, y: Array, z: Array, begins: Marks, p: Array, m: Weights, limits: Array,
    base_flag: int, state: Array, w: Array, ax: Array, dv: Array, u: Array, flags: Flags,
) -> None:  # fmt: skip
    """A tile of ``rows`` at most, in arrays of its own that go on evenly, behind the state; state in and out."""
    size = TILE + PAST
    c, marks = np.zeros((7, size)), np.zeros(size, dtype=np.bool_)
    signs = np.zeros(size if flags.size else 0, dtype=np.int32)
    c[0, 1], c[1, 1], c[2, 1], c[3, 1] = (
        state[at.S_TIME], state[at.S_PSI], state[at.S_FORCE_Y], state[at.S_FORCE_Z],
    )  # fmt: skip
    c[1, 0], c[2, 0], c[3, 0] = (
        state[at.S_PSI_BEFORE], state[at.S_FORCE_Y_BEFORE], state[at.S_FORCE_Z_BEFORE],
    )  # fmt: skip
    if state[at.S_VALID] == 0.0:
        c[1, 0] = c[1, 1] = psi[0]
    for j in range(rows):
        c[0, PAST + j], c[1, PAST + j], c[2, PAST + j], c[3, PAST + j] = t[j], psi[j], y[j], z[j]
    marks[PAST] = state[at.S_VALID] == 0.0
    for j in range(rows if begins.size else 0):
        marks[PAST + j] |= begins[j]
    last = rows + PAST - 1
    for j in range(last + 1, size):
        for k in range(2):
            c[k, j] = c[k, last] + (j - last) * (c[k, last] - c[k, last - 1])
        c[2, j], c[3, j] = c[2, last], c[3, last]
    whole_tiles(
        c[0], c[1], c[2], c[3], marks, p, m, limits, base_flag, w, c[4], c[5], c[6, : size if u.size else 0], signs
    )  # fmt: skip
    for j in range(rows):
        ax[j], dv[j] = c[4, PAST + j], c[5, PAST + j]
    for j in range(rows if u.size else 0):
        u[j] = c[6, PAST + j]
    for j in range(rows if flags.size else 0):
        flags[j] = signs[PAST + j]
    state[at.S_VALID], state[at.S_TIME], state[at.S_FORCE] = 1.0, c[0, last], c[4, last]
    state[at.S_PSI], state[at.S_FORCE_Y], state[at.S_FORCE_Z] = c[1, last], c[2, last], c[3, last]
    state[at.S_PSI_BEFORE] = c[1, last - 1]
    state[at.S_FORCE_Y_BEFORE], state[at.S_FORCE_Z_BEFORE] = c[2, last - 1], c[3, last - 1]
    to_end(rows, w)


@exact
def to_end(rows: int, w: Array) -> None:
    """Bring the past behind ``rows`` to the end of the tile."""
    for k in range(3):
        w[at.EARLY + TILE - k], w[at.STEP + TILE - k] = w[at.EARLY + rows - k], w[at.STEP + rows - k]
    for row in (at.NODE_SINE, at.NODE_COSINE, at.COUPLING, at.ACROSS):
        w[row + TILE] = w[row + rows]


@exact
def load_past(state: Array, w: Array) -> None:
    """What the first tile needs of the intervals before it."""
    for k in range(3):
        w[at.EARLY + TILE - k], w[at.STEP + TILE - k] = state[at.S_EARLY + k], state[at.S_STEPS + k]
    w[at.NODE_SINE + TILE], w[at.NODE_COSINE + TILE] = state[at.S_NODE_SINE], state[at.S_NODE_COSINE]
    w[at.COUPLING + TILE], w[at.ACROSS + TILE] = state[at.S_COUPLING], state[at.S_ACROSS]


@exact
def save_past(n: int, psi: Array, y: Array, z: Array, p: Array, state: Array, w: Array) -> None:
    """What the next chunk needs of this one; ``n``: the samples in it, none where they stand in the state."""
    if n:
        state[at.S_PSI], state[at.S_PSI_BEFORE] = psi[n - 1], psi[n - 2]
        state[at.S_FORCE_Y], state[at.S_FORCE_Y_BEFORE] = y[n - 1], y[n - 2]
        state[at.S_FORCE_Z], state[at.S_FORCE_Z_BEFORE] = z[n - 1], z[n - 2]
    coupling = p[at.P_K] * p[at.P_TAN_BETA]
    state[at.S_RATE_Y_BEFORE] = coupled(coupling, state[at.S_FORCE_Y_BEFORE], p[at.P_OFFSET_Y])
    state[at.S_RATE_Z_BEFORE] = coupled(coupling, state[at.S_FORCE_Z_BEFORE], p[at.P_OFFSET_Z])
    for k in range(3):
        state[at.S_EARLY + k], state[at.S_STEPS + k] = w[at.EARLY + TILE - k], w[at.STEP + TILE - k]
    state[at.S_NODE_SINE], state[at.S_NODE_COSINE] = w[at.NODE_SINE + TILE], w[at.NODE_COSINE + TILE]
    state[at.S_COUPLING], state[at.S_ACROSS] = w[at.COUPLING + TILE], w[at.ACROSS + TILE]


@exact
def compensate_intervals(
    t: Array, psi: Array, y: Array, z: Array, begins: Marks, p: Array, codes: NDArray[np.int64], factor: Array,
    limits: Array, base_flag: int, state: Array, w: Array, ax: Array, dv: Array, u: Array, flags: Flags,
) -> None:  # fmt: skip
    """Angles (n,) to ``ax``, ``dv``, ``u`` and ``flags`` (empty: not wanted); state in and out."""
    n, done = t.size, 0
    m = basic_weights(p, codes, factor)
    load_past(state, w)
    while done < n and (done < PAST or (n - done) % TILE):
        rows = (n - done - 1) % TILE + 1
        few_rows(
            rows, t[done:], psi[done:], y[done:], z[done:], begins[done:], p, m, limits, base_flag, state, w,
            ax[done:], dv[done:], u[done:], flags[done:],
        )  # fmt: skip
        done += rows
    k = done - PAST
    if done < n:
        whole_tiles(
            t[k:], psi[k:], y[k:], z[k:], begins[k:], p, m, limits, base_flag, w, ax[k:], dv[k:], u[k:], flags[k:]
        )  # fmt: skip
        state[at.S_TIME], state[at.S_FORCE] = t[n - 1], ax[n - 1]
    save_past(n if done < n else 0, psi, y, z, p, state, w)
