r"""Compensation of angle records: the exact inverse of the motion over each sample interval.

With ``delta`` half the angle turned and ``alpha_m`` the middle of the two angles read, equation (4) of the
motion [own derivation, docs/theory/compensation] says, without approximation,

.. math:: A \cos\delta = 2 q\cot q\,\sin\delta - (Y \sin\alpha_m - Z \cos\alpha_m), \qquad
          q^2 = (A^2 - Y^2 - Z^2)/4 .

``Y, Z`` are known from the reference, ``A`` is wanted; with ``e = A - 2 delta`` the equation is solved for the
small ``e``, so that no digit of the angle is lost. Input that is linear between samples is brought to
constant increments by the fourth-order Magnus terms, the slope of ``a_x`` taken from the intervals before.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.arithmetic.sine_cosine import LIMIT, fast_sine_cosine
from piga._kernels.compensation import layout as at
from piga._kernels.jit import exact, kernel

Array = NDArray[np.float64]

FAR_TURN = 0.25
"""Half the angle turned in an interval [rad] up to which the series hold."""
FAR_PRODUCT = 1e-9
"""``(Y^2 + Z^2) delta^2`` up to which two corrections reach rounding."""
NEWTON = 60


@exact
def padded(n: int) -> int:
    """``n`` rounded up to a whole number of tiles."""
    return (n + at.TILE - 1) // at.TILE * at.TILE


@exact
def load_block(
    t: Array, psi: Array, y: Array, z: Array, omega: Array, warmth: Array, p: Array, light: bool, state: Array,
    w: Array,
) -> None:  # fmt: skip
    """Bring a block of samples and the last sample before it into the work array; ``light``: less of it."""
    K, tangent = p[at.P_K], p[at.P_TAN_BETA]
    coupling, offset_y, offset_z = K * tangent, p[at.P_OFFSET_Y], p[at.P_OFFSET_Z]
    load_past(coupling, offset_y, offset_z, tangent, state, w)
    for j in range(t.size):
        w[at.TIME + 1 + j] = t[j]
    for j in range(psi.size):
        w[at.PSI + 1 + j] = psi[j]
    for j in range(y.size):
        w[at.RATE_Y + 1 + j] = coupling * y[j] + offset_y
    for j in range(z.size):
        w[at.RATE_Z + 1 + j] = coupling * z[j] + offset_z
    if not light:
        for j in range(y.size):
            w[at.FORCE_Y + 1 + j] = y[j]
        for j in range(z.size):
            w[at.FORCE_Z + 1 + j] = z[j]
    for j in range(t.size if omega.shape[0] == 0 else 0):
        w[at.OMEGA_X + 1 + j] = w[at.OMEGA_Y + 1 + j] = w[at.OMEGA_Z + 1 + j] = 0.0
    for j in range(omega.shape[0]):
        w[at.OMEGA_X + 1 + j] = omega[j, 0]
        w[at.OMEGA_Y + 1 + j], w[at.OMEGA_Z + 1 + j] = omega[j, 1], omega[j, 2]
        w[at.RATE_Y + 1 + j] -= tangent * omega[j, 1]
        w[at.RATE_Z + 1 + j] -= tangent * omega[j, 2]
    for j in range(warmth.size):
        w[at.WARMTH + 1 + j] = warmth[j] - p[at.P_TEMPERATURE_REFERENCE]
    for j in range(1 + t.size, 1 + padded(t.size)):
        w[at.TIME + j], w[at.PSI + j] = w[at.TIME + t.size], w[at.PSI + t.size]
        w[at.RATE_Y + j], w[at.RATE_Z + j] = w[at.RATE_Y + t.size], w[at.RATE_Z + t.size]
        w[at.FORCE_Y + j], w[at.FORCE_Z + j] = w[at.FORCE_Y + t.size], w[at.FORCE_Z + t.size]
        w[at.OMEGA_X + j], w[at.WARMTH + j] = w[at.OMEGA_X + t.size], w[at.WARMTH + t.size]


@exact
def load_past(
    coupling: float, offset_y: float, offset_z: float, tangent: float, state: Array, w: Array
) -> None:  # fmt: skip
    """What the block needs of the samples and intervals before it."""
    w[at.TIME], w[at.PSI], w[at.PSI - 1] = state[at.S_TIME], state[at.S_PSI], state[at.S_PSI_BEFORE]
    w[at.FORCE_Y], w[at.FORCE_Z] = state[at.S_FORCE_Y], state[at.S_FORCE_Z]
    w[at.OMEGA_X], w[at.WARMTH] = state[at.S_OMEGA_X], state[at.S_WARMTH]
    w[at.OMEGA_Y], w[at.OMEGA_Z] = state[at.S_OMEGA_Y], state[at.S_OMEGA_Z]
    w[at.RATE_Y] = coupling * state[at.S_FORCE_Y] + offset_y - tangent * state[at.S_OMEGA_Y]
    w[at.RATE_Z] = coupling * state[at.S_FORCE_Z] + offset_z - tangent * state[at.S_OMEGA_Z]
    for k in range(2):
        w[at.OMEGA_X - 1 - k] = state[at.S_OMEGA_X_BEFORE + k]
        w[at.RATE_Y - 1 - k] = state[at.S_RATE_Y_BEFORE + k]
        w[at.RATE_Z - 1 - k] = state[at.S_RATE_Z_BEFORE + k]
    w[at.FIRST], w[at.FORCE] = state[at.S_FIRST], state[at.S_FORCE]
    for k in range(3):
        step = state[at.S_STEPS + k]
        w[at.EARLY - k], w[at.STEP - k] = state[at.S_EARLY + k], step
        w[at.INVERSE - k] = 1.0 / step if step != 0.0 else 0.0


@exact
def save_last(n: int, y: Array, z: Array, omega: Array, state: Array, w: Array) -> None:
    """Keep what the next block needs to know of this one."""
    state[at.S_VALID] = 1.0
    state[at.S_TIME], state[at.S_PSI] = w[at.TIME + n], w[at.PSI + n]
    state[at.S_PSI_BEFORE] = w[at.PSI + n - 1]
    state[at.S_FORCE_Y], state[at.S_FORCE_Z] = y[n - 1], z[n - 1]
    state[at.S_WARMTH] = w[at.WARMTH + n]
    state[at.S_FIRST], state[at.S_FORCE] = w[at.FIRST + n], w[at.FORCE + n]
    for k in range(3):
        state[at.S_EARLY + k], state[at.S_STEPS + k] = w[at.EARLY + n - k], w[at.STEP + n - k]
    for axis in range(3):
        state[at.S_OMEGA_X + axis] = omega[n - 1, axis] if omega.shape[0] else 0.0


@exact
def find_steps(n: int, begins: NDArray[np.bool_], valid: bool, w: Array) -> None:
    """Interval lengths; 0 where a stretch begins."""
    for j in range(1, n + 1):
        w[at.STEP + j] = w[at.TIME + j] - w[at.TIME + j - 1]
    for j in range(begins.size):
        w[at.STEP + 1 + j] = 0.0 if begins[j] else w[at.STEP + 1 + j]
    if not valid:
        w[at.STEP + 1] = 0.0
    for j in range(n + 1, padded(n) + 1):
        w[at.STEP + j] = 0.0


@exact
def find_inverse(n: int, w: Array) -> None:
    """Inverse of the interval lengths; 0 where a stretch begins."""
    for j in range(1, n + 1):
        step = w[at.STEP + j]
        w[at.INVERSE + j] = 1.0 / step if step != 0.0 else 0.0
    for j in range(n + 1, padded(n) + 1):
        w[at.INVERSE + j] = 0.0


@kernel
def find_angles(first: int, stop: int, phi: float, w: Array) -> None:
    """Effective angle of every interval (the middle of the angles read), its sine and cosine."""
    far = 0
    for j in range(first, stop):
        angle = phi + 0.5 * (w[at.PSI + j - 1] + w[at.PSI + j])
        w[at.ANGLE + j] = angle
        sine, cosine = fast_sine_cosine(angle)
        w[at.SINE + j] = sine
        w[at.COSINE + j] = cosine
        far |= abs(angle) > LIMIT
    if far:
        library_angles(first, stop, w)


@exact
def library_angles(first: int, stop: int, w: Array) -> None:
    """Sine and cosine of angles beyond the fast reduction."""
    for j in range(first, stop):
        angle = w[at.ANGLE + j]
        if abs(angle) > LIMIT:
            w[at.SINE + j] = math.sin(angle)
            w[at.COSINE + j] = math.cos(angle)


@kernel
def solve_small(delta: float, square: float, coupling: float) -> tuple[float, float]:
    """``e = A - 2 delta`` for small turns and ``sin(delta)/delta``, minus its derivative by the coupling.

    Series of ``q cot q`` about ``delta^2``; ``cos(delta) - 2 delta sin(delta) c'(delta^2) = delta/sin(delta)``.
    """
    d = delta * delta
    gain = 1.0 + d * (-1 / 6 + d * (1 / 120 + d * (-1 / 5040 + d * (1 / 362880 - d / 39916800))))
    cosine = 1.0 + d * (-1 / 2 + d * (1 / 24 + d * (-1 / 720 + d * (1 / 40320 - d / 3628800))))
    first = -1 / 3 + d * (-2 / 45 + d * (-6 / 945 + d * (-4 / 4725 + d * (-10 / 93555))))
    second = -1 / 45 + d * (-6 / 945 + d * (-6 / 4725))
    weight = 2.0 * delta * gain
    e = -coupling * gain
    for _ in range(2):
        eta = delta * e + 0.25 * (e * e - square)
        e -= (e * cosine - weight * eta * (first + eta * second) + coupling) * gain
    return e, gain


@kernel
def estimate_first(first: int, stop: int, w: Array) -> None:
    """Mean ``u_x`` of every interval for input that is constant in it: exact then."""
    far = 0
    for j in range(first, stop):
        step = w[at.STEP + j]
        delta = 0.5 * (w[at.PSI + j] - w[at.PSI + j - 1])
        Y = 0.5 * step * (w[at.RATE_Y + j - 1] + w[at.RATE_Y + j])
        Z = 0.5 * step * (w[at.RATE_Z + j - 1] + w[at.RATE_Z + j])
        square = Y * Y + Z * Z
        e, gain = solve_small(delta, square, Y * w[at.SINE + j] - Z * w[at.COSINE + j])
        w[at.CONSTANT + j] = (2.0 * delta + e) * w[at.INVERSE + j]
        w[at.GAIN + j] = gain
        w[at.ANGLE_TURNED + j] = 2.0 * delta + e
        far |= (abs(delta) > FAR_TURN) | (square * delta * delta > FAR_PRODUCT)
    if far:
        estimate_far(first, stop, w)


@exact
def estimate_far(first: int, stop: int, w: Array) -> None:
    """The intervals that turn too far for the series."""
    for j in range(first, stop):
        step = w[at.STEP + j]
        delta = 0.5 * (w[at.PSI + j] - w[at.PSI + j - 1])
        Y = 0.5 * step * (w[at.RATE_Y + j - 1] + w[at.RATE_Y + j])
        Z = 0.5 * step * (w[at.RATE_Z + j - 1] + w[at.RATE_Z + j])
        square = Y * Y + Z * Z
        if step != 0.0 and (abs(delta) > FAR_TURN or square * delta * delta > FAR_PRODUCT):
            e = solve_far(delta, square, Y * w[at.SINE + j] - Z * w[at.COSINE + j])
            w[at.GAIN + j] = math.sin(delta) / delta if delta != 0.0 else 1.0
            w[at.ANGLE_TURNED + j] = 2.0 * delta + e
            w[at.CONSTANT + j] = w[at.ANGLE_TURNED + j] / step


@exact
def solve_far(delta: float, square: float, coupling: float) -> float:
    """``e = A - 2 delta`` for any turn and any regime: Newton's method on the equation times ``sin q / q``."""
    sine, cosine = math.sin(delta), math.cos(delta)
    A = 2.0 * delta - coupling * (sine / delta if abs(delta) > 1e-8 else 1.0)
    for _ in range(NEWTON):
        x = 0.25 * (square - A * A)
        if abs(x) < 1e-3:
            C = 1.0 + x * (1 / 2 + x * (1 / 24 + x * (1 / 720 + x / 40320)))
            S = 1.0 + x * (1 / 6 + x * (1 / 120 + x * (1 / 5040 + x / 362880)))
            slope = 1 / 6 + x * (1 / 60 + x * (1 / 1680 + x / 90720))
        elif x > 0.0:
            root = math.sqrt(x)
            C, S = 1.0, math.tanh(root) / root
            slope = 0.5 * (C - S) / x
        else:
            root = math.sqrt(-x)
            C, S = math.cos(root), math.sin(root) / root
            slope = 0.5 * (C - S) / x
        value = S * (A * cosine + coupling) - 2.0 * C * sine
        derivative = S * cosine - 0.5 * A * (slope * (A * cosine + coupling) - S * sine)
        correction = value / derivative
        A -= correction
        if abs(correction) <= 4e-16 * max(abs(A), abs(delta)):
            break
    return A - 2.0 * delta


