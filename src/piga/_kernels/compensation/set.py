r"""Compensation of a set of instruments: specific force from their effective input axes alone.

Over an interval every instrument gives one equation, nearly linear in the mean force [own derivation,
docs/theory/compensation], with ``g = sin(delta)/delta`` to leading order:

.. math:: a_x + e(f) + g \tan\beta (a_Y \sin\alpha_m - a_Z \cos\alpha_m) = \text{known} ,

at a sample with recorded rate the same with ``g = 1``. The effective axes stand in a normal matrix; the exact
(nonlinear) equations are satisfied by iteration with that matrix, so its condition costs no digits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from piga._kernels.compensation import compensate as angle
from piga._kernels.compensation import layout as at
from piga._kernels.compensation import near, terms
from piga._kernels.jit import exact, kernel

Array = NDArray[np.float64]

# rows of the set
FORCE_X, FORCE_Y, FORCE_Z = 0 * at.STRIDE, 1 * at.STRIDE, 2 * at.STRIDE
EARLY_X, EARLY_Y, EARLY_Z = 3 * at.STRIDE, 4 * at.STRIDE, 5 * at.STRIDE
RISE_X, RISE_Y, RISE_Z = 6 * at.STRIDE, 7 * at.STRIDE, 8 * at.STRIDE
N_XX, N_XY, N_XZ = 9 * at.STRIDE, 10 * at.STRIDE, 11 * at.STRIDE
N_YY, N_YZ, N_ZZ = 12 * at.STRIDE, 13 * at.STRIDE, 14 * at.STRIDE
R_X, R_Y, R_Z = 15 * at.STRIDE, 16 * at.STRIDE, 17 * at.STRIDE
MISFIT = 18 * at.STRIDE
CHI = 19 * at.STRIDE
WEIGHT = 20 * at.STRIDE
BEND_X, BEND_Y, BEND_Z = 21 * at.STRIDE, 22 * at.STRIDE, 23 * at.STRIDE  # standard uncertainty of RISE
SET_WORK = 24 * at.STRIDE
SET_STATE = 21  # early estimate and force of the last row, early estimates of the two rows before it, those without weights
EARLY_PLACES = (0, 6, 9)  # of the last rows, the latest first
PLAIN_PLACES = (12, 15, 18)  # the same of the solution without weights


@kernel
def interval_axis(rows: int, p: Array, axes: Array, w: Array) -> None:
    """Effective axis of an instrument over every interval, common frame; half turn and gain."""
    tangent = p[at.P_TAN_BETA]
    for j in range(1, rows + 1):
        delta = 0.5 * (w[at.PSI + j] - w[at.PSI + j - 1])
        d = delta * delta
        # sin(delta)/delta: the derivative of the angle equation by A over that by the coupling
        gain = 1.0 + d * (-1 / 6 + d * (1 / 120 + d * (-1 / 5040 + d * (1 / 362880 - d / 39916800))))
        w[at.HALF + j], w[at.GAIN + j] = delta, gain
        y, z = tangent * gain * w[at.SINE + j], -tangent * gain * w[at.COSINE + j]
        x = 1.0 + p[terms.K1]
        y, z = y + p[terms.M_Y], z + p[terms.M_Z]
        w[at.AXIS_X + j] = x * axes[0, 0] + y * axes[1, 0] + z * axes[2, 0]
        w[at.AXIS_Y + j] = x * axes[0, 1] + y * axes[1, 1] + z * axes[2, 1]
        w[at.AXIS_Z + j] = x * axes[0, 2] + y * axes[1, 2] + z * axes[2, 2]


@kernel
def sample_axis(rows: int, p: Array, axes: Array, w: Array) -> None:
    """Effective axis of an instrument at every sample, common frame."""
    tangent = p[at.P_TAN_BETA]
    x = 1.0 + p[terms.K1]
    for j in range(1, rows + 1):
        y, z = p[terms.M_Y] + tangent * w[at.SINE + j], p[terms.M_Z] - tangent * w[at.COSINE + j]
        w[at.AXIS_X + j] = x * axes[0, 0] + y * axes[1, 0] + z * axes[2, 0]
        w[at.AXIS_Y + j] = x * axes[0, 1] + y * axes[1, 1] + z * axes[2, 1]
        w[at.AXIS_Z + j] = x * axes[0, 2] + y * axes[1, 2] + z * axes[2, 2]


@kernel
def mean_base(rows: int, w: Array) -> None:
    """What base rate and first harmonic add, averaged over every interval, and its change."""
    for j in range(1, rows + 1):
        w[at.BASE_X + j] = 0.5 * (w[at.OMEGA_X + j - 1] + w[at.OMEGA_X + j]) + w[at.BOW_X + j]
        w[at.BASE_Y + j] = 0.5 * (w[at.RATE_Y + j - 1] + w[at.RATE_Y + j]) + w[at.BOW_Y + j]
        w[at.BASE_Z + j] = 0.5 * (w[at.RATE_Z + j - 1] + w[at.RATE_Z + j]) + w[at.BOW_Z + j]
        w[at.BASE_RISE_X + j] = w[at.OMEGA_X + j] - w[at.OMEGA_X + j - 1]
        w[at.BASE_RISE_Y + j] = w[at.RATE_Y + j] - w[at.RATE_Y + j - 1]
        w[at.BASE_RISE_Z + j] = w[at.RATE_Z + j] - w[at.RATE_Z + j - 1]


@kernel
def sample_base(rows: int, w: Array) -> None:
    """What base rate and first harmonic add at every sample."""
    for j in range(1, rows + 1):
        w[at.BASE_X + j] = w[at.OMEGA_X + j]
        w[at.BASE_Y + j] = w[at.RATE_Y + j]
        w[at.BASE_Z + j] = w[at.RATE_Z + j]


@kernel
def misfit_first(rows: int, p: Array, w: Array) -> None:
    """Linear misfit of every interval at zero force [m/s^2], into the row INPUT: the first round."""
    inverse = 1.0 / p[at.P_K]
    for j in range(1, rows + 1):
        rate = 2.0 * w[at.HALF + j] * w[at.INVERSE + j] + w[at.BASE_X + j]
        base = w[at.GAIN + j] * (w[at.BASE_Y + j] * w[at.SINE + j] - w[at.BASE_Z + j] * w[at.COSINE + j])
        w[at.INPUT + j] = (rate - base) * inverse - p[terms.K0]


@kernel
def clear_normal(rows: int, c: Array) -> None:
    """Empty normal matrices."""
    for j in range(1, rows + 1):
        c[N_XX + j] = c[N_XY + j] = c[N_XZ + j] = c[N_YY + j] = c[N_YZ + j] = c[N_ZZ + j] = 0.0


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
def clear_right(rows: int, c: Array) -> None:
    """Empty right-hand sides and misfits."""
    for j in range(1, rows + 1):
        c[R_X + j] = c[R_Y + j] = c[R_Z + j] = c[MISFIT + j] = c[CHI + j] = 0.0


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
    """Error model at the force and its change over the interval: what the indicated force has beyond ``a_x``.

    The row HALF holds the rate where the set is ``sampled``.
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
        far |= abs(delta) > angle.FAR_TURN
    if far:
        misfit_far(rows, p, w)


