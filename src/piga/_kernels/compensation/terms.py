"""Inverse of the error model for one interval (or sample), with uncertainty and validity of the result.

A triangular factor ``R`` represents the covariance ``R'R`` of the coefficients. The variance ``|R x|^2`` for the regressors
``x`` of a row is then a sum of squares.
"""

from __future__ import annotations

import math

from piga._kernels.compensation import data as at
from piga._kernels.compensation.data import Covariance, Inputs, Instrument
from piga._kernels.estimation import half_angle_moments
from piga._kernels.jit import Array, exact, inline_exact

NEAR = 1.25
"""Near-critical: ``|a_x|`` below this multiple of ``a_t tan(beta)``."""
_ITERATIONS = 4
"""Newton steps: the error model is nearly linear, each step squares a relative error below 1e-2."""
TWELFTH = 1.0 / 12.0
(
    K0, K1, K2, K3, _K2O, _K1A, M_Y, _M_Z, _K_XY, _K_XZ, _K_YY, _K_ZZ, _K_YZ, _K0_TIME, _K0_TEMP, _K1_TEMP,
    _K2_VIBRATION, SERVO, _SERVO_DAMPING,
) = range(len(at.TERMS))  # fmt: skip


@exact
def harmonics(more: Covariance, x: Inputs, bend: float) -> float:
    """Second and higher harmonics of the output angle [m/s^2]; their mean over an interval by Filon's rule.

    ``bend``: ``h^2`` times the slope of ``u_x`` [rad], the sag of the angle to first order.
    """
    total = 0.0
    for k in range(more.orders.size):
        order = more.orders[k]
        even, _, sag = half_angle_moments(order * x.half)
        bent = -0.125 * order * bend * sag
        sine, cosine = math.sin(order * x.angle), math.cos(order * x.angle)
        total += more.sines[k] * (even * sine + bent * cosine) + more.cosines[k] * (even * cosine - bent * sine)
    return total


@exact
def _odd_square_mean(a: float, change: float) -> float:
    """Mean of ``a|a|`` while a goes linearly from ``a - change/2`` to ``a + change/2``."""
    start, end = a - 0.5 * change, a + 0.5 * change
    if start * end >= 0.0:
        return math.copysign(a * a + change * change / 12.0, a)
    return (abs(end) ** 3 - abs(start) ** 3) / (3.0 * change)


@exact
def size_mean(a: float, change: float) -> float:
    """Mean of ``|a|`` while a goes linearly from ``a - change/2`` to ``a + change/2``."""
    if abs(a) >= 0.5 * abs(change):
        return abs(a)
    return a * a / abs(change) + 0.25 * abs(change)


@inline_exact
def invert_terms(p: Instrument, x: Inputs, indicated: float) -> tuple[float, float]:
    """Specific force ``a_x`` from the indicated force, to rounding, and the derivative of one by the other.

    Terms linear in ``a_x`` are solved first.
    """
    if p.has_terms == 0.0:
        return indicated, 1.0
    y, z, dy, dz, da = x.a_Y, x.a_Z, x.da_Y, x.da_Z, x.da
    apart = p.k0 + p.m_Y * y + p.m_Z * z + p.k0_T * x.T + p.k0_t * (x.t - p.t_0)
    apart += p.k_YY * (y * y + dy * dy * TWELFTH) + p.k_ZZ * (z * z + dz * dz * TWELFTH)
    apart += p.k_YZ * (y * z + dy * dz * TWELFTH)
    apart += (p.k_XY * dy + p.k_XZ * dz + p.k1_T * x.dT) * da * TWELFTH
    apart += p.k2v * x.vibration
    right, gain = indicated - apart, p.k1 + p.k_XY * y + p.k_XZ * z + p.k1_T * x.T
    if p.servo != 0.0 or p.servo_damping != 0.0:
        right -= servo_error(p, x)
    inverse = 1.0 / (1.0 + gain)
    a = right * inverse
    if p.k2 != 0.0 or p.k3 != 0.0:
        spread = da * da * TWELFTH
        for _ in range(_ITERATIONS):
            square = a * a
            value = a * gain + p.k2 * (square + spread) + p.k3 * a * (square + 3.0 * spread)
            derivative = 1.0 + gain + 2.0 * p.k2 * a + 3.0 * p.k3 * (square + spread)
            inverse *= 2.0 - derivative * inverse
            a += ((right - a) - value) * inverse
    if p.k2o != 0.0 or p.k1a != 0.0:
        start, first = a, 1.0 / inverse
        derivative = first
        for _ in range(_ITERATIONS + 1):
            step = a - start
            smooth = step * first + p.k2 * step * step + p.k3 * step * step * (3.0 * start + step)
            derivative = first + 2.0 * p.k2 * step + 3.0 * p.k3 * step * (2.0 * start + step)
            derivative += 2.0 * p.k2o * abs(a) + math.copysign(p.k1a, a)
            a -= (smooth + p.k2o * _odd_square_mean(a, da) + p.k1a * size_mean(a, da)) / derivative
        inverse = 1.0 / derivative
    return a, inverse


