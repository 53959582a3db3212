r"""Which of the four regimes a specific force puts the instrument in.

With constant input, ``theta = alpha - gamma`` obeys Adler's equation ``theta' = a + b sin(theta)``
[Adler1946] with ``a = u_x`` and ``b = tan(beta) sqrt(u_Y^2 + u_Z^2)``; [Wei2024] and [Wei2020] tell
the four regimes apart by the signs of ``a`` and ``a^2 - b^2``.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from piga.errors import ArgumentError
from piga.instrument.parameters import Instrument

Regime = Literal["zero", "critical", "locked", "running"]

_ROUNDING = 2.0 * float(np.finfo(np.float64).eps)


def effective_rates(
    inst: Instrument, a_x: float, a_Y: float, a_Z: float, base_rate: ArrayLike | None = None
) -> tuple[float, float, float]:
    """``a = u_x``, ``y = tan(beta) u_Y``, ``z = tan(beta) u_Z`` [rad/s] with ``u = K f - Omega``.

    Parameters
    ----------
    inst:
        The instrument.
    a_x, a_Y, a_Z:
        Specific force in base axes [m/s^2].
    base_rate:
        Inertial rate of the base in base axes, shape (3,) [rad/s]; None: the base does not turn.

    Raises
    ------
    ArgumentError
        If a value is not finite or the base rate does not have three components.
    """
    omega = np.zeros(3) if base_rate is None else np.asarray(base_rate, dtype=float)
    if omega.shape != (3,):
        raise ArgumentError(f"base_rate: shape {omega.shape} instead of (3,)")
    for name, value in (("a_x", a_x), ("a_Y", a_Y), ("a_Z", a_Z), ("base_rate", omega.sum())):
        if not math.isfinite(value):
            raise ArgumentError(f"{name}: {value!r} is not a finite number")
    K = inst.scale_factor
    u_x, u_Y, u_Z = K * a_x - omega[0], K * a_Y - omega[1], K * a_Z - omega[2]
    return float(u_x), float(inst.tan_beta * u_Y), float(inst.tan_beta * u_Z)


def regime(
    inst: Instrument, a_x: float, a_Y: float, a_Z: float, *, base_rate: ArrayLike | None = None
) -> Regime:
    """Regime of the motion under constant input: ``zero``, ``critical``, ``locked`` or ``running``.

    ``zero``: no input along the axis; ``locked``: the output rate decays to zero although there is
    input; ``running``: the gimbal revolves; ``critical``: the border between the last two. ``a`` and
    ``b`` are compared as float64 numbers: critical means that they agree within the rounding of
    the products they come from (4.4e-16 of ``b``), so a force written as ``a_t * tan_beta`` is critical and
    one that differs by 1e-15 is not.

    Parameters
    ----------
    inst:
        The instrument.
    a_x, a_Y, a_Z:
        Constant specific force in base axes [m/s^2].
    base_rate:
        Inertial rate of the base in base axes, shape (3,) [rad/s].

    Raises
    ------
    ArgumentError
        If a value is not finite.

    Examples
    --------
    >>> inst = Instrument(scale_factor="0.8884 rad/s/g", beta="1000 arcsec")
    >>> regime(inst, a_x=9.8, a_Y=49.0, a_Z=0.0)
    'running'
    """
    a, y, z = effective_rates(inst, a_x, a_Y, a_Z, base_rate)
    if a == 0.0:
        return "zero"
    b = math.hypot(y, z)
    if base_rate is None:
        a, b = a_x, abs(inst.tan_beta) * math.hypot(a_Y, a_Z)
    gap = abs(a) - b
    if abs(gap) <= _ROUNDING * b:
        return "critical"
    return "running" if gap > 0.0 else "locked"
