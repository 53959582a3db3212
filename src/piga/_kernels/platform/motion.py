"""Kernels of the true platform: gyro drift, exact nulled geometry, increments, and its three gyro accelerometers."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from piga._kernels.jit import Array, inline, kernel
from piga._kernels.motion.step import step_functions


class Misalignment(NamedTuple):
    """Misalignment of one gyro over its case angle: ``m(c) = m + sum_k A_k cos(k c) + B_k sin(k c)`` [rad]."""

    constant: float
    cosines: Array
    sines: Array


@inline
def _misalignment_at(m: Misalignment, c: float, s: float) -> float:
    """Misalignment [rad] from cosine and sine of the case angle."""
    total = m.constant
    ck, sk = 1.0, 0.0
    for k in range(m.cosines.shape[0]):
        ck, sk = ck * c - sk * s, sk * c + ck * s
        total += m.cosines[k] * ck + m.sines[k] * sk
    return total


@inline
def _nulled_platform(
    m1: float, s1: float, c1: float, m2: float, s2: float, c2: float, eta: float, out: Array
) -> float:
    """Exact attitude ``C_G^P`` (into ``out`` (3, 3)) and redundancy-ring angle Y [rad], both pick-offs nulled.

    Polar tip in P: ``n1 = (-sin m1 sin c1, sin m1 cos c1, cos m1)``; equatorial tip in the ring:
    ``n2 = (cos m2, -sin m2 sin c2, sin m2 cos c2)``; ``s1, c1, s2, c2`` are sines and cosines of the case angles.
    Y solves ``n1 . R_y(Y) n2 = -sin(eta)``; the attitude is then the triad of the two momenta. Own derivation,
    docs/theory/platform.md section 2.
    """
    sin_m1, cos_m1, sin_m2, cos_m2 = math.sin(m1), math.cos(m1), math.sin(m2), math.cos(m2)
    n1x, n1y, n1z = -sin_m1 * s1, sin_m1 * c1, cos_m1
    n2x, n2y, n2z = cos_m2, -sin_m2 * s2, sin_m2 * c2
    along = n1x * n2x + n1z * n2z
    across = n1z * n2x - n1x * n2z
    ring = math.atan2(along, across) + math.asin((math.sin(eta) + n1y * n2y) / math.hypot(along, across))
    cy, sy = math.cos(ring), math.sin(ring)
    h2x, h2y, h2z = n2x * cy + n2z * sy, n2y, n2z * cy - n2x * sy
    yx, yy, yz = n1y * h2z - n1z * h2y, n1z * h2x - n1x * h2z, n1x * h2y - n1y * h2x
    scale = 1.0 / math.sqrt(yx * yx + yy * yy + yz * yz)
    yx, yy, yz = yx * scale, yy * scale, yz * scale
    out[0, 0], out[1, 0], out[2, 0] = yy * n1z - yz * n1y, yz * n1x - yx * n1z, yx * n1y - yy * n1x
    out[0, 1], out[1, 1], out[2, 1] = yx, yy, yz
    out[0, 2], out[1, 2], out[2, 2] = n1x, n1y, n1z
    return ring


@inline
def multiply(a: Array, b: Array, out: Array) -> None:
    """``out = a @ b`` for 3 by 3 matrices, without allocation."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@inline
def _turn_about_pole(c: float, s: float, m: Array, out: Array) -> None:
    """``out = C_e^i @ m``: Earth axes turned by the angle with cosine ``c`` and sine ``s`` about z."""
    for j in range(3):
        out[0, j] = c * m[0, j] - s * m[1, j]
        out[1, j] = s * m[0, j] + c * m[1, j]
        out[2, j] = m[2, j]


@inline
def _body_to_earth(
    roll: float, pitch: float, heading: float, latitude: float, longitude: float, work: Array, out: Array
) -> None:
    """``C_b^e`` from attitude and place [rad]; ``work`` (3, 3) is overwritten with ``C_b^n``."""
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    ch, sh = math.cos(heading), math.sin(heading)
    work[0, 0], work[0, 1], work[0, 2] = cp * ch, sr * sp * ch - cr * sh, cr * sp * ch + sr * sh
    work[1, 0], work[1, 1], work[1, 2] = cp * sh, sr * sp * sh + cr * ch, cr * sp * sh - sr * ch
    work[2, 0], work[2, 1], work[2, 2] = -sp, sr * cp, cr * cp
    cl, sl, co, so = math.cos(latitude), math.sin(latitude), math.cos(longitude), math.sin(longitude)
    for j in range(3):
        north, east, down = work[0, j], work[1, j], work[2, j]
        out[0, j] = -sl * co * north - so * east - cl * co * down
        out[1, j] = -sl * so * north + co * east - cl * so * down
        out[2, j] = cl * north - sl * down


