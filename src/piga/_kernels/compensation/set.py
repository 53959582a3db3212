r"""Compensation of a set of instruments: specific force from their effective input axes alone.

Over an interval every instrument gives one equation, nearly linear in the mean force [own derivation,
docs/theory/compensation], with ``g = sin(delta)/delta`` to leading order:

.. math:: a_x + e(f) + g \tan\beta (a_Y \sin\alpha_m - a_Z \cos\alpha_m) = \text{known} ,

At a sample with recorded rate the equation is the same with ``g = 1``. The effective axes form a normal matrix. The exact
(nonlinear) equations are satisfied by iteration with that matrix, so its condition costs no digits.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from piga._kernels.compensation import indication as indicated
from piga._kernels.compensation import layout as at
from piga._kernels.compensation import terms
from piga._kernels.compensation.indication import padded
from piga._kernels.compensation.record import (
    Samples,
    describe_intervals,
    describe_samples,
    find_inverse,
    load_block,
    save_last,
    take_rates,
)
from piga._kernels.jit import Array, exact, kernel


class SetSamples(NamedTuple):
    """Samples of N instruments: ``t``, ``begins`` (n,); ``psi`` (N, n); ``rate`` (N, n), or (N, 0): angles only.

    ``base_rate`` (N, n or 0, 3), ``temperature`` (N, n or 0). ``none`` (0,) replaces the transverse force, which is
    unknown.
    """

    t: Array
    begins: NDArray[np.bool_]
    psi: Array
    rate: Array
    base_rate: Array
    temperature: Array
    none: Array


class SetModels(NamedTuple):
    """Coefficients of all instruments, padded to one size; ``axes`` (N, 3, 3)."""

    parameters: Array
    axes: Array
    has_terms: NDArray[np.bool_]
    orders: Array
    sines: Array
    cosines: Array
    codes: NDArray[np.int64]
    factors: Array
    limits: Array


class SetWork(NamedTuple):
    """Scratch memory: of every instrument ``w``, ``weights``; common ``c``; of a block ``flags``; ``bend`` (3, rows)."""

    w: Array
    weights: Array
    c: Array
    flags: NDArray[np.int32]
    bend: Array


class SetRows(NamedTuple):
    """Results: ``force`` [m/s^2], ``dv`` [m/s], (n, 3); ``u`` (n, 3) or (0, 3): not wanted, empty ``flags`` alike.

    ``residual`` (n,) is the root of the sum of squared misfits [m/s^2]. ``misfits`` [m/s^2] and flags ``each`` of the
    single instruments, (N, n) or (N, 0): not wanted.
    """

    force: Array
    dv: Array
    u: Array
    residual: Array
    flags: NDArray[np.int32]
    misfits: Array
    each: NDArray[np.int32]


EXACT_ROUNDS = 3
"""Rounds with the exact equations after the linear one; each reduces the misfit by more than 1e4."""
TERM_ROUNDS = 7
"""The same with an error model; each round leaves about ``2 k2 a_x`` of the misfit (0.4 % for 2e-3 per g at 1 g)."""
# rows of the set
FORCE_X, FORCE_Y, FORCE_Z = 0 * at.STRIDE, 1 * at.STRIDE, 2 * at.STRIDE
EARLY_X, EARLY_Y, EARLY_Z = 3 * at.STRIDE, 4 * at.STRIDE, 5 * at.STRIDE
RISE_X, RISE_Y, RISE_Z = 6 * at.STRIDE, 7 * at.STRIDE, 8 * at.STRIDE
N_XX, N_XY, N_XZ = 9 * at.STRIDE, 10 * at.STRIDE, 11 * at.STRIDE
N_YY, N_YZ, N_ZZ = 12 * at.STRIDE, 13 * at.STRIDE, 14 * at.STRIDE
R_X, R_Y, R_Z = 15 * at.STRIDE, 16 * at.STRIDE, 17 * at.STRIDE
MISFIT = 18 * at.STRIDE
CHI = 19 * at.STRIDE
BEND_X, BEND_Y, BEND_Z = 20 * at.STRIDE, 21 * at.STRIDE, 22 * at.STRIDE  # standard uncertainty of RISE
SET_WORK = 23 * at.STRIDE
SET_STATE = 21  # early estimate and force of the last row, early estimates of the two rows before it, those without weights
EARLY_PLACES = (0, 6, 9)  # of the last rows, the latest first
PLAIN_PLACES = (12, 15, 18)  # the same of the solution without weights


@exact
def one_of(samples: SetSamples, i: int) -> Samples:
    """Known inputs of one instrument; the transverse force is not known."""
    return Samples(
        samples.t, samples.none, samples.none, samples.begins, samples.base_rate[i], samples.temperature[i]
    )  # fmt: skip


@kernel
def find_gains(rows: int, w: Array) -> None:
    """Half the turn ``delta`` of every interval, and its gain ``sin(delta)/delta``.

    The gain is the derivative of the angle equation by A over that by the coupling.
    """
    for j in range(1, rows + 1):
        delta = 0.5 * (w[at.PSI + j] - w[at.PSI + j - 1])
        d = delta * delta
        gain = 1.0 + d * (-1 / 6 + d * (1 / 120 + d * (-1 / 5040 + d * (1 / 362880 - d / 39916800))))
        w[at.HALF + j], w[at.GAIN + j] = delta, gain


@kernel
def find_axis(rows: int, p: Array, axes: Array, w: Array) -> None:
    """Effective axis of an instrument over every interval or at every sample, common frame."""
    tangent = p[at.P_TAN_BETA]
    x = 1.0 + p[terms.K1]
    for j in range(1, rows + 1):
        y = tangent * w[at.GAIN + j] * w[at.SINE + j] + p[terms.M_Y]
        z = p[terms.M_Z] - tangent * w[at.GAIN + j] * w[at.COSINE + j]
        w[at.AXIS_X + j] = x * axes[0, 0] + y * axes[1, 0] + z * axes[2, 0]
        w[at.AXIS_Y + j] = x * axes[0, 1] + y * axes[1, 1] + z * axes[2, 1]
        w[at.AXIS_Z + j] = x * axes[0, 2] + y * axes[1, 2] + z * axes[2, 2]


@kernel
def find_base(rows: int, sampled: bool, w: Array) -> None:
    """Contribution of base rate and first harmonic: mean over every interval and its change, or at every sample."""
    if sampled:
        for j in range(1, rows + 1):
            w[at.BASE_X + j] = w[at.OMEGA_X + j]
            w[at.BASE_Y + j] = w[at.RATE_Y + j]
            w[at.BASE_Z + j] = w[at.RATE_Z + j]
        return
    for j in range(1, rows + 1):
        w[at.BASE_X + j] = 0.5 * (w[at.OMEGA_X + j - 1] + w[at.OMEGA_X + j]) + w[at.BOW_X + j]
        w[at.BASE_Y + j] = 0.5 * (w[at.RATE_Y + j - 1] + w[at.RATE_Y + j]) + w[at.BOW_Y + j]
        w[at.BASE_Z + j] = 0.5 * (w[at.RATE_Z + j - 1] + w[at.RATE_Z + j]) + w[at.BOW_Z + j]
        w[at.BASE_RISE_X + j] = w[at.OMEGA_X + j] - w[at.OMEGA_X + j - 1]
        w[at.BASE_RISE_Y + j] = w[at.RATE_Y + j] - w[at.RATE_Y + j - 1]
        w[at.BASE_RISE_Z + j] = w[at.RATE_Z + j] - w[at.RATE_Z + j - 1]


@kernel
def misfit_first(rows: int, p: Array, w: Array) -> None:
    """Linear misfit of every interval at zero force [m/s^2], into the row INPUT: the first round."""
    inverse = 1.0 / p[at.P_K]
    for j in range(1, rows + 1):
        rate = 2.0 * w[at.HALF + j] * w[at.INVERSE + j] + w[at.BASE_X + j]
        base = w[at.GAIN + j] * (w[at.BASE_Y + j] * w[at.SINE + j] - w[at.BASE_Z + j] * w[at.COSINE + j])
        w[at.INPUT + j] = (rate - base) * inverse - p[terms.K0]


@kernel
def clear(first: int, last: int, rows: int, c: Array) -> None:
    """Set rows of the set to zero, from ``first`` to ``last``."""
    for row in range(first, last + at.STRIDE, at.STRIDE):
        for j in range(1, rows + 1):
            c[row + j] = 0.0


@kernel
def add_normal(rows: int, w: Array, weight: Array, c: Array) -> None:
    """Add an instrument to the normal matrices."""
    for j in range(1, rows + 1):
        x, y, z, k = w[at.AXIS_X + j], w[at.AXIS_Y + j], w[at.AXIS_Z + j], weight[j]
        c[N_XX + j] += k * x * x
        c[N_XY + j] += k * x * y
        c[N_XZ + j] += k * x * z
        c[N_YY + j] += k * y * y
        c[N_YZ + j] += k * y * z
        c[N_ZZ + j] += k * z * z


@kernel
def invert_normal(rows: int, c: Array) -> None:
    """Invert the symmetric normal matrices in place."""
    for j in range(1, rows + 1):
        xx, xy, xz = c[N_XX + j], c[N_XY + j], c[N_XZ + j]
        yy, yz, zz = c[N_YY + j], c[N_YZ + j], c[N_ZZ + j]
        a, b, d = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
        inverse = 1.0 / (xx * a + xy * b + xz * d)
        c[N_XX + j], c[N_XY + j], c[N_XZ + j] = a * inverse, b * inverse, d * inverse
        c[N_YY + j], c[N_YZ + j] = (xx * zz - xz * xz) * inverse, (xy * xz - xx * yz) * inverse
        c[N_ZZ + j] = (xx * yy - xy * xy) * inverse


@kernel
def add_right(rows: int, w: Array, weight: Array, c: Array) -> None:
    """Add the misfit (row INPUT) of an instrument to the right-hand sides and sums of squares."""
    for j in range(1, rows + 1):
        misfit = w[at.INPUT + j]
        k = weight[j] * misfit
        c[R_X + j] += k * w[at.AXIS_X + j]
        c[R_Y + j] += k * w[at.AXIS_Y + j]
        c[R_Z + j] += k * w[at.AXIS_Z + j]
        c[MISFIT + j] += misfit * misfit
        c[CHI + j] += k * misfit


@kernel
def correct_force(rows: int, c: Array) -> None:
    """Add the least-squares correction to the force."""
    for j in range(1, rows + 1):
        x, y, z = c[R_X + j], c[R_Y + j], c[R_Z + j]
        c[FORCE_X + j] += c[N_XX + j] * x + c[N_XY + j] * y + c[N_XZ + j] * z
        c[FORCE_Y + j] += c[N_XY + j] * x + c[N_YY + j] * y + c[N_YZ + j] * z
        c[FORCE_Z + j] += c[N_XZ + j] * x + c[N_YZ + j] * y + c[N_ZZ + j] * z


@kernel
def turn_force(rows: int, axes: Array, w: Array, c: Array) -> None:
    """Force and its change over the interval in the axes of an instrument."""
    for j in range(1, rows + 1):
        x, y, z = c[FORCE_X + j], c[FORCE_Y + j], c[FORCE_Z + j]
        w[at.FORCE + j] = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z
        w[at.MEAN_Y + j] = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z
        w[at.MEAN_Z + j] = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z
        x, y, z = c[RISE_X + j], c[RISE_Y + j], c[RISE_Z + j]
        w[at.SLOPE + j] = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z
        w[at.CHANGE_Y + j] = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z
        w[at.CHANGE_Z + j] = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z


@kernel
def model_errors(rows: int, p: Array, has_terms: bool, sampled: bool, w: Array) -> None:
    """Error model at the force and its change over the interval: the difference of the indicated force and ``a_x``.

    The row HALF contains the rate if the set is ``sampled``.
    """
    reference = p[at.P_TIME_REFERENCE]
    for j in range(1, rows + 1):
        w[at.ERROR + j], w[at.ERROR_RISE + j] = w[at.HARMONICS + j], 0.0
    if not has_terms:
        return
    for j in range(1, rows + 1):
        a, y, z = w[at.FORCE + j], w[at.MEAN_Y + j], w[at.MEAN_Z + j]
        da, dy, dz = w[at.SLOPE + j] / 12.0, w[at.CHANGE_Y + j], w[at.CHANGE_Z + j]
        spread = da * w[at.SLOPE + j]
        warmth, time = w[at.MEAN_T + j], w[at.MEAN_TIME + j] - reference
        value = p[terms.K0] + a * p[terms.K1] + p[terms.M_Y] * y + p[terms.M_Z] * z
        value += p[terms.K2] * (a * a + spread) + p[terms.K3] * a * (a * a + 3.0 * spread)
        value += (
            p[terms.K2O] * a * abs(a) + p[terms.K_XY] * (a * y + da * dy) + p[terms.K_XZ] * (a * z + da * dz)
        )
        value += p[terms.K_YY] * (y * y + dy * dy / 12.0) + p[terms.K_ZZ] * (z * z + dz * dz / 12.0)
        value += p[terms.K_YZ] * (y * z + dy * dz / 12.0)
        value += p[terms.K0_T] * time + (p[terms.K0_TEMP] + p[terms.K1_TEMP] * a) * warmth
        w[at.ERROR + j] = value + w[at.HARMONICS + j]
        da = w[at.SLOPE + j]
        rise = (p[terms.K1] + 2.0 * (p[terms.K2] * a + p[terms.K2O] * abs(a)) + 3.0 * p[terms.K3] * a * a) * da
        rise += p[terms.M_Y] * dy + p[terms.M_Z] * dz + 2.0 * (p[terms.K_YY] * y * dy + p[terms.K_ZZ] * z * dz)
        rise += p[terms.K_XY] * (a * dy + y * da) + p[terms.K_XZ] * (a * dz + z * da)
        rise += p[terms.K_YZ] * (y * dz + z * dy) + p[terms.K0_T] * w[at.STEP + j]
        rise += (p[terms.K0_TEMP] + p[terms.K1_TEMP] * a) * w[at.CHANGE_T + j] + p[terms.K1_TEMP] * warmth * da
        w[at.ERROR_RISE + j] = rise
    if p[terms.SERVO] == 0.0 and p[terms.SERVO_DAMPING] == 0.0:
        return
    for j in range(1, rows + 1):
        half = 0.0 if sampled else w[at.HALF + j]
        w[at.ERROR + j] += terms.servo_error(p, j, sampled, half, w)


@kernel
def misfit_intervals(rows: int, p: Array, w: Array) -> None:
    """Misfit of the exact equation of every interval [m/s^2], into the row INPUT."""
    K, tangent = p[at.P_K], p[at.P_TAN_BETA]
    far = 0
    for j in range(1, rows + 1):
        h, delta, s, c = w[at.STEP + j], w[at.HALF + j], w[at.SINE + j], w[at.COSINE + j]
        a = K * (w[at.FORCE + j] + w[at.ERROR + j]) - w[at.BASE_X + j]
        y = K * tangent * w[at.MEAN_Y + j] + w[at.BASE_Y + j]
        z = K * tangent * w[at.MEAN_Z + j] + w[at.BASE_Z + j]
        da = K * (w[at.SLOPE + j] + w[at.ERROR_RISE + j]) - w[at.BASE_RISE_X + j]
        dy = K * tangent * w[at.CHANGE_Y + j] + w[at.BASE_RISE_Y + j]
        dz = K * tangent * w[at.CHANGE_Z + j] + w[at.BASE_RISE_Z + j]
        cross = h * h / 12.0
        Y = h * y + cross * (a * dz - z * da)
        Z = h * z - cross * (a * dy - y * da)
        e = (h * a - 2.0 * delta) + cross * (y * dz - z * dy)
        d = delta * delta
        sine = delta * w[at.GAIN + j]
        cosine = 1.0 + d * (-1 / 2 + d * (1 / 24 + d * (-1 / 720 + d * (1 / 40320 - d / 3628800))))
        first = -1 / 3 + d * (-2 / 45 + d * (-6 / 945 + d * (-4 / 4725 + d * (-10 / 93555))))
        second = -1 / 45 + d * (-6 / 945 + d * (-6 / 4725))
        eta = delta * e + 0.25 * (e * e - (Y * Y + Z * Z))
        value = e * cosine - 2.0 * sine * eta * (first + eta * second) + (Y * s - Z * c)
        w[at.INPUT + j] = -value * w[at.GAIN + j] * w[at.INVERSE + j] / K
        far |= abs(delta) > indicated.FAR_TURN
    if far:
        misfit_far(rows, p, w)


@exact
def misfit_far(rows: int, p: Array, w: Array) -> None:
    """Misfit of intervals that turn too far for the series, by the library's functions."""
    K, tangent = p[at.P_K], p[at.P_TAN_BETA]
    for j in range(1, rows + 1):
        h, delta = w[at.STEP + j], w[at.HALF + j]
        if abs(delta) <= indicated.FAR_TURN or h == 0.0:
            continue
        a = K * (w[at.FORCE + j] + w[at.ERROR + j]) - w[at.BASE_X + j]
        y = K * tangent * w[at.MEAN_Y + j] + w[at.BASE_Y + j]
        z = K * tangent * w[at.MEAN_Z + j] + w[at.BASE_Z + j]
        da = K * (w[at.SLOPE + j] + w[at.ERROR_RISE + j]) - w[at.BASE_RISE_X + j]
        dy = K * tangent * w[at.CHANGE_Y + j] + w[at.BASE_RISE_Y + j]
        dz = K * tangent * w[at.CHANGE_Z + j] + w[at.BASE_RISE_Z + j]
        cross = h * h / 12.0
        Y = h * y + cross * (a * dz - z * da)
        Z = h * z - cross * (a * dy - y * da)
        A = h * a + cross * (y * dz - z * dy)
        e = indicated.solve_far(delta, Y * Y + Z * Z, Y * w[at.SINE + j] - Z * w[at.COSINE + j])
        w[at.INPUT + j] = (2.0 * delta + e - A) / (K * h)


