"""Kernel of the linear error dynamics of inertial-axes navigation (fourth-order Runge-Kutta)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from piga._kernels.jit import inline, kernel

Array = NDArray[np.float64]


class ErrorDynamics(NamedTuple):
    """A navigator at rest and what is wrong with it.

    ``r0, f0`` position [m] and specific force [m/s^2] of the base and ``axes`` its ``C_n^e``, all in Earth axes at time
    zero; errors of attitude [rad], drift [rad/s], bias [m/s^2] and reference height [m]; ``gains`` of the altitude
    loop; GM, 1.5 J2 a^2 and rate of the Earth.
    """

    r0: Array
    f0: Array
    axes: Array
    attitude: Array
    drift: Array
    bias: Array
    height: float
    gains: Array
    gm: float
    j2a2: float
    earth_rate: float


@inline
def error_rates(t: float, state: Array, model: ErrorDynamics, rate: Array) -> None:
    """Time derivative of the error (6,) in inertial axes at ``t``; see :mod:`piga.platform.navigation.navigator`."""
    r0, f0, axes, earth_rate = model.r0, model.f0, model.axes, model.earth_rate
    attitude, drift, bias, gains = model.attitude, model.drift, model.bias, model.gains
    height, gm, j2a2 = model.height, model.gm, model.j2a2
    c, s = math.cos(earth_rate * t), math.sin(earth_rate * t)
    x, y, z = c * r0[0] - s * r0[1], s * r0[0] + c * r0[1], r0[2]
    fx, fy, fz = c * f0[0] - s * f0[1], s * f0[0] + c * f0[1], f0[2]
    nx, ny, nz = -(c * axes[0, 2] - s * axes[1, 2]), -(s * axes[0, 2] + c * axes[1, 2]), -axes[2, 2]
    px, py, pz = attitude[0] + drift[0] * t, attitude[1] + drift[1] * t, attitude[2] + drift[2] * t
    r2 = x * x + y * y + z * z
    g3 = -gm / (r2 * math.sqrt(r2))
    q, s2 = j2a2 / r2, z * z / r2
    equatorial, polar = 1.0 + q * (1.0 - 5.0 * s2), 1.0 + q * (3.0 - 5.0 * s2)
    along = (x * state[0] + y * state[1] + z * state[2]) / r2
    slope = 10.0 * q * (z * state[2] / r2 - s2 * along)
    flat = -3.0 * along * equatorial - 2.0 * along * (equatorial - 1.0) - slope
    upright = -3.0 * along * polar - 2.0 * along * (polar - 1.0) - slope
    up = nx * state[0] + ny * state[1] + nz * state[2] - height
    rate[0] = state[3] - gains[0] * up * nx
    rate[1] = state[4] - gains[0] * up * ny
    rate[2] = state[5] - gains[0] * up * nz
    rate[3] = g3 * (equatorial * state[0] + flat * x) + py * fz - pz * fy + bias[0] - gains[1] * up * nx
    rate[4] = g3 * (equatorial * state[1] + flat * y) + pz * fx - px * fz + bias[1] - gains[1] * up * ny
    rate[5] = g3 * (polar * state[2] + upright * z) + px * fy - py * fx + bias[2] - gains[1] * up * nz


@kernel
def propagate_errors(start: Array, model: ErrorDynamics, h: float, out: Array) -> None:
    """Errors (m, 6) in local axes (position n, e, d; velocity n, e, d over the Earth) every ``h`` seconds.

    ``start`` (6,) in inertial axes.
    """
    axes, earth_rate = model.axes, model.earth_rate
    state, moved = start.copy(), start.copy()
    k = np.zeros((4, 6))
    for i in range(out.shape[0]):
        t = i * h
        c, s = math.cos(earth_rate * t), math.sin(earth_rate * t)
        x, y, z = c * state[0] + s * state[1], c * state[1] - s * state[0], state[2]
        u, v, w = (
            c * state[3] + s * state[4] + earth_rate * y,
            c * state[4] - s * state[3] - earth_rate * x,
            state[5],
        )
        for j in range(3):
            out[i, j] = axes[0, j] * x + axes[1, j] * y + axes[2, j] * z
            out[i, 3 + j] = axes[0, j] * u + axes[1, j] * v + axes[2, j] * w
        for stage in range(4):
            fraction = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
            for j in range(6):
                moved[j] = state[j] + (fraction * h * k[stage - 1, j] if stage > 0 else 0.0)
            error_rates(t + fraction * h, moved, model, k[stage])
        for j in range(6):
            state[j] += h / 6.0 * (k[0, j] + 2.0 * k[1, j] + 2.0 * k[2, j] + k[3, j])