@inline
def gimbal_angles(c_bp: Array, out: Array) -> None:
    """Gimbal angles (outer psi, middle theta, inner sigma) [rad] of ``C_b^P = R3(sigma) R2(theta) R3(psi)``."""
    out[0] = math.atan2(c_bp[2, 1], c_bp[2, 0])
    out[1] = math.atan2(math.hypot(c_bp[2, 0], c_bp[2, 1]), c_bp[2, 2])
    out[2] = math.atan2(c_bp[1, 2], -c_bp[0, 2])


@inline
def _case_angle(t: float, rate: float, turns: float) -> float:
    """Case angle from its start [rad]: ``rate t``, or back and forth when ``turns`` > 0 (reversal)."""
    angle = rate * t
    if turns <= 0:
        return angle
    span = 2.0 * math.pi * turns
    within = angle - 2.0 * span * math.floor(angle / (2.0 * span))
    return within if within <= span else 2.0 * span - within


@kernel
def exact_geometry_series(
    first: Misalignment, c1: Array, second: Misalignment, c2: Array, eta: Array, attitude: Array, ring: Array
) -> None:
    """Exact ``C_G^P`` (n, 3, 3) and ring angle (n,) for case angles ``c1, c2`` (n,) and ``eta`` (n,)."""
    for i in range(c1.shape[0]):
        s1, k1, s2, k2 = math.sin(c1[i]), math.cos(c1[i]), math.sin(c2[i]), math.cos(c2[i])
        p, q = _misalignment_at(first, k1, s1), _misalignment_at(second, k2, s2)
        ring[i] = _nulled_platform(p, s1, k1, q, s2, k2, eta[i], attitude[i])


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


_Phasors = tuple[float, float, float, float]


class Gyros(NamedTuple):
    """Polar and equatorial gyro: misalignments, their phases [rad], drift and case rotation.

    ``rates`` (8,) see :func:`drift_triad`; ``case`` (4,) rate 1, turns before reversal 1, rate 2, turns 2.
    """

    first: Misalignment
    phase1: float
    second: Misalignment
    phase2: float
    rates: Array
    case: Array


class Base(NamedTuple):
    """Base of the platform.

    ``f_e`` specific force in Earth axes at every half step (2n + 1, 3) or (1, 3); ``attitude`` roll, pitch, heading
    and ``place`` latitude, longitude at the nodes (n + 1, k) or (1, k).
    """

    f_e: Array
    attitude: Array
    place: Array
    earth_rate: float


class TrueRows(NamedTuple):
    """Output arrays.

    ``dv`` (n, 3) by Simpson's rule, ``force`` (n + 1, 3) at the nodes, ``gimbals`` (n + 1, 3), ``ring`` and ``eta``
    (n + 1,), ``spin`` (n, 3) or (0, 3): turn of the platform over the step in P axes.
    """

    dv: Array
    force: Array
    gimbals: Array
    ring: Array
    eta: Array
    spin: Array


@inline
def drift_triad(
    c_ig: Array, rates: Array, eta: float, s1: float, c1: float, s2: float, c2: float, h: float
) -> float:
    """Turn ``C_i^G`` (3, 3) in place by the gyros' drift over ``h``; returns the new eta [He2014].

    ``rates`` (8,): w1x, w1y, w2y, w2z that stay in G axes, then the same four in case axes.
    ``w_Gx = w1x, w_Gy = w1y, w_Gz = w2z sec(eta) - w1x tan(eta), eta' = w2y - w1y``.
    """
    wx = rates[0] + c1 * rates[4] - s1 * rates[5]
    wy = rates[1] + s1 * rates[4] + c1 * rates[5]
    w2y = rates[2] + c2 * rates[6] - s2 * rates[7]
    w2z = rates[3] + s2 * rates[6] + c2 * rates[7]
    middle = eta + 0.5 * (w2y - wy) * h
    wz = (w2z - wx * math.sin(middle)) / math.cos(middle)
    x, y, z = wx * h, wy * h, wz * h
    for j in range(3):
        a, b, c = c_ig[0, j], c_ig[1, j], c_ig[2, j]
        # C <- (I - [x] + [x]^2 / 2) C
        da, db, dc = z * b - y * c, x * c - z * a, y * a - x * b
        c_ig[0, j] = a + da + 0.5 * (z * db - y * dc)
        c_ig[1, j] = b + db + 0.5 * (x * dc - z * da)
        c_ig[2, j] = c + dc + 0.5 * (y * da - x * db)
    return eta + (w2y - wy) * h


