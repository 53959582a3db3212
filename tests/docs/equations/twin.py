"""Equations of docs/theory/twin.md."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from piga._kernels.motion.servo import derivative, friction, wheel
from piga.frames import axis_turn
from piga.instrument.twin.linear import (
    open_loop,
    predicted_k2,
    predicted_rectification,
    predicted_second_harmonic,
    tilt_compliance,
)
from piga.units import G0
from tests.instrument.rigid_body import RICH as DESIGN

from .registry import Pair, equation

P = DESIGN.constants()
TIME = 0.3
STATE = np.array([0.7, 4e-3, 1.1, -0.06, 2e-4])
"""Gimbal angle, tilt, their rates, integral of the pick-off: off its rest in everything, within all limits."""
FORCE = np.array([9.0, 4.0, -3.0])
OMEGA, OMEGA_RATE = np.array([0.05, -0.08, 0.11]), np.array([0.3, 0.2, -0.1])


def rates(state: np.ndarray, omega: np.ndarray) -> tuple[float, float, float]:
    """``p, q, r`` as printed."""
    alpha, _, w, _, _ = state
    q = omega[1] * np.cos(alpha) + omega[2] * np.sin(alpha)
    return w + omega[0], q, -omega[1] * np.sin(alpha) + omega[2] * np.cos(alpha)


def float_rates(state: np.ndarray, omega: np.ndarray) -> np.ndarray:
    beta, (p, q, r) = state[1], rates(state, omega)
    return np.array([p * np.cos(beta) - r * np.sin(beta), q + state[3], p * np.sin(beta) + r * np.cos(beta)])


def momentum(state: np.ndarray, omega: np.ndarray, H: float) -> np.ndarray:
    """``L`` as printed, along X1, y and Z1."""
    x, y, z = float_rates(state, omega)
    L = np.array([P.A * x - P.D * z, P.B * y, P.C * z - P.D * x + H])
    return axis_turn(1, -state[1]) @ L


def servo_torque() -> float:
    return -(P.k_p * (STATE[1] - P.beta_null) + P.k_i * STATE[4] + P.k_d * STATE[3])


def torques() -> tuple[float, float]:
    """About X1 and about y."""
    (a_x, a_Y, a_Z), alpha, beta = FORCE, STATE[0], STATE[1]
    outer = P.ml * np.cos(beta) * (a_Y * np.cos(alpha) + a_Z * np.sin(alpha))
    along = a_x * np.cos(beta) + np.sin(beta) * (a_Y * np.sin(alpha) - a_Z * np.cos(alpha))
    inner = -P.ml * along - P.c * STATE[3] - P.k_r * (beta - P.beta_r) + P.M_y
    return outer + servo_torque() + friction(P, STATE[2]) + P.M_x, inner


def motion() -> np.ndarray:
    """Derivative of the state, from the library."""
    out = np.empty(5)
    derivative(P, TIME, STATE, np.array([*FORCE, *OMEGA, 0.0, 0.0, 0.0, *OMEGA_RATE]), out)
    return out


@equation("twin-rates")
def _rates() -> Iterator[Pair]:
    turned = axis_turn(0, STATE[0]) @ OMEGA + np.array([STATE[2], 0.0, 0.0])
    yield rates(STATE, OMEGA), turned, 1e-15


@equation("twin-momentum")
def _momentum() -> Iterator[Pair]:
    """Along the library's motion the momentum changes by the torques (Euler's law, in the gimbal's axes)."""
    step, flow = 1e-4, motion()

    def total(h: float) -> np.ndarray:
        state, omega = STATE + h * flow, OMEGA + h * OMEGA_RATE
        outer = np.array([P.J_o * rates(state, omega)[0], 0.0, 0.0])
        return momentum(state, omega, wheel(P, TIME + h)[0]) + outer

    change = (total(step) - total(-step)) / (2 * step)
    p, q, r = rates(STATE, OMEGA)
    whole = momentum(STATE, OMEGA, wheel(P, TIME)[0])
    about_x = change[0] + q * whole[2] - r * whole[1]
    yield about_x, torques()[0], 1e-6
    # about y: the float alone, whose momentum turns with p and r
    yield change[1] + r * whole[0] - p * whole[2], torques()[1], 1e-6


@equation("twin-inner")
def _inner() -> Iterator[Pair]:
    r = rates(STATE, OMEGA)[2]
    q_rate = OMEGA_RATE[1] * np.cos(STATE[0]) + OMEGA_RATE[2] * np.sin(STATE[0]) + STATE[2] * r
    x, _, z = float_rates(STATE, OMEGA)
    H = wheel(P, TIME)[0]
    left = P.B * (motion()[3] + q_rate) - H * x - (P.C - P.A) * x * z - P.D * (z**2 - x**2)
    yield left, torques()[1], 1e-14


@equation("twin-outer")
def _outer() -> Iterator[Pair]:
    beta, v = STATE[1], STATE[3]
    s, c = np.sin(beta), np.cos(beta)
    p, q, r = rates(STATE, OMEGA)
    r_rate = -OMEGA_RATE[1] * np.sin(STATE[0]) + OMEGA_RATE[2] * np.cos(STATE[0]) - STATE[2] * q
    H, H_rate = wheel(P, TIME)
    J = P.J_o + P.A * c**2 + P.C * s**2 - 2 * P.D * s * c
    E = (P.C - P.A) * s * c - P.D * np.cos(2 * beta)
    E_tilt = (P.C - P.A) * np.cos(2 * beta) + 2 * P.D * np.sin(2 * beta)
    L_Z1 = momentum(STATE, OMEGA, H)[2]
    left = J * (motion()[2] + OMEGA_RATE[0]) + E * r_rate + 2 * E * v * p + E_tilt * v * r
    left += H * c * v + H_rate * s + q * L_Z1 - r * P.B * (q + v)
    yield left, torques()[0], 1e-14


def compliance(w: float) -> tuple[complex, complex]:
    """``G`` and ``C P`` as printed."""
    s = 1j * w
    plant = P.H / ((P.B * s**2 + P.c * s + P.k_r) * ((P.J_o + P.A) * s + P.c_x) + P.H**2 * s)
    servo = P.k_p + P.k_i / s + P.k_d * s
    return plant / (1 + servo * plant), servo * plant


@equation("twin-loop")
def _loop() -> Iterator[Pair]:
    for w in (0.5, 20.0, 400.0):
        G, loop = compliance(w)
        yield G, tilt_compliance(DESIGN, [w])[0], 1e-13 * abs(G)
        yield loop, open_loop(DESIGN, [w])[0], 1e-13 * abs(loop)


@equation("twin-rectification")
def _rectification() -> Iterator[Pair]:
    for w in (1.7, 9.0):
        G, size = compliance(w)[0], DESIGN.K * (2 * G0) ** 2 * P.ml
        yield -0.5 * size * G.imag, predicted_rectification(DESIGN, 2 * G0, w), 1e-13 * size * abs(G)
        yield 0.5 * size * abs(G), predicted_second_harmonic(DESIGN, 2 * G0, w), 1e-13 * size * abs(G)


@equation("twin-k2")
def _k2() -> Iterator[Pair]:
    """To first order in the tilt of 3 mrad."""
    literal = (P.D - (P.C - P.A) * P.beta_null) * DESIGN.K**2 * G0 / P.ml
    yield literal, predicted_k2(DESIGN) * G0, 4e-5 * abs(literal)
