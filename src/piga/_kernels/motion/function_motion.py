r"""Exact motion under a force that is a polynomial on each panel of time.

A panel contains Chebyshev coefficients of the rates ``a, y, z`` [rad/s], so the force is known at any time on it. The
steps are those of the sixth-order Magnus expansion with Gauss nodes [Blanes2009]. They are as fine as needed and end at the
output times. The user's function is not called again.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels.jit import Array, kernel
from piga._kernels.motion.step import step_functions

Three = tuple[float, float, float]

NODE = math.sqrt(0.6)
"""The outer Gauss nodes of [-1, 1]."""
HALVES_ARE_BETTER = 16.0
"""Assumed error ratio of a whole step to two half steps. For smooth input it is 64; this is a quarter of it."""
MOST_STEPS = 1 << 16
"""Most steps of a panel."""


@kernel
def rates_at(c: Array, x: float, y: float, z: float) -> tuple[Three, Three, Three]:
    """Rates ``a, y, z`` [rad/s] of a panel with coefficients ``c`` (n, 3) at three places in [-1, 1].

    Three sums by Clenshaw's recurrence at once: nine chains keep the processor busy.
    """
    x1, y1, z1 = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    x2, y2, z2 = x1, y1, z1
    for j in range(c.shape[0] - 1, 0, -1):
        u, v, w = c[j, 0], c[j, 1], c[j, 2]
        x1, x2 = (
            (u + 2.0 * x * x1[0] - x2[0], v + 2.0 * x * x1[1] - x2[1], w + 2.0 * x * x1[2] - x2[2]),
            x1,
        )
        y1, y2 = (
            (u + 2.0 * y * y1[0] - y2[0], v + 2.0 * y * y1[1] - y2[1], w + 2.0 * y * y1[2] - y2[2]),
            y1,
        )
        z1, z2 = (
            (u + 2.0 * z * z1[0] - z2[0], v + 2.0 * z * z1[1] - z2[1], w + 2.0 * z * z1[2] - z2[2]),
            z1,
        )
    u, v, w = c[0, 0], c[0, 1], c[0, 2]
    return (
        (u + x * x1[0] - x2[0], v + x * x1[1] - x2[1], w + x * x1[2] - x2[2]),
        (u + y * y1[0] - y2[0], v + y * y1[1] - y2[1], w + y * y1[2] - y2[2]),
        (u + z * z1[0] - z2[0], v + z * z1[1] - z2[1], w + z * z1[2] - z2[2]),
    )


@kernel
def bracket(p: Three, q: Three) -> Three:
    """Commutator of matrices (5) of docs/theory/motion, as increments ``a, y, z``."""
    return (p[2] * q[1] - p[1] * q[2], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0])


@kernel
def combined(u: float, p: Three, v: float, q: Three) -> Three:
    """``u p + v q``."""
    return (u * p[0] + v * q[0], u * p[1] + v * q[1], u * p[2] + v * q[2])


@kernel
def magnus_six(h: float, before: Three, middle: Three, after: Three) -> Three:
    """Increments ``A, Y, Z`` [rad] of a step ``h`` [s] from the rates [rad/s] at its Gauss nodes."""
    one = combined(h, middle, 0.0, middle)
    slope = math.sqrt(15.0) / 3.0 * h
    two = combined(slope, after, -slope, before)
    ends = combined(10.0 / 3.0 * h, after, 10.0 / 3.0 * h, before)
    three = combined(1.0, ends, -20.0 / 3.0, one)
    first = bracket(one, two)
    second = bracket(one, combined(2.0, three, 1.0, first))
    left = combined(1.0, first, -20.0, one)
    left = combined(1.0, left, -1.0, three)
    last = bracket(left, combined(1.0, two, -1.0 / 60.0, second))
    return combined(1.0, combined(1.0, one, 1.0 / 12.0, three), 1.0 / 240.0, last)


@kernel
def step_of_panel(c: Array, h: float, x0: float, x1: float) -> Three:
    """Increments ``A, Y, Z`` [rad] from ``x0`` to ``x1`` in [-1, 1] of a panel of length ``h`` [s]."""
    middle, half = 0.5 * (x0 + x1), 0.5 * (x1 - x0)
    first, second, third = rates_at(c, middle - NODE * half, middle, middle + NODE * half)
    return magnus_six(h * half, first, second, third)


@kernel
def panel_matrix(c: Array, h: float, count: int) -> tuple[float, float, float, float]:
    """Matrix of a panel taken in ``count`` steps, of unit norm: rows ``(p, q)``, ``(r, s)``."""
    p, q, r, s = 1.0, 0.0, 0.0, 1.0
    for j in range(count):
        A, Y, Z = step_of_panel(c, h, 2.0 * j / count - 1.0, 2.0 * (j + 1) / count - 1.0)
        d, w = step_functions(0.25 * (Y * Y + Z * Z - A * A))
        w *= 0.5
        p, r = p + (d * p + w * (Y * p + (A - Z) * r)), r + (d * r - w * ((A + Z) * p + Y * r))
        q, s = q + (d * q + w * (Y * q + (A - Z) * s)), s + (d * s - w * ((A + Z) * q + Y * s))
        scale = 1.0 / math.sqrt(p * p + q * q + r * r + s * s)
        p, q, r, s = scale * p, scale * q, scale * r, scale * s
    return p, q, r, s


@kernel
def steps_of_panels(c: Array, h: Array, tolerance: Array, counts: NDArray[np.int64]) -> None:
    """Number of steps of each panel (m,), doubled until the matrix agrees within ``tolerance`` [rad]."""
    count = 1
    for k in range(h.size):
        count = max(count // 4, 1)
        p, q, r, s = panel_matrix(c[k], h[k], count)
        while True:
            count *= 2
            p1, q1, r1, s1 = panel_matrix(c[k], h[k], count)
            sign = math.copysign(1.0, p * p1 + q * q1 + r * r1 + s * s1)
            p, q, r, s = p1 - sign * p, q1 - sign * q, r1 - sign * r, s1 - sign * s
            error = 2.0 * math.sqrt(p * p + q * q + r * r + s * s) / HALVES_ARE_BETTER
            if error <= tolerance[k] or count >= MOST_STEPS:
                break
            p, q, r, s = p1, q1, r1, s1
        counts[k] = count


@kernel
def lay_steps(
    c: Array,
    start: Array,
    h: Array,
    counts: NDArray[np.int64],
    times: Array,
    steps: Array,
    until: NDArray[np.int64],
) -> None:
    """Increments of all steps in order of time, cut at the output times.

    ``steps`` (counts.sum() + times.size, 3) [rad]; ``until[k]``: steps up to ``times[k]`` [s].
    """
    done, output = 0, 0
    for k in range(h.size):
        x, j = -1.0, 1
        while j <= counts[k]:
            end = 2.0 * j / counts[k] - 1.0
            cut = output < times.size and times[output] < start[k] + h[k]
            stop = min(end, 2.0 * (times[output] - start[k]) / h[k] - 1.0) if cut else end
            if stop > x:
                steps[done, 0], steps[done, 1], steps[done, 2] = step_of_panel(c[k], h[k], x, stop)
                done += 1
                x = stop
            if stop < end:
                until[output] = done
                output += 1
            else:
                j += 1
    until[output:] = done
