"""Drivers: a chunk of any size through the stages, block by block, state in and state out."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.arithmetic.sine_cosine import LIMIT, fast_sine_cosine, sine_cosine
from piga._kernels.compensation import bow as between
from piga._kernels.compensation import compensate as angle
from piga._kernels.compensation import layout as at
from piga._kernels.compensation import near, terms
from piga._kernels.compensation import uncertainty as known
from piga._kernels.jit import exact, kernel
from piga._kernels.motion.step import advance, magnus_increments, unwrapped

Array = NDArray[np.float64]


@exact
def finish_block(
    n: int, per: int, p: Array, has_terms: bool, codes: NDArray[np.int64], factor: Array, limits: Array,
    base_flag: int, warm: bool, w: Array, u: Array, flags: NDArray[np.int32],
) -> None:  # fmt: skip
    """Error model, uncertainty and flags of a block whose indicated force is known."""
    if has_terms:
        terms.invert_terms(n, p, per == at.PER, w)
    else:
        terms.take_input(n, w)
    if u.size:
        known.find_uncertainty(n, per, has_terms, p, codes, factor, w, u)
    if flags.size:
        known.find_flags(n, p[at.P_TAN_BETA], limits, w, base_flag, warm, flags)


@exact
def indicate_intervals(n: int, formula: int, phi: float, K: float, w: Array) -> None:
    """Indicated mean force of every interval for inputs that are linear in it, and the angle in the middle."""
    if formula == at.PUBLISHED:
        near.find_nodes(angle.padded(n + 1), phi, w)
        angle.find_angles(1, angle.padded(n) + 1, phi, w)
        near.find_early(n + 1, w)
        angle.take_early(n, w)
        angle.published_formula(n, K, w)
        return
    stop = angle.padded(n) + 1
    near.find_nodes(angle.padded(n + 1), phi, w)
    far = near.find_early(stop, w)
    if far:
        angle.find_angles(0, angle.padded(n + 1), phi, w)
        angle.estimate_first(0, angle.padded(n + 1), w)
        angle.invert_motion(stop, K, w)
    near.invert_near(stop, K, w)
    if far:
        near.take_far(stop, w)
    near.middle_angles(n, phi, w)


@exact
def compensate_angles(
    t: Array,
    psi: Array,
    y: Array,
    z: Array,
    begins: NDArray[np.bool_],
    omega: Array,
    temperature: Array,
    formula: int,
    p: Array,
    has_terms: bool,
    orders: Array,
    sines: Array,
    cosines: Array,
    codes: NDArray[np.int64],
    factor: Array,
    limits: Array,
    base_flag: int,
    state: Array,
    w: Array,
    ax: Array,
    dv: Array,
    u: Array,
    flags: NDArray[np.int32],
) -> None:
    """Angle record (n,) to ``ax`` [m/s^2] and ``dv`` [m/s] of the interval that ends at each sample.

    Empty ``begins``, ``omega``, ``temperature``, ``u`` and ``flags`` mean: none, not wanted.
    """
    K = p[at.P_K]
    light = not (has_terms or orders.size or u.size or flags.size)
    full = has_terms or temperature.size > 0 or known.needs_time(codes)
    for start in range(0, t.size, at.BLOCK):
        n = min(at.BLOCK, t.size - start)
        stop = start + n
        valid = state[at.S_VALID] != 0.0
        if formula == at.PUBLISHED and not valid:
            state[at.S_START] = psi[start]
        angle.load_block(
            t[start:stop], psi[start:stop], y[start:stop], z[start:stop], omega[start:stop],
            temperature[start:stop], p, light, state, w,
        )  # fmt: skip
        angle.find_steps(n, begins[start:stop], valid, w)
        indicate_intervals(n, formula, p[at.P_PHI] - state[at.S_START], K, w)
        between.find_bows(n, omega.shape[0] > 0, state, w)
        if formula == at.PUBLISHED:
            between.straighten(n, w)
        if u.size:
            between.find_doubt(n, K, state, w)
        between.add_bows(n, K, w)
        if not light:
            angle.describe_means(n, K, w)
            if full:
                angle.describe_changes(n, w)
        terms.subtract_harmonics(n, orders, sines, cosines, w)
        finish_block(
            n, at.INVERSE, p, has_terms, codes, factor, limits, base_flag, temperature.size > 0,
            w, u[start:stop], flags[start:stop],
        )  # fmt: skip
        write_intervals(n, w, ax[start:stop], dv[start:stop], u[start:stop], flags[start:stop])
        angle.save_last(n, y[start:stop], z[start:stop], omega[start:stop], state, w)


@exact
def write_intervals(n: int, w: Array, ax: Array, dv: Array, u: Array, flags: NDArray[np.int32]) -> None:
    """Results of a block; rows without an increment hold no force, no uncertainty and no velocity."""
    for j in range(1, n + 1):
        step = w[at.STEP + j]
        ax[j - 1] = w[at.FORCE + j] if step != 0.0 else math.nan
        dv[j - 1] = w[at.FORCE + j] * step + 0.0  # never a negative zero
    for j in range(1, u.size + 1):
        u[j - 1] = u[j - 1] if w[at.STEP + j] != 0.0 else math.nan
    for j in range(1, flags.size + 1):
        flags[j - 1] = flags[j - 1] if w[at.STEP + j] != 0.0 else at.NO_INCREMENT


@exact
def follow_rate(n: int, rate: Array, p: Array, valid: bool, state: Array, w: Array) -> None:
    """Angle of a rate log by the exact motion, and ``u_x`` at every sample.

    The input that the rate and the transverse force give at both ends of an interval drives the motion over
    it; the end value depends on the angle there, three rounds settle it.
    """
    turns, rest = state[at.S_TURNS], state[at.S_REST]
    if not valid:
        turns, rest = 0.0, p[at.P_PHI]
    else:
        rest += p[at.P_PHI] - state[at.S_PHI]
    for j in range(1, n + 1):
        step = w[at.STEP + j]
        y1, z1 = w[at.RATE_Y + j], w[at.RATE_Z + j]
        if step != 0.0:
            y0, z0, a0 = w[at.RATE_Y + j - 1], w[at.RATE_Z + j - 1], w[at.FIRST + j - 1]
            half = 0.5 * rest
            sine, cosine = math.sin(half), math.cos(half)
            angle_turns, angle_rest = turns, rest + step * rate[j - 1]
            for _ in range(3):
                s, c = math.sin(angle_rest), math.cos(angle_rest)
                a1 = rate[j - 1] - (y1 * s - z1 * c)
                A, Y, Z = magnus_increments(step, a0, y0, z0, a1, y1, z1)
                angle_turns, angle_rest, _, _ = advance(turns, rest, sine, cosine, A, Y, Z)
            turns, rest = angle_turns, angle_rest
        s, c = sine_cosine(rest)
        w[at.SINE + j], w[at.COSINE + j] = s, c
        w[at.ANGLE + j] = rest
        w[at.PSI + j] = unwrapped(turns, rest)
        w[at.FIRST + j] = rate[j - 1] - (y1 * s - z1 * c)
    state[at.S_TURNS], state[at.S_REST], state[at.S_PHI] = turns, rest, p[at.P_PHI]


@exact
def take_angles(n: int, psi: Array, rate: Array, w: Array) -> None:
    """Recorded angle and rate into the work array, the last sample repeated to the end of the tile."""
    for j in range(n):
        w[at.PSI + 1 + j] = psi[j]
        w[at.FIRST + 1 + j] = rate[j]
    for j in range(n + 1, angle.padded(n) + 1):
        w[at.PSI + j], w[at.FIRST + j] = psi[n - 1], rate[n - 1]


@exact
def take_rates(n: int, rate: Array, w: Array) -> None:
    """Recorded rate of an instrument of a set, the last sample repeated to the end of the tile."""
    for j in range(n):
        w[at.HALF + 1 + j] = rate[j]
    for j in range(n + 1, angle.padded(n) + 1):
        w[at.HALF + j] = rate[n - 1]


@kernel
def find_samples(rows: int, phi: float, w: Array) -> None:
    """Angle, its sine and cosine, and ``u_x`` at samples whose angle and rate are both recorded.

    The angle stands in the row PSI, the rate in FIRST.
    """
    far = 0
    for j in range(1, rows + 1):
        alpha = phi + w[at.PSI + j]
        w[at.ANGLE + j] = alpha
        sine, cosine = fast_sine_cosine(alpha)
        w[at.SINE + j], w[at.COSINE + j] = sine, cosine
        far |= abs(alpha) > LIMIT
    if far:
        angle.library_angles(1, rows + 1, w)
    for j in range(1, rows + 1):
        w[at.FIRST + j] -= w[at.RATE_Y + j] * w[at.SINE + j] - w[at.RATE_Z + j] * w[at.COSINE + j]


@exact
def indicate_samples(n: int, K: float, w: Array) -> None:
    """Indicated specific force at the samples [m/s^2]."""
    inverse = 1.0 / K
    for j in range(1, n + 1):
        w[at.BASE_X + j] = w[at.OMEGA_X + j]
        w[at.INPUT + j] = (w[at.FIRST + j] + w[at.OMEGA_X + j]) * inverse


@exact
def write_samples(n: int, w: Array, ax: Array, dv: Array, flags: NDArray[np.int32]) -> None:
    """Results of a block of samples."""
    for j in range(1, n + 1):
        ax[j - 1] = w[at.FORCE + j]
        step = w[at.STEP + j]
        dv[j - 1] = 0.5 * step * (w[at.FORCE + j - 1] + w[at.FORCE + j]) if step != 0.0 else 0.0
    for j in range(1, flags.size + 1):
        if w[at.STEP + j] == 0.0:
            flags[j - 1] |= at.NO_INCREMENT


@exact
def describe_samples(n: int, full: bool, rate: Array, K: float, typical: float, w: Array) -> None:
    """The inputs at the samples, in the rows that hold means for intervals; ``full``: for the error model, too."""
    inverse, usual = 1.0 / K, 1.0 / typical
    for j in range(1, n + 1):
        w[at.MEAN_Y + j], w[at.MEAN_Z + j] = w[at.FORCE_Y + j], w[at.FORCE_Z + j]
        w[at.TURN + j] = rate[j - 1] * inverse
        w[at.PER + j] = w[at.INVERSE + j] if w[at.STEP + j] != 0.0 else usual
    if full:
        for j in range(1, n + 1):
            w[at.CHANGE_Y + j] = w[at.CHANGE_Z + j] = w[at.CHANGE_T + j] = w[at.SLOPE + j] = 0.0
            w[at.MEAN_T + j], w[at.MEAN_TIME + j] = w[at.WARMTH + j], w[at.TIME + j]


@exact
def sample_harmonics(n: int, orders: Array, sines: Array, cosines: Array, w: Array) -> None:
    """Second and higher harmonics of the output angle at the samples."""
    for k in range(orders.size):
        for j in range(1, n + 1):
            angle_k = orders[k] * w[at.ANGLE + j]
            w[at.INPUT + j] -= sines[k] * math.sin(angle_k) + cosines[k] * math.cos(angle_k)


@exact
def compensate_rates(
    t: Array,
    rate: Array,
    y: Array,
    z: Array,
    begins: NDArray[np.bool_],
    omega: Array,
    temperature: Array,
    typical: float,
    psi: Array,
    p: Array,
    has_terms: bool,
    orders: Array,
    sines: Array,
    cosines: Array,
    codes: NDArray[np.int64],
    factor: Array,
    limits: Array,
    base_flag: int,
    state: Array,
    w: Array,
    ax: Array,
    dv: Array,
    u: Array,
    flags: NDArray[np.int32],
) -> None:
    """Rate record (n,) to ``ax`` at the samples and ``dv`` over the interval before (ax linear in it).

    ``psi`` holds the recorded angle; empty: the angle follows from the rate.
    """
    light = not (has_terms or orders.size or u.size or flags.size)
    full = has_terms or temperature.size > 0 or known.needs_time(codes)
    for start in range(0, t.size, at.BLOCK):
        n = min(at.BLOCK, t.size - start)
        stop = start + n
        valid = state[at.S_VALID] != 0.0
        angle.load_block(
            t[start:stop], rate[start:stop], y[start:stop], z[start:stop], omega[start:stop],
            temperature[start:stop], p, light, state, w,
        )  # fmt: skip
        angle.find_steps(n, begins[start:stop], valid, w)
        if psi.size:
            take_angles(n, psi[start:stop], rate[start:stop], w)
            find_samples(angle.padded(n), p[at.P_PHI], w)
        else:
            follow_rate(n, rate[start:stop], p, valid, state, w)
        indicate_samples(n, p[at.P_K], w)
        if u.size:
            between.no_doubt(n, w)
        if not light:
            angle.find_inverse(n, w)
            describe_samples(n, full, rate[start:stop], p[at.P_K], typical, w)
        sample_harmonics(n, orders, sines, cosines, w)
        finish_block(
            n, at.PER, p, has_terms, codes, factor, limits, base_flag, temperature.size > 0, w,
            u[start:stop], flags[start:stop],
        )  # fmt: skip
        write_samples(n, w, ax[start:stop], dv[start:stop], flags[start:stop])
        angle.save_last(n, y[start:stop], z[start:stop], omega[start:stop], state, w)
