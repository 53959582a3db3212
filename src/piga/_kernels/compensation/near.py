r"""Angle records that turn little between samples: the coupling integrated from its values at the samples.

Over an interval the mean of ``u_x`` is the output rate less the mean of the coupling
``g = tan_beta (u_Y sin(alpha) - u_Z cos(alpha))``, whose integral follows from its values and derivatives at both
ends, where the angle is known (Euler-Maclaurin [own derivation, docs/theory/compensation]):

.. math:: \bar g = \tfrac12 (g_0 + g_1) + \tfrac{h}{12} (g_0' - g_1') - \tfrac{h^3}{720} (g_0''' - g_1''') .

Transverse input is linear between samples; ``u_x`` is so with the change that backward differences of its means
give (three intervals; fewer at the beginning of a stretch). The derivatives need ``u_x`` itself: the equation is linear
in it. No angle between samples is needed, so one sine and cosine per sample does.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.arithmetic.sine_cosine import LIMIT, fast_sine_cosine
from piga._kernels.compensation import layout as at
from piga._kernels.jit import exact, inline, kernel

Array = NDArray[np.float64]

NEAR_TURN = 0.03
"""Angle turned in an interval [rad] up to which the formula holds."""
NEAR_COUPLING = 1e-3
"""Angle that the transverse input could turn in an interval [rad] up to which the formula holds."""
EVEN = 1e-4
"""Half the relative change of the interval up to which a series takes the place of a division (1e-8 of the rise)."""


@kernel
def find_nodes(stop: int, phi: float, w: Array) -> None:
    """Sine and cosine of the angles read, and the coupling there, from the last sample before the block on."""
    far = 0
    for j in range(stop):
        alpha = phi + w[at.PSI + j]
        sine, cosine = fast_sine_cosine(alpha)
        y, z = w[at.RATE_Y + j], w[at.RATE_Z + j]
        w[at.NODE_SINE + j], w[at.NODE_COSINE + j] = sine, cosine
        w[at.COUPLING + j] = y * sine - z * cosine
        w[at.ACROSS + j] = y * cosine + z * sine
        far |= abs(alpha) > LIMIT
    if far:
        far_nodes(stop, phi, w)


@exact
def far_nodes(stop: int, phi: float, w: Array) -> None:
    """The same at angles beyond the fast reduction."""
    for j in range(stop):
        alpha = phi + w[at.PSI + j]
        if abs(alpha) > LIMIT:
            sine, cosine = math.sin(alpha), math.cos(alpha)
            y, z = w[at.RATE_Y + j], w[at.RATE_Z + j]
            w[at.NODE_SINE + j], w[at.NODE_COSINE + j] = sine, cosine
            w[at.COUPLING + j] = y * sine - z * cosine
            w[at.ACROSS + j] = y * cosine + z * sine


@inline
def is_near(turn: float, h: float, y: float, z: float) -> bool:
    """True for an interval that the formula holds for."""
    return (abs(turn) <= NEAR_TURN) & (abs(h) * (abs(y) + abs(z)) <= NEAR_COUPLING)


@kernel
def find_early(stop: int, w: Array) -> bool:
    """Mean ``u_x`` of every interval if it is constant there; True where an interval turns far."""
    far = 0
    for j in range(1, stop):
        h, turn = w[at.STEP + j], w[at.PSI + j] - w[at.PSI + j - 1]
        y0, y1, z0, z1 = w[at.RATE_Y + j - 1], w[at.RATE_Y + j], w[at.RATE_Z + j - 1], w[at.RATE_Z + j]
        g0, g1, q0, q1 = w[at.COUPLING + j - 1], w[at.COUPLING + j], w[at.ACROSS + j - 1], w[at.ACROSS + j]
        ds = w[at.NODE_SINE + j - 1] - w[at.NODE_SINE + j]
        dc = w[at.NODE_COSINE + j - 1] - w[at.NODE_COSINE + j]
        inverse = 1.0 / h if h != 0.0 else 0.0
        mean = turn * inverse - 0.5 * (g0 + g1)
        ends = (y1 - y0) * ds - (z1 - z0) * dc + h * ((mean + g0) * q0 - (mean + g1) * q1)
        w[at.EARLY + j] = mean - ends * (1 / 12 + turn * turn * (1 / 720) - (1 / 144) * (h * (q0 - q1)))
        w[at.INVERSE + j] = inverse
        far |= (not is_near(turn, h, y1, z1)) & (h != 0.0)
    return far != 0


@kernel
def invert_near(stop: int, K: float, w: Array) -> None:
    """Indicated mean specific force of every interval [m/s^2], by the formula for those that turn little.

    The change of ``u_x`` over an interval is ``d + d^2/2 + d^3/4`` of backward differences ``d`` of the means: for
    input that is linear between samples the series is that of ``2 d/(2 - d)``. The first difference is scaled for
    unequal intervals.
    """
    inverse_K = 1.0 / K
    odd = 0
    for j in range(1, stop):
        h, u0, u1, u2 = w[at.STEP + j], w[at.EARLY + j], w[at.EARLY + j - 1], w[at.EARLY + j - 2]
        x = 0.5 * (w[at.STEP + j - 1] * w[at.INVERSE + j] - 1.0)
        change, before = u0 - u1, u1 - u2
        second = change - before
        rise = change - change * x + 0.5 * second + 0.25 * (second - (before - (u2 - w[at.EARLY + j - 3])))
        odd |= abs(x) > EVEN
        mean = u0 + curved(h * rise, j, w)
        w[at.INPUT + j] = mean * inverse_K
        w[at.FIRST + j] = mean
        w[at.SLOPE + j] = rise * inverse_K
    if odd or w[at.STEP - 1] == 0.0 or w[at.STEP - 2] == 0.0:
        invert_odd(stop, K, w)


@inline
def curved(bend: float, j: int, w: Array) -> float:
    """What a change ``bend`` of ``h u_x`` over interval ``j`` adds to the mean of ``u_x``."""
    g0, g1, q0, q1 = w[at.COUPLING + j - 1], w[at.COUPLING + j], w[at.ACROSS + j - 1], w[at.ACROSS + j]
    turn = w[at.PSI + j] - w[at.PSI + j - 1]
    share = (q0 + q1) * (1 / 24 + (1 / 240) * (turn * turn))
    return bend * (share + (1 / 480) * bend * (g0 + g1))


@exact
def is_odd(j: int, w: Array) -> bool:
    """True for an interval that differs from the one before, or stands near the beginning of a stretch."""
    x = 0.5 * (w[at.STEP + j - 1] * w[at.INVERSE + j] - 1.0)
    return abs(x) > EVEN or w[at.STEP + j - 2] == 0.0 or w[at.STEP + j - 3] == 0.0


@exact
def invert_odd(stop: int, K: float, w: Array) -> None:
    """The same next to the beginning of a stretch, and where intervals differ: with the differences there are."""
    for j in range(1, stop):
        s0, s1, s2 = w[at.STEP + j], w[at.STEP + j - 1], w[at.STEP + j - 2]
        x = 0.5 * (s1 * w[at.INVERSE + j] - 1.0)
        uneven = abs(x) > EVEN
        if s0 == 0.0 or not is_odd(j, w):
            continue
        u0, u1, u2 = w[at.EARLY + j], w[at.EARLY + j - 1], w[at.EARLY + j - 2]
        rise = (u0 - u1) * 2.0 * s0 / (s0 + s1) if s1 != 0.0 else 0.0
        rise += 0.5 * ((u0 - u1) - (u1 - u2)) if s2 != 0.0 and not uneven else 0.0
        mean = u0 + curved(s0 * rise, j, w)
        w[at.INPUT + j], w[at.FIRST + j], w[at.SLOPE + j] = mean / K, mean, rise / K


@exact
def take_far(stop: int, w: Array) -> None:
    """Put the exact inverse in where an interval turns far."""
    for j in range(1, stop):
        turn, h = w[at.PSI + j] - w[at.PSI + j - 1], w[at.STEP + j]
        if not is_near(turn, h, w[at.RATE_Y + j], w[at.RATE_Z + j]):
            w[at.INPUT + j], w[at.FIRST + j] = w[at.FAR_INPUT + j], w[at.CONSTANT + j]
            w[at.SLOPE + j] = w[at.FAR_SLOPE + j]


@exact
def middle_angles(n: int, phi: float, w: Array) -> None:
    """Angle in the middle of the near intervals, sine and cosine to the digits that the uncertainty needs."""
    for j in range(1, n + 1):
        turn = w[at.PSI + j] - w[at.PSI + j - 1]
        near = is_near(turn, w[at.STEP + j], w[at.RATE_Y + j], w[at.RATE_Z + j])
        sine, cosine = (
            w[at.NODE_SINE + j - 1] + w[at.NODE_SINE + j],
            w[at.NODE_COSINE + j - 1] + w[at.NODE_COSINE + j],
        )
        w[at.SINE + j] = 0.5 * sine if near else w[at.SINE + j]
        w[at.COSINE + j] = 0.5 * cosine if near else w[at.COSINE + j]
        w[at.ANGLE + j] = phi + 0.5 * (w[at.PSI + j - 1] + w[at.PSI + j])