@kernel
def misfit_samples(rows: int, p: Array, w: Array) -> None:
    """Misfit of the effective-axis equation at samples (rate in the row HALF), into the row INPUT."""
    K, tangent = p[at.P_K], p[at.P_TAN_BETA]
    inverse = 1.0 / K
    for j in range(1, rows + 1):
        y = tangent * w[at.MEAN_Y + j] + w[at.BASE_Y + j] * inverse
        z = tangent * w[at.MEAN_Z + j] + w[at.BASE_Z + j] * inverse
        indicated = (w[at.HALF + j] + w[at.BASE_X + j]) * inverse - (y * w[at.SINE + j] - z * w[at.COSINE + j])
        w[at.INPUT + j] = indicated - (w[at.FORCE + j] + w[at.ERROR + j])


@kernel
def find_rise(rows: int, early: int, rise: int, bend: int, w: Array, c: Array) -> None:
    """Change of a component of the force over every interval, from its early estimates there and before.

    ``d + d^2/2 + d^3/4`` of backward differences ``d``, as for one instrument
    (:func:`piga._kernels.compensation.indication.invert_near`). Near the beginning of a stretch the
    differences that exist are used. Where intervals differ, only the first difference is used. The last term of this series is
    the possible error of the change (row ``bend``). The first interval of a stretch gives no estimate.
    """
    for j in range(1, rows + 1):
        h0, h1 = w[at.STEP + j], w[at.STEP + j - 1]
        u0, u1, u2, u3 = c[early + j], c[early + j - 1], c[early + j - 2], c[early + j - 3]
        joined = (h0 != 0.0) & (h1 != 0.0)
        even = (
            joined & (abs(h1 * w[at.INVERSE + j] - 1.0) <= 2.0 * indicated.EVEN) & (w[at.STEP + j - 2] != 0.0)
        )
        change, second = u0 - u1, (u0 - u1) - (u1 - u2)
        third = second - ((u1 - u2) - (u2 - u3))
        value = change * (2.0 * h0 / (h0 + h1 if joined else 1.0))
        value += 0.5 * second if even else 0.0
        value += 0.25 * third if even & (w[at.STEP + j - 3] != 0.0) else 0.0
        c[rise + j] = value if joined else 0.0
        known = w[at.STEP + j - 2] != 0.0
        last = 0.25 * third if even & (w[at.STEP + j - 3] != 0.0) else (0.5 * second if known else change)
        c[bend + j] = last if joined else 0.0


