"""Driver of a set of instruments: a chunk of any size, block by block, state in and state out."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.compensation import bow as between
from piga._kernels.compensation import compensate as angle
from piga._kernels.compensation import layout as at
from piga._kernels.compensation import record as single
from piga._kernels.compensation import set as set_of
from piga._kernels.compensation import terms
from piga._kernels.compensation import uncertainty as known
from piga._kernels.jit import exact

Array = NDArray[np.float64]

EXACT_ROUNDS = 3
"""Rounds with the exact equations behind the linear one; each leaves less than 1e-4 of the misfit before it."""
TERM_ROUNDS = 7
"""The same with an error model: each round leaves about ``2 k2 a_x`` (0.4 % for 2e-3 per g at 1 g) of it."""


@exact
def load_instrument(
    t: Array, psi: Array, rate: Array, begins: NDArray[np.bool_], omega: Array, temperature: Array,
    p: Array, axes: Array, orders: Array, sines: Array, cosines: Array, state: Array, zeros: Array, w: Array,
) -> None:  # fmt: skip
    """Samples of one instrument, its angles, effective axes and harmonics."""
    n, rows = t.size, angle.padded(t.size)
    angle.load_block(t, psi, zeros[:n], zeros[:n], omega, temperature, p, False, state, w)
    angle.find_steps(n, begins, state[at.S_VALID] != 0.0, w)
    angle.find_inverse(n, w)
    if rate.size:
        single.take_angles(n, psi, rate, w)
        single.find_samples(rows, p[at.P_PHI], w)
        single.describe_samples(n, True, rate, p[at.P_K], math.nan, w)
        single.take_rates(n, rate, w)
        set_of.sample_axis(rows, p, axes, w)
        set_of.sample_base(rows, w)
        between.no_doubt(n, w)
    else:
        angle.find_angles(1, rows + 1, p[at.P_PHI], w)
        angle.describe_means(n, p[at.P_K], w)
        angle.describe_changes(n, w)
        set_of.interval_axis(rows, p, axes, w)
        between.find_bows(n, omega.shape[0] > 0, state, w)
        set_of.mean_base(rows, w)
    for j in range(1, rows + 1):
        w[at.INPUT + j] = 0.0
        w[at.DERIVATIVE + j] = 1.0
    if rate.size:
        single.sample_harmonics(n, orders, sines, cosines, w)
    else:
        terms.subtract_harmonics(n, orders, sines, cosines, w)
    for j in range(1, rows + 1):
        w[at.HARMONICS + j] = -w[at.INPUT + j]


@exact
def solve_rounds(
    n: int, count: int, sampled: bool, has_terms: NDArray[np.bool_], parameters: Array, axes: Array,
    weights: Array, w: Array, c: Array,
) -> None:  # fmt: skip
    """Force of the block by rounds of least squares on the exact equations."""
    rows = angle.padded(n)
    set_of.clear_normal(rows, c)
    for i in range(count):
        set_of.add_normal(rows, w[i], weights[i], c)
    set_of.invert_normal(rows, c)
    rounds = TERM_ROUNDS + 1 if has_terms.any() else (2 if sampled else EXACT_ROUNDS + 1)
    for k in range(rounds):
        set_of.clear_right(rows, c)
        for i in range(count):
            set_of.turn_force(rows, axes[i], w[i], c)
            set_of.model_errors(rows, parameters[i], has_terms[i], sampled, w[i])
            if sampled:
                set_of.misfit_samples(rows, parameters[i], w[i])
            elif k == 0:
                set_of.misfit_first(rows, parameters[i], w[i])
            else:
                set_of.misfit_intervals(rows, parameters[i], w[i])
            set_of.add_right(rows, w[i], weights[i], c)
        set_of.correct_force(rows, c)
        if k == rounds // 2 - 1 and not sampled:
            set_of.keep_early(rows, c)
            for axis in range(0, 3 * at.STRIDE, at.STRIDE):
                set_of.find_rise(
                    rows, set_of.EARLY_X + axis, set_of.RISE_X + axis, set_of.BEND_X + axis, w[0], c
                )


@exact
def weigh(
    n: int, i: int, per: int, axes: Array, parameters: Array, codes: NDArray[np.int64], factor: Array, weights: Array,
    scratch: Array, state: Array, bend: Array, w: Array, c: Array,
) -> None:  # fmt: skip
    """Weights ``1/u^2`` of an instrument from the uncertainty of its indication, dead zone included."""
    K, tangent = parameters[i, at.P_K], parameters[i, at.P_TAN_BETA]
    set_of.turn_force(n, axes[i], w[i], c)
    for j in range(1, n + 1):
        w[i, at.RATE_Y + j] = K * tangent * w[i, at.MEAN_Y + j] + w[i, at.BASE_Y + j]
        w[i, at.RATE_Z + j] = K * tangent * w[i, at.MEAN_Z + j] + w[i, at.BASE_Z + j]
    if per == at.INVERSE:
        set_of.turn_bend(n, axes[i], c, bend)
        between.find_set_doubt(n, K, tangent, bend, state, w[i])
    known.find_uncertainty(n, per, False, parameters[i], codes, factor, w[i], scratch[:n])
    for j in range(1, n + 1):
        weights[i, j] = 1.0 / (scratch[j - 1] * scratch[j - 1]) if scratch[j - 1] > 0.0 else 1.0


@exact
def weigh_all(
    n: int, sampled: bool, has_terms: NDArray[np.bool_], parameters: Array, axes: Array,
    codes: NDArray[np.int64],
    factors: Array, weights: Array, scratch: Array, states: Array, w: Array, c: Array,
) -> None:  # fmt: skip
    """Weights of all instruments; a redundant set is solved again with them."""
    count = parameters.shape[0]
    bend = np.zeros((3, at.STRIDE))
    for i in range(count):
        weigh(
            n,
            i,
            at.PER if sampled else at.INVERSE,
            axes,
            parameters,
            codes[i],
            factors[i],
            weights,
            scratch,
            states[i],
            bend,
            w,
            c,
        )
    if count > 3:
        set_of.start_force(angle.padded(n), c)
        solve_rounds(n, count, sampled, has_terms, parameters, axes, weights, w, c)
    else:
        invert_weighted(n, count, weights, w, c)


@exact
def take_early(places: tuple[int, int, int], set_state: Array, c: Array) -> None:
    """Early estimates of the rows before the block, of the solution that they are of."""
    for k in range(3):
        for axis in range(3):
            c[set_of.EARLY_X + axis * at.STRIDE - k] = set_state[places[k] + axis]


@exact
def save_early(n: int, places: tuple[int, int, int], set_state: Array, c: Array) -> None:
    """Keep those of the last rows."""
    for k in range(3):
        for axis in range(3):
            set_state[places[k] + axis] = c[set_of.EARLY_X + axis * at.STRIDE + n - k]


@exact
def compensate_set(
    t: Array,
    psi: Array,
    rate: Array,
    begins: NDArray[np.bool_],
    omega: Array,
    temperature: Array,
    parameters: Array,
    axes: Array,
    has_terms: NDArray[np.bool_],
    orders: Array,
    sines: Array,
    cosines: Array,
    codes: NDArray[np.int64],
    factors: Array,
    limits: Array,
    base_flag: int,
    threshold: float,
    states: Array,
    set_state: Array,
    weights: Array,
    scratch: Array,
    w: Array,
    c: Array,
    force: Array,
    dv: Array,
    u: Array,
    residual: Array,
    flags: NDArray[np.int32],
    misfits: Array,
    each: NDArray[np.int32],
) -> None:
    """Specific force (n, 3) [m/s^2] in the common frame and velocity increments (n, 3) [m/s].

    ``psi`` (N, n); ``rate`` (N, n), or (N, 0): angles only; ``omega`` (N, n or 0, 3); ``temperature`` (N, n or
    0); ``u`` (n, 3) or (0, 3): not wanted, empty ``flags`` alike. ``residual`` is the
    root of the sum of squared misfits [m/s^2], a fault is flagged where the weighted sum exceeds ``threshold``.
    ``misfits`` (N, n) [m/s^2] and ``each`` (N, n), the flags, of the single instruments; (N, 0): not wanted.
    """
    count = psi.shape[0]
    sampled = rate.shape[1] > 0
    zeros = np.zeros(at.BLOCK)
    block_flags = np.zeros(at.BLOCK, dtype=np.int32)
    weighed = u.shape[0] > 0 or count > 3
    for start in range(0, t.size, at.BLOCK):
        n = min(at.BLOCK, t.size - start)
        stop = start + n
        for i in range(count):
            load_instrument(
                t[start:stop], psi[i, start:stop], rate[i, start:stop], begins[start:stop],
                omega[i, start:stop], temperature[i, start:stop], parameters[i], axes[i], orders[i],
                sines[i], cosines[i], states[i], zeros, w[i],
            )  # fmt: skip
        for axis in range(3):
            c[set_of.FORCE_X + axis * at.STRIDE] = set_state[3 + axis]
        take_early(set_of.PLAIN_PLACES, set_state, c)
        set_of.start_force(angle.padded(n), c)
        weights[:, :] = 1.0
        solve_rounds(n, count, sampled, has_terms, parameters, axes, weights, w, c)
        save_early(n, set_of.PLAIN_PLACES, set_state, c)
        if weighed:
            take_early(set_of.EARLY_PLACES, set_state, c)
            weigh_all(n, sampled, has_terms, parameters, axes, codes, factors, weights, scratch, states, w, c)
        write_set(
            n, sampled, w[0], c, force[start:stop], dv[start:stop], u[start:stop], residual[start:stop]
        )  # fmt: skip
        flags[start:stop] = 0
        for i in range(count):
            angle.save_last(n, zeros[:n], zeros[:n], omega[i, start:stop], states[i], w[i])
            if flags.size == 0:
                continue
            set_of.turn_force(angle.padded(n), axes[i], w[i], c)
            known.find_flags(
                n, parameters[i, at.P_TAN_BETA], limits[i], w[i], base_flag, temperature.shape[1] > 0,
                block_flags,
            )  # fmt: skip
            for j in range(n):
                flags[start + j] |= block_flags[j]
            for j in range(n if each.shape[1] else 0):
                begins_here = w[i, at.STEP + 1 + j] == 0.0
                misfits[i, start + j] = math.nan if begins_here and not sampled else w[i, at.INPUT + 1 + j]
                inside = 0 if begins_here and not sampled else block_flags[j]
                each[i, start + j] = inside | (at.NO_INCREMENT if begins_here else 0)
        flag_set(sampled, threshold if count > 3 else math.inf, w[0], c, flags[start:stop])
        save_early(n, set_of.EARLY_PLACES, set_state, c)
        for axis in range(3):
            set_state[3 + axis] = c[set_of.FORCE_X + axis * at.STRIDE + n]


@exact
def flag_set(sampled: bool, threshold: float, w: Array, c: Array, flags: NDArray[np.int32]) -> None:
    """Faults, and rows without an increment."""
    for j in range(flags.size):
        if c[set_of.CHI + j + 1] > threshold:
            flags[j] |= at.FAULT
        if w[at.STEP + j + 1] == 0.0:
            flags[j] = at.NO_INCREMENT | (flags[j] if sampled else 0)


@exact
def invert_weighted(n: int, count: int, weights: Array, w: Array, c: Array) -> None:
    """Covariance of the force: the inverse of the weighted normal matrix."""
    rows = angle.padded(n)
    set_of.clear_normal(rows, c)
    for i in range(count):
        set_of.add_normal(rows, w[i], weights[i], c)
    set_of.invert_normal(rows, c)


@exact
def write_set(
    n: int, sampled: bool, w: Array, c: Array, force: Array, dv: Array, u: Array, residual: Array
) -> None:
    """Results of a block; an interval that begins a stretch holds no force."""
    for axis in range(3):
        row, inverse = set_of.FORCE_X + axis * at.STRIDE, (set_of.N_XX, set_of.N_YY, set_of.N_ZZ)[axis]
        for j in range(1, n + 1):
            step = w[at.STEP + j]
            known = sampled or step != 0.0
            force[j - 1, axis] = c[row + j] if known else math.nan
            mean = 0.5 * (c[row + j - 1] + c[row + j]) if sampled else c[row + j]
            dv[j - 1, axis] = mean * step if step != 0.0 else 0.0
        for j in range(1, u.shape[0] + 1):
            known = sampled or w[at.STEP + j] != 0.0
            u[j - 1, axis] = math.sqrt(max(c[inverse + j], 0.0)) if known else math.nan
    for j in range(1, n + 1):
        residual[j - 1] = math.sqrt(c[set_of.MISFIT + j]) if sampled or w[at.STEP + j] != 0.0 else math.nan
