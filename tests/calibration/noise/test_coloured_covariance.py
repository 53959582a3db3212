"""The covariance with coloured noise in it stays one: correlations at most one, whatever the signs of the levels."""

from __future__ import annotations

import numpy as np

import piga
from tests.results.conftest import TERMS, a_run


def test_the_covariance_is_positive() -> None:
    """A record whose level of the walk comes out negative; a correlation was 1.19."""
    cal = piga.calibrate(a_run(), TERMS)
    assert cal.coloured_noise is not None
    size = np.sqrt(np.diag(cal.covariance))
    assert np.linalg.eigvalsh(cal.covariance / np.outer(size, size)).min() > 0.0
