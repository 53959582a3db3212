"""Arithmetic of the kernels: double-double numbers, smooth inputs between samples, arctangent.

**Double-double.** A number is the unevaluated sum ``high + low`` of two float64, with about 31 significant digits. It is used
where a phase grows over many revolutions, where two nearly equal squares are subtracted, and where triangular factors are
merged. The error-free transformations are those of Dekker and Knuth. They are valid while products stay below 1e300 and
above 1e-290.

**Between samples.** The mean of a smooth input over an interval is the mean of both ends less ``h^2/12`` of its second
derivative in the middle. At a step, a kink or a bad sample, second differences change their sign or size from sample to
sample. If the sign changes, the second derivative is set to zero. It is limited to twice the smaller of two
neighbours. So the result does not ring.

**The arctangent of a half-angle pair** has no branches and no table, so it runs on whole vectors: angles from pairs take a third
of the time. It is a Chebyshev fit of ``(atan(u)/u - 1)/u^2`` over ``|u| <= tan(pi/8)``, made with ``mpmath.chebyfit`` at 50
digits. It has eleven coefficients. The relative error is 6e-18, half an ulp in float64.
"""

from __future__ import annotations

import math

import numpy as np

from piga._kernels.jit import Array, exact, inline

_PI_HIGH = math.pi
_PI_LOW = 1.2246467991473532e-16
_PI_LOWEST = -2.9947698097183397e-33
_SPLIT = 134217729.0  # 2^27 + 1


@exact
def two_sum(a: float, b: float) -> tuple[float, float]:
    """``a + b`` as rounded sum and its exact rounding error."""
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


@exact
def two_product(a: float, b: float) -> tuple[float, float]:
    """``a * b`` as rounded product and its exact rounding error."""
    product = a * b
    scaled = _SPLIT * a
    a_high = scaled - (scaled - a)
    a_low = a - a_high
    scaled = _SPLIT * b
    b_high = scaled - (scaled - b)
    b_low = b - b_high
    return product, ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low


@exact
def add(a: tuple[float, float], b: tuple[float, float]) -> tuple[float, float]:
    """Sum of two double-doubles (accurate also under cancellation)."""
    high, error = two_sum(a[0], b[0])
    low, low_error = two_sum(a[1], b[1])
    high, error = two_sum(high, error + low)
    return two_sum(high, error + low_error)


@exact
def multiply(a: tuple[float, float], b: tuple[float, float]) -> tuple[float, float]:
    """Product of two double-doubles."""
    high, error = two_product(a[0], b[0])
    return two_sum(high, error + (a[0] * b[1] + a[1] * b[0]))


@exact
def square_root(a: tuple[float, float]) -> tuple[float, float]:
    """Square root of a non-negative double-double (one Newton step from the float64 root)."""
    if a[0] <= 0.0:
        return 0.0, 0.0
    root = math.sqrt(a[0])
    square, error = two_product(root, root)
    rest = ((a[0] - square) - error) + a[1]
    return two_sum(root, rest / (2.0 * root))


@exact
def remainder_pi(a: tuple[float, float]) -> tuple[float, float]:
    """``(n, a - n pi)`` with the nearest integer ``n``; keeps 1e-16 rad up to n of 1e15."""
    n = np.rint(a[0] / _PI_HIGH)
    rest = add(a, two_product(-n, _PI_HIGH))
    rest = add(rest, two_product(-n, _PI_LOW))
    return n, rest[0] + (rest[1] - n * _PI_LOWEST)


_MOST_GROWTH = 2.0
"""The second derivative in an interval is at most this multiple of the smaller one of its neighbours."""


@inline
def limited(value: float, first: float, second: float) -> float:
    """A second derivative limited by two others; 0 if their signs differ."""
    low, high = min(first, second), max(first, second)
    return min(max(value, _MOST_GROWTH * min(high, 0.0)), _MOST_GROWTH * max(low, 0.0))


@inline
def bow_of(h: float, curved: float) -> float:
    """Mean over an interval ``h`` less the mean of both ends, for a second derivative ``curved``."""
    return -h * h * (1.0 / 12.0) * curved


@inline
def weigh_neighbours(h: Array, before: Array, after: Array, share: Array) -> None:
    """Weights of second derivatives, (n,) each, from the intervals ``h`` (n,) [s].

    At the beginning of interval i the second derivative is ``after[i]`` times the change over it less ``before[i]`` times that
    over the interval before. The middle of the interval lies ``share[i]`` of the way to that at its end.
    """
    for i in range(h.size - 1):  # indices that only add: the compiler then knows that none is negative
        h0, h1 = h[i], h[i + 1]
        per = 2.0 / (h0 * h1 * (h0 + h1))
        before[i + 1], after[i + 1] = h1 * per, h0 * per
    for i in range(h.size - 2):
        h0, h1, h2 = h[i], h[i + 1], h[i + 2]
        share[i + 1] = (h1 + 2.0 * h0) / (2.0 * (h0 + h1 + h2))


@inline
def second_derivatives(x: Array, before: Array, after: Array, bend: Array) -> None:
    """Second derivatives ``bend`` (n,) at the beginnings of the intervals but the first, from n + 1 samples of ``x``."""
    for i in range(x.size - 2):
        bend[i + 1] = after[i + 1] * (x[i + 2] - x[i + 1]) - before[i + 1] * (x[i + 1] - x[i])


@inline
def bow_inside(h: float, share: float, first: float, second: float) -> float:
    """Bow in an interval ``h`` from two second derivatives; its middle lies ``share`` of the way. Exact for a cubic."""
    return bow_of(h, limited(first + share * (second - first), first, second))


@inline
def share_at_end(h: float, h_near: float, h_far: float) -> float:
    """The share for an interval ``h`` at an end of a stretch, from the second derivatives at the next two samples."""
    return -(h + 2.0 * h_near) / (2.0 * (h + h_near + h_far))


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
