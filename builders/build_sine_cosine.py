"""Polynomials and the split of pi/2 in ``piga/_kernels/arithmetic.py``: run to print them again.

Chebyshev fits at 50 digits over ``r^2`` in [0, (pi/4)^2] of ``(sin r/r - 1)/r^2`` and
``(cos r - 1 + r^2/2)/r^4``; the leading parts of pi/2 have few bits, so that any quotient below 2^20
times a part is exact.
"""

from __future__ import annotations

import mpmath as mp

BITS = 33
PARTS = 3


def split_half_pi() -> list[float]:
    rest, parts = mp.pi / 2, []
    for _ in range(PARTS - 1):
        exponent = BITS - 1 - mp.floor(mp.log(rest, 2))
        part = mp.floor(rest * mp.mpf(2) ** exponent) / mp.mpf(2) ** exponent
        parts.append(float(part))
        rest -= part
    return [*parts, float(rest)]


def sine_tail(x: mp.mpf) -> mp.mpf:
    if x < mp.mpf("1e-12"):
        return -mp.mpf(1) / 6 + x / 120
    r = mp.sqrt(x)
    return (mp.sin(r) / r - 1) / x


def cosine_tail(x: mp.mpf) -> mp.mpf:
    if x < mp.mpf("1e-8"):
        return mp.mpf(1) / 24 - x / 720 + x * x / 40320
    return (mp.cos(mp.sqrt(x)) - 1 + x / 2) / x**2


if __name__ == "__main__":
    mp.mp.dps = 50
    print("half pi", [part.hex() for part in split_half_pi()], split_half_pi())
    for name, function, terms in (("sine", sine_tail, 6), ("cosine", cosine_tail, 6)):
        coefficients, error = mp.chebyfit(function, [0, (mp.pi / 4) ** 2 * mp.mpf("1.0001")], terms, error=True)
        print(name, [float(c) for c in reversed(coefficients)], "error", mp.nstr(error, 3))
