"""Kernel that follows the redundancy angle from the pick-off on its axis."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from piga._kernels.jit import kernel

Array = NDArray[np.float64]


@kernel
def follow(
    pickoff: Array,
    expected: Array,
    start: float,
    rate: float,
    step: float,
    gain: float,
    rate_gain: float,
    out: Array,
) -> None:
    """Track ``pickoff - expected`` [rad] to second order; ``out`` (n,) has no lag on a ramp."""
    value = start
    for i in range(pickoff.shape[0]):
        if i > 0:
            value += step * rate
        error = pickoff[i] - expected[i] - value
        value += gain * error
        rate += rate_gain * error
        out[i] = value
