"""Double-double arithmetic: a number is the unevaluated sum ``high + low`` of two float64.

About 31 significant digits. Used where a phase grows over many revolutions or where two nearly
equal squares are subtracted, and where triangular factors are gathered. Dekker's and Knuth's error-free
transformations, valid while products stay below 1e300 and above 1e-290.
"""

from __future__ import annotations

import math

import numpy as np

from piga._kernels.jit import exact

PI_HIGH = math.pi
PI_LOW = 1.2246467991473532e-16
PI_LOWEST = -2.9947698097183397e-33
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
    n = np.rint(a[0] / PI_HIGH)
    rest = add(a, two_product(-n, PI_HIGH))
    rest = add(rest, two_product(-n, PI_LOW))
    return n, rest[0] + (rest[1] - n * PI_LOWEST)


@exact
def divide(a: tuple[float, float], b: tuple[float, float]) -> tuple[float, float]:
    """Quotient of two double-doubles (three steps of long division)."""
    first = a[0] / b[0]
    rest = add(a, _negative(multiply((first, 0.0), b)))
    second = rest[0] / b[0]
    rest = add(rest, _negative(multiply((second, 0.0), b)))
    return add(two_sum(first, second), (rest[0] / b[0], 0.0))


@exact
def _negative(a: tuple[float, float]) -> tuple[float, float]:
    return -a[0], -a[1]
