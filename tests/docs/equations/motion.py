"""Equations of docs/theory/motion.md, docs/understanding/instrument.md and docs/reference/terms.md."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.linalg import expm, logm

import piga
from piga._kernels.estimation import product_column
from piga._kernels.motion.step import magnus_increments, step_functions
from piga.instrument.parameters import ErrorModel
from piga.terms import PRODUCTS
from tests.compensation.twin_data import TAN_BETA, instrument

from .registry import F0, FORCE, LOCKED, PHI, TURN, K, Pair, T, equation, half_angles, matrix, rates


@equation("instrument-ideal")
def _ideal() -> Iterator[Pair]:
    ideal = piga.Instrument(scale_factor=K, beta=0.0, alpha0=PHI)
    yield K * FORCE[:, 0], piga.propagate(ideal, T, FORCE, with_rate=True)[1], 1e-14


@equation("terms-model")
def _model() -> Iterator[Pair]:
    """A record whose rates are the printed sum comes back as its own coefficients."""
    random = np.random.default_rng(8)
    psi = np.linspace(0.0, 40.0, 400)
    f = 9.8 * np.column_stack([1.5 * np.sin(psi / 7), np.cos(psi / 5), np.sin(psi / 3)])
    turn = 0.01 * random.standard_normal((400, 3))
    a_x, a_Y, a_Z = f.T
    u_x, u_Y, u_Z = (K * f - turn).T
    t, T_less = psi / K, np.sin(psi / 11)
    value = {name: 1e-5 * (2 + k) for k, name in enumerate(_SINGLE)}
    p, q = TAN_BETA * np.cos(PHI), TAN_BETA * np.sin(PHI)
    alpha = psi + PHI
    s, c = np.sin(alpha), np.cos(alpha)
    literal = a_x + TAN_BETA * (u_Y / K * s - u_Z / K * c)
    literal += value["k0"] + value["k2"] * a_x**2 + value["k3"] * a_x**3 + value["k2o"] * a_x * np.abs(a_x)
    literal += value["k1a"] * np.abs(a_x)
    literal += value["m_Y"] * a_Y + value["m_Z"] * a_Z
    literal += value["k_XY"] * a_x * a_Y + value["k_XZ"] * a_x * a_Z
    literal += value["k_YY"] * a_Y**2 + value["k_ZZ"] * a_Z**2 + value["k_YZ"] * a_Y * a_Z
    literal += value["k0_t"] * t + value["k0_T"] * T_less + value["k1_T"] * a_x * T_less
    v = 1.0 + np.cos(psi / 13)
    literal += 3e-5 * v**2
    literal -= 2 * value["servo"] * (u_x / K) * ((u_Y * s - u_Z * c) / K) ** 2
    literal -= value["servo_damping"] * (u_x / K) ** 2 * (u_Y * c + u_Z * s) / K
    part = ErrorModel(**{name: value[name] for name in _SINGLE if not name.startswith("servo")}, T_ref=0.0)
    library = part.specific_force(t, f, T_less) + a_x + 3e-5 * _squares(v)
    library += p * ((u_Y * np.sin(psi) - u_Z * np.cos(psi)) / K) + q * (
        (u_Y * np.cos(psi) + u_Z * np.sin(psi)) / K
    )
    zeta, w = (u_Y + 1j * u_Z) / K, u_x / K
    turned = zeta * np.exp(-1j * alpha)
    library += -2 * value["servo"] * w * turned.imag**2 - value["servo_damping"] * w**2 * turned.real
    yield literal, library, 1e-13


_SINGLE = (
    "k0", "k2", "k3", "k2o", "k1a", "m_Y", "m_Z", "k_XY", "k_XZ", "k_YY", "k_ZZ", "k_YZ", "k0_t", "k0_T", "k1_T",
    "servo", "servo_damping",
)  # fmt: skip


def _squares(v: np.ndarray) -> np.ndarray:
    """Column of ``k2v`` over intervals of one second in which ``v`` does not change."""
    ends, column = np.repeat(v, 2), np.empty(2 * v.size - 1)
    none = np.zeros((3, ends.size))
    product_column(PRODUCTS["k2v"], none[0], none, none[0], np.ones(column.size), column, ends)
    return column[::2]


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
    for A, Y, Z in ((0.3, 0.02, -0.01), (0.001, 0.2, 0.1), (2.0, 0.5, 0.2)):
        above_one, S = step_functions(0.25 * (Y * Y + Z * Z - A * A))
        literal = (1.0 + above_one) * np.eye(2) + S / 2 * np.array([[Y, A - Z], [-(A + Z), -Y]])
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
