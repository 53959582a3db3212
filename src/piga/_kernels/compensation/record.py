"""Compensate a chunk of any size of one instrument, block by block; state in, state out.

Angles and rates use the same kernel. A missing angle or rate is None. The compiler then omits the code for it. Any other
missing input is an empty array.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from piga._kernels.arithmetic import sine_cosine
from piga._kernels.compensation import indication as indicated
from piga._kernels.compensation import layout as at
from piga._kernels.compensation import terms
from piga._kernels.compensation.indication import padded
from piga._kernels.jit import Array, exact
from piga._kernels.motion.step import advance, magnus_increments, unwrapped


class Samples(NamedTuple):
    """Known inputs: time [s], transverse force [m/s^2], stretches, base rate (n, 3) [rad/s], temperature [K].

    All but ``t`` may be empty.
    """

    t: Array
    y: Array
    z: Array
    begins: NDArray[np.bool_]
    base_rate: Array
    temperature: Array


class InstrumentArrays(NamedTuple):
    """Coefficients of an instrument: parameters by index, harmonics, covariance factor, limits.

    ``factor`` F (rank, coefficients) is upper triangular. ``F' F`` is the covariance of the coefficients ``codes``.
    """

    parameters: Array
    orders: Array
    sines: Array
    cosines: Array
    codes: NDArray[np.int64]
    factor: Array
    limits: Array


class Settings(NamedTuple):
    """Settings: error model present or not; formula; flags for all rows; time of a rate that begins a stretch [s]."""

    has_terms: bool
    formula: int
    base_flag: int
    typical: float


class RowArrays(NamedTuple):
    """Results (n,): ``ax`` [m/s^2], ``dv`` [m/s], ``u`` [m/s^2] and flags; the last two may be empty."""

    ax: Array
    dv: Array
    u: Array
    flags: NDArray[np.int32]


@exact
def compensate_record(
    samples: Samples,
    psi: Array | None,
    rate: Array | None,
    instrument: InstrumentArrays,
    settings: Settings,
    state: Array,
    w: Array,
    rows: RowArrays,
) -> None:
    """Compensate angles ``psi`` [rad], or rates [rad/s] with or without recorded angles, (n,).

    Without a rate: mean force and increment of the interval that ends at each sample. With a rate: force at the samples,
    and increments of a force that is linear between them.
    """
    p, orders = instrument.parameters, instrument.orders
    K, warm = p[at.P_K], samples.temperature.size > 0
    light = not (settings.has_terms or orders.size or rows.u.size or rows.flags.size)
    full = settings.has_terms or warm or terms.needs_time(instrument.codes)
    per = at.INVERSE
    for start in range(0, samples.t.size, at.BLOCK):
        n = at.BLOCK if samples.t.size - start > at.BLOCK else samples.t.size - start
        valid = state[at.S_VALID] != 0.0
        load_block(start, n, samples, psi, p, light, state, w)
        if rate is None:
            published = settings.formula == at.PUBLISHED
            if published and not valid:
                state[at.S_START] = w[at.PSI + 1]
            indicated.indicate_intervals(n, published, p[at.P_PHI] - state[at.S_START], K, w)
            indicated.find_bows(n, samples.base_rate.shape[0] > 0, published, state, w)
            if rows.u.size:
                indicated.find_doubt(n, K, state, w)
            indicated.add_bows(n, K, w)
            if not light:
                describe_intervals(n, K, full, w)
            if orders.size:
                terms.subtract_harmonics(n, orders, instrument.sines, instrument.cosines, w)
            terms.invert_terms(n, p, settings.has_terms, False, w)
        else:
            per, rates = at.PER, rate[start : start + n]
            if psi is None:
                follow_rate(n, rates, p, valid, state, w)
            else:
                take_rates(n, rates, at.FIRST, w)
                indicated.find_samples(padded(n), p[at.P_PHI], w)
            indicated.indicate_samples(n, K, w)
            if not light:
                find_inverse(n, w)
                describe_samples(n, full, rates, K, settings.typical, w)
            if orders.size:
                terms.sample_harmonics(n, orders, instrument.sines, instrument.cosines, w)
            terms.invert_terms(n, p, settings.has_terms, True, w)
        if rows.u.size:
            terms.find_variance(n, instrument.codes, instrument.factor, p, w)
            terms.find_uncertainty(n, per, settings.has_terms, p, w)
        if rows.flags.size:
            terms.find_flags(
                n,
                p[at.P_TAN_BETA],
                instrument.limits,
                w,
                settings.base_flag,
                warm,
                rows.flags[start : start + n],
            )
        if rate is None:
            write_intervals(start, n, w, rows)
        else:
            write_samples(start, n, w, rows)
        save_last(start, n, samples, state, w)


@exact
def load_block(
    start: int, n: int, samples: Samples, psi: Array | None, p: Array, light: bool, state: Array, w: Array
) -> None:
    """Load a block of samples and its past into the work array; ``light``: only part of it."""
    K, tangent = p[at.P_K], p[at.P_TAN_BETA]
    coupling, offset_y, offset_z = K * tangent, p[at.P_OFFSET_Y], p[at.P_OFFSET_Z]
    load_past(coupling, offset_y, offset_z, tangent, state, w)
    stop, tail = start + n, padded(n)
    t, y, z = samples.t[start:stop], samples.y[start:stop], samples.z[start:stop]
    omega, warmth = samples.base_rate[start:stop], samples.temperature[start:stop]
    for j in range(n):
        w[at.TIME + 1 + j] = t[j]
    if psi is not None:
        angles = psi[start:stop]
        for j in range(n):
            w[at.PSI + 1 + j] = angles[j]
        for j in range(n, tail):
            w[at.PSI + 1 + j] = w[at.PSI + n]
    for j in range(0 if y.size else n):
        w[at.RATE_Y + 1 + j], w[at.RATE_Z + 1 + j] = offset_y, offset_z
    for j in range(y.size):
        w[at.RATE_Y + 1 + j] = coupling * y[j] + offset_y
    for j in range(z.size):
        w[at.RATE_Z + 1 + j] = coupling * z[j] + offset_z
    for j in range(0 if light else y.size):
        w[at.FORCE_Y + 1 + j], w[at.FORCE_Z + 1 + j] = y[j], z[j]
    for j in range(0 if omega.shape[0] else n):
        w[at.OMEGA_X + 1 + j] = w[at.OMEGA_Y + 1 + j] = w[at.OMEGA_Z + 1 + j] = 0.0
    for j in range(omega.shape[0]):
        w[at.OMEGA_X + 1 + j], w[at.OMEGA_Y + 1 + j], w[at.OMEGA_Z + 1 + j] = (
            omega[j, 0],
            omega[j, 1],
            omega[j, 2],
        )
        w[at.RATE_Y + 1 + j] -= tangent * omega[j, 1]
        w[at.RATE_Z + 1 + j] -= tangent * omega[j, 2]
    for j in range(warmth.size):
        w[at.WARMTH + 1 + j] = warmth[j] - p[at.P_TEMPERATURE_REFERENCE]
    for j in range(1 + n, 1 + tail):
        w[at.TIME + j], w[at.OMEGA_X + j], w[at.WARMTH + j] = (
            w[at.TIME + n],
            w[at.OMEGA_X + n],
            w[at.WARMTH + n],
        )
        w[at.RATE_Y + j], w[at.RATE_Z + j] = w[at.RATE_Y + n], w[at.RATE_Z + n]
        w[at.FORCE_Y + j], w[at.FORCE_Z + j] = w[at.FORCE_Y + n], w[at.FORCE_Z + n]
    find_steps(start, n, samples.begins, state[at.S_VALID] != 0.0, w)


@exact
def load_past(
    coupling: float, offset_y: float, offset_z: float, tangent: float, state: Array, w: Array
) -> None:  # fmt: skip
    """Load the earlier samples and intervals that the block needs."""
    w[at.TIME], w[at.PSI], w[at.PSI - 1] = state[at.S_TIME], state[at.S_PSI], state[at.S_PSI_BEFORE]
    w[at.FORCE_Y], w[at.FORCE_Z] = state[at.S_FORCE_Y], state[at.S_FORCE_Z]
    w[at.OMEGA_X], w[at.WARMTH] = state[at.S_OMEGA_X], state[at.S_WARMTH]
    w[at.OMEGA_Y], w[at.OMEGA_Z] = state[at.S_OMEGA_Y], state[at.S_OMEGA_Z]
    w[at.RATE_Y] = coupling * state[at.S_FORCE_Y] + offset_y - tangent * state[at.S_OMEGA_Y]
    w[at.RATE_Z] = coupling * state[at.S_FORCE_Z] + offset_z - tangent * state[at.S_OMEGA_Z]
    for k in range(2):
        w[at.OMEGA_X - 1 - k] = state[at.S_OMEGA_X_BEFORE + k]
        w[at.RATE_Y - 1 - k] = state[at.S_RATE_Y_BEFORE + k]
        w[at.RATE_Z - 1 - k] = state[at.S_RATE_Z_BEFORE + k]
    w[at.FIRST], w[at.FORCE] = state[at.S_FIRST], state[at.S_FORCE]
    for k in range(3):
        step = state[at.S_STEPS + k]
        w[at.EARLY - k], w[at.STEP - k] = state[at.S_EARLY + k], step
        w[at.INVERSE - k] = 1.0 / step if step != 0.0 else 0.0


@exact
def find_steps(start: int, n: int, begins: NDArray[np.bool_], valid: bool, w: Array) -> None:
    """Interval lengths; 0 where a stretch begins."""
    for j in range(1, n + 1):
        w[at.STEP + j] = w[at.TIME + j] - w[at.TIME + j - 1]
    marks = begins[start : start + n]
    for j in range(marks.size):
        w[at.STEP + 1 + j] = 0.0 if marks[j] else w[at.STEP + 1 + j]
    if not valid:
        w[at.STEP + 1] = 0.0
    for j in range(n + 1, padded(n) + 1):
        w[at.STEP + j] = 0.0


@exact
def save_last(start: int, n: int, samples: Samples, state: Array, w: Array) -> None:
    """Save the data that the next block needs."""
    last, known = start + n - 1, samples.y.size > 0
    state[at.S_VALID] = 1.0
    state[at.S_TIME], state[at.S_PSI] = w[at.TIME + n], w[at.PSI + n]
    state[at.S_PSI_BEFORE] = w[at.PSI + n - 1]
    state[at.S_FORCE_Y], state[at.S_FORCE_Z] = (
        samples.y[last] if known else 0.0,
        samples.z[last] if known else 0.0,
    )
    state[at.S_WARMTH] = w[at.WARMTH + n]
    state[at.S_FIRST], state[at.S_FORCE] = w[at.FIRST + n], w[at.FORCE + n]
    for k in range(3):
        state[at.S_EARLY + k], state[at.S_STEPS + k] = w[at.EARLY + n - k], w[at.STEP + n - k]
    for axis in range(3):
        state[at.S_OMEGA_X + axis] = samples.base_rate[last, axis] if samples.base_rate.shape[0] else 0.0


@exact
def describe_intervals(n: int, K: float, full: bool, w: Array) -> None:
    """Means of the known inputs over every interval; ``full``: also times, temperatures and changes."""
    inverse = 1.0 / K
    for j in range(1, n + 1):
        w[at.MEAN_Y + j] = 0.5 * (w[at.FORCE_Y + j - 1] + w[at.FORCE_Y + j])
        w[at.MEAN_Z + j] = 0.5 * (w[at.FORCE_Z + j - 1] + w[at.FORCE_Z + j])
        w[at.TURN + j] = (w[at.PSI + j] - w[at.PSI + j - 1]) * w[at.INVERSE + j] * inverse
    for j in range(1, n + 1 if full else 0):
        w[at.MEAN_T + j] = 0.5 * (w[at.WARMTH + j - 1] + w[at.WARMTH + j])
        w[at.CHANGE_Y + j] = w[at.FORCE_Y + j] - w[at.FORCE_Y + j - 1]
        w[at.CHANGE_Z + j] = w[at.FORCE_Z + j] - w[at.FORCE_Z + j - 1]
        w[at.CHANGE_T + j] = w[at.WARMTH + j] - w[at.WARMTH + j - 1]
        w[at.MEAN_TIME + j] = 0.5 * (w[at.TIME + j - 1] + w[at.TIME + j])


@exact
def write_intervals(start: int, n: int, w: Array, rows: RowArrays) -> None:
    """Results of a block; rows without an increment contain no force, no uncertainty and no velocity."""
    stop = start + n
    ax, dv, u, flags = rows.ax[start:stop], rows.dv[start:stop], rows.u[start:stop], rows.flags[start:stop]
    for j in range(n):
        step = w[at.STEP + 1 + j]
        ax[j] = w[at.FORCE + 1 + j] if step != 0.0 else math.nan
        dv[j] = w[at.FORCE + 1 + j] * step + 0.0  # never a negative zero
    for j in range(u.size):
        u[j] = w[at.KNOWN_TO + 1 + j] if w[at.STEP + 1 + j] != 0.0 else math.nan
    for j in range(flags.size):
        flags[j] = flags[j] if w[at.STEP + 1 + j] != 0.0 else at.NO_INCREMENT


@exact
def write_samples(start: int, n: int, w: Array, rows: RowArrays) -> None:
    """Write the results of a block of samples."""
    stop = start + n
    ax, dv, u, flags = rows.ax[start:stop], rows.dv[start:stop], rows.u[start:stop], rows.flags[start:stop]
    for j in range(n):
        step = w[at.STEP + 1 + j]
        ax[j] = w[at.FORCE + 1 + j]
        dv[j] = 0.5 * step * (w[at.FORCE + j] + w[at.FORCE + 1 + j]) if step != 0.0 else 0.0
    for j in range(u.size):
        u[j] = w[at.KNOWN_TO + 1 + j]
    for j in range(flags.size):
        if w[at.STEP + 1 + j] == 0.0:
            flags[j] |= at.NO_INCREMENT


@exact
def take_rates(n: int, rate: Array, row: int, w: Array) -> None:
    """Recorded rate into a row of the work array, the last sample repeated to the end of the tile."""
    into = w[row + 1 : row + 1 + padded(n)]
    for j in range(n):
        into[j] = rate[j]
    for j in range(n, into.size):
        into[j] = rate[n - 1]


@exact
def find_inverse(n: int, w: Array) -> None:
    """Inverse of the interval lengths; 0 where a stretch begins."""
    for j in range(1, n + 1):
        step = w[at.STEP + j]
        w[at.INVERSE + j] = 1.0 / step if step != 0.0 else 0.0
    for j in range(n + 1, padded(n) + 1):
        w[at.INVERSE + j] = 0.0


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
def describe_samples(n: int, full: bool, rate: Array, K: float, typical: float, w: Array) -> None:
    """The inputs at the samples, in the rows for interval means; ``full``: also those for the error model."""
    inverse, usual = 1.0 / K, 1.0 / typical
    for j in range(1, n + 1):
        w[at.MEAN_Y + j], w[at.MEAN_Z + j] = w[at.FORCE_Y + j], w[at.FORCE_Z + j]
        w[at.TURN + j] = rate[j - 1] * inverse
        w[at.PER + j] = w[at.INVERSE + j] if w[at.STEP + j] != 0.0 else usual
    if full:
        for j in range(1, n + 1):
            w[at.CHANGE_Y + j] = w[at.CHANGE_Z + j] = w[at.CHANGE_T + j] = w[at.SLOPE + j] = 0.0
            w[at.MEAN_T + j], w[at.MEAN_TIME + j] = w[at.WARMTH + j], w[at.TIME + j]