@exact
def turn_bend(n: int, axes: Array, c: Array, out: Array) -> None:
    """Uncertainty of the change of the force in the axes of an instrument, into ``out`` (3, rows)."""
    for j in range(1, n + 1):
        x, y, z = c[BEND_X + j], c[BEND_Y + j], c[BEND_Z + j]
        for k in range(3):
            out[k, j] = axes[k, 0] * x + axes[k, 1] * y + axes[k, 2] * z


@exact
def load_instrument(
    start: int, n: int, i: int, samples: SetSamples, set_of: SetModels, state: Array, w: Array
) -> None:
    """Samples of instrument ``i``, its angles, effective axes and harmonics."""
    p, axes, rows = set_of.parameters[i], set_of.axes[i], padded(n)
    psi, omega = samples.psi[i], samples.base_rate[i]
    load_block(start, n, one_of(samples, i), psi, p, False, state, w)
    find_inverse(n, w)
    for j in range(1, rows + 1):
        w[at.INPUT + j] = 0.0
        w[at.DERIVATIVE + j] = w[at.GAIN + j] = 1.0
    if samples.rate.shape[1]:
        rate = samples.rate[i, start : start + n]
        take_rates(n, rate, at.FIRST, w)
        indicated.find_samples(rows, p[at.P_PHI], w)
        describe_samples(n, True, rate, p[at.P_K], math.nan, w)
        take_rates(n, rate, at.HALF, w)
        for j in range(1, n + 1):
            w[at.DOUBT + j] = 0.0
        terms.sample_harmonics(n, set_of.orders[i], set_of.sines[i], set_of.cosines[i], w)
    else:
        indicated.find_angles(rows + 1, p[at.P_PHI], w)
        describe_intervals(n, p[at.P_K], True, w)
        find_gains(rows, w)
        indicated.find_bows(n, omega.shape[0] > 0, False, state, w)
        terms.subtract_harmonics(n, set_of.orders[i], set_of.sines[i], set_of.cosines[i], w)
    find_axis(rows, p, axes, w)
    find_base(rows, samples.rate.shape[1] > 0, w)
    for j in range(1, rows + 1):
        w[at.HARMONICS + j] = -w[at.INPUT + j]


