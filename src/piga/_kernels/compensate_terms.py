"""The error model inverted, and the uncertainty of the result: both work on rows of interval means."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels import compensate_layout as at
from piga._kernels.jit import exact
from piga._kernels.regressors import half_angle_moments

Array = NDArray[np.float64]

ITERATIONS = 4
"""Newton steps: the error model is nearly linear, each step squares a relative error below 1e-2."""
K0, K1, K2, K3, K2O, M_Y, M_Z, K_XY, K_XZ, K_YY, K_ZZ, K_YZ, K0_T, K0_TEMP, K1_TEMP = (
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
def invert_terms(n: int, p: Array, w: Array) -> None:
    """Specific force ``a_x`` from the indicated one: Newton's method on the error model, to rounding."""
    reference = p[at.P_TIME_REFERENCE]
    for j in range(1, n + 1):
        y, z, dy, dz = w[at.MEAN_Y + j], w[at.MEAN_Z + j], w[at.CHANGE_Y + j], w[at.CHANGE_Z + j]
        warmth, change = w[at.MEAN_T + j], w[at.SLOPE + j]
        known = p[K0] + p[M_Y] * y + p[M_Z] * z + p[K0_TEMP] * warmth
        known += p[K0_T] * (w[at.MEAN_TIME + j] - reference)
        known += p[K_YY] * (y * y + dy * dy / 12.0) + p[K_ZZ] * (z * z + dz * dz / 12.0)
        known += p[K_YZ] * (y * z + dy * dz / 12.0)
        known += (p[K_XY] * dy + p[K_XZ] * dz + p[K1_TEMP] * w[at.CHANGE_T + j]) * change / 12.0
        gain = p[K1] + p[K_XY] * y + p[K_XZ] * z + p[K1_TEMP] * warmth
        spread = change * change / 12.0
        right = w[at.INPUT + j] - known
        a, derivative = right / (1.0 + gain), 1.0
        for _ in range(ITERATIONS):
            value = a * gain + p[K2] * (a * a + spread) + p[K3] * a * (a * a + 3.0 * spread)
            if p[K2O] != 0.0:
                value += p[K2O] * odd_square_mean(a, change)
            derivative = 1.0 + gain + 2.0 * p[K2] * a + 3.0 * p[K3] * (a * a + spread) + 2.0 * p[K2O] * abs(a)
            a += ((right - a) - value) / derivative
        w[at.FORCE + j] = a
        w[at.DERIVATIVE + j] = derivative


@exact
def take_input(n: int, w: Array) -> None:
    """Without error terms the indicated force is the compensated one."""
    for j in range(1, n + 1):
        w[at.FORCE + j] = w[at.INPUT + j]
    for j in range(1, n + 1):
        w[at.DERIVATIVE + j] = 1.0


@exact
def fill_regressor(code: int, n: int, p: Array, w: Array) -> None:
    """Derivative of the indicated force by one coefficient, for every interval."""
    for j in range(1, n + 1):
        a, y, z = w[at.FORCE + j], w[at.MEAN_Y + j], w[at.MEAN_Z + j]
        if code == at.P_TERMS:
            value = 1.0
        elif code == at.SCALE_FACTOR:
            value = (w[at.TURN + j] + w[at.OMEGA_X + j] / p[at.P_K]) / p[at.P_K]
        elif code == at.TAN_BETA:
            value = y * w[at.SINE + j] - z * w[at.COSINE + j]
        elif code == at.PHI:
            value = (w[at.RATE_Y + j] * w[at.COSINE + j] + w[at.RATE_Z + j] * w[at.SINE + j]) / p[at.P_K]
        else:
            time = w[at.MEAN_TIME + j] - p[at.P_TIME_REFERENCE]
            value = term_regressor(code, a, y, z, w[at.MEAN_T + j], time)
        w[at.REGRESSOR + j] = value