@exact
def servo_error(p: Instrument, x: Inputs) -> float:
    """Contribution of the servo to the indicated force [m/s^2].

    The mean of ``-2 s v (y sin - z cos)^2 - d v^2 (y cos + z sin)`` with ``(y, z) = (u_Y, u_Z)/K``. Here ``v`` is the output
    rate over K, which moves the load of the servo; in the terms of the calibration it is ``u_x/K``, the same to first order.
    """
    y, z = x.a_Y - x.Omega_Y / p.K, x.a_Z - x.Omega_Z / p.K
    once, _, _ = half_angle_moments(x.half)
    twice, _, _ = half_angle_moments(2.0 * x.half)
    across, along = y * x.s - z * x.c, y * x.c + z * x.s
    steady, turning = across * across + along * along, along * along - across * across
    return -x.v * (p.servo * (steady - twice * turning) + p.servo_damping * x.v * once * along)


@inline_exact
def _power_regressor(code: int, a: float) -> float:
    """Derivative by ``k0``, ``k1``, ``k2``, ``k3``, ``k2o`` or ``k1a``."""
    if code == K0:
        return 1.0
    if code == K1:
        return a
    if code == _K2O:
        return a * abs(a)
    if code == _K1A:
        return abs(a)
    return a * a if code == K2 else a * a * a


@inline_exact
def _product_regressor(code: int, p: Instrument, x: Inputs, a: float) -> float:
    """Derivative by a term that is a product with the transverse force, time or temperature."""
    if code <= _K_XZ:
        across = x.a_Y if code in (M_Y, _K_XY) else x.a_Z
        return across if code in (M_Y, _M_Z) else a * across
    if code == _K_YY:
        return x.a_Y * x.a_Y
    if code <= _K_YZ:
        return (x.a_Z if code == _K_ZZ else x.a_Y) * x.a_Z
    if code == _K0_TIME:
        return x.t - p.t_0
    return x.T if code == _K0_TEMP else a * x.T


