"""Kernel that solves three gyro accelerometers together: specific force from gimbal angles, step by step."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.jit import inline, kernel
from piga._kernels.motion.step import step_functions

Array = NDArray[np.float64]


@inline
def gimbal_step(p: float, q: float, a: float, y: float, z: float) -> float:
    """Increment of the gimbal angle [rad], below half a turn, for increments ``a, y, z`` of the input [rad]."""
    c, s = step_functions(0.25 * (y * y + z * z - a * a))
    s *= 0.5
    p1 = p + (c * p + s * (y * p + (a - z) * q))
    q1 = q + (c * q - s * ((a + z) * p + y * q))
    return 2.0 * math.atan2(p1 * q - q1 * p, p1 * p + q1 * q)


@inline
def mean_sine_cosine(
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
    Jacobian; ``work`` (3, 4) is scratch space. Own derivation, docs/platform.md section 10.
    """
    fx = fy = fz = 0.0
    for k in range(increments.shape[0]):
        for _ in range(sweeps):
            for i in range(3):
                start, end = alpha[i, k], alpha[i, k + 1]
                s0, c0, s1, c1 = math.sin(start), math.cos(start), math.sin(end), math.cos(end)
                sine, cosine = mean_sine_cosine(s0, c0, s1, c1, end - start)
                t, gain = tan_beta[i], scale[i] * step
                for j in range(3):
                    work[i, j] = gain * (axes[i, 0, j] + t * (sine * axes[i, 1, j] - cosine * axes[i, 2, j]))
                ax = gain * (axes[i, 0, 0] * fx + axes[i, 0, 1] * fy + axes[i, 0, 2] * fz)
                ay = gain * (axes[i, 1, 0] * fx + axes[i, 1, 1] * fy + axes[i, 1, 2] * fz) * t
                az = gain * (axes[i, 2, 0] * fx + axes[i, 2, 1] * fy + axes[i, 2, 2] * fz) * t
                work[i, 3] = end - start - gimbal_step(math.sin(0.5 * start), math.cos(0.5 * start), ax, ay, az)
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