@inline
def _platform_at(at: _Phasors, gyros: Gyros, eta: float, c_ig: Array, c_gp: Array, c_ip: Array) -> float:
    """Exact ``C_i^P`` at one instant, from sine and cosine of both case angles; returns the ring angle."""
    s1, k1, s2, k2 = at
    m1, m2 = _misalignment_at(gyros.first, k1, s1), _misalignment_at(gyros.second, k2, s2)
    ring = _nulled_platform(m1, s1, k1, m2, s2, k2, eta, c_gp)
    multiply(c_gp, c_ig, c_ip)
    return ring


@inline
def _case_phasors(t: float, gyros: Gyros) -> tuple[float, float, float, float]:
    """Sine and cosine of the polar, then of the equatorial case angle, phases included."""
    first = _case_angle(t, gyros.case[0], gyros.case[1]) + gyros.phase1
    second = _case_angle(t, gyros.case[2], gyros.case[3]) + gyros.phase2
    return math.sin(first), math.cos(first), math.sin(second), math.cos(second)


@inline
def _force_in_platform(
    t: float, earth_rate: float, c_ip: Array, f_e: Array, row: int
) -> tuple[float, float, float]:
    """Specific force in P axes from its Earth-axes components."""
    c, s = math.cos(earth_rate * t), math.sin(earth_rate * t)
    fx, fy, fz = c * f_e[row, 0] - s * f_e[row, 1], s * f_e[row, 0] + c * f_e[row, 1], f_e[row, 2]
    return (
        c_ip[0, 0] * fx + c_ip[0, 1] * fy + c_ip[0, 2] * fz,
        c_ip[1, 0] * fx + c_ip[1, 1] * fy + c_ip[1, 2] * fz,
        c_ip[2, 0] * fx + c_ip[2, 1] * fy + c_ip[2, 2] * fz,
    )


@kernel
def simulate_platform(
    gyros: Gyros, base: Base, start: float, h: float, c_ig: Array, eta: float, rows: TrueRows
) -> float:
    """True readouts over ``n`` steps of ``h``; node k at ``start + k h``. Returns the last eta.

    ``c_ig`` (3, 3) is advanced.
    """
    f_e, attitude, place, earth_rate, rates = base.f_e, base.attitude, base.place, base.earth_rate, gyros.rates
    dv, force, spin = rows.dv, rows.force, rows.spin
    work = np.zeros((6, 3, 3))
    n = dv.shape[0]
    force_stride = 1 if f_e.shape[0] > 1 else 0
    moving = attitude.shape[0] > 1
    want_spin = spin.shape[0] > 0
    c_gp, c_ip, c_be, c_bi, c_bp, before = work[0], work[1], work[2], work[3], work[4], work[5]
    _body_to_earth(attitude[0, 0], attitude[0, 1], attitude[0, 2], place[0, 0], place[0, 1], c_bi, c_be)
    gx = gy = gz = mx = my = mz = 0.0
    s1, k1, s2, k2 = _case_phasors(start, gyros)
    for i in range(n + 1):
        t = start + i * h
        ring_angle = _platform_at((s1, k1, s2, k2), gyros, eta, c_ig, c_gp, c_ip)
        fx, fy, fz = _force_in_platform(t, earth_rate, c_ip, f_e, 2 * i * force_stride)
        if i > 0:
            dv[i - 1, 0] = h / 6.0 * (gx + 4.0 * mx + fx)
            dv[i - 1, 1] = h / 6.0 * (gy + 4.0 * my + fy)
            dv[i - 1, 2] = h / 6.0 * (gz + 4.0 * mz + fz)
            if want_spin:
                for j in range(3):
                    a, b = (j + 1) % 3, (j + 2) % 3
                    spin[i - 1, j] = 0.5 * (
                        c_ip[a, 0] * before[b, 0] + c_ip[a, 1] * before[b, 1] + c_ip[a, 2] * before[b, 2]
                        - c_ip[b, 0] * before[a, 0] - c_ip[b, 1] * before[a, 1] - c_ip[b, 2] * before[a, 2]
                    )  # fmt: skip
        if moving:
            k = i if place.shape[0] > 1 else 0
            _body_to_earth(attitude[i, 0], attitude[i, 1], attitude[i, 2], place[k, 0], place[k, 1], c_bi, c_be)
        _turn_about_pole(math.cos(earth_rate * t), math.sin(earth_rate * t), c_be, c_bi)
        multiply(c_ip, c_bi, c_bp)
        gimbal_angles(c_bp, rows.gimbals[i])
        force[i, 0], force[i, 1], force[i, 2] = fx, fy, fz
        rows.ring[i], rows.eta[i] = ring_angle, eta
        if i == n:
            break
        if want_spin:
            before[:, :] = c_ip
        gx, gy, gz = fx, fy, fz
        middle = t + 0.5 * h
        p1, q1, p2, q2 = _case_phasors(middle, gyros)
        eta = drift_triad(
            c_ig, rates, eta, 0.5 * (s1 + p1), 0.5 * (k1 + q1), 0.5 * (s2 + p2), 0.5 * (k2 + q2), 0.5 * h
        )
        _platform_at((p1, q1, p2, q2), gyros, eta, c_ig, c_gp, c_ip)
        mx, my, mz = _force_in_platform(middle, earth_rate, c_ip, f_e, (2 * i + 1) * force_stride)
        s1, k1, s2, k2 = _case_phasors(t + h, gyros)
        eta = drift_triad(
            c_ig, rates, eta, 0.5 * (s1 + p1), 0.5 * (k1 + q1), 0.5 * (s2 + p2), 0.5 * (k2 + q2), 0.5 * h
        )
    return eta


