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
from piga.instrument.regimes import effective_rates, float_array, require_finite
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
    effective_rates(inst, a_x, a_Y, a_Z, base_rate)  # checks the values
    omega = np.zeros(3) if base_rate is None else np.asarray(base_rate, dtype=float)
    result = constant_motion(inst, times.ravel(), [[a_x, a_Y, a_Z]], omega[None], onward=False)
    shaped = result.reshape((3, *times.shape))
    return shaped[0], shaped[1], shaped[2]


def closed_form(
    inst: Instrument,
    t: ArrayLike,
    f: ArrayLike | None = None,
    a_Y: float | None = None,
    a_Z: float | None = None,
    *,
    a_x: float | None = None,
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
    f, a_x, a_Y, a_Z:
        Constant specific force in base axes [m/s^2]: ``f`` with shape (3,), as :func:`propagate` takes it for each sample,
        or three scalars.
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
        If a value is not finite, ``t`` is empty, or ``f`` has another shape.

    Examples
    --------
    >>> inst = Instrument(scale_factor="0.8884 rad/s/g", beta="1000 arcsec", alpha0="45 deg")
    >>> alpha, rate = closed_form(inst, 10.0, [9.80665, 49.03325, 0.0])
    >>> round(float(alpha), 9), round(float(rate), 9)
    (9.707147027, 0.882399502)
    """
    force = _force(f, a_x, a_Y, a_Z)
    turns, rest, rate = closed_form_turns(inst, t, *force, base_rate=base_rate)
    return np.asarray(turns * TWO_PI_HIGH + (turns * TWO_PI_LOW + rest)), rate


def _force(
    f: ArrayLike | None, a_x: float | None, a_Y: float | None, a_Z: float | None
) -> tuple[float, float, float]:
    """The three components, given as one array or as scalars."""
    scalars = a_Y is not None or a_Z is not None
    if scalars and a_x is None and f is not None and np.ndim(f) == 0:
        f, a_x = None, float(np.asarray(f))
    if f is None and a_x is not None and a_Y is not None and a_Z is not None:
        return a_x, a_Y, a_Z
    if f is None or scalars or a_x is not None:
        raise ArgumentError(
            "f: the specific force is given twice, or not at all",
            remedy="give f=[a_x, a_Y, a_Z], or a_x, a_Y and a_Z",
        )
    force = np.asarray(f, dtype=float)
    if force.shape != (3,):
        raise ArgumentError(
            f"f: shape {force.shape}, (3,) is needed",
            remedy="a constant force; propagate takes one for each sample",
        )
    x, y, z = force.tolist()
    return x, y, z