@exact
def solve_rounds(n: int, sampled: bool, set_of: SetModels, work: SetWork) -> None:
    """Force of the block by rounds of least squares on the exact equations."""
    rows, w, c, count = padded(n), work.w, work.c, set_of.parameters.shape[0]
    invert_weighted(n, set_of, work)
    more = False
    for i in range(count):
        more |= set_of.has_terms[i]
    rounds = TERM_ROUNDS + 1 if more else (2 if sampled else EXACT_ROUNDS + 1)
    for k in range(rounds):
        clear(R_X, CHI, rows, c)
        for i in range(count):
            p = set_of.parameters[i]
            turn_force(rows, set_of.axes[i], w[i], c)
            model_errors(rows, p, set_of.has_terms[i], sampled, w[i])
            if sampled:
                misfit_samples(rows, p, w[i])
            elif k == 0:
                misfit_first(rows, p, w[i])
            else:
                misfit_intervals(rows, p, w[i])
            add_right(rows, w[i], work.weights[i], c)
        correct_force(rows, c)
        if k == rounds // 2 - 1 and not sampled:
            for axis in range(0, 3 * at.STRIDE, at.STRIDE):
                for j in range(1, rows + 1):  # the estimate for a change of zero
                    c[EARLY_X + axis + j] = c[FORCE_X + axis + j]
                find_rise(rows, EARLY_X + axis, RISE_X + axis, BEND_X + axis, w[0], c)


