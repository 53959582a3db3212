"""The error model inverted, on rows of interval means."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.compensation import layout as at
from piga._kernels.estimation.regressors import half_angle_moments
from piga._kernels.jit import exact

Array = NDArray[np.float64]

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
def invert_terms(n: int, p: Array, sampled: bool, w: Array) -> None:
    """Specific force ``a_x`` from the indicated one, to rounding: solved for the terms that are linear in it first.

    ``sampled``: rows are samples, not intervals.
    """
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
    """What the servo adds to the indicated force of row ``j`` [m/s^2], which turns by ``2 half`` [rad].

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
    """Go on with ``k2 a^2 + k3 a^3`` by Newton's method; the inverse of the derivative is carried along by it, too."""
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
    """Go on with the term ``k2o a|a|``, from the solution without it."""
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
def take_input(n: int, w: Array) -> None:
    """Without error terms the indicated force is the compensated one."""
    for j in range(1, n + 1):
        w[at.FORCE + j] = w[at.INPUT + j]
