"""Kernels of the estimator: columns against quadrature, whitening against the dense covariance, samples off the path."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from scipy.integrate import quad

from piga._kernels.estimation import (
    coupling_columns,
    half_angle_moments,
    innovation_weights,
    merge_rows,
    product_column,
    rate_sums,
    scan_samples,
    whiten,
)
from piga.terms import PRODUCTS

pytestmark = pytest.mark.interpreted


@pytest.mark.parametrize("x", [1e-9, 1e-3, 0.1, 0.35, 0.499999, 0.500001, 0.7, 3.0, -0.4, -2.0, 40.0])
def test_half_angle_moments(x: float) -> None:
    """Against spherical Bessel functions with 50 digits; the series for small ones reach rounding."""
    with mp.workdps(50):
        size = mp.mpf(x)
        j0 = mp.sin(size) / size
        j1 = (mp.sin(size) - size * mp.cos(size)) / size**2
        for one, exact in zip(half_angle_moments(x), (j0, j1, 2 * j1 / size), strict=True):
            assert abs(one - exact) < (4e-16 * abs(exact) if abs(x) < 0.5 else 1e-14)
    assert half_angle_moments(0.0) == pytest.approx((1.0, 0.0, 2.0 / 3.0), abs=1e-16)


@pytest.mark.parametrize("turn", [1e-4, 0.1, 0.9, 2.5])
@pytest.mark.parametrize("order", [1.0, 2.0])
def test_product_integration_of_the_coupling(turn: float, order: float) -> None:
    psi, y, z = np.array([0.3, 0.3 + turn]), np.array([4.0, 5.5]), np.array([-2.0, 1.0])
    h, bend, bows = np.array([0.05]), np.array([2e-5]), np.zeros((2, 1))
    columns = np.empty((2, 1))
    sine, cosine = columns
    coupling_columns(psi, y, z, bows, h, bend, order, columns)

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
    coupling_columns(psi, y, z, bows, h, 0.0 * bend, order, columns)
    bend[0] = 0.0
    assert sine[0] == pytest.approx(wanted(0), rel=1e-12, abs=1e-14)
    assert cosine[0] == pytest.approx(wanted(1), rel=1e-12, abs=1e-14)


FORCE_TERMS = {
    "scale_factor": lambda x, y, z, t, T: x,
    "k1": lambda x, y, z, t, T: x,
    "k0": lambda x, y, z, t, T: 1.0,
    "k2": lambda x, y, z, t, T: x * x,
    "k3": lambda x, y, z, t, T: x**3,
    "k2o": lambda x, y, z, t, T: x * abs(x),
    "k1a": lambda x, y, z, t, T: abs(x),
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
    "k2v": lambda x, y, z, t, T: (2.0 * T) ** 2,
}


@pytest.mark.parametrize("name", list(PRODUCTS))
@pytest.mark.parametrize("ends", [(1.2, 3.4), (-2.0, 5.0), (-1.0, -4.0), (5.0, -0.1)])
def test_force_terms_are_integrated_exactly(name: str, ends: tuple[float, float]) -> None:
    force = np.array([ends, (0.4, -1.1), (2.0, 2.5)])
    t, temperature, h = np.array([3.0, 3.2]), np.array([-4.0, 5.0]), np.array([0.2])
    out, inputs = np.empty(1), dict(zip("xyztTv", (*force, t, temperature, 2.0 * temperature), strict=True))
    product_column(
        PRODUCTS[name], inputs, {name: own.mean(keepdims=True) for name, own in inputs.items()}, h, out
    )

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


@pytest.mark.parametrize("kappa", [1e-3, 0.7, 1e3])
def test_sums_by_position_are_those_of_the_dense_covariance(kappa: float) -> None:
    """The largest products of variances grow beyond 1e300 on the way: their logarithm is taken in between."""
    rng = np.random.default_rng(6)
    h, edges = rng.uniform(0.05, 0.2, 240), np.array([0, 20, 90, 240])
    h[edges[:-1]] = 0.0
    h[50] = -1.0  # left out: the innovation is passed on
    d = rng.standard_normal(h.size) * (h > 0.0)
    sums = np.zeros((3, 3))
    logarithm, wanted = rate_sums(d, h, edges, kappa, sums), 0.0
    for k in range(3):
        rows = np.flatnonzero(h[edges[k] : edges[k + 1]] > 0.0) + edges[k]
        covariance = dense_covariance(h[rows], 1.0, kappa)
        wanted += np.linalg.slogdet(covariance)[1]
        along, off = np.linalg.solve(covariance, h[rows]), np.linalg.solve(covariance, d[rows])
        assert sums[k] == pytest.approx([h[rows] @ along, h[rows] @ off, d[rows] @ off], rel=1e-9)
    assert logarithm == pytest.approx(wanted, rel=1e-12)


def flags_of(angle: np.ndarray, begins: tuple[int, ...] = (0,)) -> np.ndarray:
    d, h = np.diff(angle, prepend=angle[0]), np.full(angle.size, 0.1)
    d[list(begins)], h[list(begins)] = 0.0, 0.0
    flags = np.zeros(angle.size, dtype=np.int8)
    scan_samples(d, h, 1e-10, 1e-12, 5.0, 0.0, flags)
    return flags


def noise(size: int) -> np.ndarray:
    return 1e-5 * np.random.default_rng(7).standard_normal(size)


def test_jump_with_a_spike_inside() -> None:
    angle = noise(80)
    angle[30:] += 1e-2
    angle[33] -= 5e-2
    flags = flags_of(angle)
    assert flags[30] == 2
    assert np.flatnonzero(flags == 1).tolist() == [33]


def test_a_bad_first_sample_is_left_out_not_a_jump_of_the_rest() -> None:
    angle = noise(40)
    angle[0] += 1.0
    assert flags_of(angle)[:3].tolist() == [1, 2, 0]


def test_in_a_stretch_of_few_samples_the_majority_decides() -> None:
    angle = noise(12)
    angle[[0, 6]] += 1.0
    assert np.flatnonzero(flags_of(angle, (0, 6))).tolist() == [0, 6]


def test_merging_keeps_the_sums_and_stops_at_a_new_stretch() -> None:
    h = np.array([0.0, 1.0, 1.0, 1.0, 0.0, 1.0])
    columns = np.array([[0.0, 1.0, 2.0, 3.0, 0.0, 5.0]])
    left_out = np.array([False, True, True, False, False, True])
    merge_rows(columns, h, left_out)
    assert h.tolist() == [0.0, -1.0, -1.0, 3.0, 0.0, -1.0]
    assert columns[0].tolist() == [0.0, 0.0, 0.0, 6.0, 0.0, 0.0]
