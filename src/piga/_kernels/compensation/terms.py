"""Inverse of the error model, with uncertainty and validity of the result, on rows of interval means (or samples).

A triangular factor ``R`` represents the covariance ``R'R`` of the coefficients. The variance ``|R x|^2`` for the regressors
``x`` of a row is then a sum of squares. The dead zone is rare. It is computed row by row, and only in blocks in which it
occurs.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.compensation import layout as at
from piga._kernels.estimation.regressors import half_angle_moments
from piga._kernels.jit import Array, exact, inline

NEAR = 1.25
"""Near-critical: ``|a_x|`` below this multiple of ``a_t tan(beta)``."""
ITERATIONS = 4
"""Newton steps: the error model is nearly linear, each step squares a relative error below 1e-2."""
K0, K1, K2, K3, K2O, M_Y, M_Z, K_XY, K_XZ, K_YY, K_ZZ, K_YZ, K0_T, K0_TEMP, K1_TEMP, SERVO, SERVO_DAMPING = (
    at.P_TERMS + i for i in range(len(at.TERMS))
)


@exact
def subtract_harmonics(n: int, orders: Array, sines: Array, cosines: Array, w: Array) -> None:
    """Second and higher harmonics of the output angle, integrated over the interval (Filon's rule)."""
    for k in range(orders.size):
        order = orders[k]
        for j in range(1, n + 1):
            sine, cosine = harmonic_means(order, j, w)
            w[at.INPUT + j] -= sines[k] * sine + cosines[k] * cosine


@exact
def harmonic_means(order: float, j: int, w: Array) -> tuple[float, float]:
    """Means of ``sin(n alpha)`` and ``cos(n alpha)`` over interval ``j``, sag of alpha to first order."""
    middle = order * w[at.ANGLE + j]
    turn = w[at.PSI + j] - w[at.PSI + j - 1]
    rise = w[at.FIRST + j] - w[at.FIRST + j - 1]
    rise = rise if w[at.STEP + j - 1] != 0.0 else 0.0
    even, _, sag = half_angle_moments(0.5 * order * turn)
    bent = -0.125 * order * w[at.STEP + j] * rise * sag
    sine, cosine = math.sin(middle), math.cos(middle)
    return even * sine + bent * cosine, even * cosine - bent * sine


@exact
def odd_square_mean(a: float, change: float) -> float:
    """Mean of ``a|a|`` while a goes linearly from ``a - change/2`` to ``a + change/2``."""
    start, end = a - 0.5 * change, a + 0.5 * change
    if start * end >= 0.0:
        return math.copysign(a * a + change * change / 12.0, a)
    return (abs(end) ** 3 - abs(start) ** 3) / (3.0 * change)


@exact
def invert_terms(n: int, p: Array, has_terms: bool, sampled: bool, w: Array) -> None:
    """Specific force ``a_x`` from the indicated force, to rounding; terms linear in it are solved first.

    ``has_terms`` False: no error terms, the result is the indicated force. ``sampled``: rows are samples, not intervals.
    """
    if not has_terms:
        for j in range(1, n + 1):
            w[at.FORCE + j] = w[at.INPUT + j]
        return
    reference = p[at.P_TIME_REFERENCE]
    twelfth = 1.0 / 12.0
    for j in range(1, n + 1):
        y, z, dy, dz = w[at.MEAN_Y + j], w[at.MEAN_Z + j], w[at.CHANGE_Y + j], w[at.CHANGE_Z + j]
        warmth, change = w[at.MEAN_T + j], w[at.SLOPE + j]
        known = p[K0] + p[M_Y] * y + p[M_Z] * z + p[K0_TEMP] * warmth
        known += p[K0_T] * (w[at.MEAN_TIME + j] - reference)
        known += p[K_YY] * (y * y + dy * dy * twelfth) + p[K_ZZ] * (z * z + dz * dz * twelfth)
        known += p[K_YZ] * (y * z + dy * dz * twelfth)
        known += (p[K_XY] * dy + p[K_XZ] * dz + p[K1_TEMP] * w[at.CHANGE_T + j]) * change * twelfth
        gain = p[K1] + p[K_XY] * y + p[K_XZ] * z + p[K1_TEMP] * warmth
        w[at.PARTIAL + j], w[at.SQUARE + j] = w[at.INPUT + j] - known, gain
    if p[SERVO] != 0.0 or p[SERVO_DAMPING] != 0.0:
        for j in range(1, n + 1):
            half = 0.0 if sampled else 0.5 * (w[at.PSI + j] - w[at.PSI + j - 1])
            w[at.PARTIAL + j] -= servo_error(p, j, sampled, half, w)
    for j in range(1, n + 1):
        inverse = 1.0 / (1.0 + w[at.SQUARE + j])
        w[at.DERIVATIVE + j] = inverse
        w[at.FORCE + j] = w[at.PARTIAL + j] * inverse
    if p[K2] != 0.0 or p[K3] != 0.0:
        invert_powers(n, p[K2], p[K3], w)
    if p[K2O] != 0.0:
        invert_odd_square(n, p, w)


@exact
def servo_error(p: Array, j: int, sampled: bool, half: float, w: Array) -> float:
    """Contribution of the servo to the indicated force of row ``j`` [m/s^2], which turns by ``2 half`` [rad].

    The mean of ``-2 s v (y sin - z cos)^2 - d v^2 (y cos + z sin)`` with ``(y, z) = (u_Y, u_Z)/K``. Here ``v`` is the output
    rate over K, which moves the load of the servo; in the terms of the calibration it is ``u_x/K``, the same to first order.
    """
    y, z, sine, cosine = w[at.MEAN_Y + j], w[at.MEAN_Z + j], w[at.SINE + j], w[at.COSINE + j]
    share = 0.0 if sampled else 0.5
    inverse = 1.0 / p[at.P_K]
    y -= ((1.0 - share) * w[at.OMEGA_Y + j] + share * w[at.OMEGA_Y + j - 1]) * inverse
    z -= ((1.0 - share) * w[at.OMEGA_Z + j] + share * w[at.OMEGA_Z + j - 1]) * inverse
    once, _, _ = half_angle_moments(half)
    twice, _, _ = half_angle_moments(2.0 * half)
    across, along, v = y * sine - z * cosine, y * cosine + z * sine, w[at.TURN + j]
    steady, turning = across * across + along * along, along * along - across * across
    return -v * (p[SERVO] * (steady - twice * turning) + p[SERVO_DAMPING] * v * once * along)


@exact
def invert_powers(n: int, k2: float, k3: float, w: Array) -> None:
    """Add ``k2 a^2 + k3 a^3`` by Newton's method; the inverse of the derivative is updated too."""
    for j in range(1, n + 1):
        a, inverse, right, gain = w[at.FORCE + j], w[at.DERIVATIVE + j], w[at.PARTIAL + j], w[at.SQUARE + j]
        spread = w[at.SLOPE + j] * w[at.SLOPE + j] * (1 / 12)
        for _ in range(ITERATIONS):
            square = a * a
            value = a * gain + k2 * (square + spread) + k3 * a * (square + 3.0 * spread)
            derivative = 1.0 + gain + 2.0 * k2 * a + 3.0 * k3 * (square + spread)
            inverse *= 2.0 - derivative * inverse
            a += ((right - a) - value) * inverse
        w[at.FORCE + j] = a
        w[at.DERIVATIVE + j] = inverse


@exact
def invert_odd_square(n: int, p: Array, w: Array) -> None:
    """Add the term ``k2o a|a|`` to the solution without it."""
    for j in range(1, n + 1):
        change = w[at.SLOPE + j]
        a = start = w[at.FORCE + j]
        first = 1.0 / w[at.DERIVATIVE + j]
        derivative = first
        for _ in range(ITERATIONS + 1):
            step = a - start
            smooth = step * first + p[K2] * step * step + p[K3] * step * step * (3.0 * start + step)
            derivative = first + 2.0 * p[K2] * step + 3.0 * p[K3] * step * (2.0 * start + step)
            derivative += 2.0 * p[K2O] * abs(a)
            a -= (smooth + p[K2O] * odd_square_mean(a, change)) / derivative
        w[at.FORCE + j] = a
        w[at.DERIVATIVE + j] = 1.0 / derivative


@exact
def sample_harmonics(n: int, orders: Array, sines: Array, cosines: Array, w: Array) -> None:
    """Second and higher harmonics of the output angle at the samples."""
    for k in range(orders.size):
        for j in range(1, n + 1):
            angle_k = orders[k] * w[at.ANGLE + j]
            w[at.INPUT + j] -= sines[k] * math.sin(angle_k) + cosines[k] * math.cos(angle_k)


ONE = 0
"""Stands for a row of ones."""
FIRST_FACTOR = np.array([
    ONE, at.FORCE, at.FORCE, at.FORCE, at.FORCE, at.MEAN_Y, at.MEAN_Z, at.FORCE, at.FORCE, at.MEAN_Y, at.MEAN_Z,
    at.MEAN_Y, at.MEAN_TIME, at.MEAN_T, at.FORCE,
])  # fmt: skip
SECOND_FACTOR = np.array([
    ONE, ONE, at.FORCE, at.FORCE, at.FORCE, ONE, ONE, at.MEAN_Y, at.MEAN_Z, at.MEAN_Y, at.MEAN_Z,
    at.MEAN_Z, ONE, ONE, at.MEAN_T,
])  # fmt: skip
"""Rows whose product is the regressor of a term, in the order of ``layout.TERMS`` up to ``k1_T``; k3 has ``a`` once more."""


@exact
def fill_regressor(code: int, n: int, p: Array, w: Array, x: Array) -> None:
    """Derivative of the indicated force by one coefficient, for every row of the block, into ``x``."""
    inverse = 1.0 / p[at.P_K]
    if code == at.SCALE_FACTOR:
        for j in range(1, n + 1):
            x[j] = (w[at.TURN + j] + w[at.BASE_X + j] * inverse) * inverse
    elif code == at.TAN_BETA:
        for j in range(1, n + 1):
            x[j] = w[at.MEAN_Y + j] * w[at.SINE + j] - w[at.MEAN_Z + j] * w[at.COSINE + j]
    elif code == at.PHI:
        for j in range(1, n + 1):
            x[j] = (w[at.RATE_Y + j] * w[at.COSINE + j] + w[at.RATE_Z + j] * w[at.SINE + j]) * inverse
    elif code >= at.HARMONIC:
        order, even = (code - at.HARMONIC) // 2, code % 2 == 0
        for j in range(1, n + 1):
            if order == 1:  # its sine and cosine are there already
                x[j] = w[at.SINE + j] if even else w[at.COSINE + j]
            else:
                angle = order * w[at.ANGLE + j]
                x[j] = math.sin(angle) if even else math.cos(angle)
    elif code >= SERVO:
        for j in range(1, n + 1):  # at the means of an interval
            v, y, z, s, c = w[at.TURN + j], w[at.MEAN_Y + j], w[at.MEAN_Z + j], w[at.SINE + j], w[at.COSINE + j]
            across, along = y * s - z * c, y * c + z * s
            x[j] = -2.0 * v * across * across if code == SERVO else -v * v * along
    elif code == K0:
        for j in range(1, n + 1):
            x[j] = 1.0
    else:
        fill_product(code, n, p, w, x)


@exact
def fill_product(code: int, n: int, p: Array, w: Array, x: Array) -> None:
    """Like :func:`fill_regressor`, for a term that is a product of inputs."""
    first, second = FIRST_FACTOR[code - at.P_TERMS], SECOND_FACTOR[code - at.P_TERMS]
    reference = p[at.P_TIME_REFERENCE] if code == K0_T else 0.0
    one, other = w[first : first + n + 1], w[second : second + n + 1]
    for j in range(1, n + 1):
        x[j] = one[j] - reference
    for j in range(1, n + 1 if second != ONE else 1):
        x[j] *= abs(other[j]) if code == K2O else other[j]
    for j in range(1, n + 1 if code == K3 else 1):
        x[j] *= w[at.FORCE + j]


@exact
def needs_time(codes: NDArray[np.int64]) -> bool:
    """True if a regressor contains time or temperature."""
    needed = False
    for code in codes:
        needed |= (code == K0_T) | (code == K0_TEMP) | (code == K1_TEMP)
    return needed


@exact
def find_variance(n: int, codes: NDArray[np.int64], factor: Array, p: Array, w: Array) -> None:
    """Variance of the indicated force by the coefficients, row SQUARE; ``factor`` (rank, coefficients) triangular."""
    count, square, part = codes.size, w[at.SQUARE : at.SQUARE + n + 1], w[at.PARTIAL : at.PARTIAL + n + 1]
    for k in range(count):
        fill_regressor(codes[k], n, p, w, regressor(n, k, count, w))
    for j in range(square.size):
        square[j] = 0.0
    last = count - 4 if count > 4 else 0
    for i in range(last if last < factor.shape[0] else factor.shape[0]):
        for j in range(square.size):
            part[j] = 0.0
        for k in range(i, count, 4):
            a, b, c, d = four(factor, i, k)
            x, y = regressor(n, k, count, w), regressor(n, k + 1, count, w)
            z, v = regressor(n, k + 2, count, w), regressor(n, k + 3, count, w)
            for j in range(square.size):
                part[j] += (a * x[j] + b * y[j]) + (c * z[j] + d * v[j])
        for j in range(square.size):
            square[j] += part[j] * part[j]
    if factor.shape[0] <= last:
        return
    a, b, c, d = four(factor, last, last)
    e, f, g, _ = four(factor, last + 1, last + 1)
    h, o, _, _ = four(factor, last + 2, last + 2)
    q, _, _, _ = four(factor, last + 3, last + 3)
    x, y = regressor(n, last, count, w), regressor(n, last + 1, count, w)
    z, v = regressor(n, last + 2, count, w), regressor(n, last + 3, count, w)
    for j in range(square.size):
        first, second = (a * x[j] + b * y[j]) + (c * z[j] + d * v[j]), e * y[j] + (f * z[j] + g * v[j])
        third, fourth = h * z[j] + o * v[j], q * v[j]
        square[j] += (first * first + second * second) + (third * third + fourth * fourth)


@exact
def four(factor: Array, i: int, k: int) -> tuple[float, float, float, float]:
    """Four elements of a row of the triangular factor; 0 beyond it."""
    left = factor.shape[1] - k if i < factor.shape[0] else 0
    return (
        factor[i, k] if left > 0 else 0.0, factor[i, k + 1] if left > 1 else 0.0,
        factor[i, k + 2] if left > 2 else 0.0, factor[i, k + 3] if left > 3 else 0.0,
    )  # fmt: skip


@exact
def regressor(n: int, k: int, count: int, w: Array) -> Array:
    """Row of a regressor; for ``k`` beyond the last regressor, the last one."""
    start = at.REGRESSORS + (k if k < count else count - 1) * at.STRIDE
    return w[start : start + n + 1]


@exact
def find_uncertainty(n: int, per: int, scaled: bool, p: Array, w: Array) -> None:
    """Standard uncertainty of ``a_x`` [m/s^2], row KNOWN_TO, from the variance by the coefficients (row SQUARE).

    Noise and the unknown between samples are added.

    ``per`` is the row that contains 1 over the time of a row in the noise. ``scaled``: by the row DERIVATIVE.
    """
    tangent, inverse = p[at.P_TAN_BETA], 1.0 / (p[at.P_K] * p[at.P_K])
    white, walk = 2.0 * p[at.P_WHITE] * inverse, p[at.P_WALK] * inverse
    near, zone = (NEAR * tangent) ** 2, 0
    rates, u = w[per + 1 : per + 1 + n], w[at.KNOWN_TO + 1 : at.KNOWN_TO + 1 + n]
    for j in range(u.size):
        rate, doubt = rates[j], w[at.DOUBT + 1 + j]
        a, y, z = w[at.FORCE + 1 + j], w[at.MEAN_Y + 1 + j], w[at.MEAN_Z + 1 + j]
        u[j] = math.sqrt(w[at.SQUARE + 1 + j] + (white * rate + walk) * rate + doubt * doubt)
        zone |= a * a < near * (y * y + z * z)
    if scaled:
        for j in range(u.size):
            u[j] *= abs(w[at.DERIVATIVE + 1 + j])
    if zone:
        for j in range(1, n + 1):
            w[at.KNOWN_TO + j] = widened(
                w[at.KNOWN_TO + j], w[at.FORCE + j], w[at.MEAN_Y + j], w[at.MEAN_Z + j], tangent
            )


@exact
def widened(u: float, a: float, y: float, z: float, tangent: float) -> float:
    """Standard uncertainty including the dead zone, whose part vanishes at ``|a|`` = ``NEAR`` times its half-width."""
    dead, size = tangent * math.sqrt(y * y + z * z), abs(a)
    if size >= NEAR * dead:
        return u
    share = 1.0 if size <= dead else (NEAR * dead - size) / ((NEAR - 1.0) * dead)
    return math.sqrt(u * u + dead * dead / 3.0 * share)


@inline
def flag_of(a: float, y: float, z: float, dead: float, low: float, high: float, most: float) -> int:
    """Validity of a row by its force; ``dead`` squared tangent, ``most`` squared limit of the transverse force."""
    square, across = a * a, y * y + z * z
    flag = at.LOCKED if square < dead * across else 0
    flag |= at.NEAR_CRITICAL if (square >= dead * across) & (square < NEAR * NEAR * dead * across) else 0
    return flag | (at.OUT_OF_RANGE if (a < low) | (a > high) | (across > most) else 0)


@exact
def find_flags(
    n: int, tangent: float, limits: Array, w: Array, base: int, warm: bool, flags: NDArray[np.int32]
) -> None:
    """Validity of every row; ``limits``: a_x low, high, a_t high; temperature low, high above reference."""
    dead, most = tangent * tangent, limits[2] * limits[2]
    low, high, cold, hot = limits[0], limits[1], limits[3], limits[4]
    for j in range(n):
        a, y, z = w[at.FORCE + 1 + j], w[at.MEAN_Y + 1 + j], w[at.MEAN_Z + 1 + j]
        turn = w[at.PSI + 1 + j] - w[at.PSI + j]
        coarse = at.COARSE if (abs(turn) > 1.0) & (w[at.STEP + 1 + j] != 0.0) else 0
        flags[j] = base | flag_of(a, y, z, dead, low, high, most) | coarse
    if warm:
        for j in range(n):
            warmth = w[at.MEAN_T + 1 + j]
            flags[j] |= at.TEMPERATURE if (warmth < cold) | (warmth > hot) else 0