@kernel
def invert_motion(stop: int, K: float, w: Array) -> None:
    """Indicated mean specific force along X0 of every interval [m/s^2], and the slope used.

    The Magnus terms of input that is linear in the interval are small beside its mean: the equation is
    solved for the mean and corrected for them to first order (their square is below rounding).
    """
    inverse_K = 1.0 / K
    for j in range(1, stop):
        step, before = w[at.STEP + j], w[at.STEP + j - 1]
        y0, y1, z0, z1 = w[at.RATE_Y + j - 1], w[at.RATE_Y + j], w[at.RATE_Z + j - 1], w[at.RATE_Z + j]
        mean_y, mean_z = 0.5 * (y0 + y1), 0.5 * (z0 + z1)
        a = w[at.CONSTANT + j]
        joined = (step != 0.0) & (before != 0.0)
        rise = (a - w[at.CONSTANT + j - 1]) * 2.0 * step / (step + before if joined else 1.0)
        rise = rise if joined else 0.0
        cross = step * step / 12.0
        Y = cross * (a * (z1 - z0) - rise * mean_z)
        Z = -cross * (a * (y1 - y0) - rise * mean_y)
        delta = 0.5 * (w[at.PSI + j] - w[at.PSI + j - 1])
        bent = Y * w[at.SINE + j] - Z * w[at.COSINE + j] - delta / 3.0 * step * (mean_y * Y + mean_z * Z)
        turned = w[at.ANGLE_TURNED + j] - (w[at.GAIN + j] * bent + cross * (y0 * z1 - z0 * y1))
        w[at.FAR_INPUT + j] = turned * w[at.INVERSE + j] * inverse_K
        w[at.FAR_SLOPE + j] = rise * inverse_K


