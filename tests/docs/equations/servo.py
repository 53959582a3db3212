"""Equations of docs/understanding/servo.md: the printed formulas beside the rigid body of SciPy and the library."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from piga.instrument.twin.linear import ServoParameters, servo_terms
from piga.instrument.twin.parameters import TwinParameters
from tests.instrument.servo_truth import Design, G, motion, waves

from .registry import Pair, equation

P = Design(K=0.8884 / G, beta=2e-4, k_r=0.01)
FORCE, TURN = np.array([5.0, 0.6, -0.8]) * G, np.zeros(3)
U = P.K * FORCE - TURN
U_T, W = np.hypot(U[1], U[2]), U[0]
S, D = P.K * P.ml / (2 * P.k_i), P.c * P.K**2 / P.k_i


def impedance(s: complex) -> complex:
    return P.J_y * s**2 + P.c * s + P.k_r


def compliance(s: complex) -> complex:
    return 1.0 / (impedance(s) * P.J_x * s / P.H + P.H * s + P.k_p + P.k_i / s + P.k_d * s)


def turn() -> tuple[np.ndarray, np.ndarray]:
    """Settled states over a turn, and ``theta``."""
    states = motion(P, FORCE, TURN, 0.3, np.concatenate([[0.0], 1.0 + np.linspace(0.0, 1.5, 400)]))[1:]
    return states, states[:, 0] - np.arctan2(U[2], U[1])


@equation("servo-torque")
def _torque() -> Iterator[Pair]:
    """Torque that the servo's motor gives, against what it has to hold."""
    states, theta = turn()
    alpha, beta, _, v, z = states.T
    literal = P.H * (U[1] * np.cos(alpha) + U[2] * np.sin(alpha))
    yield literal, P.H * U_T * np.cos(theta), 1e-15
    yield literal, P.k_p * (beta - P.beta) + P.k_i * z + P.H * v, 1e-4 * P.H * U_T


@equation("servo-tilt")
def _tilt() -> Iterator[Pair]:
    states, theta = turn()
    literal = (compliance(1j * W) * P.H * U_T * np.exp(1j * theta)).real
    yield literal, states[:, 1] - P.beta, 2e-3 * np.abs(literal).max()


@equation("servo-coupling")
def _coupling() -> Iterator[Pair]:
    """Without restoring torque of the constant tilt, which is a bias."""
    states, theta = turn()
    literal = (impedance(1j * W) * compliance(1j * W) * P.H * U_T * np.exp(1j * theta)).real / P.H
    literal += W + (np.tan(P.beta) + states[:, 1] - P.beta) * U_T * np.sin(theta)
    yield literal, states[:, 2] - P.k_r * P.beta / P.H, 2e-5 * U_T


@equation("servo-rate")
def _rate() -> Iterator[Pair]:
    G_w, Z_w = compliance(1j * W), impedance(1j * W)
    half = 0.5 * P.H * U_T**2
    literal = (
        -half * G_w.imag,
        -U_T * (Z_w * G_w).imag,
        U_T * (Z_w * G_w).real,
        half * G_w.real,
        half * G_w.imag,
    )
    own = waves(P, FORCE, TURN)
    own -= np.array([P.k_r * P.beta / P.H, np.tan(P.beta) * U_T, 0.0, 0.0, 0.0])
    yield np.array(literal), own, 3e-3 * np.abs(literal).max()


@equation("servo-terms")
def _terms() -> Iterator[Pair]:
    """A rate of 1 g, where the next order is below 1e-4 of the terms."""
    p = Design(K=0.8884 / G)
    force = np.array([1.0, 0.6, -0.8]) * G
    u, psi = p.K * force - TURN, np.linspace(0.0, 6.0, 50)
    s, d = p.K * p.ml / (2 * p.k_i), p.c * p.K**2 / p.k_i
    across = (u[1] * np.sin(psi) - u[2] * np.cos(psi)) / p.K
    literal = -2 * s * (u[0] / p.K) * across**2
    literal -= d * (u[0] / p.K) ** 2 * (u[1] * np.cos(psi) + u[2] * np.sin(psi)) / p.K
    mean, s1, c1, s2, c2 = waves(p, force, TURN) / p.K
    theta = psi - np.arctan2(u[2], u[1])
    body = mean + s1 * np.sin(theta) + c1 * np.cos(theta) + s2 * np.sin(2 * theta) + c2 * np.cos(2 * theta)
    yield literal, body, 0.02 * np.abs(literal).max()
    yield mean, -s * (u[0] / p.K) * (u[1] ** 2 + u[2] ** 2) / p.K**2, 3e-4 * abs(mean)
    known = servo_terms(ServoParameters(p.K, p.ml, p.k_i, p.k_p, 0.0, p.c))
    yield np.array([s, d]), np.array([known.servo, known.servo_damping]), 1e-18


@equation("servo-gain")
def _gain() -> Iterator[Pair]:
    w, twin = 8.884, TwinParameters(integral_gain=3000.0, rate_gain=0.02)
    nu = (twin.angular_momentum + twin.rate_gain) * w**2 / twin.integral_gain
    literal = (1 - nu) / ((1 - nu) ** 2 + (twin.proportional_gain * w / twin.integral_gain) ** 2)
    at_rest, turning = servo_terms(twin), servo_terms(twin, rate=w)
    yield literal, turning.servo / at_rest.servo, 1e-12
    yield literal, turning.servo_damping / at_rest.servo_damping, 1e-12
    p = Design(K=0.8884 / G, k_d=0.02)
    own = waves(p, (10 * G, G, 0.0))[0] / (-p.K * 10 * G * p.K * p.ml * G**2 / (2 * p.k_i))
    yield literal, own, 1e-3  # the wave of the damping pulls the mean rate by 7e-4 of the shift


@equation("servo-tangent")
def _tangent() -> Iterator[Pair]:
    for level in (1.0, 10.0, -8.0):
        w = P.K * level * G
        literal = np.tan(P.beta) + (P.J_y * P.k_i - P.c * P.k_p) / P.k_i**2 * w**3 - P.k_r / P.k_i * w
        own = waves(P, (level * G, G, 0.0))[1] / (P.K * G)
        yield literal, own, 3e-6 if abs(level) > 1 else 1e-8


@equation("servo-head")
def _head() -> Iterator[Pair]:
    x = np.linspace(0.0, 6.0, 30)
    a_x, a_t = G * np.cos(x), -G * np.sin(x)
    yield a_x * a_t**2, G**2 * a_x - a_x**3, 1e-12
