r"""The published closed forms under constant input, one for each regime, for comparison.

[Wei2024] eq. 5 to 11 and [Wei2020], with poles of the tangent, a branch to choose and no count of turns. With
``p = tan(theta/2)``, ``theta = alpha - gamma``, ``r = a_t tan(beta)/a_x``:

1. ``a_x = 0``: ``p = p0 exp(K b t)``;
2. ``|r| = 1``: ``(p - 1)/(p + 1) = K a_x t + (p0 - 1)/(p0 + 1)``, mirrored for negative ``a_x``;
3. ``|r| > 1``: ``(p - p1)/(p - p2) = (p0 - p1)/(p0 - p2) exp(K a_x t sqrt(r^2 - 1))``;
4. ``|r| < 1``: ``p = sqrt(1 - r^2) tan(sqrt(1 - r^2)/2 (K a_x t + C)) - r``.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from piga.errors import ArgumentError
from piga.instrument.parameters import Instrument
from piga.results import Array

Case = Literal[1, 2, 3, 4]


def _case_2(p0: float, phase: Array, sign: float) -> Array:
    m = phase * sign + (sign * p0 - 1.0) / (sign * p0 + 1.0)
    return sign * (1.0 + m) / (1.0 - m)


def _case_3(p0: float, phase: Array, r: float) -> Array:
    root = math.sqrt(r * r - 1.0)
    p1, p2 = -r + root, -r - root
    m = (p0 - p1) / (p0 - p2) * np.exp(phase * root)
    return (p1 - p2 * m) / (1.0 - m)


def _case_4(p0: float, phase: Array, r: float) -> Array:
    root = math.sqrt(1.0 - r * r)
    return root * np.tan(0.5 * root * phase + math.atan((p0 + r) / root)) - r


def published_closed_form(
    case: Case,
    inst: Instrument,
    t: ArrayLike,
    a_x: float,
    a_Y: float,
    a_Z: float,
    *,
    as_published: bool = False,
) -> tuple[Array, Array]:
    """Angle within one turn [rad] and rate [rad/s] by the published form of regime ``case``.

    Parameters
    ----------
    case:
        1 zero input, 2 critical, 3 locked, 4 running; must be the regime of the input.
    inst:
        The instrument; ``inst.alpha0`` is the angle at ``t = 0``.
    t:
        Time [s], any shape.
    a_x, a_Y, a_Z:
        Constant specific force in base axes [m/s^2].
    as_published:
        Use ``|r|`` instead of the signed ``r`` and do not mirror case 2, as printed. Differs only for negative
        ``a_x``, where the printed forms are wrong by 0.03 to 0.04 rad/s on the published data.

    Returns
    -------
    alpha, rate:
        ``alpha`` in (gamma - pi, gamma + pi]: these forms do not count revolutions.

    Raises
    ------
    ArgumentError
        If ``case`` is not 1 to 4, or its formula has no real value for this input.
    """
    a_t = math.hypot(a_Y, a_Z)
    b = a_t * inst.tan_beta
    if case not in (1, 2, 3, 4) or (case == 1) != (a_x == 0.0):
        raise ArgumentError(
            f"case: {case!r} does not fit a_x = {a_x!r} m/s^2",
            remedy="leave case out, or take the one of piga.regime",
        )
    if (case == 3 and abs(a_x) >= abs(b)) or (case == 4 and abs(a_x) <= abs(b)):
        raise ArgumentError(
            f"case: {case!r} has no real value for |a_x/b| = {abs(a_x / b) if b else math.inf}",
            remedy="leave case out, or take the one of piga.regime",
        )
    K, gamma = inst.scale_factor, math.atan2(a_Z, a_Y)
    p0 = math.tan(0.5 * (inst.alpha0 - gamma))
    phase = np.asarray(K * a_x * np.asarray(t, dtype=float))
    r = math.inf if a_x == 0.0 else b / a_x
    if as_published:
        r = abs(r)
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        if case == 1:
            p = np.asarray(p0 * np.exp(K * b * np.asarray(t, dtype=float)))
            rate = K * b * np.sin(2.0 * np.arctan(p))
        else:
            p = {2: _case_2, 3: _case_3, 4: _case_4}[case](p0, phase, math.copysign(1.0, r) if case == 2 else r)
            rate = K * a_x * (1.0 + (math.copysign(1.0, r) if case == 2 else r) * np.sin(2.0 * np.arctan(p)))
    return gamma + 2.0 * np.arctan(p), np.asarray(rate)
