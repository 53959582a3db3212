"""Whitening and likelihood of white noise and random walk against the dense covariance."""

from __future__ import annotations

import numpy as np
import pytest

from piga._kernels.estimation.noise import CANDIDATES, innovation_weights, likelihoods, whiten

pytestmark = pytest.mark.compiled


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
    """The products of the variances grow beyond 1e300 on the way: they are scaled down in between."""
    rng = np.random.default_rng(6)
    h = rng.uniform(0.05, 0.2, 160)
    h[20] = 0.0
    d = rng.standard_normal(160)
    d[20] = 0.0
    kappas = np.geomspace(1e-3, 1e3, CANDIDATES)
    log, square = np.zeros(CANDIDATES), np.zeros(CANDIDATES)
    likelihoods(d, h, kappas, log, square)
    for kappa, found_log, found_square in zip(kappas, log, square, strict=True):
        wanted_log = wanted_square = 0.0
        for part in (slice(0, 20), slice(21, 160)):
            covariance = dense_covariance(h[part], 1.0, kappa)
            wanted_log += np.linalg.slogdet(covariance)[1]
            wanted_square += d[part] @ np.linalg.solve(covariance, d[part])
        assert found_log == pytest.approx(wanted_log, rel=1e-12, abs=1e-12)
        assert found_square == pytest.approx(wanted_square, rel=1e-12)
