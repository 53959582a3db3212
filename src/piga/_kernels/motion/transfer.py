r"""Blocks of steps as two-by-two matrices of unit determinant: many at once, the chain kept short.

A block holds up to :data:`BLOCK` steps. Its rows live in one flat array with constant distances, so
that the compiler sees that they do not overlap and works on whole vectors: everything but the product
of the matrices is free of dependences from sample to sample. A matrix is kept as what it adds to the
identity, ``E = 1 + [[g, b], [-c, h]]``: rounding of a small step stays small.

Rows: effective rates ``a, y, z`` [rad/s] at the samples; increments ``A, Y, Z`` [rad] of the steps;
``g, h, b, c`` of the steps; the half-angle pair ``P, Q`` at the samples.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.arithmetic.trig import double_arctangent
from piga._kernels.jit import inline, kernel, prefetch
from piga._kernels.motion.step import TWO_PI_HIGH, TWO_PI_LOW

Array = NDArray[np.float64]

BLOCK = 256
HALF = BLOCK // 2
_LINES = 3 * BLOCK // 8
_PITCH = BLOCK + 8
RATE_A, RATE_Y, RATE_Z = 0, _PITCH, 2 * _PITCH
STEP_A, STEP_Y, STEP_Z = 3 * _PITCH, 4 * _PITCH, 5 * _PITCH
_G, _H, _B, _C = 6 * _PITCH, 7 * _PITCH, 8 * _PITCH, 9 * _PITCH
PAIR_P, PAIR_Q = 10 * _PITCH, 11 * _PITCH
_U, _V, _X, _Y = 12 * _PITCH, 13 * _PITCH, 14 * _PITCH, 15 * _PITCH
SIZE = 16 * _PITCH

SMALL_STEP = 1.0
"""Bound of ``A^2 + Y^2 + Z^2`` [rad^2] up to which the series below and the turn count hold."""

_C1, _C2, _C3, _C4, _C5, _C6, _C7 = (1.0 / math.factorial(2 * k) for k in range(1, 8))
_S0, _S1, _S2, _S3, _S4, _S5, _S6, _S7 = (0.5 / math.factorial(2 * k + 1) for k in range(8))


@kernel
def matrices(w: Array, m: int) -> int:
    """Matrices of ``m`` steps from their increments; returns how many steps are small enough for it.

    ``C - 1`` and ``S/2`` as Taylor series in ``x``, ``|x| <= 1/4``: truncation below 1e-18.
    """
    small = 0
    for j in range(m):
        A, Y, Z = w[STEP_A + j], w[STEP_Y + j], w[STEP_Z + j]
        square_a, square_t = A * A, Y * Y + Z * Z
        small += square_a + square_t <= SMALL_STEP
        x = 0.25 * (square_t - square_a)
        c = x * (_C1 + x * (_C2 + x * (_C3 + x * (_C4 + x * (_C5 + x * (_C6 + x * _C7))))))
        s = _S0 + x * (_S1 + x * (_S2 + x * (_S3 + x * (_S4 + x * (_S5 + x * (_S6 + x * _S7))))))
        w[_G + j], w[_H + j] = c + s * Y, c - s * Y
        w[_B + j], w[_C + j] = s * (A - Z), s * (A + Z)
    return small


@inline
def transfer(w: Array, j: int, p: float, q: float) -> tuple[float, float]:
    """The pair after step ``j``."""
    return (p + w[_G + j] * p) + w[_B + j] * q, (q + w[_H + j] * q) - w[_C + j] * p


@kernel
def chain(w: Array, m: int, p: float, q: float, t: Array, f: Array, out: Array) -> None:
    """Pairs at all samples of a block that starts with ``(p, q)``, not normalised.

    The second half of a full block is multiplied up as a matrix while the first half is worked off as
    a vector: two chains at once, each half as long. Its multiply-adds wait for each other; meanwhile
    the memory fetches what the next block will read and write, a line of 64 bytes at a time: ``t``,
    ``f``, ``out`` begin where that block does. Fetched in one go they would add 2 ns a sample.
    """
    w[PAIR_P], w[PAIR_Q] = p, q
    if m < BLOCK:
        for j in range(m):
            p, q = transfer(w, j, p, q)
            w[PAIR_P + 1 + j], w[PAIR_Q + 1 + j] = p, q
        return
    u, v, x, y = 1.0, 0.0, 0.0, 1.0
    for j in range(HALF):
        if j < _LINES:
            prefetch(f, 8 * j)
        else:
            prefetch(t, 8 * (j - _LINES))
        if j % 4 == 0:
            prefetch(out, 2 * j)
        p, q = transfer(w, j, p, q)
        u, v = transfer(w, HALF + j, u, v)
        x, y = transfer(w, HALF + j, x, y)
        w[PAIR_P + 1 + j], w[PAIR_Q + 1 + j] = p, q
        w[_U + j], w[_V + j], w[_X + j], w[_Y + j] = u, v, x, y
    for j in range(HALF):
        w[PAIR_P + HALF + 1 + j] = w[_U + j] * p + w[_X + j] * q
        w[PAIR_Q + HALF + 1 + j] = w[_V + j] * p + w[_Y + j] * q


@kernel
def rates(w: Array, rate: Array) -> None:
    """Rate [rad/s] at the samples: ``a + y sin(alpha) - z cos(alpha)`` from the pairs."""
    for j in range(rate.size):
        p, q = w[PAIR_P + j], w[PAIR_Q + j]
        square_p, square_q = p * p, q * q
        pull = 2.0 * p * q * w[RATE_Y + j] - (square_q - square_p) * w[RATE_Z + j]
        rate[j] = w[RATE_A + j] + pull / (square_p + square_q)


@kernel
def angles(w: Array, m: int, turns: float, alpha: Array) -> float:
    """Unwrapped angle [rad] after each of ``m`` small steps; returns the turns at the last.

    The first pair of the block has ``Q >= 0``. A turn is completed where ``Q`` changes sign: upwards
    if ``P`` has the old sign of ``Q``.
    """
    negative = 0
    for j in range(m):
        negative += w[PAIR_Q + 1 + j] < 0.0
        rest = double_arctangent(w[PAIR_P + 1 + j], w[PAIR_Q + 1 + j])
        alpha[j] = turns * TWO_PI_HIGH + (turns * TWO_PI_LOW + rest)
    if negative == 0:
        return turns
    before = False
    for j in range(m):
        p, q = w[PAIR_P + 1 + j], w[PAIR_Q + 1 + j]
        if (q < 0.0) != before:
            turns += 1.0 if (p < 0.0) == before else -1.0
            before = not before
        alpha[j] = turns * TWO_PI_HIGH + (turns * TWO_PI_LOW + double_arctangent(p, q))
    return turns
