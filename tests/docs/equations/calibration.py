"""Equations of docs/theory/calibration.md and docs/understanding/intervals.md."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator

import numpy as np
from scipy.integrate import quad

import piga
from piga._kernels.estimation import coupling_columns, innovation_weights, servo_columns, whiten
from piga.calibration.intervals import sandwich
from piga.calibration.model.design import ServoState
from piga.calibration.model.reduction import triangle
from piga.calibration.remarks.missing_terms import tested
from piga.calibration.revolutions import ripple
from piga.instrument.parameters import ErrorModel
from piga.units import G0
from tests.compensation.twin_data import TAN_BETA, instrument

from .registry import PHI, K, Pair, equation


@equation("calibration-linear")
def _linear() -> Iterator[Pair]:
    psi, (a_Y, a_Z) = 1.234, (3.0, -2.0)
    p, q = TAN_BETA * np.cos(PHI), TAN_BETA * np.sin(PHI)
    columns = np.empty((2, 1))
    still = np.full(2, psi), np.full(2, a_Y), np.full(2, a_Z)
    coupling_columns(*still, np.zeros((2, 1)), np.ones(1), np.zeros(1), 1.0, columns)
    sine, cosine = columns
    literal = np.hypot(a_Y, a_Z) * TAN_BETA * np.sin(psi + PHI - np.arctan2(a_Z, a_Y))
    yield literal, p * sine[0] + q * cosine[0], 1e-16


@equation("calibration-increment")
def _increment() -> Iterator[Pair]:
    """Integrals by Simpson's rule over a finely sampled motion with bias and quadratic term."""
    t = np.linspace(0.0, 0.5, 2001)
    f = G0 * np.column_stack([0.8 + 0.4 * t, 4 + 0 * t, 1 - t])
    k0, k2 = 2e-3 * G0, 1e-4 / G0
    psi = piga.propagate(instrument(PHI), t, f, error_model=ErrorModel(k0=k0, k2=k2), between="linear") - PHI
    weights = np.full(t.size, 2.0)
    weights[1::2], weights[0], weights[-1] = 4.0, 1.0, 1.0
    p, q = TAN_BETA * np.cos(PHI), TAN_BETA * np.sin(PHI)
    s, c = np.sin(psi), np.cos(psi)
    A, P, Q, A2 = (
        (weights * column).sum() * (t[1] - t[0]) / 3
        for column in (f[:, 0], f[:, 1] * s - f[:, 2] * c, f[:, 1] * c + f[:, 2] * s, f[:, 0] ** 2)
    )
    yield K * A + K * p * P + K * q * Q + K * k0 * 0.5 + K * k2 * A2, psi[-1], 1e-12


@equation("calibration-whitening")
def _whitening() -> Iterator[Pair]:
    random = np.random.default_rng(3)
    d, h, r, q_w = random.standard_normal(20), random.uniform(0.5, 1.5, 20), 0.7, 0.2
    literal, v, i = [], 0.0, 0.0
    for n in range(d.size):
        v_next = q_w * h[n] + 2 * r - (r**2 / v if n else 0.0)
        i = d[n] + (r / v * i if n else 0.0)
        v = v_next
        literal.append(i / np.sqrt(v))
    carry, scale, out = np.empty(20), np.empty(20), np.empty((1, 20))
    innovation_weights(h, r, q_w, 0.0, carry, scale)
    whiten(d[None], carry, scale, np.zeros(1), out)
    yield literal, out[0], 1e-14


@equation("calibration-added-variable")
def _added_variable() -> Iterator[Pair]:
    """Fall of the sum of squares and estimate of a candidate, from normal equations and from the library."""
    random = np.random.default_rng(12)
    X, x = random.standard_normal((60, 3)), random.standard_normal(60)
    y = X @ [1.0, -2.0, 0.5] + 0.3 * x + random.standard_normal(60)

    def without_model(v: np.ndarray) -> np.ndarray:
        return v - X @ np.linalg.solve(X.T @ X, X.T @ v)

    e, rest = without_model(y), without_model(x)
    fall, estimate = (rest @ e) ** 2 / (rest @ rest), (rest @ e) / (rest @ rest)
    rows = np.column_stack([X, x, y])
    pieces = [np.linalg.qr(rows[at : at + 12], mode="r") for at in range(0, 60, 12)]
    m = X.shape[1]
    candidates = tested(np.array(pieces), range(m), [m], ("k2",), 60, 1.0)
    yield fall / (e @ e), candidates.fall, 1e-12
    yield estimate, candidates.size[0], 1e-12


