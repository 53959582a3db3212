"""Equations of the pages, evaluated as they are printed, beside what the library computes.

Here stand the models that a page and the library must share, and what no test of its own module compares. A test bears the label
of its equation.
"""

from __future__ import annotations

import re

import numpy as np
import pytest

import piga
from piga._kernels.compensation.terms import near_nyquist
from piga._kernels.estimation import product_at
from piga.calibration import missing_terms
from piga.calibration.intervals import scatter_of
from piga.calibration.model.reduction import triangle
from piga.instrument.parameters import ErrorModel
from piga.instrument.twin import TwinParameters, servo_terms
from piga.studies.revolutions import ripple
from piga.terms import PRODUCTS
from piga.units import G0
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of, run_of

from .pages import DOCS

THEORY = [
    *(page for folder in ("understanding", "theory") for page in sorted((DOCS / folder).glob("*.md"))),
    DOCS / "reference" / "terms.md",
]
_DISPLAYED = re.compile(r"^ *\$\$$(.*?)^ *\$\$ *(?:\(([\w-]+)\))?$", re.MULTILINE | re.DOTALL)


def test_every_equation_has_a_label_of_its_own() -> None:
    labels = [one[1] for page in THEORY for one in _DISPLAYED.findall(page.read_text(encoding="utf-8"))]
    assert "" not in labels
    assert len(labels) == len(set(labels))
    tests = {name.removeprefix("test_").replace("_", "-") for name in globals() if name.startswith("test_")}
    assert len(tests & set(labels)) == len(tests) - 1, "this test alone is not named by a label"


K, PHI = K_G / G0, 0.7
T = np.arange(0.0, 3.0, 0.01)
FORCE = G0 * np.column_stack([0.8 + 0.3 * np.sin(2 * T), 4 + np.cos(T), 1 + 0.2 * T])
SINGLE = (
    "k0", "k2", "k3", "k2o", "k1a", "m_Y", "m_Z", "k_XY", "k_XZ", "k_YY", "k_ZZ", "k_YZ", "k0_t", "k0_T", "k1_T",
)  # fmt: skip


def test_terms_model() -> None:
    """The products of the printed sum are those of the simulation; ``k2v`` is that of the estimation."""
    x = np.linspace(0.0, 40.0, 400)
    f = 9.8 * np.column_stack([1.5 * np.sin(x / 7), np.cos(x / 5), np.sin(x / 3)])
    (a_x, a_Y, a_Z), t, T_less, v = f.T, x / K, np.sin(x / 11), 1.0 + np.cos(x / 13)
    value = {name: 1e-5 * (2 + k) for k, name in enumerate(SINGLE)}
    literal = value["k0"] + value["k2"] * a_x**2 + value["k3"] * a_x**3 + value["k2o"] * a_x * np.abs(a_x)
    literal += value["k1a"] * np.abs(a_x)
    literal += value["m_Y"] * a_Y + value["m_Z"] * a_Z
    literal += value["k_XY"] * a_x * a_Y + value["k_XZ"] * a_x * a_Z
    literal += value["k_YY"] * a_Y**2 + value["k_ZZ"] * a_Z**2 + value["k_YZ"] * a_Y * a_Z
    literal += value["k0_t"] * t + value["k0_T"] * T_less + value["k1_T"] * a_x * T_less
    literal += 3e-5 * v**2
    model = ErrorModel(**value, T_ref=0.0)
    assert literal == pytest.approx(model.specific_force(t, f, T_less) + 3e-5 * squares(v), abs=1e-13)


def squares(v: np.ndarray) -> np.ndarray:
    """Column of ``k2v`` of a rate log."""
    return product_at(PRODUCTS["k2v"], {"x": v, "v": v})


def test_calibration_added_variable() -> None:
    """Fall of the sum of squares and estimate of a candidate, from normal equations and from the library."""
    random = np.random.default_rng(12)
    X, x = random.standard_normal((60, 3)), random.standard_normal(60)
    y = X @ [1.0, -2.0, 0.5] + 0.3 * x + random.standard_normal(60)
    e, rest = (v - X @ np.linalg.solve(X.T @ X, X.T @ v) for v in (y, x))
    rows = np.column_stack([X, x, y])
    pieces = [np.linalg.qr(rows[at : at + 12], mode="r") for at in range(0, 60, 12)]
    candidates = missing_terms.tested(np.array(pieces), range(3), [3], ("k2",), 60, 1.0)
    assert (rest @ e) ** 2 / (rest @ rest) / (e @ e) == pytest.approx(candidates.fall, abs=1e-12)
    assert (rest @ e) / (rest @ rest) == pytest.approx(candidates.size[0], abs=1e-12)


def test_calibration_scatter() -> None:
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
        P = -np.array([[d[j] @ B[j] @ B[k] @ d[k] for k in range(6)] for j in range(6)])
        P += np.diag([d[j] @ B[j] @ d[j] for j in range(6)])
        variance = np.diag(P)
        w = (variance + 1e-3 * variance.mean()) ** -0.5
        literal_u.append(np.sqrt((c @ L) @ (c @ L) * (w @ z**2) / (w @ variance)))
        literal_nu.append((w @ variance) ** 2 / (w @ P**2 @ w))
    parts = [triangle(np.column_stack([part[:, :3], part[:, 3] - part[:, :3] @ theta])) for part in rows]
    u, nu, _ = scatter_of(parts)
    assert literal_u == pytest.approx(u, abs=1e-10)
    assert literal_nu == pytest.approx(nu, abs=1e-9)


