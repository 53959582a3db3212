"""Blocks of steps of motion, whatever form the input had: to pairs and angles.

The increments ``A, Y, Z`` of the steps stand in the work rows (see :mod:`piga._kernels.motion.transfer`); a block with a
step too large for the fast path is worked off step by step (:func:`piga._kernels.motion.step.advance`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.arithmetic.trig import double_arctangent
from piga._kernels.jit import kernel
from piga._kernels.motion import transfer as block
from piga._kernels.motion.step import advance, unwrapped
from piga._kernels.motion.transfer import PAIR_P, PAIR_Q, STEP_A, STEP_Y, STEP_Z

Array = NDArray[np.float64]

_TOO_LARGE = 1e150
GOOD = -1
"""What the kernels of whole records return when all samples were usable; else the index where a bad block starts."""


@kernel
def stepwise(
    w: Array, m: int, turns: float, p: float, q: float, alpha: Array
) -> tuple[bool, float, float, float]:
    """The block one step of any size after the other; False when an increment is not a usable number."""
    rest = double_arctangent(p, q)
    w[PAIR_P], w[PAIR_Q] = p, q
    for j in range(m):
        A, Y, Z = w[STEP_A + j], w[STEP_Y + j], w[STEP_Z + j]
        if not abs(A) + abs(Y) + abs(Z) < _TOO_LARGE:
            return False, turns, p, q
        turns, rest, p, q = advance(turns, rest, p, q, A, Y, Z)
        w[PAIR_P + 1 + j], w[PAIR_Q + 1 + j] = p, q
        if alpha.size:
            alpha[j] = unwrapped(turns, rest)
    return True, turns, p, q


@kernel
def close_block(w: Array, m: int, turns: float, alpha: Array) -> tuple[float, float, float]:
    """Angles (unless ``alpha`` is empty) from the pairs of a block; turns and unit pair at its end."""
    if alpha.size:
        turns = block.angles(w, m, turns, alpha)
    p, q = w[PAIR_P + m], w[PAIR_Q + m]
    scale = 1.0 / math.sqrt(p * p + q * q)
    if q < 0.0:
        scale = -scale
    return turns, p * scale, q * scale


@kernel
def run_block(
    w: Array, m: int, start: tuple[float, float, float], alpha: Array, ahead: tuple[Array, Array, Array]
) -> tuple[bool, float, float, float]:
    """Pairs and angles (unless ``alpha`` is empty) of a block whose increments stand in ``w``.

    ``start``: turns, P, Q. The times, inputs and outputs ``ahead`` begin where the next block does, to be fetched
    meanwhile.
    """
    turns, p, q = start
    if block.matrices(w, m) < m:
        return stepwise(w, m, turns, p, q, alpha)
    t, f, out = ahead
    block.chain(w, m, p, q, t, f, out)
    turns, p, q = close_block(w, m, turns, alpha)
    return True, turns, p, q
