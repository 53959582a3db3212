"""What the twin's rate should differ by from that of the quasi-steady model, by linear theory."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.polynomial import polynomial as poly
from numpy.typing import NDArray
from scipy import signal

from piga.instrument.twin import TwinParameters, loop_poles

Array = NDArray[np.float64]


def stiffened(p: TwinParameters, factor: float) -> TwinParameters:
    """The design with all servo gains multiplied by ``factor``."""
    gains = ("proportional_gain", "integral_gain", "rate_gain")
    return replace(p, **{name: factor * getattr(p, name) for name in gains})


def tilt_compliance(p: TwinParameters, frequency: float) -> complex:
    """Closed-loop tilt per outer-axis torque [rad/(N m)] at ``frequency`` [rad/s]."""
    numerator, denominator = tilt_transfer(p)[0]
    return complex(np.polyval(numerator, 1j * frequency) / np.polyval(denominator, 1j * frequency))


def tilt_transfer(p: TwinParameters) -> list[tuple[Array, Array]]:
    """Closed loop from outer-axis torque to tilt, and to ``(B s^2 + c s + k_r)`` times tilt.

    Numerator and denominator each, descending powers of s.
    """
    inner, H = np.array([p.restoring, p.damping, p.float_inertia_y]), p.angular_momentum
    plant = poly.polyadd(poly.polymul(inner, [p.viscous_friction, p.J_x]), [0.0, H**2])
    servo = np.array([p.integral_gain, p.proportional_gain, p.rate_gain])
    tilt = np.array([0.0, H])
    if p.integral_gain == 0.0:
        servo, tilt, closed = servo[1:], tilt[1:], plant
    else:
        closed = poly.polymul(plant, [0.0, 1.0])
    closed = poly.polyadd(closed, H * servo)
    return [(tilt[::-1], closed[::-1]), (poly.polymul(inner, tilt)[::-1], closed[::-1])]


def predicted_rate_error(p: TwinParameters, t: Array, alpha: Array, f: Array, base_rate: Array) -> Array:
    """Rate of the twin less that of the quasi-steady model with its k0 and k2 [rad/s], (n,).

    Parameters
    ----------
    p:
        The design, beyond spin-up, inside its limits.
    t:
        Equidistant times [s], (n,).
    alpha:
        Gimbal angle [rad], (n,), of the twin or of the quasi-steady model.
    f, base_rate:
        Specific force [m/s^2] and inertial base rate [rad/s] in base axes, (n, 3).

    Notes
    -----
    ``tau = H (u_Y cos(alpha) + u_Z sin(alpha)) - J_x (w' + Omega_x') - c_x w - M_c sign(w) + M_x`` goes
    through the compliance, ``e = G(s) tau``; then ``w_twin - w = (Z(s) e + R)/H + e (u_Y sin(alpha) - u_Z
    cos(alpha))`` with the impedance ``Z = B s^2 + c s + k_r``. ``R`` is the torque that turns the float with the
    base: ``R = B q' - (C - A) p r + D (p^2 - r^2 - K^2 a_x^2)``, ``p = w + Omega_x``, ``q = Omega_Y1``, ``r =
    Omega_Z1``. Errors are of second order in ``e``.
    """
    u = p.K * f - base_rate
    c, s = np.cos(alpha), np.sin(alpha)
    across = u[:, 1] * s - u[:, 2] * c
    w = u[:, 0] + math.tan(p.pick_off_null) * across
    q, r = base_rate[:, 1] * c + base_rate[:, 2] * s, base_rate[:, 2] * c - base_rate[:, 1] * s
    torque = p.angular_momentum * (u[:, 1] * c + u[:, 2] * s) - p.J_x * np.gradient(w + base_rate[:, 0], t)
    torque += p.outer_torque - p.viscous_friction * w - p.coulomb_friction * np.tanh(w / p.coulomb_rate)
    load = complex(u[0, 1], -u[0, 2]) * p.angular_momentum * np.exp(1j * alpha[0])
    tilt, reaction = _through_loop(p, torque, load, float(w[0]), float(t[1] - t[0]))
    turn, unequal = w + base_rate[:, 0], p.float_inertia_z - p.float_inertia_x
    carried = p.float_inertia_y * np.gradient(q, t) - unequal * turn * r
    carried += p.product_of_inertia * (turn**2 - r**2 - (p.K * f[:, 0]) ** 2)
    return np.asarray((reaction + carried) / p.angular_momentum + tilt * across)


def _through_loop(
    p: TwinParameters, torque: Array, load: complex, rate: float, step: float
) -> tuple[Array, Array]:
    """Tilt [rad] and torque ``Z e`` [N m] that the outer-axis ``torque`` makes, linear between samples.

    Before the first sample the torque is that of a gimbal that turns at ``rate``. ``load`` is its rotating part at
    the first sample, as a complex number.
    """
    count = math.ceil(30.0 / -float(np.max(loop_poles(p).real)) / step)
    before = np.arange(-count, 0) * step
    past = (load * (np.exp(1j * rate * before) - 1.0)).real + torque[0]
    whole = np.concatenate([past, torque])
    results = []
    for numerator, denominator in tilt_transfer(p):
        b, a, _ = signal.cont2discrete((numerator, denominator), step, method="foh")
        results.append(signal.lfilter(np.atleast_1d(np.squeeze(b)), a, whole)[count:])
    return results[0], results[1]
