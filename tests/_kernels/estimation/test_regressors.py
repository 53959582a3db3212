"""Kernels of the calibration against quadrature and dense linear algebra."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.interpolate import CubicSpline

from piga._kernels.estimation.noise import CANDIDATES, innovation_weights, likelihoods, whiten
from piga._kernels.estimation.regressors import CODES, coupling_columns, half_angle_moments, product_column
from piga._kernels.estimation.square_root import absorb, absorb_rows
from piga.calibration.fit.residuals import LAG_PART, add_lagged_products
from piga.calibration.noise.levels import Noise, find_noise, natural_spline

pytestmark = pytest.mark.compiled


@pytest.mark.parametrize("x", [0.0, 1e-9, 1e-3, 0.3, 0.499999, 0.500001, 0.7, 3.0, -0.4, -2.0, 40.0])
def test_half_angle_moments(x: float) -> None:
    j0, j1, sag = half_angle_moments(x)
    options = {"epsabs": 1e-13, "epsrel": 1e-12, "limit": 400}
    assert j0 == pytest.approx(0.5 * quad(lambda v: np.cos(x * v), -1, 1, **options)[0], abs=3e-14)
    assert j1 == pytest.approx(0.5 * quad(lambda v: v * np.sin(x * v), -1, 1, **options)[0], abs=3e-14)
    assert sag == pytest.approx(
        0.5 * quad(lambda v: (1 - v * v) * np.cos(x * v), -1, 1, **options)[0], abs=3e-14
    )


@pytest.mark.parametrize("x", [0.1, 0.35, 0.4999])
def test_the_series_of_the_moments_reach_rounding(x: float) -> None:
    """Against spherical Bessel functions with 50 digits."""
    with mp.workdps(50):
        size = mp.mpf(x)
        j0 = mp.sin(size) / size
        j1 = (mp.sin(size) - size * mp.cos(size)) / size**2
        for one, exact in zip(half_angle_moments(x), (j0, j1, 2 * j1 / size), strict=True):
            assert abs(one / exact - 1) < 4e-16


def test_every_column_has_a_code_of_its_own() -> None:
    assert len(set(CODES.values())) == len(CODES)
    assert max(CODES.values()) < 100  # where the harmonics begin


@pytest.mark.parametrize("name", ["a_x", *(name for name in CODES if name[0] == "k" or name[0] == "m")])
def test_columns_of_several_intervals_are_those_of_each(name: str) -> None:
    rng = np.random.default_rng(8)
    h, t, temperature, force = (
        rng.uniform(0.1, 0.3, 4),
        rng.normal(size=5),
        rng.normal(size=5),
        rng.normal(size=(3, 5)),
    )
    out, one = np.empty(4), np.empty(1)
    product_column(CODES[name], t, force, temperature, h, out)
    for i in range(4):
        part = slice(i, i + 2)
        force_of_one = np.ascontiguousarray(force[:, part])
        product_column(CODES[name], t[part], force_of_one, temperature[part], h[i : i + 1], one)
        assert out[i] == one[0]


@pytest.mark.parametrize("turn", [1e-4, 0.1, 0.9, 2.5])
@pytest.mark.parametrize("order", [1.0, 2.0])
def test_product_integration_of_the_coupling(turn: float, order: float) -> None:
    psi, y, z = np.array([0.3, 0.3 + turn]), np.array([4.0, 5.5]), np.array([-2.0, 1.0])
    h, bend = np.array([0.05]), np.array([2e-5])
    cosine, sine = np.empty(1), np.empty(1)
    coupling_columns(psi, y, z, h, bend, order, cosine, sine)

    def at(s: float) -> tuple[float, float, float]:
        angle = order * (psi[0] + s * turn + 4.0 * s * (1.0 - s) * bend[0])
        return angle, y[0] + s * (y[1] - y[0]), z[0] + s * (z[1] - z[0])

    def wanted(which: int) -> float:
        def integrand(s: float) -> float:
            angle, ys, zs = at(s)
            if which:
                return ys * np.cos(angle) + zs * np.sin(angle)
            return ys * np.sin(angle) - zs * np.cos(angle)

        return h[0] * quad(integrand, 0, 1, epsabs=1e-13, epsrel=1e-12)[0]

    # left out is the sag times the slope of y and z; the sag itself makes up to 1.2e-4 h here
    assert sine[0] == pytest.approx(wanted(0), abs=2e-5 * h[0])
    assert cosine[0] == pytest.approx(wanted(1), abs=2e-5 * h[0])
    coupling_columns(psi, y, z, h, 0.0 * bend, order, cosine, sine)
    bend[0] = 0.0
    assert sine[0] == pytest.approx(wanted(0), rel=1e-12, abs=1e-14)
    assert cosine[0] == pytest.approx(wanted(1), rel=1e-12, abs=1e-14)


FORCE_TERMS = {
    "a_x": lambda x, y, z, t, T: x,
    "k0": lambda x, y, z, t, T: 1.0,
    "k2": lambda x, y, z, t, T: x * x,
    "k3": lambda x, y, z, t, T: x**3,
    "k2o": lambda x, y, z, t, T: x * abs(x),
    "m_Y": lambda x, y, z, t, T: y,
    "m_Z": lambda x, y, z, t, T: z,
    "k_XY": lambda x, y, z, t, T: x * y,
    "k_XZ": lambda x, y, z, t, T: x * z,
    "k_YY": lambda x, y, z, t, T: y * y,
    "k_ZZ": lambda x, y, z, t, T: z * z,
    "k_YZ": lambda x, y, z, t, T: y * z,
    "k0_t": lambda x, y, z, t, T: t,
    "k0_T": lambda x, y, z, t, T: T,
    "k1_T": lambda x, y, z, t, T: x * T,
}


@pytest.mark.parametrize("name", list(FORCE_TERMS))
@pytest.mark.parametrize("ends", [(1.2, 3.4), (-2.0, 5.0), (-1.0, -4.0), (5.0, -0.1)])
def test_force_terms_are_integrated_exactly(name: str, ends: tuple[float, float]) -> None:
    force = np.array([ends, (0.4, -1.1), (2.0, 2.5)])
    t, temperature, h = np.array([3.0, 3.2]), np.array([-4.0, 5.0]), np.array([0.2])
    out = np.empty(1)
    product_column(CODES[name], t, force, temperature, h, out)

    def integrand(s: float) -> float:
        x, y, z = force[:, 0] + s * np.diff(force, axis=1)[:, 0]
        return FORCE_TERMS[name](x, y, z, t[0] + s * h[0], temperature[0] + s * np.diff(temperature)[0])

    kink = -ends[0] / (ends[1] - ends[0])
    points = [kink] if 0.0 < kink < 1.0 else None
    assert out[0] == pytest.approx(
        h[0] * quad(integrand, 0, 1, points=points, epsabs=1e-13)[0], rel=1e-12, abs=1e-13
    )


def dense_covariance(h: np.ndarray, white: float, walk: float) -> np.ndarray:
    covariance = np.diag(walk * h + 2.0 * white)
    index = np.arange(len(h) - 1)
    covariance[index, index + 1] = covariance[index + 1, index] = -white
    return covariance


def test_whitening_is_the_inverse_cholesky_factor() -> None:
    rng = np.random.default_rng(5)
    h = rng.uniform(0.05, 0.2, 40)
    columns = rng.standard_normal((3, 40))
    white, walk = 2.0, 7.0
    carry, scale, out, state = np.empty(40), np.empty(40), np.empty((3, 40)), np.zeros(3)
    last = innovation_weights(h[:17], white, walk, 0.0, carry[:17], scale[:17])
    innovation_weights(h[17:], white, walk, last, carry[17:], scale[17:])
    whiten(columns[:, :17].copy(), carry[:17], scale[:17], state, out[:, :17])
    whiten(columns[:, 17:].copy(), carry[17:], scale[17:], state, out[:, 17:])
    wanted = np.linalg.solve(np.linalg.cholesky(dense_covariance(h, white, walk)), columns.T).T
    np.testing.assert_allclose(out, wanted, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize(("white", "walk"), [(2e-10, 3e-3), (2e-10, 1e-12), (2e-10, 0.0), (0.0, 1e-4)])
def test_weights_are_those_of_the_recursion(white: float, walk: float) -> None:
    """Over many rows, with new stretches and samples left out, in blocks: ``v_n = q h_n + 2 r - r^2/v_(n-1)``."""
    rng = np.random.default_rng(9)
    h = rng.uniform(0.005, 0.02, 2000)
    h[rng.integers(0, h.size, 9)] = 0.0
    h[rng.integers(0, h.size, 50)] = -1.0
    carry, scale, last = np.empty(h.size), np.empty(h.size), 0.0
    for part in (slice(0, 701), slice(701, 702), slice(702, None)):
        last = innovation_weights(h[part], white, walk, last, carry[part], scale[part])
    before = 0.0
    for i, step in enumerate(h):
        if step < 0.0:
            assert (carry[i], scale[i]) == (1.0, 0.0)
            continue
        if step == 0.0:
            assert (carry[i], scale[i]) == (0.0, 0.0)
            before = 0.0
            continue
        share = white / before if before > 0.0 else 0.0
        before = walk * step + 2.0 * white - share * white
        assert carry[i] == pytest.approx(share, rel=1e-11, abs=0.0)
        assert scale[i] == pytest.approx(before**-0.5, rel=1e-11, abs=0.0)
    assert last == pytest.approx(before, rel=1e-11)


def test_likelihood_is_that_of_the_dense_covariance() -> None:
    rng = np.random.default_rng(6)
    h = rng.uniform(0.05, 0.2, 50)
    h[20] = 0.0
    d = rng.standard_normal(50)
    d[20] = 0.0
    kappas = np.geomspace(1e-3, 1e3, CANDIDATES)
    log, square = np.zeros(CANDIDATES), np.zeros(CANDIDATES)
    likelihoods(d, h, kappas, np.empty((4, CANDIDATES)), log, square)
    for kappa, found_log, found_square in zip(kappas, log, square, strict=True):
        wanted_log = wanted_square = 0.0
        for part in (slice(0, 20), slice(21, 50)):
            covariance = dense_covariance(h[part], 1.0, kappa)
            wanted_log += np.linalg.slogdet(covariance)[1]
            wanted_square += d[part] @ np.linalg.solve(covariance, d[part])
        assert found_log == pytest.approx(wanted_log, rel=1e-12, abs=1e-12)
        assert found_square == pytest.approx(wanted_square, rel=1e-12)


@pytest.mark.only_compiled
@pytest.mark.parametrize(("white", "walk"), [(3e-5, 0.0), (3e-5, 1e-6), (3e-5, 1e-4), (1e-9, 1e-4)])
def test_noise_levels_are_found(white: float, walk: float) -> None:
    """Levels of 40 000 samples within four standard deviations of what such a record can tell."""
    rng = np.random.default_rng(7)
    n, step = 40_000, 0.01
    angle = white * rng.standard_normal(n + 1) + np.concatenate(
        ([0.0], np.cumsum(walk * np.sqrt(step) * rng.standard_normal(n)))
    )
    noise = find_noise(np.diff(angle), np.full(n, step), 0, 1e-15)
    if white > 1e-8:
        assert noise.angle_rms == pytest.approx(white, rel=0.02)
    if walk > 0.0:
        corner = walk * np.sqrt(step) / white
        assert noise.angle_random_walk == pytest.approx(walk, rel=4.0 / np.sqrt(2.0 * n * min(corner, 1.0)))
    else:
        assert noise.angle_random_walk < 2e-7
    assert noise.close_to(Noise(white**2, walk**2), step, tolerance=0.5) or walk in (0.0, 1e-6)


def test_householder_and_rotations_give_one_factor() -> None:
    rng = np.random.default_rng(8)
    columns = rng.standard_normal((4, 300))
    block, rows = np.zeros((4, 4)), np.zeros((4, 4))
    absorb(block, columns.copy())
    snapshots = np.empty((2, 4, 4))
    absorb_rows(rows, columns, np.array([150, 300]), snapshots)
    np.testing.assert_allclose(np.abs(block), np.abs(rows), atol=1e-12)
    np.testing.assert_array_equal(snapshots[1], rows)
    np.testing.assert_allclose(snapshots[0].T @ snapshots[0], columns[:, :150] @ columns[:, :150].T, atol=1e-11)


def test_lagged_products() -> None:
    x = np.random.default_rng(9).standard_normal(2 * LAG_PART + 2)
    out = np.zeros(4)
    add_lagged_products(x, out)
    np.testing.assert_allclose(out, [x[k:] @ x[: x.size - k] for k in range(4)], rtol=1e-12, atol=1e-10)


def test_natural_spline() -> None:
    rng = np.random.default_rng(3)
    x, at = np.cumsum(rng.uniform(0.5, 2.0, 9)), np.linspace(-1.0, 14.0, 400)
    y = rng.standard_normal(9)
    expected = CubicSpline(x, y, bc_type="natural")(at)
    np.testing.assert_allclose(
        natural_spline(x, y)(at), expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max()
    )