@inline
def _gimbal_step(p: float, q: float, a: float, y: float, z: float) -> float:
    """Increment of the gimbal angle [rad], below half a turn, for increments ``a, y, z`` of the input [rad]."""
    c, s = step_functions(0.25 * (y * y + z * z - a * a))
    s *= 0.5
    p1 = p + (c * p + s * (y * p + (a - z) * q))
    q1 = q + (c * q - s * ((a + z) * p + y * q))
    return 2.0 * math.atan2(p1 * q - q1 * p, p1 * p + q1 * q)


@inline
def _mean_sine_cosine(
    sine0: float, cosine0: float, sine1: float, cosine1: float, turned: float
) -> tuple[float, float]:
    """Means of sine and cosine over an angle that runs evenly from one end to the other (Filon's rule)."""
    if abs(turned) < 1e-3:
        return 0.5 * (sine0 + sine1), 0.5 * (cosine0 + cosine1)
    return (cosine0 - cosine1) / turned, (sine1 - sine0) / turned


@kernel
def solve_triad(
    alpha: Array,
    axes: Array,
    scale: Array,
    tan_beta: Array,
    step: float,
    sweeps: int,
    work: Array,
    increments: Array,
) -> None:
    """Velocity increments (n, 3) [m/s] that turn three gimbals as measured.

    ``alpha`` (3, n + 1) measured angles [rad], ``axes`` (3, 3, 3): rows X0, Y0, Z0 of each instrument in
    the common frame; ``scale`` (3,) K [(rad/s)/(m/s^2)], ``tan_beta`` (3,). Newton steps (``sweeps``) on
    the exact motion under a constant force, with the effective input axes averaged over the step as
    Jacobian; ``work`` (3, 4) is scratch space. Own derivation, docs/theory/platform.md section 10.
    """
    fx = fy = fz = 0.0
    for k in range(increments.shape[0]):
        for _ in range(sweeps):
            for i in range(3):
                start, end = alpha[i, k], alpha[i, k + 1]
                s0, c0, s1, c1 = math.sin(start), math.cos(start), math.sin(end), math.cos(end)
                sine, cosine = _mean_sine_cosine(s0, c0, s1, c1, end - start)
                t, gain = tan_beta[i], scale[i] * step
                for j in range(3):
                    work[i, j] = gain * (axes[i, 0, j] + t * (sine * axes[i, 1, j] - cosine * axes[i, 2, j]))
                ax = gain * (axes[i, 0, 0] * fx + axes[i, 0, 1] * fy + axes[i, 0, 2] * fz)
                ay = gain * (axes[i, 1, 0] * fx + axes[i, 1, 1] * fy + axes[i, 1, 2] * fz) * t
                az = gain * (axes[i, 2, 0] * fx + axes[i, 2, 1] * fy + axes[i, 2, 2] * fz) * t
                work[i, 3] = (
                    end - start - _gimbal_step(math.sin(0.5 * start), math.cos(0.5 * start), ax, ay, az)
                )
            m00, m01, m02 = work[0, 0], work[0, 1], work[0, 2]
            m10, m11, m12 = work[1, 0], work[1, 1], work[1, 2]
            m20, m21, m22 = work[2, 0], work[2, 1], work[2, 2]
            a, b, c = work[0, 3], work[1, 3], work[2, 3]
            x0, x1, x2 = m11 * m22 - m12 * m21, m12 * m20 - m10 * m22, m10 * m21 - m11 * m20
            inverse = 1.0 / (m00 * x0 + m01 * x1 + m02 * x2)
            fx += inverse * (a * x0 + b * (m02 * m21 - m01 * m22) + c * (m01 * m12 - m02 * m11))
            fy += inverse * (a * x1 + b * (m00 * m22 - m02 * m20) + c * (m02 * m10 - m00 * m12))
            fz += inverse * (a * x2 + b * (m01 * m20 - m00 * m21) + c * (m00 * m11 - m01 * m10))
        increments[k, 0], increments[k, 1], increments[k, 2] = step * fx, step * fy, step * fz
