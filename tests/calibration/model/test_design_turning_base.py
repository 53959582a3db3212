"""Base rate and reference force that bend between samples: records by SciPy on equation (2) of the theory."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import piga
from piga._kernels.arithmetic import weigh_neighbours
from piga._kernels.estimation import product_column, smooth_bows
from piga.terms import PRODUCTS
from piga.units import G0

K_G, TAN_BETA, BIAS, PHI = 0.8884, 5e-3, 1e-4, 0.3


def swaying(s: float) -> tuple[np.ndarray, np.ndarray]:
    """Force and rate of a base that sways by 0.3 rad/s at 0.3 Hz."""
    w = 2.0 * np.pi * 0.3
    tilt = 0.4 + 0.3 / w * np.sin(w * s)
    force = G0 * np.array([np.cos(tilt), -np.sin(tilt), 0.3 + 0.1 * np.sin(0.7 * w * s)])
    return force, np.array([0.3 * np.sin(w * s), 0.1 * np.cos(w * s), 0.3 * np.cos(w * s)])


def record(rate: float, seconds: float) -> piga.Run:
    t, K = np.arange(0.0, seconds, 1.0 / rate), K_G / G0

    def motion(s: float, x: np.ndarray) -> list[float]:
        f, turn = swaying(s)
        u = K * f - turn
        return [u[0] + K * BIAS * G0 + TAN_BETA * (u[1] * np.sin(x[0]) - u[2] * np.cos(x[0]))]

    solution = solve_ivp(
        motion, (0.0, t[-1]), [PHI], method="DOP853", rtol=1e-11, atol=1e-11, t_eval=t, max_step=0.1
    )
    f, turn = (np.array([swaying(s)[i] for s in t]) for i in (0, 1))
    psi = solution.y[0] - PHI + 1e-8 * np.random.default_rng(0).standard_normal(t.size)
    return piga.Run.from_arrays(t, psi, f, scale_factor="0.8884 rad/s/g", base_rate=turn, units="SI")


@pytest.mark.interpreted
def test_coefficients_of_a_swaying_base() -> None:
    """Chords made K wrong by 763 ppm and k0 by 700 micro-g here."""
    calibration = piga.calibrate(record(50.0, 20.0), ["scale_factor", "tan_beta", "k0"])
    assert calibration["scale_factor"].value == pytest.approx(K_G, rel=2e-6)
    assert calibration["k0"].value == pytest.approx(BIAS, abs=2e-6)
    assert calibration["tan_beta"].value == pytest.approx(TAN_BETA, rel=1e-5)
    assert calibration["phi"].value == pytest.approx(PHI, abs=1e-5)


def bows_of(x: np.ndarray, h: np.ndarray) -> np.ndarray:
    before, after, share, bend, bows = np.empty((5, h.size))
    weigh_neighbours(np.where(h != 0.0, h, 1.0), before, after, share)
    smooth_bows(x, h, before, after, share, bend, bows)
    return bows


def test_a_cubic_has_its_mean_whatever_the_intervals() -> None:
    rng = np.random.default_rng(1)
    t = np.cumsum(rng.uniform(0.8, 1.2, 12))
    cubic = np.polynomial.Polynomial([1.0, -0.3, 2.0, 0.02])
    whole, h = cubic.integ(), np.diff(t)
    bows = bows_of(cubic(t), h)
    np.testing.assert_allclose(bows, np.diff(whole(t)) / h - 0.5 * (cubic(t[1:]) + cubic(t[:-1])), rtol=1e-9)
    h[5] = 0.0
    parted = bows_of(cubic(t), h)
    assert parted[5] == 0.0
    np.testing.assert_allclose(np.delete(parted, 5), np.delete(bows, 5), rtol=1e-9)
    h[3] = h[8] = 0.0
    assert not bows_of(cubic(t), h)[3:9].any()  # two intervals tell no smoothness


@pytest.mark.parametrize(
    "samples",
    [np.arange(20) >= 10, np.arange(20) == 10, np.arange(20), np.zeros(20)],
    ids=["step", "bad sample", "ramp", "rest"],
)
def test_nothing_rings(samples: np.ndarray) -> None:
    assert not bows_of(samples.astype(float), np.full(19, 0.25)).any()


def test_a_kink_stays_at_a_kink() -> None:
    """The wrong mean of the interval that holds it is an eighth of the change; no other is off by more than that."""
    bows = bows_of(np.maximum(np.arange(20) - 9.4, 0.0), np.ones(19))
    assert np.flatnonzero(bows).tolist() == [9]
    assert abs(bows[9]) < 1.0 / 12.0


@pytest.mark.parametrize(
    "name",
    ["k1", "k2", "k3", "k2o", "k1a", "m_Y", "m_Z", "k_XY", "k_XZ", "k_YY", "k_ZZ", "k_YZ", "k1_T", "x t"],
)
def test_columns_with_bows_are_integrals_over_parabolas(name: str) -> None:
    """To first order: bows of 1e-5 of the force, against the integrand at 20 nodes of Gauss. The last name is no term yet."""
    rng = np.random.default_rng(2)
    f, warm, bows, h = (
        rng.normal(size=(3, 2)),
        rng.normal(size=2),
        1e-5 * rng.normal(size=(3, 1)),
        np.array([0.7]),
    )
    v, weight = np.polynomial.legendre.leggauss(20)
    t = np.array([2.0, 2.7])

    def mean(size: float) -> float:
        a = [0.5 * (s[0] + s[1]) + 0.5 * v * (s[1] - s[0]) for s in (*f, warm)]
        for axis in range(3):
            a[axis] = a[axis] + size * 1.5 * bows[axis, 0] * (1.0 - v * v)
        x, y, z, T = a
        integrand = {
            "k1": x, "k2": x * x, "k3": x**3, "k2o": x * abs(x), "k1a": abs(x), "m_Y": y, "m_Z": z, "k_XY": x * y, "k_XZ": x * z,
            "k_YY": y * y, "k_ZZ": z * z, "k_YZ": y * z, "k1_T": x * T, "x t": x * (2.35 + 0.35 * v),
        }[name]  # fmt: skip
        return 0.5 * float(weight @ integrand)

    f[:] = 3.0 + 0.01 * f
    bent, straight, samples = np.zeros(1), np.zeros(1), dict(zip("xyzTt", (*f, warm, t - 0.0), strict=True))
    middles = {name: own.mean(keepdims=True) for name, own in samples.items()}
    product_column(PRODUCTS.get(name) or ("x", "t"), samples, middles, h, straight)
    middles |= {name: middles[name] + 1.5 * bow for name, bow in zip("xyz", bows, strict=True)}
    product_column(PRODUCTS.get(name) or ("x", "t"), samples, middles, h, bent)
    assert bent[0] - straight[0] == pytest.approx(h[0] * (mean(1.0) - mean(0.0)), rel=0.02, abs=1e-9)