@inline_exact
def regressor(code: int, p: Instrument, x: Inputs, a: float) -> float:
    """Derivative of the indicated force by one coefficient."""
    if code == at.SCALE_FACTOR:
        per_K = 1.0 / p.K
        return (x.v + x.Omega_x * per_K) * per_K
    if code == at.TAN_BETA:
        return x.a_Y * x.s - x.a_Z * x.c
    if code == at.PHI:
        return (x.y * x.c + x.z * x.s) / p.K
    if code >= at.HARMONIC:
        angle = ((code - at.HARMONIC) // 2) * x.angle
        return math.sin(angle) if code % 2 == 0 else math.cos(angle)
    if code <= _K1A:
        return _power_regressor(code, a)
    if code == _K2_VIBRATION:
        return x.vibration
    if code <= _K1_TEMP:
        return _product_regressor(code, p, x, a)
    across, along = x.a_Y * x.s - x.a_Z * x.c, x.a_Y * x.c + x.a_Z * x.s
    return -2.0 * x.v * across * across if code == SERVO else -x.v * x.v * along


@inline_exact
def variance_by_coefficients(more: Covariance, p: Instrument, x: Inputs, a: float, work: Array) -> float:
    """Variance of the indicated force by the coefficients [m^2/s^4]; ``work`` has room for the regressors."""
    count = more.codes.size
    for k in range(count):
        work[k] = regressor(more.codes[k], p, x, a)
    total = 0.0
    for i in range(more.factor.shape[0]):
        part = 0.0
        for k in range(i, count):
            part += more.factor[i, k] * work[k]
        total += part * part
    return total


@inline_exact
def uncertainty(p: Instrument, x: Inputs, variance: float, derivative: float, dead: float) -> float:
    """Standard uncertainty of ``a_x`` [m/s^2]: coefficients, noise of the output, motion between samples, ``dead`` zone."""
    inverse = 1.0 / (p.K * p.K)
    noise = (2.0 * p.white * inverse * x.per + p.walk * inverse) * x.per
    square = (variance + noise + x.doubt * x.doubt) * derivative * derivative
    return math.sqrt(square + dead * dead)


@inline_exact
def dead_zone(p: Instrument, a_Y: float, a_Z: float, a: float) -> float:
    """Standard uncertainty of ``a_x`` by the dead zone [m/s^2]; 0 far from it."""
    square = p.tan_beta * p.tan_beta * (a_Y * a_Y + a_Z * a_Z)
    if a * a >= NEAR * NEAR * square:
        return 0.0
    dead, size = math.sqrt(square), abs(a)
    share = 1.0 if size <= dead else (NEAR * dead - size) / ((NEAR - 1.0) * dead)
    return dead * math.sqrt(share / 3.0)


TIME, GAIN, STRETCHES, DOUBT, HIDDEN, DEAD = range(at.MOST_TERMS, at.MOST_TERMS + 6)
SUMS = at.MOST_TERMS + 6
"""Places and number of the sums for the uncertainty of a velocity; before them those of the coefficients."""


@inline_exact
def add_to_velocity(
    sums: Array, count: int, work: Array, h: float, gain: float, doubt: float, hidden: float, dead: float
) -> None:
    """Add a row to the sums over rows from which the uncertainty of the velocity follows.

    ``work``: derivatives of the indicated force by ``count`` coefficients. ``gain``: derivative of the force by the indicated
    one. ``doubt``, ``hidden``, ``dead``: uncertainty by the motion between samples, by rectification and by the dead zone
    [m/s^2].
    """
    for k in range(count):
        sums[k] += gain * h * work[k]
    size = abs(gain) * h
    sums[TIME] += h
    sums[GAIN] += gain * size
    sums[DOUBT] += (size * doubt) ** 2
    sums[HIDDEN] += size * hidden
    sums[DEAD] += h * dead
    if h == 0.0:
        sums[STRETCHES] += 1.0


@inline_exact
def flags_of(p: Instrument, x: Inputs, a: float, warm: bool) -> int:
    """Validity of a row. ``warm``: the temperature is recorded."""
    square, across = a * a, x.a_Y * x.a_Y + x.a_Z * x.a_Z
    dead = p.tan_beta * p.tan_beta * across
    flag = 0
    if square < dead:
        flag |= at.LOCKED
    elif square < NEAR * NEAR * dead:
        flag |= at.NEAR_CRITICAL
    if a < p.low or a > p.high or across > p.most * p.most:
        flag |= at.OUT_OF_RANGE
    if x.h != 0.0 and abs(x.turn) > 1.0:
        flag |= at.COARSE
    if warm and (p.cold > x.T or p.hot < x.T):
        flag |= at.TEMPERATURE
    return flag
