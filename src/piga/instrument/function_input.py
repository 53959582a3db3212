r"""Exact motion under a specific force given as a function of time, to a stated tolerance.

Steps of the sixth-order Magnus expansion with Gauss nodes [Blanes2009]. The matrix of a step does not
depend on the angle, so steps are refined all at once, before the motion is run through them: a step is
halved until its matrix agrees with the product of its halves.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga._kernels.motion import propagate_steps
from piga.errors import ArgumentError
from piga.instrument.checks import require_finite, require_increasing, time_array
from piga.instrument.parameters import Instrument
from piga.instrument.sampled_motion import initial_state

Array = NDArray[np.float64]
Force = Callable[..., ArrayLike]

_NODES = np.array([-0.5, 0.0, 0.5]) * math.sqrt(0.6)
_HALVES_ARE_BETTER = 16.0
"""Halves err 64 times less than the whole in smooth input; a quarter of that is kept in reserve."""
_JUMP_LEVEL, _JUMP_SHARE = 15, 1e-3
"""From this halving on, a step may take this share of the whole tolerance: it holds a jump."""
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
        raise ArgumentError(f"{name}: returned {values[k]} at t = {times[k]} s: not finite numbers")
    return values


def _bracket(p: Array, q: Array) -> Array:
    """Commutators of matrices (5) of docs/theory/motion, as increments ``a, y, z`` in columns."""
    a, y, z = p.T
    b, w, v = q.T
    return np.stack([z * w - y * v, z * b - a * v, a * w - y * b], axis=1)


def magnus_six(h: Array, rates: Array) -> Array:
    """Increments ``A, Y, Z`` [rad] of steps ``h`` (m,) [s] from rates at the Gauss nodes (m, 3, 3)."""
    before, middle, after = (h[:, None] * rates[:, node] for node in range(3))
    two = math.sqrt(15.0) / 3.0 * (after - before)
    three = 10.0 / 3.0 * (after - 2.0 * middle + before)
    first = _bracket(middle, two)
    second = -_bracket(middle, 2.0 * three + first) / 60.0
    last = _bracket(first - 20.0 * middle - three, two + second)
    return np.asarray(middle + three / 12.0 + last / 240.0)


def _matrices(steps: Array) -> Array:
    """Matrices (m, 2, 2) of steps, of unit norm."""
    A, Y, Z = steps.T
    x = 0.25 * (Y * Y + Z * Z - A * A)
    root = np.sqrt(np.abs(x))
    grows = x > 0.0
    c = np.where(grows, 1.0, np.cos(root))
    s = 0.5 * np.where(grows, np.tanh(root), np.sin(root)) / np.where(root > 0.0, root, 1.0)
    s = np.where(root > 0.0, s, 0.5)
    matrices = np.stack([c + s * Y, s * (A - Z), -s * (A + Z), c - s * Y], axis=1).reshape(-1, 2, 2)
    return np.asarray(matrices / np.linalg.norm(matrices, axis=(1, 2), keepdims=True))


def _at_nodes(rates: Callable[[Array], Array], start: Array, h: Array) -> Array:
    """Rates at the Gauss nodes of steps, shape (m, 3, 3): step, node, component."""
    nodes = (start + 0.5 * h)[:, None] + h[:, None] * _NODES
    return rates(nodes.ravel()).reshape(-1, 3, 3)


def _end_weights() -> Array:
    """Weights (2, 6) that continue the polynomial through the nodes of two halves to start and end."""
    x = np.concatenate((0.25 + 0.5 * _NODES, 0.75 + 0.5 * _NODES))
    weights = [
        [np.prod((end - np.delete(x, i)) / (x[i] - np.delete(x, i))) for i in range(6)] for end in (0.0, 1.0)
    ]
    return np.array(weights)


def _unseen(nodes: Array, ends: Array) -> Array:
    """Change [rad/s] at the ends of steps that their nodes do not foretell, times its share of the step.

    ``nodes`` (2, m, 3, 3) of the halves, ``ends`` (2, m, 3). Between an end and the node next to it
    lie 0.056 of the step, where a jump would go unnoticed.
    """
    foretold = np.einsum("ehn,hmnc->emc", _end_weights().reshape(2, 2, 3), nodes)
    return np.asarray(0.06 * np.linalg.norm(foretold - ends, axis=2).max(axis=0))


def _mismatch(whole: Array, first: Array, second: Array) -> Array:
    """Difference [rad] between the matrix of each step and the product of its halves."""
    product = _matrices(second) @ _matrices(first)
    product = product / np.linalg.norm(product, axis=(1, 2), keepdims=True)
    one = _matrices(whole)
    sign = np.sign(np.sum(one * product, axis=(1, 2), keepdims=True))
    return np.asarray(2.0 * np.linalg.norm(one - sign * product, axis=(1, 2)))


def _first_steps(times: Array, longest: float) -> tuple[Array, Array]:
    """Starts and lengths of the first steps: output intervals cut to ``longest``."""
    counts = np.ceil(np.diff(times) / longest * (1.0 - 1e-12)).astype(int)
    if counts.sum() > _MOST_EVALUATIONS:
        raise ArgumentError(f"max_step: {longest} s takes more than {_MOST_EVALUATIONS} steps")
    lengths = np.repeat(np.diff(times) / counts, counts)
    index = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.repeat(times[:-1], counts) + index * lengths, lengths


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

    Steps of order six, each halved until it agrees with its halves; their estimated errors add up to
    less than ``tolerance``. Jumps of the force are passed in tiny steps.

    Parameters
    ----------
    inst:
        The instrument; ``inst.alpha0`` is the angle at ``t[0]``.
    t:
        Output times [s], shape (n,), increasing.
    f:
        Specific force in base axes [m/s^2]: ``f(time) -> (a_x, a_Y, a_Z)``.
    base_rate:
        Inertial rate of the base in base axes [rad/s], likewise.
    tolerance:
        Error of the angle at the last time [rad]; rounding (about 1e-13 rad) comes on top.
    max_step:
        Longest step [s]: a feature of the force much shorter than it can be missed. None: a thousandth
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
            raise ArgumentError(f"{name}: {value!r} is not positive")
    if times.size == 1:
        return np.array([inst.alpha0])

    def rates(at: Array) -> Array:
        return _rates(inst, at, f, base_rate, vectorized)

    span = float(times[-1] - times[0])
    starts, steps = _refined(rates, *_first_steps(times, max_step or 1e-3 * span), tolerance, span)
    alpha = np.empty(times.size)
    alpha[0] = inst.alpha0
    until = np.searchsorted(starts, times[1:], side="left")
    propagate_steps(steps, until, initial_state(inst.alpha0), alpha[1:])
    return alpha


def _refined(
    rates: Callable[[Array], Array], start: Array, h: Array, tolerance: float, span: float
) -> tuple[Array, Array]:
    """Starts (m,) and increments (m, 3) of steps fine enough, in order of time."""
    starts: list[Array] = []
    steps: list[Array] = []
    whole = magnus_six(h, _at_nodes(rates, start, h))
    level, evaluations = 0, 3 * start.size
    while start.size:
        middle, half = start + 0.5 * h, 0.5 * h
        nodes = _at_nodes(rates, np.concatenate((start, middle)), np.tile(half, 2))
        first, second = np.split(magnus_six(np.tile(half, 2), nodes), 2)
        ends = rates(np.concatenate((start, start + h))).reshape(2, -1, 3)
        error = _mismatch(whole, first, second) / _HALVES_ARE_BETTER
        error = np.maximum(error, h * _unseen(nodes.reshape(2, -1, 3, 3), ends))
        good = error <= tolerance * h / span
        if level >= _JUMP_LEVEL:
            good |= error <= _JUMP_SHARE * tolerance
        starts += [start[good], middle[good]]
        steps += [first[good], second[good]]
        bad = ~good
        evaluations += 8 * start.size
        if bad.any() and evaluations > _MOST_EVALUATIONS:
            raise ArgumentError(
                f"f: the tolerance {tolerance} rad cannot be reached at t = {start[bad].min()} s",
                remedy="allow a larger tolerance, or smooth the force",
            )
        start = np.concatenate((start[bad], middle[bad]))
        whole = np.concatenate((first[bad], second[bad]))
        h = np.tile(half[bad], 2)
        level += 1
    order = np.argsort(np.concatenate(starts), kind="stable")
    return np.concatenate(starts)[order], np.ascontiguousarray(np.concatenate(steps)[order])
