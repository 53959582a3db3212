"""Gimbal angle under constant force, step by step: the exponential of a 2 x 2 matrix, with noise between the steps.

The tests of a coverage campaign are simulated with it. It shares no code with the motion that the estimator integrates.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.jit import kernel

Array = NDArray[np.float64]


@kernel
def constant_steps(a: float, y: float, z: float, start: float, noise: Array, out: Array) -> None:
    """Angle after every step, in ``out`` (n + 1,).

    ``a``: turn of one step without the coupling [rad]. ``y``, ``z``: turns of the coupling, times its tangent [rad].
    ``noise`` (n,) is added after each step [rad].
    """
    x = 0.25 * (y * y + z * z - a * a)
    root = math.sqrt(abs(x))
    if x >= 0.0:
        c, s = math.cosh(root), (math.sinh(root) / root if root > 1e-9 else 1.0)
    else:
        c, s = math.cos(root), (math.sin(root) / root if root > 1e-9 else 1.0)
    alpha = start
    out[0] = alpha
    for i in range(noise.size):
        sine, cosine = math.sin(alpha), math.cos(alpha)
        step = 2.0 * math.atan2(0.5 * s * (a + y * sine - z * cosine), c - 0.5 * s * (y * cosine + z * sine))
        alpha += step + noise[i]
        out[i + 1] = alpha
