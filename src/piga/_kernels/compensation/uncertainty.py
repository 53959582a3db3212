"""Uncertainty and validity of compensated rows: both work on rows of interval means (or samples).

The covariance of the coefficients stands in a triangular factor ``R`` (``R'R`` is the covariance), so the variance
``|R x|^2`` of the regressors ``x`` of a row is a sum of squares. What is rare (the dead zone) is done row by row, and only
in blocks where it occurs.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.compensation import layout as at
from piga._kernels.compensation import terms
from piga._kernels.jit import exact, inline

Array = NDArray[np.float64]

NEAR = 1.25
"""Near-critical: ``|a_x|`` below this multiple of ``a_t tan(beta)``."""


@exact
def fill_regressor(code: int, n: int, p: Array, w: Array, x: Array) -> None:
    """Derivative of the indicated force by one coefficient, for every row of the block, into ``x``."""
    inverse = 1.0 / p[at.P_K]
    if code == at.P_TERMS:
        x[: n + 1] = 1.0
    elif code == at.SCALE_FACTOR:
        for j in range(1, n + 1):
            x[j] = (w[at.TURN + j] + w[at.BASE_X + j] * inverse) * inverse
    elif code == at.TAN_BETA:
        for j in range(1, n + 1):
            x[j] = w[at.MEAN_Y + j] * w[at.SINE + j] - w[at.MEAN_Z + j] * w[at.COSINE + j]
    elif code == at.PHI:
        for j in range(1, n + 1):
            x[j] = (w[at.RATE_Y + j] * w[at.COSINE + j] + w[at.RATE_Z + j] * w[at.SINE + j]) * inverse
    elif code in (terms.SERVO, terms.SERVO_DAMPING):
        fill_servo(code, n, w, x)
    elif code >= at.HARMONIC:
        fill_harmonic(code, n, w, x)
    else:
        for j in range(1, n + 1):
            time = w[at.MEAN_TIME + j] - p[at.P_TIME_REFERENCE]
            x[j] = term_regressor(
                code, w[at.FORCE + j], w[at.MEAN_Y + j], w[at.MEAN_Z + j], w[at.MEAN_T + j], time
            )


@exact
def term_regressor(code: int, a: float, y: float, z: float, warmth: float, time: float) -> float:
    """Regressor of a term of the error model at the means of an interval."""
    if code == terms.K1:
        return a
    if code == terms.K2:
        return a * a
    if code == terms.K3:
        return a * a * a
    if code == terms.K2O:
        return a * abs(a)
    if code == terms.M_Y:
        return y
    if code == terms.M_Z:
        return z
    if code == terms.K_XY:
        return a * y
    if code == terms.K_XZ:
        return a * z
    if code == terms.K_YY:
        return y * y
    if code == terms.K_ZZ:
        return z * z
    if code == terms.K_YZ:
        return y * z
    if code == terms.K0_T:
        return time
    return warmth if code == terms.K0_TEMP else a * warmth


@exact
def fill_servo(code: int, n: int, w: Array, x: Array) -> None:
    """Regressor of a term of the servo: the same at the means of an interval."""
    for j in range(1, n + 1):
        v, y, z = w[at.TURN + j], w[at.MEAN_Y + j], w[at.MEAN_Z + j]
        across, along = y * w[at.SINE + j] - z * w[at.COSINE + j], y * w[at.COSINE + j] + z * w[at.SINE + j]
        x[j] = -2.0 * v * across * across if code == terms.SERVO else -v * v * along


@exact
def fill_harmonic(code: int, n: int, w: Array, x: Array) -> None:
    """Regressor of a harmonic of the output angle; the first one has its sine and cosine already."""
    order = (code - at.HARMONIC) // 2
    row = at.SINE if code % 2 == 0 else at.COSINE
    if order == 1:
        for j in range(1, n + 1):
            x[j] = w[row + j]
        return
    for j in range(1, n + 1):
        angle = order * w[at.ANGLE + j]
        x[j] = math.sin(angle) if code % 2 == 0 else math.cos(angle)


@exact
def needs_time(codes: NDArray[np.int64]) -> bool:
    """True when a regressor holds time or temperature."""
    found = False
    for code in codes:
        found |= (code == terms.K0_T) | (code == terms.K0_TEMP) | (code == terms.K1_TEMP)
    return found


@exact
def find_variance(n: int, codes: NDArray[np.int64], factor: Array, p: Array, w: Array) -> None:
    """Variance of the indicated force by the coefficients, row SQUARE; ``factor`` (rank, coefficients) triangular."""
    for k in range(codes.size):
        start = at.REGRESSORS + k * at.STRIDE
        fill_regressor(codes[k], n, p, w, w[start : start + at.STRIDE])
    square, part = w[at.SQUARE : at.SQUARE + n + 1], w[at.PARTIAL : at.PARTIAL + n + 1]
    square[:] = 0.0
    single = max(codes.size - 4, 0)
    for i in range(min(single, factor.shape[0])):
        part[:] = 0.0
        for k in range(i, codes.size, 4):
            left = codes.size - k
            add_four(
                factor[i, k], factor[i, k + 1] if left > 1 else 0.0, factor[i, k + 2] if left > 2 else 0.0,
                factor[i, k + 3] if left > 3 else 0.0, regressor(n, k, w), regressor(n, k + min(1, left - 1), w),
                regressor(n, k + min(2, left - 1), w), regressor(n, k + min(3, left - 1), w), part,
            )  # fmt: skip
        for j in range(square.size):
            square[j] += part[j] * part[j]
    if factor.shape[0] > single:
        m = np.zeros((4, 4))
        m[: factor.shape[0] - single, : codes.size - single] = factor[single:, single:]
        last = codes.size - 1
        add_triangle(
            m, regressor(n, single, w), regressor(n, min(single + 1, last), w),
            regressor(n, min(single + 2, last), w), regressor(n, min(single + 3, last), w), square,
        )  # fmt: skip


@exact
def add_triangle(m: Array, x: Array, y: Array, z: Array, v: Array, square: Array) -> None:
    """Add the squares of the rows of a triangular matrix (4, 4) times four regressors."""
    a, b, c, d, e, f = m[0, 0], m[0, 1], m[0, 2], m[0, 3], m[1, 1], m[1, 2]
    g, h, i, k = m[1, 3], m[2, 2], m[2, 3], m[3, 3]
    for j in range(square.size):
        one = (a * x[j] + b * y[j]) + (c * z[j] + d * v[j])
        two, three, four = e * y[j] + (f * z[j] + g * v[j]), h * z[j] + i * v[j], k * v[j]
        square[j] += (one * one + two * two) + (three * three + four * four)


@exact
def regressor(n: int, k: int, w: Array) -> Array:
    """Row of one regressor."""
    start = at.REGRESSORS + k * at.STRIDE
    return w[start : start + n + 1]


@exact
def add_four(
    a: float, b: float, c: float, d: float, x: Array, y: Array, z: Array, v: Array, part: Array
) -> None:  # fmt: skip
    """Add four weighted rows."""
    for j in range(part.size):
        part[j] += (a * x[j] + b * y[j]) + (c * z[j] + d * v[j])


@exact
def find_uncertainty(
    n: int, per: int, scaled: bool, p: Array, codes: NDArray[np.int64], factor: Array, w: Array, u: Array
) -> None:
    """Standard uncertainty of ``a_x`` [m/s^2]: coefficients, noise, the unknown between samples (row DOUBT).

    ``scaled``: by the row DERIVATIVE.

    ``per`` is the row that holds 1 over the time of a row in the noise.
    """
    find_variance(n, codes, factor, p, w)
    inverse = 1.0 / (p[at.P_K] * p[at.P_K])
    white, walk = 2.0 * p[at.P_WHITE] * inverse, p[at.P_WALK] * inverse
    near = (NEAR * p[at.P_TAN_BETA]) ** 2
    zone = 0
    for j in range(u.size):
        rate, a = w[per + 1 + j], w[at.FORCE + 1 + j]
        y, z = w[at.MEAN_Y + 1 + j], w[at.MEAN_Z + 1 + j]
        doubt = w[at.DOUBT + 1 + j]
        u[j] = math.sqrt(w[at.SQUARE + 1 + j] + (white * rate + walk) * rate + doubt * doubt)
        zone |= a * a < near * (y * y + z * z)
    if scaled:
        for j in range(u.size):
            u[j] *= abs(w[at.DERIVATIVE + 1 + j])
    if zone:
        widen(p[at.P_TAN_BETA], w, u)


@exact
def widen(tangent: float, w: Array, u: Array) -> None:
    """Add the variance of the dead zone to every row."""
    for j in range(u.size):
        u[j] = widened(u[j], w[at.FORCE + 1 + j], w[at.MEAN_Y + 1 + j], w[at.MEAN_Z + 1 + j], tangent)


@exact
def widened(u: float, a: float, y: float, z: float, tangent: float) -> float:
    """Standard uncertainty with the dead zone, falling to nothing where ``|a|`` reaches ``NEAR`` times its half-width."""
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
