"""Every labelled equation of the theory pages: evaluated literally, beside what the library computes.

An entry returns pairs ``(literal, library, tolerance)``; both sides are arrays or numbers, the tolerance is absolute. The
literal side is the formula as it is printed, in plain NumPy or SciPy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from scipy.linalg import expm, expm_frechet
from scipy.optimize import brentq, minimize_scalar

import piga
from piga._kernels.compensate import solve_far, solve_small
from piga._kernels.function_motion import magnus_six
from piga._kernels.motion import magnus_increments
from piga._kernels.motion_sensitivity import unimodular_functions
from piga._kernels.regressors import coupling_columns
from piga._kernels.whitening import innovation_weights, whiten
from piga.calibration.leverage import all_but_one, leverages
from piga.calibration.missing_terms import tested
from piga.calibration.noise import find_noise
from piga.calibration.reduction import Reduction
from piga.instrument import dead_zone, fixed_points, locking_time, mean_rate, revolution_period, sensitivities
from piga.instrument.parameters import ErrorModel
from piga.instrument.published import published_closed_form
from piga.units import G0
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of, instrument, run_of

Pair = tuple[object, object, float]
EQUATIONS: dict[str, Callable[[], Iterator[Pair]]] = {}

K = K_G / G0
PHI = 0.7
T = np.arange(0.0, 3.0, 0.01)
FORCE = G0 * np.column_stack([0.8 + 0.3 * np.sin(2 * T), 4 + np.cos(T), 1 + 0.2 * T])
TURN = np.column_stack([0.01 * np.sin(T), 0.02 + 0 * T, -0.01 * T])
F0 = G0 * np.array([0.6, 4.0, 3.0])
"""A constant force, running."""
LOCKED = G0 * np.array([0.01, 4.0, 3.0])


def equation(label: str) -> Callable[[Callable[[], Iterator[Pair]]], Callable[[], Iterator[Pair]]]:
    """Register an entry under its label."""

    def register(entry: Callable[[], Iterator[Pair]]) -> Callable[[], Iterator[Pair]]:
        EQUATIONS[label] = entry
        return entry

    return register


def rates(f: np.ndarray) -> tuple[float, float, float]:
    """``a, y, z`` [rad/s] of a constant force."""
    return K * f[0], TAN_BETA * K * f[1], TAN_BETA * K * f[2]


def matrix(a: float, y: float, z: float) -> np.ndarray:
    """``M`` of the Riccati equation."""
    return 0.5 * np.array([[y, a - z], [-(a + z), -y]])


def half_angles(alpha: float) -> np.ndarray:
    return np.array([np.sin(alpha / 2), np.cos(alpha / 2)])


# --- motion ------------------------------------------------------------------------------------------


@equation("motion-coupling")
def _coupling() -> Iterator[Pair]:
    alpha, rate = piga.propagate(instrument(PHI), T, FORCE, with_rate=True)
    a_x, a_Y, a_Z = FORCE.T
    literal = K * a_x + K * (a_Y * np.sin(alpha) - a_Z * np.cos(alpha)) * TAN_BETA
    yield literal, rate, 1e-14
    yield np.gradient(alpha, T, edge_order=2)[1:-1], rate[1:-1], 2e-4  # and it is the derivative of the angle


@equation("motion-base")
def _base() -> Iterator[Pair]:
    alpha, rate = piga.propagate(instrument(PHI), T, FORCE, TURN, with_rate=True)
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
    """Against the sixth-order step with Gauss nodes; what both leave out falls with h^7."""
    first, second = np.array([0.9, 0.2, -0.1]), np.array([0.4, -0.3, 0.5])
    for h in (0.1, 0.2):
        M0, M1 = matrix(*first), matrix(*second)
        literal = (
            h * M0
            - h**3 / 12 * bracket(M0, M1)
            + h**5 / 240 * bracket(bracket(M0, M1), M1)
            + h**5 / 720 * bracket(M0, bracket(M0, bracket(M0, M1)))
        )
        nodes = [tuple(first + s * np.sqrt(0.6) * h / 2 * second) for s in (-1, 0, 1)]
        yield literal, matrix(*magnus_six(h, *nodes)), 3e-3 * h**7


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
    found = sensitivities(instrument(PHI), t, np.vstack([F0, F0])).of_alpha("beta")[1]
    _, dy, dz = np.array(rates(F0)) * (1 + TAN_BETA**2) / TAN_BETA
    E, dE = expm_frechet(matrix(*rates(F0)) * 0.4, matrix(0.0, dy, dz) * 0.4)
    before, after = dE @ half_angles(PHI), E @ half_angles(PHI)
    yield 2 * (before[0] * after[1] - before[1] * after[0]) / (after @ after), found, 1e-14


# --- effective axis ----------------------------------------------------------------------------------


@equation("axis-definition")
def _axis() -> Iterator[Pair]:
    alpha, rate = piga.propagate(instrument(PHI), T, FORCE, TURN, with_rate=True)
    n = np.column_stack([np.ones_like(alpha), TAN_BETA * np.sin(alpha), -TAN_BETA * np.cos(alpha)])
    yield (n * FORCE).sum(axis=1), (rate + (n * TURN).sum(axis=1)) / K, 1e-12


@equation("axis-single")
def _single() -> Iterator[Pair]:
    run = run_of(T, FORCE, phi=PHI, kind="rate")
    calibration = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": PHI})
    alpha, rate = piga.propagate(instrument(PHI), T, FORCE, with_rate=True)
    literal = rate / K - TAN_BETA * (FORCE[:, 1] * np.sin(alpha) - FORCE[:, 2] * np.cos(alpha))
    yield literal, piga.compensate(run, calibration).ax, 1e-11
    yield literal, FORCE[:, 0], 1e-12


@equation("axis-drift")
def _drift() -> Iterator[Pair]:
    """Over whole revolutions, to the second order of r."""
    period = float(revolution_period(instrument(PHI), *F0))
    V, r = F0[0] * 40 * period, np.hypot(F0[1], F0[2]) * TAN_BETA / F0[0]
    turned = piga.closed_form(instrument(PHI), 40 * period, *F0)[0] - PHI
    yield K * V * r**2 / 2, K * V - turned, K * V * r**4


# --- locking -----------------------------------------------------------------------------------------


def _ab(f: np.ndarray) -> tuple[float, float]:
    return K * f[0], K * np.hypot(f[1], f[2]) * TAN_BETA


@equation("locking-period")
def _period() -> Iterator[Pair]:
    for sign in (1.0, -1.0):
        f = F0 * (sign, 1.0, 1.0)
        a, b = _ab(f)
        yield 2 * np.pi / np.sqrt(a**2 - b**2), revolution_period(instrument(PHI), *f), 1e-13
        yield np.sign(a) * np.sqrt(a**2 - b**2), mean_rate(instrument(PHI), *f), 1e-15


@equation("locking-time")
def _time() -> Iterator[Pair]:
    a, b = _ab(LOCKED)
    yield 1 / np.sqrt(b**2 - a**2), locking_time(instrument(PHI), *LOCKED), 1e-12


@equation("locking-dead-zone")
def _zone() -> Iterator[Pair]:
    limit = np.hypot(F0[1], F0[2]) * TAN_BETA
    yield (-limit, limit), dead_zone(instrument(PHI), *F0[1:]), 1e-15
    assert piga.regime(instrument(PHI), limit * 0.999, *F0[1:]) == "locked"
    assert piga.regime(instrument(PHI), limit * 1.001, *F0[1:]) == "running"


@equation("locking-rest")
def _rest() -> Iterator[Pair]:
    a, b = _ab(LOCKED)
    resting = np.arctan2(-a / b, -np.sqrt(1 - a**2 / b**2)) + np.arctan2(LOCKED[2], LOCKED[1])
    yield np.exp(1j * resting), np.exp(1j * float(fixed_points(instrument(PHI), *LOCKED)[0])), 1e-14
    yield np.exp(1j * resting), np.exp(1j * float(piga.closed_form(instrument(PHI), 1e5, *LOCKED)[0])), 1e-12


@equation("locking-running-form")
def _running_form() -> Iterator[Pair]:
    gamma, r = np.arctan2(F0[2], F0[1]), np.hypot(F0[1], F0[2]) * TAN_BETA / F0[0]
    p0, V = np.tan((PHI - gamma) / 2), F0[0] * 3.0
    C0 = 2 / np.sqrt(1 - r**2) * np.arctan((p0 + r) / np.sqrt(1 - r**2))
    p = np.sqrt(1 - r**2) * np.tan(np.sqrt(1 - r**2) / 2 * (K * V + C0)) - r
    literal = np.exp(1j * (gamma + 2 * np.arctan(p)))
    yield literal, np.exp(1j * published_closed_form(4, instrument(PHI), 3.0, *F0)[0]), 1e-13
    yield literal, np.exp(1j * piga.closed_form(instrument(PHI), 3.0, *F0)[0]), 1e-13


# --- calibration -------------------------------------------------------------------------------------


@equation("calibration-linear")
def _linear() -> Iterator[Pair]:
    psi, (a_Y, a_Z) = 1.234, (3.0, -2.0)
    p, q = TAN_BETA * np.cos(PHI), TAN_BETA * np.sin(PHI)
    sine, cosine = np.empty(1), np.empty(1)
    still = np.full(2, psi), np.full(2, a_Y), np.full(2, a_Z)
    coupling_columns(*still, np.ones(1), np.zeros(1), 1.0, cosine, sine)
    literal = np.hypot(a_Y, a_Z) * TAN_BETA * np.sin(psi + PHI - np.arctan2(a_Z, a_Y))
    yield literal, p * sine[0] + q * cosine[0], 1e-16


@equation("calibration-increment")
def _increment() -> Iterator[Pair]:
    """Integrals by Simpson's rule over a finely sampled motion with bias and quadratic term."""
    t = np.linspace(0.0, 0.5, 2001)
    f = G0 * np.column_stack([0.8 + 0.4 * t, 4 + 0 * t, 1 - t])
    k0, k2 = 2e-3 * G0, 1e-4 / G0
    psi = piga.propagate(instrument(PHI), t, f, error_model=ErrorModel(k0=k0, k2=k2)) - PHI
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
    found = tested(pieces, ["k2"], ("k2",), 60)
    yield fall / (e @ e), found.fall, 1e-12
    yield estimate, found.columns[0], 1e-12