@exact
def weigh(n: int, i: int, sampled: bool, set_of: SetModels, state: Array, work: SetWork) -> None:
    """Weights ``1/u^2`` of an instrument from the uncertainty of its indication, dead zone included."""
    p, w, weights = set_of.parameters[i], work.w[i], work.weights
    K, tangent = p[at.P_K], p[at.P_TAN_BETA]
    turn_force(n, set_of.axes[i], w, work.c)
    for j in range(1, n + 1):
        w[at.RATE_Y + j] = K * tangent * w[at.MEAN_Y + j] + w[at.BASE_Y + j]
        w[at.RATE_Z + j] = K * tangent * w[at.MEAN_Z + j] + w[at.BASE_Z + j]
    if not sampled:
        turn_bend(n, set_of.axes[i], work.c, work.bend)
        indicated.find_set_doubt(n, K, tangent, work.bend, state, w)
    terms.find_variance(n, set_of.codes[i], set_of.factors[i], p, w)
    terms.find_uncertainty(n, at.PER if sampled else at.INVERSE, False, p, w)
    for j in range(1, n + 1):
        u = w[at.KNOWN_TO + j]
        weights[i, j] = 1.0 / (u * u) if u > 0.0 else 1.0


@exact
def weigh_all(n: int, sampled: bool, set_of: SetModels, states: Array, work: SetWork) -> None:
    """Weights of all instruments; a redundant set is solved again with them."""
    count = set_of.parameters.shape[0]
    for i in range(count):
        weigh(n, i, sampled, set_of, states[i], work)
    if count > 3:
        clear(FORCE_X, FORCE_Z, padded(n), work.c)
        clear(RISE_X, RISE_Z, padded(n), work.c)
        solve_rounds(n, sampled, set_of, work)
    else:
        invert_weighted(n, set_of, work)