@exact
def published_formula(n: int, K: float, w: Array) -> None:
    """The published compensation: output rate less the coupling at the phase [Wei2024, eq. 20]."""
    for j in range(1, n + 1):
        rate = (w[at.PSI + j] - w[at.PSI + j - 1]) * w[at.INVERSE + j]
        y, z = 0.5 * (w[at.RATE_Y + j - 1] + w[at.RATE_Y + j]), 0.5 * (w[at.RATE_Z + j - 1] + w[at.RATE_Z + j])
        w[at.INPUT + j] = (rate - (y * w[at.SINE + j] - z * w[at.COSINE + j])) / K
        w[at.SLOPE + j] = 0.0


@exact
def take_early(n: int, w: Array) -> None:
    """The trapezoid's mean of ``u_x`` where no better one is formed."""
    for j in range(1, n + 1):
        w[at.FIRST + j] = w[at.EARLY + j]


@exact
def describe_means(n: int, K: float, w: Array) -> None:
    """Means of the known inputs over every interval, for flags and uncertainty."""
    inverse = 1.0 / K
    for j in range(1, n + 1):
        w[at.MEAN_Y + j] = 0.5 * (w[at.FORCE_Y + j - 1] + w[at.FORCE_Y + j])
        w[at.MEAN_Z + j] = 0.5 * (w[at.FORCE_Z + j - 1] + w[at.FORCE_Z + j])
        w[at.TURN + j] = (w[at.PSI + j] - w[at.PSI + j - 1]) * w[at.INVERSE + j] * inverse


@exact
def describe_changes(n: int, w: Array) -> None:
    """Times, temperatures and changes of the known inputs over every interval, for the error model."""
    for j in range(1, n + 1):
        w[at.MEAN_T + j] = 0.5 * (w[at.WARMTH + j - 1] + w[at.WARMTH + j])
        w[at.CHANGE_Y + j] = w[at.FORCE_Y + j] - w[at.FORCE_Y + j - 1]
        w[at.CHANGE_Z + j] = w[at.FORCE_Z + j] - w[at.FORCE_Z + j - 1]
        w[at.CHANGE_T + j] = w[at.WARMTH + j] - w[at.WARMTH + j - 1]
        w[at.MEAN_TIME + j] = 0.5 * (w[at.TIME + j - 1] + w[at.TIME + j])
