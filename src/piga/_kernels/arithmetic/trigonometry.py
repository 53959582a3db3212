"""Sine with cosine, and the arctangent of a half-angle pair, without branches or table: they run on whole vectors.

The argument of sine and cosine is reduced by a three-part pi/2 [Cody1980], exact for quotients below 2^20; larger angles are
worked off by the library's functions one by one. Polynomials and parts are printed
by ``builders/build_sine_cosine.py``. Nothing is contracted, so a value does not depend on its neighbours.

The arctangent is a Chebyshev fit of ``(atan(u)/u - 1)/u^2`` over ``|u| <= tan(pi/8)``, made with ``mpmath.chebyfit``
at 50 digits, eleven coefficients: relative error 6e-18, half an ulp in float64.
"""

from __future__ import annotations

import math

import numpy as np

from piga._kernels.jit import inline, kernel

LIMIT = 1.6e6
"""Largest angle [rad] of the fast reduction: 2^20 quarter turns."""

_TWO_OVER_PI = 2.0 / math.pi
_HALF_PI_1 = 1.5707963267341256
_HALF_PI_2 = 6.077100506303966e-11
_HALF_PI_3 = 2.0222662487959506e-21
_S0 = -0.16666666666666666
_S1 = 0.008333333333330948
_S2 = -0.00019841269836756774
_S3 = 2.7557316101617874e-06
_S4 = -2.505113165023518e-08
_S5 = 1.5918115263265974e-10
_C0 = 0.041666666666666664
_C1 = -0.0013888888888887398
_C2 = 2.480158729876456e-05
_C3 = -2.7557317271145144e-07
_C4 = 2.087614614655861e-09
_C5 = -1.1382623647474604e-11


@kernel
def fast_sine_cosine(angle: float) -> tuple[float, float]:
    """``sin`` and ``cos`` of an angle of at most ``LIMIT`` [rad]; error below 2e-16."""
    quarter = np.rint(angle * _TWO_OVER_PI)
    r = ((angle - quarter * _HALF_PI_1) - quarter * _HALF_PI_2) - quarter * _HALF_PI_3
    x = r * r
    sine = r + r * (x * (_S0 + x * (_S1 + x * (_S2 + x * (_S3 + x * (_S4 + x * _S5))))))
    tail = x * x * (_C0 + x * (_C1 + x * (_C2 + x * (_C3 + x * (_C4 + x * _C5)))))
    half = 0.5 * x
    one = 1.0 - half
    cosine = one + (((1.0 - one) - half) + tail)
    pairs = np.floor(0.5 * quarter)
    odd = quarter - 2.0 * pairs
    sign = 1.0 - 2.0 * (pairs - 2.0 * np.floor(0.5 * pairs))
    swapped = odd != 0.0
    s = cosine if swapped else sine
    c = -sine if swapped else cosine
    return sign * s, sign * c


@kernel
def sine_cosine(angle: float) -> tuple[float, float]:
    """``sin`` and ``cos`` of any finite angle [rad]."""
    if abs(angle) > LIMIT:
        return math.sin(angle), math.cos(angle)
    return fast_sine_cosine(angle)


_TAN_EIGHTH = math.tan(math.pi / 8.0)
_A0 = -0.3333333333333333
_A1 = 0.1999999999999552
_A2 = -0.14285714284666542
_A3 = 0.11111111015256292
_A4 = -0.09090904578121085
_A5 = 0.07692183190760651
_A6 = -0.0666451144646022
_A7 = 0.05858148904795124
_A8 = -0.050854496960392584
_A9 = 0.039231657085083686
_A10 = -0.019176885636589053


@inline
def double_arctangent(p: float, q: float) -> float:
    """``2 atan(p/q)`` [rad] in [-pi, pi]: the angle of a half-angle pair, of either sign of the pair.

    One division: ``atan(r) = pi/4 + atan((r - 1)/(r + 1))`` keeps the argument below tan(pi/8).
    """
    size_p, size_q = abs(p), abs(q)
    small, large = min(size_p, size_q), max(size_p, size_q)
    shifted = small > _TAN_EIGHTH * large
    u = (small - large if shifted else small) / (small + large if shifted else large)
    z = u * u
    tail = _A5 + z * (_A6 + z * (_A7 + z * (_A8 + z * (_A9 + z * _A10))))
    series = u + u * (z * (_A0 + z * (_A1 + z * (_A2 + z * (_A3 + z * (_A4 + z * tail))))))
    angle = 2.0 * series + (0.5 * math.pi if shifted else 0.0)
    if size_p > size_q:
        angle = math.pi - angle
    return -angle if (p < 0.0) != (q < 0.0) else angle
