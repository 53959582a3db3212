r"""Exact motion of the outer gimbal: one step of the half-angle pair, of any size.

With ``(P, Q) = (sin(alpha/2), cos(alpha/2))`` up to a common factor, equation (2) of the package
docstring is linear,

.. math:: \frac{d}{dt}\binom{P}{Q} = \frac12 \begin{pmatrix} y & a - z \\ -(a + z) & -y \end{pmatrix}
          \binom{P}{Q}, \qquad a = u_x,\; y = \tan\beta\, u_Y,\; z = \tan\beta\, u_Z .

The exponential of a step is ``C I + S M`` because ``M^2 = x I``, ``x = (Y^2 + Z^2 - A^2)/4``.
Derived in docs/theory/motion. Angles are kept as whole turns and a rest in [-pi, pi].
"""

from __future__ import annotations

import math

import numpy as np

from piga._kernels import arithmetic as dd
from piga._kernels.arithmetic import double_arctangent
from piga._kernels.jit import Array, exact, inline, kernel

SMALL_STEP = 1.0
"""Largest ``A^2 + Y^2 + Z^2`` [rad^2] for which the series of :func:`step_matrix` and the count of turns are valid."""
GOOD = -1
"""Result of the kernels for whole records if all samples are usable; otherwise they return the start of a bad step."""
TOO_LARGE = 1e150

_C1, _C2, _C3, _C4, _C5, _C6, _C7 = (1.0 / math.factorial(2 * k) for k in range(1, 8))
_S0, _S1, _S2, _S3, _S4, _S5, _S6, _S7 = (0.5 / math.factorial(2 * k + 1) for k in range(8))


@inline
def step_matrix(A: float, Y: float, Z: float) -> tuple[float, float, float, float]:
    """The matrix of a small step less the identity: rows P and Q.

    ``C - 1`` and ``S/2`` as Taylor series in ``x``, ``|x| <= 1/4``: truncation below 1e-18. The difference from the identity is
    kept apart, so that the rounding of small steps does not add up in one direction.
    """
    x = 0.25 * (Y * Y + Z * Z - A * A)
    c = x * (_C1 + x * (_C2 + x * (_C3 + x * (_C4 + x * (_C5 + x * (_C6 + x * _C7))))))
    s = _S0 + x * (_S1 + x * (_S2 + x * (_S3 + x * (_S4 + x * (_S5 + x * (_S6 + x * _S7))))))
    return c + s * Y, s * (A - Z), -s * (A + Z), c - s * Y


@inline
def unit_pair(p: float, q: float) -> tuple[float, float]:
    """The pair at unit length with ``Q >= 0``."""
    scale = math.copysign(1.0 / math.sqrt(p * p + q * q), q)
    return p * scale, q * scale


_TWO_PI = 2.0 * math.pi
TWO_PI_HIGH = 6.283185303211212  # the leading 27 bits of 2 pi: exact times any turn count below 2^26
TWO_PI_LOW = 3.968374318722162e-09


@inline
def unwrapped(turns: float, rest: float) -> float:
    """``2 pi turns + rest`` [rad], rounded once for up to 6e7 turns (and to an ulp beyond)."""
    return turns * TWO_PI_HIGH + (turns * TWO_PI_LOW + rest)


@exact
def split_turns(alpha: float) -> tuple[float, float]:
    """Nearest whole turns of ``alpha`` [rad] and the rest in [-pi, pi], exact for any float64 angle."""
    turns, half_rest = dd.remainder_pi((0.5 * alpha, 0.0))
    return turns, 2.0 * half_rest


@kernel
def step_functions(x: float) -> tuple[float, float]:
    """``C - 1`` and ``S``, where ``C = cosh(sqrt(x))``, ``S = sinh(sqrt(x))/sqrt(x)`` up to a common factor.

    Both are entire functions of ``x`` (``cos`` and ``sin`` for ``x < 0``). Half-turns are taken out
    for ``x < 0`` and ``cosh`` for large ``x``: the pair ``(P, Q)`` has no scale. ``C - 1`` keeps the
    digits of a small step, so that rounding does not add up in one direction.
    """
    if abs(x) < 0.0625:
        c = x * (1 / 2 + x * (1 / 24 + x * (1 / 720 + x * (1 / 40320 + x * (1 / 3628800 + x / 479001600)))))
        s = 1.0 + x * (1 / 6 + x * (1 / 120 + x * (1 / 5040 + x * (1 / 362880 + x / 39916800))))
        return c, s
    if x > 0.0:
        root = math.sqrt(x)
        return 0.0, math.tanh(root) / root
    root = math.sqrt(-x)
    remainder = root - np.rint(root / math.pi) * math.pi
    return math.cos(remainder) - 1.0, math.sin(remainder) / root


