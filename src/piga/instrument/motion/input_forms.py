"""Exact motion under other recorded forms of input: velocity increments and constant segments.

Increments use the Magnus expansion at order four [Blanes2009]; a constant segment is one step whatever
its length. Derived in docs/theory/motion.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga._kernels.motion.blocks import GOOD
from piga._kernels.motion.increments import propagate_increments as run_increments
from piga._kernels.motion.step import TWO_PI_HIGH, TWO_PI_LOW, segment_motion, split_turns
from piga.errors import ArgumentError
from piga.instrument.checks import explain, float_array, require_finite, time_array
from piga.instrument.motion.sampled_motion import initial_state
from piga.instrument.parameters import Instrument

Array = NDArray[np.float64]


def propagate_increments(
    inst: Instrument, t: ArrayLike, dv: ArrayLike, base_angle: ArrayLike | None = None
) -> Array:
    """Outer-gimbal angle from velocity increments, as counting or integrating references give them.

    Exact where the direction of the specific force is constant; fourth order in the interval where it
    varies smoothly (its slope over an interval is taken from the neighbouring increments). For force
    that jumps between intervals use :func:`propagate_segments`.

    Parameters
    ----------
    inst:
        The instrument; ``inst.alpha0`` is the angle at ``t[0]``.
    t:
        Interval limits [s], shape (n + 1,), increasing.
    dv:
        Integral of the specific force over each interval [m/s], base axes, shape (n, 3).
    base_angle:
        Integral of the base's inertial rate over each interval [rad], base axes, shape (n, 3).

    Returns
    -------
    alpha:
        Unwrapped angle at the interval limits [rad], shape (n + 1,).

    Raises
    ------
    ArgumentError
        If a shape does not fit, a value is not finite, or times do not increase; names the index.
    """
    times = time_array("t", t, least=2)
    force = float_array("dv", dv, (times.size - 1, 3))
    turning = float_array("base_angle", np.empty((0, 3)))
    if base_angle is not None:
        turning = float_array("base_angle", base_angle, force.shape)
    alpha = np.empty(times.size)
    with np.errstate(all="ignore"):
        status = run_increments(
            times, force, turning, inst.scale_factor, inst.tan_beta, initial_state(inst.alpha0), alpha
        )
    if status != GOOD:
        explain(times, status, dv=force, base_angle=turning)
    alpha[0] = inst.alpha0
    return alpha


def propagate_segments(
    inst: Instrument, durations: ArrayLike, f: ArrayLike, base_rate: ArrayLike | None = None
) -> tuple[Array, Array]:
    """Outer-gimbal angle and rate at the ends of segments of constant specific force, any length each.

    One closed-form step a segment (see :func:`piga.closed_form`): a dividing-head position of hours
    costs what one of milliseconds does, and its revolutions are counted exactly.

    Parameters
    ----------
    inst:
        The instrument; ``inst.alpha0`` is the angle at the start of the first segment.
    durations:
        Lengths of the segments [s], shape (n,), none negative.
    f:
        Specific force in each segment [m/s^2], base axes, shape (n, 3).
    base_rate:
        Inertial rate of the base in each segment [rad/s], base axes, shape (n, 3).

    Returns
    -------
    alpha, rate:
        Unwrapped angle [rad] and rate [rad/s] at the end of each segment, shape (n,) each.

    Raises
    ------
    ArgumentError
        If a shape does not fit, a value is not finite, or a duration is negative; names the index.
    """
    lengths = time_array("durations", durations)
    force = float_array("f", f, (lengths.size, 3))
    omega = np.zeros(force.shape) if base_rate is None else base_rate
    omega = float_array("base_rate", omega, force.shape)
    for name, array in (("durations", lengths), ("f", force), ("base_rate", omega)):
        require_finite(name, array)
    if lengths.min() < 0.0:
        k = int(np.argmax(lengths < 0.0))
        raise ArgumentError(f"durations: {lengths[k]} s at index {k} is negative")
    ends = np.empty((3, lengths.size))
    turns, rest = split_turns(inst.alpha0)
    segment_motion(lengths, force, omega, inst.scale_factor, inst.tan_beta, turns, rest, ends)
    return ends[0] * TWO_PI_HIGH + (ends[0] * TWO_PI_LOW + ends[1]), ends[2]