@equation("calibration-leverage")
def _leverage() -> Iterator[Pair]:
    """Leverage of segments and variance without one, from information matrices and from the library."""
    random = np.random.default_rng(13)
    rows = [random.standard_normal((7, 4)) for _ in range(4)]
    information = [part[:, :3].T @ part[:, :3] for part in rows]
    total = sum(information)
    parts = []
    for part in rows:
        parts.append(Reduction.empty(("a", "b", "c")))
        parts[-1].add(part[:, :3], part[:, 3])
    yield [np.trace(A @ np.linalg.inv(total)) for A in information], leverages(parts), 1e-12
    left = [np.diag(rest.solve()[1]) for rest in all_but_one(parts)]
    literal = [np.diag(np.linalg.inv(total - A)) for A in information]
    yield 1 - np.diag(np.linalg.inv(total)) / literal, 1 - np.diag(np.linalg.inv(total)) / left, 1e-11


@equation("calibration-likelihood")
def _likelihood() -> Iterator[Pair]:
    """The ratio at which the dense likelihood is least is the one that the library finds."""
    random = np.random.default_rng(11)
    n, m, h = 300, 2, 0.05
    X = np.column_stack([np.full(n, h), np.sin(np.arange(n) / 40.0)])
    noise = 1e-3 * np.diff(random.standard_normal(n + 1)) + 3e-3 * np.sqrt(h) * random.standard_normal(n)
    residual = noise - X @ np.linalg.lstsq(X, noise, rcond=None)[0]

    def covariance(kappa: float) -> np.ndarray:
        return (kappa * h + 2) * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)

    def information(log_ratio: float) -> float:
        return np.linalg.slogdet(X.T @ np.linalg.solve(covariance(10.0**log_ratio / h), X))[1]

    def objective(log_ratio: float) -> float:
        V = covariance(10.0**log_ratio / h)
        S = residual @ np.linalg.solve(V, residual)
        return (n - m) * np.log(S) + np.linalg.slogdet(V)[1] + information(log_ratio)

    literal = minimize_scalar(objective, bounds=(-2.0, 2.0), method="bounded", options={"xatol": 1e-6}).x
    found = find_noise(
        residual,
        np.full(n, h),
        m,
        0.0,
        information=lambda grid: np.array([information(float(g)) for g in grid]),
    )
    yield literal, np.log10(found.walk * h / found.white), 2e-2