@exact
def take_early(places: tuple[int, int, int], set_state: Array, c: Array) -> None:
    """Early estimates of the rows before the block, for one of the two solutions."""
    for k in range(3):
        for axis in range(3):
            c[EARLY_X + axis * at.STRIDE - k] = set_state[places[k] + axis]


@exact
def save_early(n: int, places: tuple[int, int, int], set_state: Array, c: Array) -> None:
    """Save the early estimates of the last rows."""
    for k in range(3):
        for axis in range(3):
            set_state[places[k] + axis] = c[EARLY_X + axis * at.STRIDE + n - k]


@exact
def compensate_set(
    samples: SetSamples, set_of: SetModels, base_flag: int, threshold: float, states: Array, set_state: Array,
    work: SetWork, rows: SetRows,
) -> None:  # fmt: skip
    """Specific force and velocity increments of a set in the common frame.

    A fault is flagged where the weighted sum of squared misfits exceeds ``threshold``.
    """
    w, c, flags, count = work.w, work.c, rows.flags, samples.psi.shape[0]
    sampled, warm, detailed = (
        samples.rate.shape[1] > 0,
        samples.temperature.shape[1] > 0,
        rows.each.shape[1] > 0,
    )
    for start in range(0, samples.t.size, at.BLOCK):
        n = at.BLOCK if samples.t.size - start > at.BLOCK else samples.t.size - start
        for i in range(count):
            load_instrument(start, n, i, samples, set_of, states[i], w[i])
            for j in range(1, padded(n) + 1):
                work.weights[i, j] = 1.0
        for axis in range(3):
            c[FORCE_X + axis * at.STRIDE] = set_state[3 + axis]
        take_early(PLAIN_PLACES, set_state, c)
        clear(FORCE_X, FORCE_Z, padded(n), c)
        clear(RISE_X, RISE_Z, padded(n), c)
        solve_rounds(n, sampled, set_of, work)
        save_early(n, PLAIN_PLACES, set_state, c)
        if rows.u.shape[0] > 0 or count > 3:
            take_early(EARLY_PLACES, set_state, c)
            weigh_all(n, sampled, set_of, states, work)
        write_set(start, n, sampled, w[0], c, rows)
        for i in range(count):
            save_last(start, n, one_of(samples, i), states[i], w[i])
            if flags.size == 0:
                continue
            turn_force(padded(n), set_of.axes[i], w[i], c)
            terms.find_flags(
                n, set_of.parameters[i, at.P_TAN_BETA], set_of.limits[i], w[i], base_flag, warm, work.flags
            )
            for j in range(n):
                flags[start + j] = work.flags[j] | (flags[start + j] if i else 0)
            for j in range(n if detailed else 0):
                begins_here = w[i, at.STEP + 1 + j] == 0.0
                rows.misfits[i, start + j] = math.nan if begins_here and not sampled else w[i, at.INPUT + 1 + j]
                inside = 0 if begins_here and not sampled else work.flags[j]
                rows.each[i, start + j] = inside | (at.NO_INCREMENT if begins_here else 0)
        flag_set(start, n if flags.size else 0, sampled, threshold if count > 3 else math.inf, w[0], c, flags)
        save_early(n, EARLY_PLACES, set_state, c)
        for axis in range(3):
            set_state[3 + axis] = c[FORCE_X + axis * at.STRIDE + n]


