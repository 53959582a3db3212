"""Kernels of the platform: drift of its gyros, the filter of its pick-off, and the navigator's step.

The navigator's step is explicit and of fourth order (Stoermer-Cowell for position, Adams-Moulton for velocity;
coefficients rederived in docs/theory/platform.md section 7). The velocity includes every increment in full, so
that motion faster than the step is not lost.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from piga._kernels.jit import Array, inline, kernel


@kernel
def follow(
    pickoff: Array,
    expected: Array,
    start: float,
    rate: float,
    step: float,
    gain: float,
    rate_gain: float,
    out: Array,
) -> None:
    """Track ``pickoff - expected`` [rad] to second order; ``out`` (n,) has no lag on a ramp."""
    value = start
    for i in range(pickoff.shape[0]):
        if i > 0:
            value += step * rate
        error = pickoff[i] - expected[i] - value
        value += gain * error
        rate += rate_gain * error
        out[i] = value


@kernel
def drift_series(first: Array, second: Array, rates: Array, h: float, triad: Array, eta: Array) -> None:
    """Drift of the triad over equal steps ``h``: ``C_i^G`` (n, 3, 3) and the redundancy angle (n,), from their first rows.

    ``first, second`` (n, 2) sine and cosine of the case angles; ``rates`` (8,): w1x, w1y, w2y, w2z that stay in G axes, then the
    same four in case axes. ``w_Gx = w1x, w_Gy = w1y, w_Gz = w2z sec(eta) - w1x tan(eta), eta' = w2y - w1y`` [He2014].
    """
    for i in range(1, eta.shape[0]):
        s1, c1 = 0.5 * (first[i - 1, 0] + first[i, 0]), 0.5 * (first[i - 1, 1] + first[i, 1])
        s2, c2 = 0.5 * (second[i - 1, 0] + second[i, 0]), 0.5 * (second[i - 1, 1] + second[i, 1])
        wx = rates[0] + c1 * rates[4] - s1 * rates[5]
        wy = rates[1] + s1 * rates[4] + c1 * rates[5]
        w2y = rates[2] + c2 * rates[6] - s2 * rates[7]
        w2z = rates[3] + s2 * rates[6] + c2 * rates[7]
        middle = eta[i - 1] + 0.5 * (w2y - wy) * h
        wz = (w2z - wx * math.sin(middle)) / math.cos(middle)
        x, y, z = wx * h, wy * h, wz * h
        for j in range(3):
            a, b, c = triad[i - 1, 0, j], triad[i - 1, 1, j], triad[i - 1, 2, j]
            # C <- (I - [x] + [x]^2 / 2) C
            da, db, dc = z * b - y * c, x * c - z * a, y * a - x * b
            triad[i, 0, j] = a + da + 0.5 * (z * db - y * dc)
            triad[i, 1, j] = b + db + 0.5 * (x * dc - z * da)
            triad[i, 2, j] = c + dc + 0.5 * (y * da - x * db)
        eta[i] = eta[i - 1] + (w2y - wy) * h


class Triad(NamedTuple):
    """``c_gi`` (3, 3) triad to inertial axes at the start of the rows; ``drift`` (3,) of the triad [rad/s]."""

    c_gi: Array
    drift: Array


class Stepping(NamedTuple):
    """Settings of the navigator's steps.

    ``h`` step [s]; every ``every``-th new state is kept; ``damping`` (2,) gains [1/s, 1/s^2]; ``earth`` (5,) = GM,
    1.5 J2 a^2, b, e^2, 1/(1 - e^2).
    """

    h: float
    every: int
    damping: Array
    earth: Array


@inline
def gravitation(x: float, y: float, z: float, gm: float, j2a2: float) -> tuple[float, float, float, float]:
    """Gravitation of the J2 field [m/s^2] at inertial position [m]; ``j2a2 = 1.5 J2 a^2`` [m^2]. Also 1/r."""
    xy2, z2 = x * x + y * y, z * z
    i2 = 1.0 / (xy2 + z2)
    inverse = i2 * math.sqrt(xy2 + z2)
    q = j2a2 * i2
    s5 = 5.0 * z2 * i2
    scale = -gm * inverse * i2
    equatorial = scale * (1.0 + q * (1.0 - s5))
    polar = scale * (1.0 + q * (3.0 - s5))
    return equatorial * x, equatorial * y, polar * z, inverse


@inline
def height_and_normal(
    x: float, y: float, z: float, inverse: float, semi_minor: float, e2: float, q: float
) -> tuple[float, float, float, float]:
    """Geodetic height [m] and unit normal; to second order in the deflection (within 4e-5 m at 10 km)."""
    s2 = z * z * (1.0 / (x * x + y * y + z * z))
    radius = semi_minor / math.sqrt(1.0 - e2 * (1.0 - s2))
    lengthened = 1.0 + (q * q - 1.0) * s2
    sine2 = (q - 1.0) * (q - 1.0) * s2 * (1.0 - s2) / lengthened
    norm = inverse / math.sqrt(lengthened)
    return (1.0 / inverse - radius) * (1.0 - 0.5 * sine2), x * norm, y * norm, q * z * norm


@inline
def moved(h: float, v: float, d: float, d1: float, d2: float, g: float, g1: float, g2: float) -> float:
    """Change of one coordinate over a step, from increments ``d`` and gravitations ``g``, now and before."""
    h24 = h / 24.0
    return h * v + h24 * (9.0 * d + 4.0 * d1 - d2) + h * h24 * (19.0 * g - 10.0 * g1 + 3.0 * g2)


@kernel
def navigate_chunk(
    dv: Array,
    angles: Array,
    triad: Triad,
    altitude: Array,
    stepping: Stepping,
    state: Array,
    positions: Array,
    velocities: Array,
) -> int:
    """Advance the navigator over a chunk of velocity increments; returns the number of rows written.

    ``dv`` (n, 3) increments in platform axes [m/s]; ``angles`` (n, 3) or (1, 3) small angles of the platform against the
    triad at the middle of each step [rad]; ``altitude`` (n,) or (1,) reference height [m]; ``state`` (9, 3) in and out:
    r, v, three gravitations, two increments, (height error, -, -), normal. The states kept go to ``positions``
    and ``velocities``.
    """
    h, every, c, drift = stepping.h, stepping.every, triad.c_gi, triad.drift
    earth = stepping.earth
    gm, j2a2, semi_minor, e2, lengthened = earth[0], earth[1], earth[2], earth[3], earth[4]
    k1, k2 = stepping.damping[0] * h, stepping.damping[1] * h
    r, v, g, g1, g2 = state[0], state[1], state[2], state[3], state[4]
    d1, d2, normal = state[5], state[6], state[8]
    d, now = np.empty(3), np.empty(3)
    h24, written, left = h / 24.0, 0, every
    for i in range(dv.shape[0]):
        at, middle = i if angles.shape[0] > 1 else 0, (i + 0.5) * h
        ex, ey, ez = (
            angles[at, 0] + drift[0] * middle,
            angles[at, 1] + drift[1] * middle,
            angles[at, 2] + drift[2] * middle,
        )
        fx, fy, fz = dv[i, 0], dv[i, 1], dv[i, 2]
        bx, by, bz = fx + ey * fz - ez * fy, fy + ez * fx - ex * fz, fz + ex * fy - ey * fx
        error = state[7, 0]
        for j in range(3):
            d[j] = c[j, 0] * bx + c[j, 1] * by + c[j, 2] * bz
            r[j] += moved(h, v[j], d[j], d1[j], d2[j], g[j], g1[j], g2[j]) - k1 * error * normal[j]
            v[j] += d[j] - k2 * error * normal[j] + h24 * (19.0 * g[j] - 5.0 * g1[j] + g2[j])
            d2[j], d1[j] = d1[j], d[j]
        now[0], now[1], now[2], inverse = gravitation(r[0], r[1], r[2], gm, j2a2)
        for j in range(3):
            v[j] += 9.0 * h24 * now[j]
            g2[j], g1[j], g[j] = g1[j], g[j], now[j]
        height, normal[0], normal[1], normal[2] = height_and_normal(
            r[0], r[1], r[2], inverse, semi_minor, e2, lengthened
        )
        state[7, 0] = height - altitude[i if altitude.shape[0] > 1 else 0]
        left -= 1
        if left == 0:
            for j in range(3):
                positions[written, j], velocities[written, j] = r[j], v[j]
            written, left = written + 1, every
    return written
