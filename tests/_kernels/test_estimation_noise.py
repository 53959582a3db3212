"""Whitening and sums by position of white noise and random walk against the dense covariance."""

from __future__ import annotations

import numpy as np
import pytest

from piga._kernels.estimation import innovation_weights, rate_sums, whiten

pytestmark = pytest.mark.interpreted


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