@exact
def misfit_far(rows: int, p: Array, w: Array) -> None:
    """The same for intervals that turn too far for the series, by the library's functions."""
    K, tangent = p[at.P_K], p[at.P_TAN_BETA]
    for j in range(1, rows + 1):
        h, delta = w[at.STEP + j], w[at.HALF + j]
        if abs(delta) <= angle.FAR_TURN or h == 0.0:
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
        e = angle.solve_far(delta, Y * Y + Z * Z, Y * w[at.SINE + j] - Z * w[at.COSINE + j])
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
def keep_early(rows: int, c: Array) -> None:
    """Keep the force as the estimate for a change of zero."""
    for j in range(1, rows + 1):
        c[EARLY_X + j], c[EARLY_Y + j], c[EARLY_Z + j] = c[FORCE_X + j], c[FORCE_Y + j], c[FORCE_Z + j]


@kernel
def find_rise(rows: int, early: int, rise: int, bend: int, w: Array, c: Array) -> None:
    """Change of a component of the force over every interval, from its early estimates there and before.

    ``d + d^2/2 + d^3/4`` of backward differences ``d``, as for one instrument
    (:func:`piga._kernels.compensation.near.invert_near`); the differences there are behind the beginning of a stretch, the
    first one where intervals differ. The last term of this series is what the change may be off by (row ``bend``); the first
    interval of a stretch tells nothing.
    """
    for j in range(1, rows + 1):
        h0, h1 = w[at.STEP + j], w[at.STEP + j - 1]
        u0, u1, u2, u3 = c[early + j], c[early + j - 1], c[early + j - 2], c[early + j - 3]
        joined = (h0 != 0.0) & (h1 != 0.0)
        even = joined & (abs(h1 * w[at.INVERSE + j] - 1.0) <= 2.0 * near.EVEN) & (w[at.STEP + j - 2] != 0.0)
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
    """What the change of the force may be off by in the axes of an instrument, into ``out`` (3, rows)."""
    for j in range(1, n + 1):
        x, y, z = c[BEND_X + j], c[BEND_Y + j], c[BEND_Z + j]
        for k in range(3):
            out[k, j] = axes[k, 0] * x + axes[k, 1] * y + axes[k, 2] * z


@exact
def start_force(rows: int, c: Array) -> None:
    """Zero force and change before the first round."""
    for j in range(1, rows + 1):
        c[FORCE_X + j] = c[FORCE_Y + j] = c[FORCE_Z + j] = 0.0
        c[RISE_X + j] = c[RISE_Y + j] = c[RISE_Z + j] = 0.0
