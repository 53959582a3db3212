"""The twin's equations once more, written another way: vectors, a float tensor, Euler's law.

Used as the outside authority of the twin tests; shares no formula with ``piga._kernels.servo``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.integrate import solve_ivp

from piga.instrument.twin import PRESETS

RICH = replace(
    PRESETS["example-floated"],
    product_of_inertia=2e-5,
    pick_off_null=3e-3,
    coulomb_friction=1e-4,
    inner_torque=1e-4,
    outer_torque=2e-3,
    hunting=1e-3,
    alpha0=0.4,
)
"""A design in which every term of the equations is at work."""


def accelerations(p, t, state, f, omega, omega_rate):
    """Solve Euler's equations of float and outer gimbal for (w', v'): linear, hence two probes."""

    def residual(dw, dv):
        alpha, beta, w, v, z = state
        turn_x = np.array([[1, 0, 0], [0, np.cos(alpha), np.sin(alpha)], [0, -np.sin(alpha), np.cos(alpha)]])
        tilt = np.array([[np.cos(beta), 0, -np.sin(beta)], [0, 1, 0], [np.sin(beta), 0, np.cos(beta)]])
        outer = turn_x @ omega + np.array([w, 0, 0])
        outer_rate = turn_x @ omega_rate - np.cross([w, 0, 0], turn_x @ omega) + np.array([dw, 0, 0])
        body = tilt @ outer + np.array([0, v, 0])
        body_rate = tilt @ outer_rate - np.cross([0, v, 0], tilt @ outer) + np.array([0, dv, 0])
        inertia = np.array(
            [
                [p.float_inertia_x, 0, -p.product_of_inertia],
                [0, p.float_inertia_y, 0],
                [-p.product_of_inertia, 0, p.float_inertia_z],
            ]
        )
        h = 2 * np.pi * p.hunting_frequency
        H = p.angular_momentum * (1 + p.hunting * np.sin(h * t + p.hunting_phase))
        dH = p.angular_momentum * p.hunting * h * np.cos(h * t + p.hunting_phase)
        momentum = inertia @ body + np.array([0, 0, H])
        needed = inertia @ body_rate + np.array([0, 0, dH]) + np.cross(body, momentum)
        lever = np.array([0, 0, 1.0]) * p.pendulosity
        weight = np.cross(lever, -(tilt @ turn_x @ f))
        e = np.clip(beta - p.pick_off_null, -p.pick_off_range, p.pick_off_range)
        motor = -(p.proportional_gain * e + p.integral_gain * z + p.rate_gain * v)
        motor = np.clip(motor, -p.torque_limit, p.torque_limit)
        drag = -p.viscous_friction * w - p.coulomb_friction * np.tanh(w / p.coulomb_rate)
        inner = -p.damping * v - p.restoring * (beta - p.restoring_zero) + p.inner_torque
        on_y = needed[1] - weight[1] - inner
        on_x = (tilt.T @ (needed - weight))[0] + p.outer_inertia * outer_rate[0] - motor - drag - p.outer_torque
        return np.array([on_x, on_y])

    at_rest = residual(0.0, 0.0)
    matrix = np.column_stack([residual(1.0, 0.0) - at_rest, residual(0.0, 1.0) - at_rest])
    return np.linalg.solve(matrix, -at_rest)


def solve(p, start, times, force, omega, method="DOP853", rtol=1e-12, atol=1e-14):
    """States at ``times``; ``force(t)``, ``omega(t)`` give vectors, ``omega`` with its rate."""

    def rhs(t, state):
        rate, rate_dot = omega(t)
        dw, dv = accelerations(p, t, state, force(t), rate, rate_dot)
        return [state[2], state[3], dw, dv, state[1] - p.pick_off_null]

    solution = solve_ivp(rhs, (times[0], times[-1]), start, method=method, t_eval=times, rtol=rtol, atol=atol)
    return solution.y.T
