r"""Derivatives of the exact motion with respect to its parameters, along with the motion itself.

A step is ``E = C + S M`` with ``M`` linear in the increments, hence ``dE = dC + dS M + S dM`` with
``dC = S dx/2`` and ``dS = S' dx``. For a pair of unit length and ``det E = 1``,

.. math:: d\alpha_1 = \frac{d\alpha_0 + 2\,(dE\,v)\times(E\,v)}{|E v|^2} .

Derived in docs/theory/motion.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.arithmetic.trig import double_arctangent
from piga._kernels.jit import inline, kernel
from piga._kernels.motion.blocks import GOOD
from piga._kernels.motion.samples import MotionSamples
from piga._kernels.motion.step import advance, unwrapped

Array = NDArray[np.float64]

PARAMETERS = 6
"""K, beta, alpha0, and biases of a_x, a_Y, a_Z: the order of the columns."""
_NO_OVERFLOW = 1e5


@inline
def unimodular_functions(x: float) -> tuple[float, float, float]:
    """``C``, ``S`` and ``S' = dS/dx = (C - S)/(2 x)``, unscaled."""
    if abs(x) < 0.5:
        c = s = slope = 0.0
        for k in range(9, -1, -1):  # Taylor: x^k/(2k)!, x^k/(2k+1)!, (k+1) x^k/(2k+3)!
            c = c * x + _TAYLOR[2 * k]
            s = s * x + _TAYLOR[2 * k + 1]
            slope = slope * x + (k + 1) * _TAYLOR[2 * k + 3]
        return c, s, slope
    root = math.sqrt(abs(x))
    c, s = (math.cosh(root), math.sinh(root) / root) if x > 0.0 else (math.cos(root), math.sin(root) / root)
    return c, s, 0.5 * (c - s) / x


_TAYLOR = np.array([1.0 / math.factorial(k) for k in range(22)])


@inline
def sample_rates(f: Array, omega: Array, k: int, K: float, tan_beta: float, r: Array, d: Array) -> None:
    """Effective rates ``r = (a, y, z)`` at sample ``k`` and their derivatives ``d`` (3, PARAMETERS)."""
    secant2 = 1.0 + tan_beta * tan_beta
    for axis in range(3):
        gain = 1.0 if axis == 0 else tan_beta
        u = K * f[k, axis] - omega[k, axis]
        r[axis] = gain * u
        d[axis, 0] = gain * f[k, axis]
        d[axis, 1] = 0.0 if axis == 0 else secant2 * u
        d[axis, 3 + axis] = gain * K


@inline
def cross_term(i: int, j: int, r0: Array, r1: Array) -> float:
    """``r0_i r1_j - r0_j r1_i``."""
    return r0[i] * r1[j] - r0[j] * r1[i]


@kernel
def step_increments(h: float, r0: Array, r1: Array, d0: Array, d1: Array, step: Array, ds: Array) -> None:
    """Magnus increments ``step`` (3,) and their derivatives ``ds`` (3, PARAMETERS)."""
    mean, cross = 0.5 * h, h * h / 12.0
    for axis in range(3):
        i, j = (1, 2) if axis == 0 else ((0, 2) if axis == 1 else (0, 1))
        sign = -cross if axis == 2 else cross
        step[axis] = mean * (r0[axis] + r1[axis]) + sign * cross_term(i, j, r0, r1)
        for n in range(PARAMETERS):
            change = d0[i, n] * r1[j] - d0[j, n] * r1[i] + r0[i] * d1[j, n] - r0[j] * d1[i, n]
            ds[axis, n] = mean * (d0[axis, n] + d1[axis, n]) + sign * change


@kernel
def advance_derivatives(p: float, q: float, step: Array, ds: Array, d_alpha: Array) -> None:
    """Carry ``d_alpha`` (PARAMETERS,) over one step from the unit pair ``(p, q)``."""
    A, Y, Z = step[0], step[1], step[2]
    c, s, slope = unimodular_functions(0.25 * (Y * Y + Z * Z - A * A))
    mp, mq = 0.5 * (Y * p + (A - Z) * q), -0.5 * ((A + Z) * p + Y * q)
    p1, q1 = c * p + s * mp, c * q + s * mq
    square = p1 * p1 + q1 * q1
    for n in range(PARAMETERS):
        dA, dY, dZ = ds[0, n], ds[1, n], ds[2, n]
        dx = 0.5 * (Y * dY + Z * dZ - A * dA)
        dp = dx * (0.5 * s * p + slope * mp) + 0.5 * s * (dY * p + (dA - dZ) * q)
        dq = dx * (0.5 * s * q + slope * mq) - 0.5 * s * ((dA + dZ) * p + dY * q)
        d_alpha[n] = (d_alpha[n] + 2.0 * (dp * q1 - dq * p1)) / square


@kernel
def propagate_sensitivities(
    samples: MotionSamples, state: Array, alpha: Array, rate: Array, d_alpha: Array, d_rate: Array
) -> int:
    """Angle, rate (n,) and their derivatives (n, PARAMETERS) at the samples; ``state``: turns, P, Q.

    Of the samples, ``base_rate`` is (n, 3), and what an error model adds is left out.
    """
    t, f, omega, K, tan_beta = samples.t, samples.f, samples.base_rate, samples.K, samples.tan_beta
    turns, p, q = state[0], state[1], state[2]
    rest = double_arctangent(p, q)
    r0, r1, step, carried = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(PARAMETERS)
    d0, d1, ds = np.zeros((3, PARAMETERS)), np.zeros((3, PARAMETERS)), np.zeros((3, PARAMETERS))
    carried[2] = 1.0
    for k in range(t.size):
        sample_rates(f, omega, k, K, tan_beta, r1, d1)
        if k:
            h = t[k] - t[k - 1]
            step_increments(h, r0, r1, d0, d1, step, ds)
            if not (h > 0.0 and abs(step[0]) + abs(step[1]) + abs(step[2]) < _NO_OVERFLOW):
                return k - 1
            advance_derivatives(p, q, step, ds, carried)
            turns, rest, p, q = advance(turns, rest, p, q, step[0], step[1], step[2])
        sine, cosine = 2.0 * p * q, q * q - p * p
        alpha[k] = unwrapped(turns, rest)
        rate[k] = r1[0] + r1[1] * sine - r1[2] * cosine
        stiffness = r1[1] * cosine + r1[2] * sine
        for n in range(PARAMETERS):
            d_alpha[k, n] = carried[n]
            d_rate[k, n] = d1[0, n] + d1[1, n] * sine - d1[2, n] * cosine + stiffness * carried[n]
        r0[:], d0[:, :] = r1, d1
    return GOOD
