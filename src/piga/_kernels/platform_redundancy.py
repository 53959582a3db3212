"""Kernel that follows the redundancy angle from the pick-off on its axis."""

from __future__ import annotations

from piga._kernels.jit import kernel


@kernel
def follow(pickoff, expected, start, rate, step, gain, rate_gain, out):
    """Second-order tracker of ``pickoff - expected`` [rad]; ``out`` (n,) is the redundancy angle, no lag on a ramp."""
    value = start
    for i in range(pickoff.shape[0]):
        if i > 0:
            value += step * rate
        error = pickoff[i] - expected[i] - value
        value += gain * error
        rate += rate_gain * error
        out[i] = value
