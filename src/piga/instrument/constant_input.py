r"""Motion under constant input in closed form: one expression for all four regimes.

With ``A = u_x t``, ``Y = tan(beta) u_Y t``, ``Z = tan(beta) u_Z t`` and ``x = (Y^2 + Z^2 - A^2)/4``,

.. math::

   \alpha = \alpha_0 + 2\,\mathrm{atan2}\!\left(\tfrac{S}{2}(A + Y\sin\alpha_0 - Z\cos\alpha_0),\;
   C - \tfrac{S}{2}(Y\cos\alpha_0 + Z\sin\alpha_0)\right), \quad
   C = \cosh\sqrt{x},\; S = \frac{\sinh\sqrt{x}}{\sqrt{x}}

This form has no branch and no pole. The rate is ``alpha'(0)`` over the squared length of the same pair, so a decaying
rate keeps its digits. Derived in docs/theory/motion.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from piga._kernels.motion.step import TWO_PI_HIGH, TWO_PI_LOW, constant_motions, split_turns
from piga.errors import ArgumentError
from piga.instrument.parameters import Instrument
from piga.instrument.regimes import adler, float_array, require_finite
from piga.results import Array


def constant_motion(
    inst: Instrument, t: ArrayLike, f: ArrayLike, base_rate: ArrayLike, *, onward: bool
) -> Array:
    """Rows turns, rest [rad], rate [rad/s] (3, n) after times (n,) of constant input; ``onward``: one after the other."""
    times, result = float_array("t", t), np.empty((3, np.size(t)))
    inputs = float_array("f", f), float_array("base_rate", base_rate)
    constant_motions(
        times, *inputs, inst.scale_factor, inst.tan_beta, *split_turns(inst.alpha0), onward, result
    )
    return result


def closed_form_turns(
    inst: Instrument,
    t: ArrayLike,
    a_x: float,
    a_Y: float,
    a_Z: float,
    *,
    base_rate: ArrayLike | None = None,
) -> tuple[Array, Array, Array]:
    """Whole turns, rest [rad] in [-pi, pi] and rate [rad/s] under constant input.

    ``alpha = 2 pi turns + rest``. After 1e9 revolutions ``alpha`` as one float64 resolves 1e-6 rad;
    turns and rest lose nothing. Arguments and errors as in :func:`closed_form`.
    """
    times = np.asarray(t, dtype=float)
    if times.size == 0:
        raise ArgumentError("t: empty", remedy="give at least one time")
    require_finite("t", times.ravel())
    adler(inst, a_x, a_Y, a_Z, base_rate)  # checks the values
    omega = np.zeros(3) if base_rate is None else np.asarray(base_rate, dtype=float)
    result = constant_motion(inst, times.ravel(), [[a_x, a_Y, a_Z]], omega[None], onward=False)
    shaped = result.reshape((3, *times.shape))
    return shaped[0], shaped[1], shaped[2]


def closed_form(
    inst: Instrument,
    t: ArrayLike,
    a_x: float,
    a_Y: float,
    a_Z: float,
    *,
    base_rate: ArrayLike | None = None,
) -> tuple[Array, Array]:
    """Angle and rate under constant input, in any regime and on its borders.

    Equation (4) of docs/theory/motion. The float64 inputs are taken as exact. The phase is computed in double-double.
    So the number of revolutions is exact, and no digits are lost near the separatrix.

    Parameters
    ----------
    inst:
        The instrument; ``inst.alpha0`` is the angle at ``t = 0``.
    t:
        Time since the start [s], scalar or any shape; negative times run backwards.
    a_x, a_Y, a_Z:
        Constant specific force in base axes [m/s^2].
    base_rate:
        Constant inertial rate of the base in base axes, shape (3,) [rad/s]; None: none.

    Returns
    -------
    alpha:
        Unwrapped outer-gimbal angle [rad], the shape of ``t``.
    rate:
        Its derivative [rad/s], the shape of ``t``.

    Raises
    ------
    ArgumentError
        If a value is not finite, or ``t`` is empty.

    Examples
    --------
    >>> inst = Instrument(scale_factor="0.8884 rad/s/g", beta="1000 arcsec", alpha0="45 deg")
    >>> alpha, rate = closed_form(inst, 10.0, 9.80665, 49.03325, 0.0)
    >>> round(float(alpha), 9), round(float(rate), 9)
    (9.707147027, 0.882399502)
    """
    turns, rest, rate = closed_form_turns(inst, t, a_x, a_Y, a_Z, base_rate=base_rate)
    return np.asarray(turns * TWO_PI_HIGH + (turns * TWO_PI_LOW + rest)), rate
