"""What the twin does beyond the quasi-steady model, to first order in the tilt (own derivation, docs/twin.md).

The torque on the outer axis, ``tau = H (u_Y cos(alpha) + u_Z sin(alpha))`` with ``u = K f - Omega``, ripples
the tilt through the servo's compliance ``G(s)``; the tilt pulls the output rate directly, through damping and
restoring torque about the inner axis, and through the transverse input, which it rectifies.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga.instrument.twin_linear import inner_impedance, tilt_compliance
from piga.instrument.twin_parameters import TwinParameters

Array = NDArray[np.float64]


def predicted_rate_error(p: TwinParameters, alpha: Array, rate: Array, f: Array, base_rate: Array) -> Array:
    """Rate of the twin less that of the quasi-steady model [rad/s], (n,).

    Parameters
    ----------
    p:
        The design.
    alpha, rate:
        Gimbal angle [rad] and its rate [rad/s], (n,); the rate changes slowly over a revolution.
    f, base_rate:
        Specific force [m/s^2] and inertial base rate [rad/s] in base axes, (n, 3), slowly changing.

    Notes
    -----
    ``e = Re(G(j w) tau)`` and ``w_twin - w = Re(Z(j w) G(j w) tau)/H + e (u_Y sin(alpha) - u_Z cos(alpha))``,
    with ``tau = H (u_Y - j u_Z) exp(j alpha)`` and the impedance ``Z = B s^2 + c s + k_r``. Constant torques
    on the outer axis shift the tilt only if the servo does not integrate; then ``k_p e = M_x - M_c sign(w)``
    adds to ``e``. A turning base adds ``((B + A - C) w - (C - A) Omega_x) Omega_Z1/H``: the float itself is
    carried round. Left out: second order in ``e``, acceleration of alpha and of the base.
    """
    u = p.K * f - base_rate
    torque = p.angular_momentum * (u[:, 1] - 1j * u[:, 2]) * np.exp(1j * alpha)
    compliance = _compliance(p, rate)
    tilt = (compliance * torque).real + static_tilt(p, rate)
    direct = (inner_impedance(p, rate) * compliance * torque).real / p.angular_momentum
    across = base_rate[:, 2] * np.cos(alpha) - base_rate[:, 1] * np.sin(alpha)
    unequal = p.float_inertia_z - p.float_inertia_x
    carried = ((p.float_inertia_y - unequal) * rate - unequal * base_rate[:, 0]) * across / p.angular_momentum
    return np.asarray(direct + carried + tilt * (u[:, 1] * np.sin(alpha) - u[:, 2] * np.cos(alpha)))


def _compliance(p: TwinParameters, rate: Array) -> NDArray[np.complex128]:
    """``G(j w)``; at a standstill an integrating servo yields nothing."""
    moving = np.where(rate == 0.0, 1e-12, rate)
    return np.asarray(
        np.where(moving < 0.0, tilt_compliance(p, np.abs(moving)).conj(), tilt_compliance(p, moving))
    )


def static_tilt(p: TwinParameters, rate: Array) -> Array:
    """Tilt from pick-off null [rad] that constant outer torque and Coulomb friction hold, (n,)."""
    if p.integral_gain > 0.0 or p.proportional_gain == 0.0:
        return np.zeros(np.shape(rate))
    friction = p.coulomb_friction * np.tanh(np.asarray(rate) / p.coulomb_rate)
    return np.asarray((p.outer_torque - friction - p.viscous_friction * np.asarray(rate)) / p.proportional_gain)


def predicted_rectification(p: TwinParameters, a_t: float, rate: float) -> float:
    """Shift of the mean output rate by finite servo stiffness [rad/s].

    ``-K a_t^2 ml Im G(j w)/2``. For strong integral action ``G = j w/k_i``: the theory page's
    ``-K a_t^2 ml w/(2 k_i)``.
    """
    compliance = tilt_compliance(p, [abs(rate)])[0]
    return float(-0.5 * p.K * a_t**2 * p.pendulosity * compliance.imag * np.sign(rate))


def predicted_second_harmonic(p: TwinParameters, a_t: float, rate: float) -> float:
    """Amplitude of the rate at twice the gimbal angle, by finite servo stiffness [rad/s]."""
    return float(0.5 * p.K * a_t**2 * p.pendulosity * abs(tilt_compliance(p, [abs(rate)])[0]))


def predicted_k2(p: TwinParameters) -> float:
    """Coefficient k2 [1/(m/s^2)] from the float's inertia: ``(D - (C - A) beta) K^2/ml`` to first order.

    The product of inertia ``D`` gives a centrifugal torque ``D w^2`` about the inner axis; with a tilt, unequal
    inertias are a product of inertia about the outer axis. In g/g^2 it is the theory page's ``D K^2 g/ml``.
    """
    twice = 2.0 * p.pick_off_null
    unequal = 0.5 * (p.float_inertia_x - p.float_inertia_z) * math.sin(twice)
    return (p.product_of_inertia * math.cos(twice) + unequal) * p.K**2 / p.pendulosity
