"""Kernels of the platform's geometry: two free-rotor gyros whose pick-offs are all nulled, and the gimbals.

Symbols follow ``docs/platform.md``. A *tip* is the direction of the pick-off null seen from the
case-rotation axis; the platform is servoed so that each momentum lies along its tip.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from piga._kernels.jit import inline, kernel

Array = NDArray[np.float64]


class Misalignment(NamedTuple):
    """Misalignment of one gyro over its case angle: ``m(c) = m + sum_k A_k cos(k c) + B_k sin(k c)`` [rad]."""

    constant: float
    cosines: Array
    sines: Array


@inline
def misalignment_at(m: Misalignment, c: float, s: float) -> float:
    """Misalignment [rad] from cosine and sine of the case angle."""
    total = m.constant
    ck, sk = 1.0, 0.0
    for k in range(m.cosines.shape[0]):
        ck, sk = ck * c - sk * s, sk * c + ck * s
        total += m.cosines[k] * ck + m.sines[k] * sk
    return total


@inline
def nulled_platform(
    m1: float, s1: float, c1: float, m2: float, s2: float, c2: float, eta: float, out: Array
) -> float:
    """Exact attitude ``C_G^P`` (into ``out`` (3, 3)) and redundancy-ring angle Y [rad], both pick-offs nulled.

    Polar tip in P: ``n1 = (-sin m1 sin c1, sin m1 cos c1, cos m1)``; equatorial tip in the ring:
    ``n2 = (cos m2, -sin m2 sin c2, sin m2 cos c2)``; ``s1, c1, s2, c2`` are sines and cosines of the case angles.
    Y solves ``n1 . R_y(Y) n2 = -sin(eta)``; the attitude is then the triad of the two momenta. Own derivation,
    docs/platform.md section 2.
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
def turn_about_pole(c: float, s: float, m: Array, out: Array) -> None:
    """``out = C_e^i @ m``: Earth axes turned by the angle with cosine ``c`` and sine ``s`` about z."""
    for j in range(3):
        out[0, j] = c * m[0, j] - s * m[1, j]
        out[1, j] = s * m[0, j] + c * m[1, j]
        out[2, j] = m[2, j]


@inline
def body_to_earth(
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
def case_angle(t: float, rate: float, turns: float) -> float:
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
        p, q = misalignment_at(first, k1, s1), misalignment_at(second, k2, s2)
        ring[i] = nulled_platform(p, s1, k1, q, s2, k2, eta[i], attitude[i])