@equation("calibration-leverage")
def _leverage() -> Iterator[Pair]:
    """A direct instrument in six positions: from its samples, and from its calibration."""
    random, segment = np.random.default_rng(13), np.repeat(np.arange(6), 40)
    x = np.array([1.0, 0.6, 0.1, -0.3, -0.8, -1.0])[segment]
    run = piga.Run.from_arrays(
        0.1 * np.arange(240) + 5.0 * segment, 0.6 * (x + 2e-3) + 1e-5 * random.standard_normal(240), np.outer(x, [1.0, 0.0, 0.0]),
        scale_factor="0.6 mA/g", kind="rate", unit="mA", segment=segment, units={"f": "g"},
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        table = piga.calibrate(run, ["scale_factor", "k0"]).diagnostics.leverage
    rows = np.column_stack([x, np.ones(240)])
    information = [rows[segment == s].T @ rows[segment == s] for s in range(6)]
    inverse = np.linalg.inv(sum(information))
    yield [np.trace(A @ inverse) for A in information], [row.leverage for row in table.values()], 1e-9
    left = np.array([np.linalg.inv(sum(information) - A)[0, 0] for A in information])
    yield 1.0 - inverse[0, 0] / left, [row.share["scale_factor"] for row in table.values()], 1e-9


@equation("intervals-mean")
def _mean() -> Iterator[Pair]:
    """Equal positions with one coefficient, their mean: the textbook and the library."""
    x = np.random.default_rng(5).standard_normal(12)
    u = np.sqrt(((x - x.mean()) ** 2).sum() / (12 * 11))
    parts = [triangle(np.array([[1.0, value - x.mean()]])) for value in x]
    library, degrees = sandwich(parts, None, [])
    yield u, library[0], 1e-12
    yield 11.0, degrees[0], 1e-6


@equation("calibration-scatter")
def _scatter() -> Iterator[Pair]:
    """The printed sums, position by position, and the library's."""
    random = np.random.default_rng(7)
    rows = [random.standard_normal((5, 4)) for _ in range(6)]
    A = [part[:, :3].T @ part[:, :3] for part in rows]
    theta = np.linalg.solve(sum(A), sum(part[:, :3].T @ part[:, 3] for part in rows))
    L = np.linalg.cholesky(np.linalg.inv(sum(A)))
    B = [L.T @ own @ L for own in A]
    g = [L.T @ part[:, :3].T @ (part[:, 3] - part[:, :3] @ theta) for part in rows]
    literal_u, literal_nu = [], []
    for c in np.eye(3):
        d = []
        for own in B:
            value, vector = np.linalg.eigh(np.eye(3) - own)
            d.append(c @ L @ (vector / np.sqrt(value)) @ vector.T)
        z = np.array([one @ score for one, score in zip(d, g, strict=True)])
        P = np.array(
            [
                [(d[j] @ B[j] @ d[j] if j == k else 0.0) - d[j] @ B[j] @ B[k] @ d[k] for k in range(6)]
                for j in range(6)
            ]
        )
        variance = np.diag(P)
        w = (variance + 1e-3 * variance.mean()) ** -0.5
        literal_u.append(np.sqrt((c @ L) @ (c @ L) * (w @ z**2) / (w @ variance)))
        literal_nu.append((w @ variance) ** 2 / (w @ P**2 @ w))
    parts = [triangle(np.column_stack([part[:, :3], part[:, 3] - part[:, :3] @ theta])) for part in rows]
    u, nu = sandwich(parts, None, [])
    yield np.array(literal_u), u, 1e-10
    yield np.array(literal_nu), nu, 1e-9


@equation("calibration-ripple")
def _ripple_of_a_turn() -> Iterator[Pair]:
    """First harmonic over mean of the time at an angle, both closed forms, and what the library takes from the parts of a turn."""
    for rho in (1e-3, 0.3, 0.8):
        x = 2.0 * np.pi * (np.arange(32 * 400) + 0.5) / (32 * 400)
        times = 1.0 / (1.0 + rho * np.sin(x - 0.7))
        literal = 2.0 * abs(np.mean(times * np.exp(-1j * x))) / times.mean()
        yield literal, 2.0 * (1.0 - np.sqrt(1.0 - rho**2)) / rho, 1e-10
        yield literal, 2.0 * np.tan(0.5 * np.arcsin(rho)), 1e-10
        yield rho, ripple(times.reshape(32, 400).sum(axis=1)), 1e-6


def _integral(value: Callable[[float], float]) -> float:
    return quad(value, 0.0, 1.5, epsabs=1e-14)[0]


def _servo_case() -> tuple[np.ndarray, np.ndarray, Callable[[float], float], complex, float]:
    """The five integrals by the library; angle, ``zeta`` and ``w`` of a case with constant forces."""
    w, zeta, psi = 2.0, 0.6 - 0.8j, np.array([0.4, 1.9])
    integrals, one = np.empty((5, 1)), np.ones(2)
    servo_columns(psi, w * one, zeta.real * one, zeta.imag * one, np.array([1.5]), np.zeros(1), integrals)
    return integrals[:, 0], psi, lambda t: psi[0] + (psi[1] - psi[0]) * t / 1.5, zeta, w


@equation("calibration-servo-columns")
def _servo_columns() -> Iterator[Pair]:
    integrals, _, psi, zeta, w = _servo_case()
    second, first = (
        (lambda t: w * zeta**2 * np.exp(-2j * psi(t))),
        (lambda t: w**2 * zeta * np.exp(-1j * psi(t))),
    )
    literal = [
        1.5 * w * abs(zeta) ** 2,
        _integral(lambda t: second(t).real),
        -_integral(lambda t: second(t).imag),
        _integral(lambda t: first(t).real),
        _integral(lambda t: first(t).imag),
    ]
    yield np.array(literal), integrals, 1e-14


@equation("calibration-servo-terms")
def _servo_terms() -> Iterator[Pair]:
    """The printed combination, the library's, and the terms of the servo page integrated."""
    integrals, _, psi, zeta, w = _servo_case()
    phi, (m, c2, s2, c1, s1) = 0.7, integrals
    literal = np.array([-m + c2 * np.cos(2 * phi) - s2 * np.sin(2 * phi), -c1 * np.cos(phi) - s1 * np.sin(phi)])
    rows = ServoState((phi,), 0.0, 0.0, 0.0).term_rows(phi)
    yield literal, np.array([rows["servo"] @ integrals, rows["servo_damping"] @ integrals]), 1e-15
    across = lambda t: zeta.real * np.sin(psi(t) + phi) - zeta.imag * np.cos(psi(t) + phi)  # noqa: E731
    along = lambda t: zeta.real * np.cos(psi(t) + phi) + zeta.imag * np.sin(psi(t) + phi)  # noqa: E731
    exact = [_integral(lambda t: -2.0 * w * across(t) ** 2), _integral(lambda t: -(w**2) * along(t))]
    yield literal, np.array(exact), 1e-13


@equation("calibration-servo-step")
def _servo_step() -> Iterator[Pair]:
    """What the step adds to the columns of the coupling is the derivative of the terms by ``p`` and ``q``."""
    integrals = _servo_case()[0]
    stiffness, damping, p, q = 0.3, 0.2, 0.5, 1.2

    def terms(p: float, q: float) -> float:
        rows = ServoState((0.0,), 0.0, 0.0, 0.0).term_rows(np.arctan2(q, p))
        return stiffness * (rows["servo"] @ integrals) + damping * (rows["servo_damping"] @ integrals)

    size, phi = np.hypot(p, q), np.arctan2(q, p)
    over = ServoState((phi,), stiffness, damping, 1.0 / size).phase_row(phi) @ integrals
    step = 1e-6
    derivative = [
        (terms(p + step, q) - terms(p - step, q)) / (2.0 * step),
        (terms(p, q + step) - terms(p, q - step)) / (2.0 * step),
    ]
    yield np.array([-np.sin(phi) * over, np.cos(phi) * over]), np.array(derivative), 1e-8