@pytest.mark.parametrize("rho", [1e-3, 0.3, 0.8])
def test_calibration_ripple(rho: float) -> None:
    """First harmonic over mean of the time at an angle, its closed form, and what the library takes from the parts of a turn."""
    x = 2.0 * np.pi * (np.arange(32 * 400) + 0.5) / (32 * 400)
    times = 1.0 / (1.0 + rho * np.sin(x - 0.7))
    literal = 2.0 * abs(np.mean(times * np.exp(-1j * x))) / times.mean()
    assert literal == pytest.approx(2.0 * (1.0 - np.sqrt(1.0 - rho**2)) / rho, abs=1e-10)
    assert rho == pytest.approx(ripple(times.reshape(32, 400).sum(axis=1)), abs=1e-6)


def test_inverse_published() -> None:
    run = run_of(T, FORCE, phi=PHI)
    calibration = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": PHI}, phase_source="input")
    phase = 0.5 * (run.output[1:] + run.output[:-1]) - run.output[0] + PHI
    rate, (_, a_Y, a_Z) = np.diff(run.output) / np.diff(T), 0.5 * (FORCE[1:] + FORCE[:-1]).T
    literal = rate / K - np.hypot(a_Y, a_Z) * TAN_BETA * np.sin(phase - np.arctan2(a_Z, a_Y))
    assert literal == pytest.approx(piga.compensate(run, calibration).ax[1:], abs=1e-11)


def test_inverse_uncertainty() -> None:
    r, q, h, u_k0 = 2e-6, 3e-5, 0.01, 3e-6
    calibration = calibration_of(
        {"scale_factor": K_G, "k0": 0.0}, {"k0": u_k0}, angle_rms=r, angle_random_walk=q
    )
    run = run_of(np.array([0.0, h, 2 * h]), np.tile([G0, 0.0, 0.0], (3, 1)))
    literal = np.sqrt((u_k0 * G0) ** 2 + (2 * r**2 / h + q**2) / (h * K**2))
    assert literal == pytest.approx(piga.compensate(run, calibration).u_ax[1], rel=1e-4)


def test_inverse_bow() -> None:
    """A base rate that is a cubic of time, over uneven intervals: its mean is that of the integral."""
    t = np.array([0.0, 0.011, 0.02, 0.032])
    cubic = np.polynomial.Polynomial([0.02, 1.0, 30.0, 20.0])
    (h2, h1, h0), x = np.diff(t), cubic(t)
    slope = np.diff(x) / np.diff(t)
    before, after = 2 * (slope[1] - slope[0]) / (h2 + h1), 2 * (slope[2] - slope[1]) / (h1 + h0)
    ahead = (h0 + 2 * h1) / (2 * (h0 + h1 + h2))
    literal = (x[2] + x[3]) / 2 - h0**2 / 12 * (after + ahead * (after - before))
    whole = cubic.integ()
    assert literal == pytest.approx((whole(t[3]) - whole(t[2])) / h0, abs=1e-14)
    force, turn = np.tile([G0, 0.0, 0.0], (4, 1)), np.column_stack([x, 0 * x, 0 * x])
    columns = {"t": t, "output": K * G0 * t, "f": force, "begins": np.arange(4) == 0}
    with_rate, without = (
        piga.Compensator(calibration_of({"scale_factor": K_G})).push({**columns, **more})
        for more in ({"base_rate": turn}, {})
    )
    assert literal / K == pytest.approx(with_rate.ax[3] - without.ax[3], abs=1e-12)


def test_inverse_hidden() -> None:
    """Long oscillations of ten to two samples a period, and a white series, seen by the differences of their samples."""
    series = [np.sin(2 * np.pi * np.arange(30000) / period) for period in (10.0, 4.4, 2.9, 2.1)]
    for x in (*series, np.random.default_rng(0).standard_normal(30000)):
        first, second = np.mean(np.diff(x) ** 2), np.mean(np.diff(x, 2) ** 2)
        literal = second / 6 * min(1, (second - first) / (2 * first))
        assert max(literal, 0.0) == pytest.approx(near_nyquist(first, second, 0.0), abs=1e-13)
    assert literal == pytest.approx(1.0, abs=0.05)


def test_servo_gain() -> None:
    w, twin = 8.884, TwinParameters(integral_gain=3000.0, rate_gain=0.02)
    nu = (twin.angular_momentum + twin.rate_gain) * w**2 / twin.integral_gain
    literal = (1 - nu) / ((1 - nu) ** 2 + (twin.proportional_gain * w / twin.integral_gain) ** 2)
    gains = twin.integral_gain, twin.proportional_gain, twin.rate_gain, twin.damping
    at_rest, turning = (servo_terms(twin.K, twin.pendulosity, *gains, rate=rate) for rate in (0.0, w))
    assert np.divide(turning, at_rest) == pytest.approx([literal] * 2, abs=1e-12)