# --- compensation ------------------------------------------------------------------------------------


def _interval(f: np.ndarray, h: float) -> tuple[float, float, float, float]:
    """``delta``, ``alpha_m``, ``Y``, ``Z`` of an interval of constant force."""
    end = float(piga.closed_form(instrument(PHI), h, *f)[0])
    _, y, z = rates(f)
    return (end - PHI) / 2, (end + PHI) / 2, y * h, z * h


@equation("inverse-interval")
def _inverse() -> Iterator[Pair]:
    for f, h in ((F0, 0.05), (F0, 2.0), (LOCKED, 0.5)):
        delta, middle, Y, Z = _interval(f, h)
        coupling = Y * np.sin(middle) - Z * np.cos(middle)

        def misfit(
            A: float, delta: float = delta, square: float = Y * Y + Z * Z, coupling: float = coupling
        ) -> float:
            q = np.sqrt(complex((A**2 - square) / 4))
            return A * np.cos(delta) - (2 * (q / np.tan(q)).real * np.sin(delta) - coupling)

        exact = K * f[0] * h
        literal = brentq(misfit, exact - 1e-2, exact + 1e-2, xtol=1e-16)
        yield literal, 2 * delta + solve_far(delta, Y * Y + Z * Z, coupling), 1e-13
        yield literal, exact, 1e-13


