"""Equations of docs/theory/motion.md."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.linalg import expm, expm_frechet, logm

import piga
from piga._kernels.motion.samples import unimodular_functions
from piga._kernels.motion.step import magnus_increments
from piga.instrument import sensitivities
from tests.compensation.twin_data import TAN_BETA, instrument

from .registry import F0, FORCE, LOCKED, PHI, TURN, K, Pair, T, equation, half_angles, matrix, rates


@equation("motion-coupling")
def _coupling() -> Iterator[Pair]:
    alpha, rate = piga.propagate(instrument(PHI), T, FORCE, with_rate=True, between="linear")
    a_x, a_Y, a_Z = FORCE.T
    literal = K * a_x + K * (a_Y * np.sin(alpha) - a_Z * np.cos(alpha)) * TAN_BETA
    yield literal, rate, 1e-14
    yield np.gradient(alpha, T, edge_order=2)[1:-1], rate[1:-1], 2e-4  # and it is the derivative of the angle


@equation("motion-base")
def _base() -> Iterator[Pair]:
    alpha, rate = piga.propagate(instrument(PHI), T, FORCE, TURN, with_rate=True, between="linear")
    u_x, u_Y, u_Z = (K * FORCE - TURN).T
    yield u_x + TAN_BETA * (u_Y * np.sin(alpha) - u_Z * np.cos(alpha)), rate, 1e-14


@equation("motion-adler")
def _adler() -> Iterator[Pair]:
    a, b = K * F0[0], K * np.hypot(F0[1], F0[2]) * TAN_BETA
    alpha, rate = piga.closed_form(instrument(PHI), T, *F0)
    theta = alpha - np.arctan2(F0[2], F0[1])
    yield a + b * np.sin(theta), rate, 1e-14


@equation("motion-one-form")
def _one_form() -> Iterator[Pair]:
    for f in (F0, LOCKED, np.array([0.0, *F0[1:]])):
        t = 3.0
        A, Y, Z = (r * t for r in rates(f))
        x = (Y**2 + Z**2 - A**2) / 4
        root = np.sqrt(complex(x))
        C, S = np.cosh(root).real, (np.sinh(root) / root).real
        literal = 2 * np.arctan2(
            S / 2 * (A + Y * np.sin(PHI) - Z * np.cos(PHI)), C - S / 2 * (Y * np.cos(PHI) + Z * np.sin(PHI))
        )
        yield literal, piga.closed_form(instrument(PHI), t, *f)[0] - PHI, 1e-14


@equation("motion-riccati")
def _riccati() -> Iterator[Pair]:
    alpha, rate = piga.closed_form(instrument(PHI), 2.0, *F0)
    P, Q = half_angles(alpha)
    dP, dQ = matrix(*rates(F0)) @ (P, Q)
    yield 2 * (dP * Q - dQ * P) / (P**2 + Q**2), rate, 1e-14


@equation("motion-exponential")
def _exponential() -> Iterator[Pair]:
    for A, Y, Z in ((0.3, 0.02, -0.01), (0.001, 0.2, 0.1), (4.0, 0.5, 0.2)):
        C, S, _ = unimodular_functions(0.25 * (Y * Y + Z * Z - A * A))
        literal = C * np.eye(2) + S / 2 * np.array([[Y, A - Z], [-(A + Z), -Y]])
        yield literal, expm(matrix(A, Y, Z)), 1e-14


@equation("motion-rate")
def _rate() -> Iterator[Pair]:
    for f in (F0, LOCKED):
        _, start = piga.closed_form(instrument(PHI), 0.0, *f)
        P1, Q1 = expm(matrix(*rates(f)) * 2.5) @ half_angles(PHI)
        yield start / (P1**2 + Q1**2), piga.closed_form(instrument(PHI), 2.5, *f)[1], 1e-14


def bracket(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    return p @ q - q @ p


@equation("motion-magnus")
def _magnus() -> Iterator[Pair]:
    """Against the logarithm of the product of 512 exact exponentials; what the series leaves out falls with h^7."""
    first, second = np.array([0.9, 0.2, -0.1]), np.array([0.4, -0.3, 0.5])
    for h in (0.1, 0.2):
        M0, M1 = matrix(*first), matrix(*second)
        literal = (
            h * M0
            - h**3 / 12 * bracket(M0, M1)
            + h**5 / 240 * bracket(bracket(M0, M1), M1)
            + h**5 / 720 * bracket(M0, bracket(M0, bracket(M0, M1)))
        )
        product, part = np.eye(2), h / 512
        for k in range(512):
            start, end = (first + (part * i - 0.5 * h) * second for i in (k, k + 1))
            product = expm(matrix(*magnus_increments(part, *start, *end))) @ product
        yield literal, logm(product), 3e-3 * h**7


@equation("motion-increments")
def _increments() -> Iterator[Pair]:
    h, (a0, y0, z0), (a1, y1, z1) = 0.01, (0.8, 0.1, -0.2), (0.9, 0.12, -0.1)
    A = h * (a0 + a1) / 2 + h**2 / 12 * (y0 * z1 - z0 * y1)
    Y = h * (y0 + y1) / 2 + h**2 / 12 * (a0 * z1 - z0 * a1)
    Z = h * (z0 + z1) / 2 - h**2 / 12 * (a0 * y1 - y0 * a1)
    yield (A, Y, Z), magnus_increments(h, a0, y0, z0, a1, y1, z1), 1e-17


@equation("motion-sensitivity")
def _sensitivity() -> Iterator[Pair]:
    """The derivative with respect to beta over one step of constant force, start angle held."""
    t = np.array([0.0, 0.4])
    result = sensitivities(instrument(PHI), t, np.vstack([F0, F0])).of_alpha("beta")[1]
    _, dy, dz = np.array(rates(F0)) * (1 + TAN_BETA**2) / TAN_BETA
    E, dE = expm_frechet(matrix(*rates(F0)) * 0.4, matrix(0.0, dy, dz) * 0.4)
    before, after = dE @ half_angles(PHI), E @ half_angles(PHI)
    yield 2 * (before[0] * after[1] - before[1] * after[0]) / (after @ after), result, 1e-14