@exact
def flag_set(
    start: int, n: int, sampled: bool, threshold: float, w: Array, c: Array, flags: NDArray[np.int32]
) -> None:  # fmt: skip
    """Faults, and rows without an increment."""
    for j in range(n):
        if c[CHI + j + 1] > threshold:
            flags[start + j] |= at.FAULT
        if w[at.STEP + j + 1] == 0.0:
            flags[start + j] = at.NO_INCREMENT | (flags[start + j] if sampled else 0)


@exact
def invert_weighted(n: int, set_of: SetModels, work: SetWork) -> None:
    """The inverse of the weighted normal matrix: with weights ``1/u^2`` the covariance of the force."""
    rows = padded(n)
    clear(N_XX, N_ZZ, rows, work.c)
    for i in range(set_of.parameters.shape[0]):
        add_normal(rows, work.w[i], work.weights[i], work.c)
    invert_normal(rows, work.c)


@exact
def write_set(start: int, n: int, sampled: bool, w: Array, c: Array, rows: SetRows) -> None:
    """Results of a block; an interval that begins a stretch contains no force."""
    stop = start + n
    force, dv, u, residual = (
        rows.force[start:stop],
        rows.dv[start:stop],
        rows.u[start:stop],
        rows.residual[start:stop],
    )
    for axis in range(3):
        row, inverse = FORCE_X + axis * at.STRIDE, (N_XX, N_YY, N_ZZ)[axis]
        for j in range(1, n + 1):
            step = w[at.STEP + j]
            known = sampled or step != 0.0
            force[j - 1, axis] = c[row + j] if known else math.nan
            mean = 0.5 * (c[row + j - 1] + c[row + j]) if sampled else c[row + j]
            dv[j - 1, axis] = mean * step if step != 0.0 else 0.0
        for j in range(1, u.shape[0] + 1):
            variance = c[inverse + j] if c[inverse + j] > 0.0 else 0.0
            known = sampled or w[at.STEP + j] != 0.0
            u[j - 1, axis] = math.sqrt(variance) if known else math.nan
    for j in range(1, n + 1):
        known = sampled or w[at.STEP + j] != 0.0
        residual[j - 1] = math.sqrt(c[MISFIT + j]) if known else math.nan