@equation("inverse-small")
def _inverse_small() -> Iterator[Pair]:
    delta, middle, Y, Z = _interval(F0, 0.05)
    coupling = Y * np.sin(middle) - Z * np.cos(middle)
    e, _ = solve_small(delta, Y * Y + Z * Z, coupling)
    d = delta**2
    w = d + delta * e + (e**2 - Y**2 - Z**2) / 4

    def c(x: float) -> float:
        return np.sqrt(x) / np.tan(np.sqrt(x))

    yield e * np.cos(delta) - 2 * np.sin(delta) * (c(w) - c(d)) + coupling, 0.0, 1e-16


@equation("interval-mean")
def _interval_mean() -> Iterator[Pair]:
    """The coupling of a constant force along the exact motion; its mean is what the angle turns beside u_x."""
    h = 0.05
    u, y, z = rates(F0)
    ends = [float(piga.closed_form(instrument(PHI), t, *F0)[0]) for t in (0.0, h)]

    def derivatives(alpha: float) -> tuple[float, float, float]:
        g, slope = y * np.sin(alpha) - z * np.cos(alpha), y * np.cos(alpha) + z * np.sin(alpha)
        rate = u + g
        first = slope * rate
        second = -g * rate**2 + slope * first
        third = -slope * rate**3 - 3 * g * rate * first + slope * second
        return g, first, third

    (g0, first0, third0), (g1, first1, third1) = (derivatives(alpha) for alpha in ends)
    literal = (g0 + g1) / 2 + h / 12 * (first0 - first1) - h**3 / 720 * (third0 - third1)
    yield literal, (ends[1] - ends[0]) / h - u, 1e-13


@equation("inverse-axis")
def _inverse_axis() -> Iterator[Pair]:
    """To the second order of the coupling; the library is exact."""
    h = 0.05
    run = run_of(np.array([0.0, h, 2 * h]), np.vstack([F0] * 3), phi=PHI)
    calibration = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": PHI})
    delta, middle, _, _ = _interval(F0, h)
    g = np.sin(delta) / delta
    known = 2 * delta / (K * h)
    literal = known - g * TAN_BETA * (F0[1] * np.sin(middle) - F0[2] * np.cos(middle))
    yield literal, piga.compensate(run, calibration).ax[1], (np.hypot(F0[1], F0[2]) * TAN_BETA) ** 2 * K * h


@equation("inverse-uncertainty")
def _uncertainty() -> Iterator[Pair]:
    r, q, u_k0, u_tan = 2e-6, 1e-6, 3e-6, 2e-7
    values = {"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": PHI, "k0": 0.0}
    calibration = calibration_of(values, {"k0": u_k0, "tan_beta": u_tan}, angle_rms=r, angle_random_walk=q)
    h = 0.01
    run = run_of(np.array([0.0, h, 2 * h]), np.vstack([F0] * 3), phi=PHI)
    _, middle, _, _ = _interval(F0, h)
    J = np.array([G0, F0[1] * np.sin(middle) - F0[2] * np.cos(middle)])
    Sigma = np.diag([u_k0**2, u_tan**2])
    literal = np.sqrt(J @ Sigma @ J + (2 * r**2 / h + q**2) / (h * K**2))
    yield literal, piga.compensate(run, calibration).u_ax[1], 1e-4 * literal


@equation("inverse-published")
def _published() -> Iterator[Pair]:
    run = run_of(T, FORCE, phi=PHI)
    calibration = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": PHI}, phase_source="input")
    found = piga.compensate(run, calibration).ax[1:]
    turned = np.concatenate([[0.0], np.cumsum(np.diff(run.output))])
    phase = 0.5 * (turned[1:] + turned[:-1]) + PHI
    rate, (_, a_Y, a_Z) = np.diff(run.output) / np.diff(T), 0.5 * (FORCE[1:] + FORCE[:-1]).T
    literal = rate / K - np.hypot(a_Y, a_Z) * TAN_BETA * np.sin(phase - np.arctan2(a_Z, a_Y))
    yield literal, found, 1e-11
