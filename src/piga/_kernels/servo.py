"""Rigid-body servo twin: right-hand side and error-controlled integration, on scalars and arrays.

The state is ``(alpha, beta, w, v, z)``: outer-gimbal angle, rotor tilt, their rates, integral of the pick-off
signal. The equations are derived in ``docs/theory/twin.md`` (own derivation from the angular momentum of the
outer gimbal and float). With equal float inertias, no product of inertia and a base that does not turn
they are the twin equations of the theory page.

Force and base rate are linear between nodes. Noise is constant from a node to the next.
"""

from __future__ import annotations

import math
from collections import namedtuple
from typing import NamedTuple

import numpy as np

from piga._kernels.jit import Array, kernel

STATES = 5
_STAGES = 12
_MAX_TRIES = 100_000


ServoConstants = namedtuple(
    "ServoConstants",
    "H ml J_o A B C D c k_r beta_r c_x M_c w_c k_p k_i k_d beta_null e_max M_max beta_stop k_stop c_stop M_x M_y "
    "h_w f_w phi_w s_0 t_s",
)
"""Numbers the right-hand side needs, SI: the symbols of :class:`piga.instrument.twin.TwinParameters`."""


@kernel
def wheel(p: ServoConstants, t: float) -> tuple[float, float]:
    """Rotor angular momentum and its rate of change at ``t`` (spin-up times hunting)."""
    if p.h_w == 0.0 and p.s_0 == 1.0:
        return p.H, 0.0
    rest, rate = (1.0 - p.s_0) * math.exp(-t / p.t_s), 2.0 * math.pi * p.f_w
    up, up_rate = 1.0 - rest, rest / p.t_s
    phase = rate * t + p.phi_w
    ripple, ripple_rate = 1.0 + p.h_w * math.sin(phase), p.h_w * rate * math.cos(phase)
    return p.H * up * ripple, p.H * (up_rate * ripple + up * ripple_rate)


@kernel
def friction(p: ServoConstants, w: float) -> float:
    """Torque of viscous and Coulomb friction on the outer axis [N m], the latter smoothed as tanh."""
    return -p.c_x * w - p.M_c * math.tanh(w / p.w_c)


@kernel
def _stop_torque(p: ServoConstants, beta: float, v: float) -> float:
    """Torque of the stops on the float [N m]: continuous at contact, more when going in, never pulling."""
    if beta > p.beta_stop:
        return -p.k_stop * (beta - p.beta_stop) * max(0.0, 1.0 + p.c_stop * v)
    if beta < -p.beta_stop:
        return -p.k_stop * (beta + p.beta_stop) * max(0.0, 1.0 - p.c_stop * v)
    return 0.0


class Method(NamedTuple):
    """Coefficients of the Runge-Kutta method: stages, weights, nodes and both error estimates."""

    tableau: Array
    weights: Array
    nodes: Array
    E3: Array
    E5: Array


@kernel
def derivative(p: ServoConstants, t: float, x: Array, inputs: Array, out: Array) -> None:
    """Write the time derivative of the state ``x`` into ``out``.

    ``inputs`` (12,): specific force [m/s^2], base rate [rad/s], noise of both torques and the pick-off, rate of change of the
    base rate; three each.
    """
    a_x, a_Y, a_Z = inputs[0], inputs[1], inputs[2]
    o_x, o_Y, o_Z = inputs[3], inputs[4], inputs[5]
    n_x, n_y, n_e = inputs[6], inputs[7], inputs[8]
    do_x, do_Y, do_Z = inputs[9], inputs[10], inputs[11]
    alpha, beta, w, v, z = x[0], x[1], x[2], x[3], x[4]
    sa, ca = math.sin(alpha), math.cos(alpha)
    sb, cb = math.sin(beta), math.cos(beta)
    H, H_rate = wheel(p, t)
    # base rate in outer-gimbal axes, and its rate of change there
    q, r = o_Y * ca + o_Z * sa, -o_Y * sa + o_Z * ca
    dq, dr = do_Y * ca + do_Z * sa + w * r, -do_Y * sa + do_Z * ca - w * q
    turn = w + o_x
    spin_x, spin_z = turn * cb - r * sb, turn * sb + r * cb
    # inertia about the outer axis and its cross term with Z1, at this tilt
    J = p.J_o + p.A * cb * cb + p.C * sb * sb - 2.0 * p.D * sb * cb
    E = (p.C - p.A) * sb * cb - p.D * (cb * cb - sb * sb)
    E_tilt = (p.C - p.A) * (cb * cb - sb * sb) + 4.0 * p.D * sb * cb
    L_Z1 = turn * E + r * (p.A * sb * sb + p.C * cb * cb + 2.0 * p.D * sb * cb) + H * cb
    # servo
    e = min(max(beta - p.beta_null + n_e, -p.e_max), p.e_max)  # the pick-off's signal within its range
    asked = -(p.k_p * e + p.k_i * z + p.k_d * v)
    motor = min(max(asked, -p.M_max), p.M_max)
    winding = asked != motor and e * asked < 0.0
    # outer axis
    torque_x = p.ml * cb * (a_Y * ca + a_Z * sa) + motor + friction(p, w) + p.M_x + n_x
    gyro_x = (
        H * cb * v + H_rate * sb + 2.0 * E * v * turn + E * dr + E_tilt * v * r + q * L_Z1 - r * p.B * (q + v)
    )
    # inner axis
    along = a_x * cb + sb * (a_Y * sa - a_Z * ca)
    torque_y = -p.ml * along - p.c * v - p.k_r * (beta - p.beta_r) + _stop_torque(p, beta, v) + p.M_y + n_y
    gyro_y = H * spin_x + (p.C - p.A) * spin_x * spin_z + p.D * (spin_z * spin_z - spin_x * spin_x)
    out[0] = w
    out[1] = v
    out[2] = (torque_x - gyro_x) / J - do_x
    out[3] = (torque_y + gyro_y) / p.B - dq
    out[4] = 0.0 if winding else e


