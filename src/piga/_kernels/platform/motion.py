"""Kernels of the true platform: gyro drift, exact nulled geometry, increments, and its three gyro accelerometers."""

from __future__ import annotations

import math

from piga._kernels.jit import Array, inline, kernel
from piga._kernels.motion.step import step_functions


@kernel
def nulled_series(m1: Array, c1: Array, m2: Array, c2: Array, eta: Array, attitude: Array, ring: Array) -> None:
    """Exact ``C_G^P`` (n, 3, 3) and redundancy-ring angle Y (n,) [rad], both pick-offs nulled.

    ``m1, m2`` misalignments, ``c1, c2`` case angles, ``eta`` redundancy angle [rad], (n,) each. Polar tip in P:
    ``n1 = (-sin m1 sin c1, sin m1 cos c1, cos m1)``; equatorial tip in the ring:
    ``n2 = (cos m2, -sin m2 sin c2, sin m2 cos c2)``. Y solves ``n1 . R_y(Y) n2 = -sin(eta)``; the attitude is then the
    triad of the two momenta. Own derivation, docs/theory/platform.md section 2.
    """
    for i in range(ring.shape[0]):
        sin_m1, cos_m1, sin_m2, cos_m2 = math.sin(m1[i]), math.cos(m1[i]), math.sin(m2[i]), math.cos(m2[i])
        n1x, n1y, n1z = -sin_m1 * math.sin(c1[i]), sin_m1 * math.cos(c1[i]), cos_m1
        n2x, n2y, n2z = cos_m2, -sin_m2 * math.sin(c2[i]), sin_m2 * math.cos(c2[i])
        along = n1x * n2x + n1z * n2z
        across = n1z * n2x - n1x * n2z
        angle = math.atan2(along, across) + math.asin(
            (math.sin(eta[i]) + n1y * n2y) / math.hypot(along, across)
        )
        cy, sy = math.cos(angle), math.sin(angle)
        h2x, h2y, h2z = n2x * cy + n2z * sy, n2y, n2z * cy - n2x * sy
        yx, yy, yz = n1y * h2z - n1z * h2y, n1z * h2x - n1x * h2z, n1x * h2y - n1y * h2x
        scale = 1.0 / math.sqrt(yx * yx + yy * yy + yz * yz)
        yx, yy, yz = yx * scale, yy * scale, yz * scale
        attitude[i, 0, 0], attitude[i, 1, 0], attitude[i, 2, 0] = (
            yy * n1z - yz * n1y,
            yz * n1x - yx * n1z,
            yx * n1y - yy * n1x,
        )
        attitude[i, 0, 1], attitude[i, 1, 1], attitude[i, 2, 1] = yx, yy, yz
        attitude[i, 0, 2], attitude[i, 1, 2], attitude[i, 2, 2] = n1x, n1y, n1z
        ring[i] = angle


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


@kernel
def drift_series(first: Array, second: Array, rates: Array, h: float, triad: Array, eta: Array) -> None:
    """Drift of the triad over equal steps ``h``: ``C_i^G`` (n, 3, 3) and the redundancy angle (n,), from their first rows.

    ``first, second`` (n, 2) sine and cosine of the case angles; ``rates`` (8,) see :func:`drift_triad`.
    """
    for i in range(1, eta.shape[0]):
        triad[i] = triad[i - 1]
        s1, c1 = 0.5 * (first[i - 1, 0] + first[i, 0]), 0.5 * (first[i - 1, 1] + first[i, 1])
        s2, c2 = 0.5 * (second[i - 1, 0] + second[i, 0]), 0.5 * (second[i - 1, 1] + second[i, 1])
        eta[i] = drift_triad(triad[i], rates, eta[i - 1], s1, c1, s2, c2, h)


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
