"""The error model of one row, its inverse, and uncertainty and validity of the result.

A triangular factor ``R`` represents the covariance ``R'R`` of the coefficients. The variance ``|R x|^2`` for the regressors
``x`` of a row is then a sum of squares.

**Vibration near the Nyquist frequency.** The output gives the mean force of an interval. The mean of ``f^2`` is larger than the
square of the mean by the variance within the interval. Where the force is smooth, its change over the interval gives this
variance. Of a vibration near the Nyquist frequency no sample shows it [own choice, docs/theory/compensation].
"""

from __future__ import annotations

import math

from piga._kernels.compensation import data as at
from piga._kernels.compensation.data import Instrument, Past, Row
from piga._kernels.estimation import half_angle_moments
from piga._kernels.jit import Array, inline, lean

NEAR = 1.25
"""Near-critical: ``|a_x|`` below this multiple of ``a_t tan(beta)``."""
_ITERATIONS, _ROUNDING = 6, 1e-16
"""Most Newton steps, and the relative correction that ends them: the error model is nearly linear, each step squares the error."""
TWELFTH = 1.0 / 12.0


@lean
def harmonics(p: Instrument, x: Row, bend: float) -> float:
    """Second and higher harmonics of the output angle [m/s^2]; their mean over an interval by Filon's rule.

    ``bend``: ``h^2`` times the slope of ``u_x`` [rad], the sag of the angle to first order.
    """
    total = 0.0
    for k in range(int(p.waves)):
        order = p.orders[k]
        even, _, sag = half_angle_moments(order * x.half)
        bent = -0.125 * order * bend * sag
        sine, cosine = math.sin(order * x.angle), math.cos(order * x.angle)
        total += p.sines[k] * (even * sine + bent * cosine) + p.cosines[k] * (even * cosine - bent * sine)
    return total


@lean
def _odd_square_mean(a: float, change: float) -> float:
    """Mean of ``a|a|`` while a goes linearly from ``a - change/2`` to ``a + change/2``."""
    start, end = a - 0.5 * change, a + 0.5 * change
    if start * end >= 0.0:
        return math.copysign(a * a + change * change / 12.0, a)
    return (abs(end) ** 3 - abs(start) ** 3) / (3.0 * change)


@lean
def _size_mean(a: float, change: float) -> float:
    """Mean of ``|a|`` while a goes linearly from ``a - change/2`` to ``a + change/2``."""
    if abs(a) >= 0.5 * abs(change):
        return abs(a)
    return a * a / abs(change) + 0.25 * abs(change)


@lean
def _servo_error(p: Instrument, x: Row) -> float:
    """Contribution of the servo to the indicated force [m/s^2].

    The mean of ``-2 s v (y sin - z cos)^2 - d v^2 (y cos + z sin)`` with ``(y, z) = (u_Y, u_Z)/K``. Here ``v`` is the output
    rate over K, which moves the load of the servo; in the terms of the calibration it is ``u_x/K``, the same to first order.
    """
    y, z = x.a_Y - x.Omega_Y * p.per_K, x.a_Z - x.Omega_Z * p.per_K
    once, _, _ = half_angle_moments(x.half)
    twice, _, _ = half_angle_moments(2.0 * x.half)
    across, along = y * x.s - z * x.c, y * x.c + z * x.s
    steady, turning = across * across + along * along, along * along - across * across
    return -x.v * (p.servo * (steady - twice * turning) + p.servo_damping * x.v * once * along)


@inline
def error_without_powers(p: Instrument, x: Row) -> tuple[float, float]:
    """The error model but for powers of ``a_x``: the part without ``a_x`` [m/s^2], and what multiplies ``a_x``."""
    y, z, dy, dz = x.a_Y, x.a_Z, x.da_Y, x.da_Z
    apart = p.k0 + p.m_Y * y + p.m_Z * z + p.k0_T * x.temperature + p.k0_t * (x.t - p.t_0)
    apart += p.k_YY * (y * y + dy * dy * TWELFTH) + p.k_ZZ * (z * z + dz * dz * TWELFTH)
    apart += p.k_YZ * (y * z + dy * dz * TWELFTH)
    apart += (p.k_XY * dy + p.k_XZ * dz + p.k1_T * x.dT) * x.da_x * TWELFTH
    apart += p.k2v * x.vibration
    if p.servo != 0.0 or p.servo_damping != 0.0:
        apart += _servo_error(p, x)
    return apart, p.k1 + p.k_XY * y + p.k_XZ * z + p.k1_T * x.temperature


@inline
def powers(p: Instrument, a: float, change: float, gain: float) -> tuple[float, float]:
    """Mean of the terms in ``a_x`` over an interval with this change, and the derivative; ``gain`` multiplies ``a_x``."""
    square, spread = a * a, change * change * TWELFTH
    value = a * gain + p.k2 * (square + spread) + p.k3 * a * (square + 3.0 * spread)
    slope = gain + 2.0 * p.k2 * a + 3.0 * p.k3 * (square + spread)
    if p.k2o != 0.0 or p.k1a != 0.0:
        value += p.k2o * _odd_square_mean(a, change) + p.k1a * _size_mean(a, change)
        slope += 2.0 * p.k2o * abs(a) + math.copysign(p.k1a, a)
    return value, slope