@kernel
def _between(
    p: ServoConstants, x: Array, t: Array, nodes: Array, i: int, now: float, inputs: Array, out: Array
) -> None:
    """Derivative ``now`` [s] after node ``i``; ``inputs`` (12,) is room."""
    span = t[i + 1] - t[i]
    for j in range(6):
        inputs[j] = nodes[i, j] + now / span * (nodes[i + 1, j] - nodes[i, j])
    for j in range(3):
        inputs[6 + j] = nodes[i, 6 + j]
        inputs[9 + j] = (nodes[i + 1, 3 + j] - nodes[i, 3 + j]) / span
    derivative(p, t[i] + now, x, inputs, out)


@kernel
def _error_ratio(K: Array, E3: Array, E5: Array, h: float, tolerance: Array) -> tuple[float, float]:
    """Local error over tolerance (largest of the states), and local error of alpha [rad]."""
    worst, alpha_error = 0.0, 0.0
    for j in range(STATES):
        low, high = 0.0, 0.0
        for s in range(_STAGES + 1):
            low += E3[s] * K[s, j]
            high += E5[s] * K[s, j]
        scale = math.sqrt(high * high + 0.01 * low * low)
        error = h * high * high / scale if scale > 0.0 else 0.0
        if j == 0:
            alpha_error = error
        share = error / tolerance[j]
        if not math.isfinite(share):
            return math.inf, 0.0
        worst = max(worst, share)
    return worst, alpha_error


@kernel
def integrate(
    p: ServoConstants, t: Array, nodes: Array, x: Array, h: float, tolerance: Array, method: Method, out: Array
) -> tuple[float, int, int]:
    """Integrate from node to node; ``out[i]`` is the state at ``t[i]``; ``x`` is start and end state.

    ``nodes`` (n, 9): specific force [m/s^2] and base rate [rad/s], linear between nodes; noise of both torques [N m] and the
    pick-off [rad]. Returns the sum of the local errors of alpha [rad], the number of steps
    taken, and the node after which the step became smaller than 1e-13 of the interval or ``_MAX_TRIES``
    steps did not reach the next node (else -1).
    """
    K = np.empty((_STAGES + 1, STATES))
    y, inputs = np.empty(STATES), np.empty(12)
    total_error, steps = 0.0, 0
    for j in range(STATES):
        out[0, j] = x[j]
    for i in range(t.shape[0] - 1):
        span, done, tries = t[i + 1] - t[i], 0.0, 0
        _between(p, x, t, nodes, i, 0.0, inputs, K[0])
        while done < span:
            rest = span - done
            step = rest if h >= rest else (0.5 * rest if 2.0 * h > rest else h)
            tries += 1
            for s in range(1, _STAGES + 1):
                weights = method.tableau[s] if s < _STAGES else method.weights
                for j in range(STATES):
                    total = 0.0
                    for m in range(s):
                        total += weights[m] * K[m, j]
                    y[j] = x[j] + step * total
                _between(
                    p, y, t, nodes, i, done + (method.nodes[s] if s < _STAGES else 1.0) * step, inputs, K[s]
                )
            ratio, alpha_error = _error_ratio(K, method.E3, method.E5, step, tolerance)
            factor = 5.0 if ratio < 1e-7 else min(5.0, max(0.2, 0.9 * ratio ** (-0.125)))
            if ratio <= 1.0:
                for j in range(STATES):
                    x[j] = y[j]
                    K[0, j] = K[_STAGES, j]
                done = span if step == rest else done + step
                total_error += alpha_error
                steps += 1
                h = max(h, step * factor) if step < h else step * factor
            else:
                h = step * min(factor, 0.9) if math.isfinite(ratio) else step * 0.1
            if h < 1e-13 * span or tries == _MAX_TRIES:
                return total_error, steps, i
        for j in range(STATES):
            out[i + 1, j] = x[j]
    return total_error, steps, -1
