r"""Exact motion under a specific force given as a function of time, to a stated tolerance.

The force is approximated by Chebyshev polynomials on panels of time. Panels are halved until the polynomials have
converged. Then the motion is computed from the polynomials, in as many exact steps as needed. The function is called
as rarely as possible, because it costs far more than the motion.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from piga._kernels.motion.function_motion import lay_steps, steps_of_panels
from piga._kernels.motion.step import propagate_steps
from piga.errors import ArgumentError
from piga.instrument.checks import require_finite, require_increasing, time_array
from piga.instrument.motion.sampled_motion import initial_state
from piga.instrument.parameters import Instrument
from piga.results import Array

Force = Callable[..., ArrayLike]

DEGREE = 16
"""Degree of the polynomial of a panel; its nodes include both ends."""
_PANELS = 128
"""Panels at the start, if the caller does not limit their length."""
_JUMP_LEVEL, _JUMP_SHARE = 15, 1e-3
"""After this many halvings a panel holds a jump: it may take this share of the whole tolerance."""
_MOST_EVALUATIONS = 3_000_000


def _rates(inst: Instrument, times: Array, f: Force, base_rate: Force | None, vectorized: bool) -> Array:
    """Effective rates ``a, y, z`` [rad/s] at the times, shape (n, 3)."""
    u = inst.scale_factor * _evaluated("f", f, times, vectorized)
    if base_rate is not None:
        u = u - _evaluated("base_rate", base_rate, times, vectorized)
    return np.asarray(u * np.array([1.0, inst.tan_beta, inst.tan_beta]))


def _evaluated(name: str, function: Force, times: Array, vectorized: bool) -> Array:
    try:
        values = np.asarray(
            function(times) if vectorized else [function(s) for s in times.tolist()], dtype=float
        )
    except ValueError:
        values = np.empty(0)
    if values.shape != (times.size, 3):
        raise ArgumentError(
            f"{name}: does not return three numbers for each time",
            remedy="return (n, 3) for n times, or leave out vectorized=True",
        )
    if not np.isfinite(values).all():
        k = int(np.argmax(~np.isfinite(values).all(axis=1)))
        raise ArgumentError(
            f"{name}: returned {values[k]} at t = {times[k]} s, which is not finite",
            remedy="return finite numbers at all times of the integration",
        )
    return values


def _nodes_and_transform() -> tuple[Array, Array]:
    """Chebyshev nodes of the second kind in [-1, 1], and the matrix from values there to coefficients."""
    index = np.arange(DEGREE + 1)
    ends = np.where((index == 0) | (index == DEGREE), 0.5, 1.0)
    transform = 2.0 / DEGREE * np.cos(np.pi * np.outer(index, index) / DEGREE) * np.outer(ends, ends)
    return -np.cos(np.pi * index / DEGREE), transform[:, ::-1]


_NODES, _TRANSFORM = _nodes_and_transform()


def _unresolved(values: Array, c: Array, start: Array, h: Array) -> Array:
    """Bound [rad] of the error of the angle by the polynomials of the panels, above rounding.

    The next two coefficients, foretold from the last four; beside a jump, which leaves about ``2/(pi n)``
    of itself in each, they are foretold to be as large as the last. The time is rounded, and so the force.
    """
    spacing = np.diff(_NODES)[:, None] * 0.5 * h[:, None, None]
    slope = np.median(np.abs(np.diff(values, axis=1)) / spacing, axis=1)
    ulp = np.spacing(np.abs(start) + h)[:, None]
    rounding = 4.0 * ulp * slope + 32.0 * np.finfo(float).eps * np.abs(values).max(axis=1)
    before, last = np.abs(c[:, -4:-2]).sum(axis=1), np.abs(c[:, -2:]).sum(axis=1)
    decay = np.divide(last, before, out=np.ones_like(last), where=last < before)
    left_out = np.maximum(last - rounding, 0.0) * decay
    return np.asarray(h * np.linalg.norm(left_out, axis=1))


def propagate_function(
    inst: Instrument,
    t: ArrayLike,
    f: Force,
    base_rate: Force | None = None,
    *,
    tolerance: float = 1e-10,
    max_step: float | None = None,
    vectorized: bool = False,
) -> Array:
    """Outer-gimbal angle under a specific force given as a function of time.

    The force is approximated by polynomials of degree 16 on panels of time. The motion is computed in steps of order
    six. Panels are halved and steps are doubled until their estimated errors add up to less than ``tolerance``. A
    jump of the force gets very short panels.

    Parameters
    ----------
    inst:
        The instrument; ``inst.alpha0`` is the angle at ``t[0]``.
    t:
        Output times [s], shape (n,), increasing.
    f:
        Specific force in base axes [m/s^2]: ``f(time) -> (a_x, a_Y, a_Z)``.
    base_rate:
        Inertial rate of the base in base axes [rad/s], as a function of time like ``f``; None: the base does not
        turn.
    tolerance:
        Largest error of the angle at the last time [rad], without rounding (about 1e-13 rad).
    max_step:
        Longest panel [s]: a feature of the force shorter than a tenth of it can be missed. None: 1/128
        of the time from first to last.
    vectorized:
        The functions take an array of times (m,) and return (m, 3): much faster.

    Returns
    -------
    alpha:
        Unwrapped angle at the output times [rad], shape (n,).

    Raises
    ------
    ArgumentError
        If times do not increase, the tolerance is not positive, a function returns something else
        than three finite numbers, or the tolerance cannot be reached (the message names the time).
    """
    times = time_array("t", t)
    require_finite("t", times)
    require_increasing("t", times)
    for name, value in (("tolerance", tolerance), ("max_step", max_step)):
        if value is not None and not value > 0.0:
            raise ArgumentError(f"{name}: {value!r} is not positive", remedy="use a positive value")
    alpha = np.full(times.size, inst.alpha0)
    if times.size == 1:
        return alpha
    first, span = float(times[0]), float(times[-1] - times[0])
    count = _PANELS if max_step is None else int(np.ceil(min(span / max_step, 1e18) * (1.0 - 1e-12)))
    if count * (DEGREE + 1) > _MOST_EVALUATIONS:
        raise ArgumentError(
            f"max_step: {max_step} s takes more than {_MOST_EVALUATIONS} evaluations",
            remedy="use a larger max_step",
        )

    def rates(at: Array) -> Array:
        return _rates(inst, at, f, base_rate, vectorized)

    edges = first + span * np.arange(count + 1) / count
    c, start, h = _panels(rates, edges[:-1], np.diff(edges), tolerance, span)
    counts = np.empty(h.size, dtype=np.int64)
    steps_of_panels(c, h, np.maximum(0.5 * tolerance * h / span, 1e-15), counts)
    steps, until = np.empty((int(counts.sum()) + times.size, 3)), np.empty(times.size - 1, dtype=np.int64)
    lay_steps(c, start, h, counts, times[1:], steps, until)
    propagate_steps(steps, until, initial_state(inst.alpha0), alpha[1:])
    return alpha


def _panels(
    rates: Callable[[Array], Array], start: Array, h: Array, tolerance: float, span: float
) -> tuple[Array, Array, Array]:
    """Coefficients (m, 17, 3), starts and lengths (m,) of panels that resolve the force, in order of time."""
    done: list[tuple[Array, Array, Array]] = []
    level, evaluations = 0, 0
    while start.size:
        at = start[:, None] + 0.5 * h[:, None] * (1.0 + _NODES)
        values = rates(at.ravel()).reshape(start.size, -1, 3)
        c = np.matmul(_TRANSFORM, values)
        error = _unresolved(values, c, start, h)
        good = error <= 0.5 * tolerance * h / span
        if level >= _JUMP_LEVEL:
            good |= (error <= _JUMP_SHARE * tolerance) | (h <= 8.0 * np.spacing(np.abs(start)))
        done.append((c[good], start[good], h[good]))
        bad = ~good
        evaluations += at.size
        if bad.any() and evaluations > _MOST_EVALUATIONS:
            raise ArgumentError(
                f"f: the tolerance {tolerance} rad cannot be reached at t = {start[bad].min()} s",
                remedy="allow a larger tolerance, or smooth the force",
            )
        start, h = np.concatenate((start[bad], start[bad] + 0.5 * h[bad])), np.tile(0.5 * h[bad], 2)
        level += 1
    coefficients, starts, lengths = (np.concatenate(parts) for parts in zip(*done, strict=True))
    order = np.argsort(starts, kind="stable")
    return coefficients[order], starts[order], lengths[order]