@inline
def invert_terms(p: Instrument, x: Row, indicated: float) -> tuple[float, float]:
    """Specific force ``a_x`` from the indicated force, to rounding, and the derivative of one by the other.

    Terms linear in ``a_x`` are solved first, powers by Newton's method.
    """
    if p.has_terms == 0.0:
        return indicated, 1.0
    apart, gain = error_without_powers(p, x)
    right, slope = indicated - apart, gain
    a = right / (1.0 + gain)
    if p.k2 == 0.0 and p.k3 == 0.0 and p.k2o == 0.0 and p.k1a == 0.0:
        return a, 1.0 / (1.0 + gain)
    for _ in range(_ITERATIONS):
        value, slope = powers(p, a, x.da_x, gain)
        correction = ((right - a) - value) / (1.0 + slope)
        a += correction
        if abs(correction) <= _ROUNDING * abs(a):
            break
    return a, 1.0 / (1.0 + slope)


@inline
def _fill_regressors(p: Instrument, x: Row) -> None:
    """Derivatives of the indicated force by the uncertain coefficients."""
    a, y, z, per_K = x.a_x, x.a_Y, x.a_Z, p.per_K
    across, along = y * x.s - z * x.c, y * x.c + z * x.s
    each = (  # in the order of the codes
        1.0, a, a * a, a * a * a, a * abs(a), abs(a), y, z, a * y, a * z, y * y, z * z, y * z, x.t - p.t_0,
        x.temperature, a * x.temperature, x.vibration, -2.0 * x.v * across * across, -x.v * x.v * along,
    )  # fmt: skip
    codes, work = p.codes, x.work
    for k in range(int(p.uncertain)):
        code = codes[k]
        if code < at.SCALE_FACTOR:
            work[k] = each[code]
        elif code == at.SCALE_FACTOR:
            work[k] = (x.v + x.base_x * per_K) * per_K
        elif code == at.TAN_BETA:
            work[k] = across
        elif code == at.PHI:
            work[k] = (x.y * x.c + x.z * x.s) * per_K
        else:
            angle = ((code - at.HARMONIC) // 2) * x.angle
            work[k] = math.sin(angle) if code % 2 == 0 else math.cos(angle)


@inline
def uncertainty(p: Instrument, x: Row, derivative: float, dead: float) -> float:
    """Standard uncertainty of ``a_x`` [m/s^2]: coefficients, rectification, noise of the output, motion between samples, dead zone.

    ``derivative``: of the force by the indicated one.
    """
    _fill_regressors(p, x)
    variance, count, factor, work = x.hidden * x.hidden, int(p.uncertain), p.factor, x.work
    for i in range(count):
        part = 0.0
        for k in range(i, count):
            part += factor[i, k] * work[k]
        variance += part * part
    noise = (2.0 * p.white * x.per + p.walk) * x.per * p.per_K * p.per_K
    return math.sqrt((variance + noise + x.doubt * x.doubt) * derivative * derivative + dead * dead)


@inline
def dead_zone(p: Instrument, x: Row) -> float:
    """Standard uncertainty of ``a_x`` by the dead zone [m/s^2]; 0 far from it."""
    square = p.tan_beta * p.tan_beta * (x.a_Y * x.a_Y + x.a_Z * x.a_Z)
    if x.a_x * x.a_x >= NEAR * NEAR * square:
        return 0.0
    dead, size = math.sqrt(square), abs(x.a_x)
    share = 1.0 if size <= dead else (NEAR * dead - size) / ((NEAR - 1.0) * dead)
    return dead * math.sqrt(share / 3.0)


TIME, GAIN, STRETCHES, DOUBT, HIDDEN, DEAD = range(at.MOST_TERMS, at.MOST_TERMS + 6)
SUMS = at.MOST_TERMS + 6
"""Places and number of the sums for the uncertainty of a velocity; before them those of the coefficients."""


@inline
def add_to_velocity(sums: Array, p: Instrument, x: Row, gain: float, dead: float) -> None:
    """Add a row to the sums over rows from which the uncertainty of the velocity follows.

    ``gain``: derivative of the force by the indicated one. ``dead``: uncertainty by the dead zone [m/s^2].
    """
    h, work = x.h, x.work
    moved, size = gain * h, abs(gain) * h
    for k in range(int(p.uncertain)):
        sums[k] += moved * work[k]
    sums[TIME] += h
    sums[GAIN] += abs(gain) * size
    sums[DOUBT] += (size * x.doubt) ** 2
    sums[HIDDEN] += size * x.hidden
    sums[DEAD] += h * dead
    if h == 0.0:
        sums[STRETCHES] += 1.0


@inline
def flags_of(p: Instrument, x: Row, warm: bool) -> int:
    """Validity of a row. ``warm``: the temperature is recorded."""
    a, across = x.a_x, x.a_Y * x.a_Y + x.a_Z * x.a_Z
    square, dead = a * a, p.tan_beta * p.tan_beta * across
    flag = at.VIBRATION if x.shaken != 0.0 else 0
    if square < dead:
        flag |= at.LOCKED
    elif square < NEAR * NEAR * dead:
        flag |= at.NEAR_CRITICAL
    if a < p.low or a > p.high or across > p.most * p.most:
        flag |= at.OUT_OF_RANGE
    if x.h != 0.0 and abs(x.turn) > 1.0:
        flag |= at.COARSE
    if warm and (p.cold > x.temperature or p.hot < x.temperature):
        flag |= at.TEMPERATURE
    return flag


@inline
def count_standing(past: Past, t: float, flag: int) -> None:
    """Count the rows in which the output stands still from the start of a stretch on."""
    if flag & at.LOCKED == 0:
        past.still = 0.0
    elif past.still != 0.0:
        past.stood += 1.0
        if past.stood == 1.0:
            past.stood_from = t


_SHARE = 1.0 / 32.0
"""Share of a row in the running mean squares."""
_FAST = 1.0
"""Mean square of second over that of first differences of an oscillation of six samples a period (half of Nyquist: 2, white: 3)."""
FULL = 3.0
"""The same from which all of the variance counts: that of white samples."""
_ABOVE_NOISE = 4.0
"""Least mean square of the second differences, over that of the noise that the calibration states."""
WHITE = 1.0 / 6.0
"""Variance of white samples over the mean square of their second differences."""
_BEYOND = 3.0
"""Standard uncertainty of the hidden variance over the variance seen (docs/theory/compensation)."""
_SAMPLED = 0.5
"""The same for a reference: its samples show all of the variance, and a third or two thirds of it is hidden."""
_ORDINARY = 1e-6
"""Quadratic coefficient at which a vibration is flagged where the calibration has a smaller one or none [s^2/m]."""
LEAST = 1e-6
"""Change of the mean from which a vibration is flagged [m/s^2]."""


@inline
def near_nyquist(first: float, second: float, noise: float) -> float:
    """Variance of a vibration near the Nyquist frequency [m^2/s^4]; 0 where there is none, or noise alone.

    Of a white vibration all of it counts, of one of six samples a period nothing.
    """
    if second <= _FAST * first or second <= _ABOVE_NOISE * noise:
        return 0.0
    if second >= FULL * first:
        return WHITE * second
    return WHITE * (second / first - _FAST) / (FULL - _FAST) * second


@inline
def see_vibration(
    p: Instrument, past: Past, a_Y: float, a_Z: float, steady: bool, sampled: bool, row: Row
) -> None:
    """Possible change of the mean by a vibration that the interval hides, and whether the row is flagged: ``hidden, shaken``.

    ``a_Y``, ``a_Z``: the force at the end. ``steady``: three intervals of the stretch are there. ``sampled``: the force is a
    value at a sample, which hides nothing.
    """
    a_x, h, row.hidden, row.shaken = row.a_x, row.h, 0.0, 0.0
    x, y, z = a_x - past.force_x, a_Y - past.force_Y, a_Z - past.force_Z
    if steady:
        bend_x, bend_y, bend_z = x - past.step_x, y - past.step_Y, z - past.step_Z
        past.first_x += _SHARE * (x * x - past.first_x)
        past.second_x += _SHARE * (bend_x * bend_x - past.second_x)
        past.first_t += _SHARE * (y * y + z * z - past.first_t)
        past.second_t += _SHARE * (bend_y * bend_y + bend_z * bend_z - past.second_t)
    past.force_x, past.force_Y, past.force_Z = a_x, a_Y, a_Z
    past.step_x, past.step_Y, past.step_Z = x, y, z
    if h == 0.0 or not (past.second_x > _FAST * past.first_x or past.second_t > _FAST * past.first_t):
        return
    noise = (20.0 * p.white / h + 6.0 * p.walk) / h * p.per_K * p.per_K
    along = near_nyquist(past.first_x, past.second_x, noise)
    across = near_nyquist(past.first_t, past.second_t, 0.0)
    bent = abs(p.k2 + math.copysign(p.k2o, a_x) + 3.0 * p.k3 * a_x)
    bent_t = max(abs(p.k_YY), abs(p.k_ZZ))
    if max(bent, _ORDINARY) * along + max(bent_t, _ORDINARY) * across <= LEAST:
        return
    row.shaken = 1.0
    if not sampled:
        row.hidden = _BEYOND * bent * along + _SAMPLED * bent_t * across
        row.hidden += max(abs(p.k_XY), abs(p.k_XZ)) * math.sqrt(along * across)
    past.shaken += h
    past.shaken_square += (along + across) * h
    past.rectified += row.hidden * h
