"""Sums, products and quotients of numbers held as an unevaluated sum of two doubles (about 32 digits).

Error-free transformations of Knuth (two-sum) and Dekker (splitting product).
"""

from __future__ import annotations

from piga._kernels.jit import exact_kernel

_SPLITTER = 134217729.0  # 2^27 + 1


@exact_kernel
def two_sum(a: float, b: float) -> tuple[float, float]:
    """``a + b`` and its rounding error, exactly."""
    s = a + b
    v = s - a
    return s, (a - (s - v)) + (b - v)


@exact_kernel
def two_product(a: float, b: float) -> tuple[float, float]:
    """``a b`` and its rounding error, exactly (barring overflow)."""
    p = a * b
    t = _SPLITTER * a
    ah = t - (t - a)
    al = a - ah
    t = _SPLITTER * b
    bh = t - (t - b)
    bl = b - bh
    return p, ((ah * bh - p) + ah * bl + al * bh) + al * bl


@exact_kernel
def add(ah: float, al: float, bh: float, bl: float) -> tuple[float, float]:
    """Sum of two double-doubles."""
    s, e = two_sum(ah, bh)
    t, f = two_sum(al, bl)
    e += t
    h = s + e
    e -= h - s
    e += f
    r = h + e
    return r, e - (r - h)


@exact_kernel
def multiply(ah: float, al: float, bh: float, bl: float) -> tuple[float, float]:
    """Product of two double-doubles."""
    p, e = two_product(ah, bh)
    e += ah * bl + al * bh
    r = p + e
    return r, e - (r - p)


@exact_kernel
def divide(ah: float, al: float, bh: float, bl: float) -> tuple[float, float]:
    """Quotient of two double-doubles (two steps of long division)."""
    q = ah / bh
    ph, pl = multiply(q, 0.0, bh, bl)
    rh, rl = add(ah, al, -ph, -pl)
    q2 = rh / bh
    ph, pl = multiply(q2, 0.0, bh, bl)
    rh, rl = add(rh, rl, -ph, -pl)
    q3 = rh / bh
    h, low = two_sum(q, q2)
    return add(h, low, q3, 0.0)