@inline
def magnus_increments(
    h: float, a0: float, y0: float, z0: float, a1: float, y1: float, z1: float
) -> tuple[float, float, float]:
    """Increments ``A, Y, Z`` [rad] of a step with input linear from ``(a0, y0, z0)`` to ``(a1, y1, z1)``.

    Mean of the ends plus the commutator of the fourth-order Magnus expansion [Blanes2009].
    """
    mean, cross = 0.5 * h, h * h / 12.0
    return (
        mean * (a0 + a1) + cross * (y0 * z1 - z0 * y1),
        mean * (y0 + y1) + cross * (a0 * z1 - z0 * a1),
        mean * (z0 + z1) - cross * (a0 * y1 - y0 * a1),
    )


@kernel
def advance(
    turns: float, rest: float, p: float, q: float, A: float, Y: float, Z: float
) -> tuple[float, float, float, float]:
    """One exact step of any size: new ``(turns, rest, p, q)`` for increments ``A, Y, Z`` [rad]."""
    x = 0.25 * (Y * Y + Z * Z - A * A)
    c, s = step_functions(x)
    s *= 0.5
    p1 = p + (c * p + s * (Y * p + (A - Z) * q))
    q1 = q + (c * q - s * ((A + Z) * p + Y * q))
    increment = 2.0 * math.atan2(p1 * q - q1 * p, p1 * p + q1 * q)
    scale = 1.0 / math.sqrt(p1 * p1 + q1 * q1)
    if q1 < 0.0:
        scale = -scale
    p1, q1 = p1 * scale, q1 * scale
    rest1 = double_arctangent(p1, q1)
    turns1 = turns + np.rint((rest + increment - rest1) / _TWO_PI)
    if x < -1.0:  # the turns that step_functions takes out
        turns1 += math.copysign(np.rint(math.sqrt(-x) / math.pi), A)
    return turns1, rest1, p1, q1


@exact
def _constant_motion(
    a: tuple[float, float],
    y: tuple[float, float],
    z: tuple[float, float],
    t: float,
    turns: float,
    rest: float,
) -> tuple[float, float, float]:
    """Turns, rest [rad] and rate [rad/s] after any time ``t`` [s] of constant input.

    ``a, y, z`` [rad/s] are double-doubles, so that neither the closeness to the separatrix nor the
    number of revolutions costs digits: the phase is reduced before it is rounded.
    """
    sine, cosine = math.sin(rest), math.cos(rest)
    rate0 = a[0] + (y[0] * sine - z[0] * cosine) + a[1]
    time = dd.multiply((0.5, 0.0), (t, 0.0))
    square_a, square_y, square_z = dd.multiply(a, a), dd.multiply(y, y), dd.multiply(z, z)
    x = dd.add(dd.add(square_y, (-square_a[0], -square_a[1])), square_z)
    x = dd.multiply(dd.multiply(x, time), time)
    whole, growth = 0.0, 1.0
    if x[0] > 0.0:
        root = dd.square_root(x)[0]
        c, s = 1.0, math.tanh(root) / root
        growth = math.cosh(min(root, 350.0))
    else:
        reduced = dd.square_root((-x[0], -x[1]))
        whole, remainder = dd.remainder_pi(reduced)
        c, s = math.cos(remainder), 1.0
        if reduced[0] > 0.0:
            s = math.sin(remainder) / reduced[0]
        whole = math.copysign(whole, a[0] * t)
    numerator = s * (0.5 * t) * rate0
    denominator = c - s * (0.5 * t) * (y[0] * cosine + z[0] * sine)
    increment = 2.0 * math.atan2(numerator, denominator)
    norm = growth * math.hypot(numerator, denominator)
    rate = rate0 / norm / norm if norm > 0.0 else rate0
    total = rest + increment
    carry = np.rint(total / _TWO_PI)
    return turns + whole + carry, (total - carry * TWO_PI_HIGH) - carry * TWO_PI_LOW, rate


@exact
def constant_motions(
    t: Array, f: Array, base_rate: Array, K: float, tan_beta: float, turns: float, rest: float, onward: bool,
    result: Array,
) -> None:  # fmt: skip
    """Rows turns, rest [rad] and rate [rad/s] of ``result`` (3, n) after times ``t`` (n,) [s] of constant input.

    ``f`` and ``base_rate`` (n or 1, 3) [m/s^2], [rad/s] are taken as exact. ``onward``: each motion goes on from the last one.
    """
    for k in range(t.size):
        i = min(k, f.shape[0] - 1)
        a = dd.add(dd.two_product(K, f[i, 0]), (-base_rate[i, 0], 0.0))
        y = dd.add(dd.two_product(K, f[i, 1]), (-base_rate[i, 1], 0.0))
        z = dd.add(dd.two_product(K, f[i, 2]), (-base_rate[i, 2], 0.0))
        y, z = dd.multiply(y, (tan_beta, 0.0)), dd.multiply(z, (tan_beta, 0.0))
        ended, left, rate = _constant_motion(a, y, z, t[k], turns, rest)
        result[0, k], result[1, k], result[2, k] = ended, left, rate
        if onward:
            turns, rest = ended, left
