r"""Exact motion under other forms of input: velocity increments, constant segments, a function of time.

Increments and functions use the Magnus expansion at order four and six [Blanes2009]; a constant
segment is one step whatever its length. Derived in docs/theory/motion.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga._kernels.motion import TWO_PI_HIGH, TWO_PI_LOW, advance, segment_motion, split_turns, unwrapped
from piga._kernels.motion_records import GOOD
from piga._kernels.motion_records import propagate_increments as run_increments
from piga.errors import ArgumentError
from piga.instrument.checks import explain, float_array, require_finite, require_increasing, time_array
from piga.instrument.parameters import Instrument
from piga.instrument.sampled_motion import initial_state

Array = NDArray[np.float64]
Vector = tuple[float, float, float]

_NODE = 0.5 * math.sqrt(0.6)
_SMALLEST_STEP = 1e-13
_JUMP_STEP = 1e-5
_SAFETY, _SHRINK, _GROW = 0.9, 0.2, 4.0


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


def _bracket(p: Vector, q: Vector) -> Vector:
    """Commutator of two matrices (5) of docs/theory/motion, as increments ``(a, y, z)``."""
    return (
        p[2] * q[1] - p[1] * q[2],
        p[2] * q[0] - p[0] * q[2],
        p[0] * q[1] - p[1] * q[0],
    )


def _sum(*terms: tuple[float, Vector]) -> Vector:
    a, y, z = (math.fsum(factor * vector[i] for factor, vector in terms) for i in range(3))
    return a, y, z


def _magnus_six(h: float, u: tuple[Vector, Vector, Vector]) -> tuple[Vector, Vector]:
    """Increments of order six from effective rates at the Gauss nodes, and of order four."""
    one = _sum((h, u[1]))
    two = _sum((h * math.sqrt(15.0) / 3.0, u[2]), (-h * math.sqrt(15.0) / 3.0, u[0]))
    three = _sum((h * 10.0 / 3.0, u[2]), (-h * 20.0 / 3.0, u[1]), (h * 10.0 / 3.0, u[0]))
    mean = _sum((1.0, one), (1.0 / 12.0, three))
    first = _bracket(one, two)
    second = _sum((-1.0 / 30.0, _bracket(one, three)), (-1.0 / 60.0, _bracket(one, first)))
    last = _bracket(_sum((-20.0, one), (-1.0, three), (1.0, first)), _sum((1.0, two), (1.0, second)))
    return _sum((1.0, mean), (1.0 / 240.0, last)), _sum((1.0, mean), (-1.0 / 12.0, first))


def _quadrature_difference(
    h: float, at_start: Vector, nodes: tuple[Vector, Vector, Vector], at_end: Vector
) -> float:
    """Mean increments by Gauss's rule less those by Simpson's [rad]: it sees a jump anywhere in the step."""
    gauss = _sum((5.0, nodes[0]), (8.0, nodes[1]), (5.0, nodes[2]))
    simpson = _sum((3.0, at_start), (12.0, nodes[1]), (3.0, at_end))
    return h / 18.0 * math.dist(gauss, simpson)


def propagate_function(
    inst: Instrument,
    t: ArrayLike,
    f: Callable[[float], ArrayLike],
    base_rate: Callable[[float], ArrayLike] | None = None,
    *,
    tolerance: float = 1e-10,
    max_step: float | None = None,
) -> Array:
    """Outer-gimbal angle under a specific force given as a function of time.

    Steps of order six whose length follows from the difference to rules of order four: the sum of
    the estimated local errors stays below ``tolerance`` over the whole time. Half of the tolerance is
    kept for jumps of the force, a few dozen of which are passed in tiny steps.

    Parameters
    ----------
    inst:
        The instrument; ``inst.alpha0`` is the angle at ``t[0]``.
    t:
        Output times [s], shape (n,), increasing.
    f:
        Specific force in base axes [m/s^2] at a time [s]: ``f(time) -> (a_x, a_Y, a_Z)``.
    base_rate:
        Inertial rate of the base in base axes [rad/s] at a time [s].
    tolerance:
        Error of the angle to be reached at the last time [rad].
    max_step:
        Longest step [s]: a feature of the force much shorter than it can be missed. None: a thousandth
        of the time from first to last.

    Returns
    -------
    alpha:
        Unwrapped angle at the output times [rad], shape (n,).

    Raises
    ------
    ArgumentError
        If times do not increase, the tolerance is not positive, the function returns something else
        than three finite numbers, or the tolerance cannot be reached (the message names the time).
    """
    times = time_array("t", t)
    require_finite("t", times)
    require_increasing("t", times)
    for name, value in (("tolerance", tolerance), ("max_step", max_step)):
        if value is not None and not value > 0.0:
            raise ArgumentError(f"{name}: {value!r} is not positive")
    K, tan_beta = inst.scale_factor, inst.tan_beta

    def rates(time: float) -> Vector:
        u = K * _three("f", f(time), time)
        if base_rate is not None:
            u = u - _three("base_rate", base_rate(time), time)
        return float(u[0]), tan_beta * float(u[1]), tan_beta * float(u[2])

    span = times[-1] - times[0]
    turns, rest = split_turns(inst.alpha0)
    state = (turns, rest, math.sin(0.5 * rest), math.cos(0.5 * rest))
    alpha = np.empty(times.size)
    alpha[0] = inst.alpha0
    longest = 1e-3 * span if max_step is None else max_step
    h, for_jumps = longest, 0.5 * tolerance
    at_start = rates(float(times[0]))
    for k in range(1, times.size):
        time, end = float(times[k - 1]), float(times[k])
        while time < end:
            step = min(h, end - time)
            middle = time + 0.5 * step
            nodes = (rates(middle - _NODE * step), rates(middle), rates(middle + _NODE * step))
            at_end = rates(time + step)
            best, coarse = _magnus_six(step, nodes)
            error = max(math.dist(best, coarse), _quadrature_difference(step, at_start, nodes, at_end))
            allowed = 0.5 * tolerance * step / span
            if _SMALLEST_STEP < step / span < _JUMP_STEP and allowed < error <= 0.25 * for_jumps:
                allowed, for_jumps = error, for_jumps - error
            if error <= allowed:
                state, at_start = advance(*state, *best), at_end
                time = end if step == end - time else time + step
            elif step < _SMALLEST_STEP * span:
                raise ArgumentError(
                    f"f: the tolerance {tolerance} rad cannot be reached at t = {time} s",
                    remedy="split the time at jumps of the force, or allow a larger tolerance",
                )
            factor = _SAFETY * (allowed / error) ** 0.25 if error > 0.0 else _GROW
            if error > allowed or step == h or factor < 1.0:
                h = min(step * min(max(factor, _SHRINK), _GROW), longest)
        alpha[k] = unwrapped(state[0], state[1])
    return alpha


def _three(name: str, values: ArrayLike, time: float) -> Array:
    vector = np.asarray(values, dtype=float)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ArgumentError(f"{name}: returned {values!r} at t = {time} s instead of three finite numbers")
    return vector