@exact
def term_regressor(code: int, a: float, y: float, z: float, warmth: float, time: float) -> float:
    """Regressor of a term of the error model at the means of an interval."""
    if code == K1:
        return a
    if code == K2:
        return a * a
    if code == K3:
        return a * a * a
    if code == K2O:
        return a * abs(a)
    if code == M_Y:
        return y
    if code == M_Z:
        return z
    if code == K_XY:
        return a * y
    if code == K_XZ:
        return a * z
    if code == K_YY:
        return y * y
    if code == K_ZZ:
        return z * z
    if code == K_YZ:
        return y * z
    if code == K0_T:
        return time
    return warmth if code == K0_TEMP else a * warmth


@exact
def fill_harmonic(code: int, n: int, w: Array) -> None:
    """Regressor of a harmonic of the output angle."""
    order = float((code - at.HARMONIC) // 2)
    for j in range(1, n + 1):
        angle = order * w[at.ANGLE + j]
        w[at.REGRESSOR + j] = math.sin(angle) if code % 2 == 0 else math.cos(angle)


@exact
def find_uncertainty(n: int, p: Array, codes: NDArray[np.int64], factor: Array, w: Array, u: Array) -> None:
    """Standard uncertainty of ``a_x`` [m/s^2]: coefficients (``factor factor'`` their covariance) and noise."""
    white, walk, K = p[at.P_WHITE], p[at.P_WALK], p[at.P_K]
    tangent = p[at.P_TAN_BETA]
    for j in range(1, n + 1):
        length = w[at.LENGTH + j]
        w[at.SQUARE + j] = (2.0 * white / length + walk) / (length * K * K)
    for column in range(factor.shape[1]):
        for j in range(1, n + 1):
            w[at.PARTIAL + j] = 0.0
        for k in range(codes.size):
            weight = factor[k, column]
            if weight == 0.0:
                continue
            if codes[k] >= at.HARMONIC:
                fill_harmonic(codes[k], n, w)
            else:
                fill_regressor(codes[k], n, p, w)
            for j in range(1, n + 1):
                w[at.PARTIAL + j] += weight * w[at.REGRESSOR + j]
        for j in range(1, n + 1):
            w[at.SQUARE + j] += w[at.PARTIAL + j] * w[at.PARTIAL + j]
    for j in range(1, n + 1):
        y, z = w[at.MEAN_Y + j], w[at.MEAN_Z + j]
        dead = tangent * math.sqrt(y * y + z * z)
        zone = dead * dead / 3.0 * dead_zone_weight(abs(w[at.FORCE + j]), dead)
        u[j - 1] = math.sqrt(w[at.SQUARE + j] / (w[at.DERIVATIVE + j] * w[at.DERIVATIVE + j]) + zone)


@exact
def dead_zone_weight(a: float, dead: float) -> float:
    """1 inside the dead zone, falling to 0 where ``a`` reaches ``NEAR`` times its half-width."""
    if a >= NEAR * dead:
        return 0.0
    return 1.0 if a <= dead else (NEAR * dead - a) / ((NEAR - 1.0) * dead)


NEAR = 1.25
"""Near-critical: ``|a_x|`` below this multiple of ``a_t tan(beta)``."""


@exact
def find_flags(
    n: int, tangent: float, limits: Array, w: Array, base: int, warm: bool, flags: NDArray[np.int32]
) -> None:
    """Validity of every row; ``limits``: a_x low, high, a_t high; temperature low, high above reference."""
    for j in range(1, n + 1):
        a, y, z = w[at.FORCE + j], w[at.MEAN_Y + j], w[at.MEAN_Z + j]
        transverse = math.sqrt(y * y + z * z)
        dead = tangent * transverse
        size = abs(a)
        flag = base
        flag |= at.LOCKED if size < dead else 0
        flag |= at.NEAR_CRITICAL if (size >= dead) & (size < NEAR * dead) else 0
        flag |= at.OUT_OF_RANGE if (a < limits[0]) | (a > limits[1]) | (transverse > limits[2]) else 0
        warmth = w[at.MEAN_T + j]
        flag |= at.TEMPERATURE if warm & ((warmth < limits[3]) | (warmth > limits[4])) else 0
        turn = w[at.PSI + j] - w[at.PSI + j - 1]
        flag |= at.COARSE if (abs(turn) > 1.0) & (w[at.STEP + j] != 0.0) else 0
        flags[j - 1] = flag
