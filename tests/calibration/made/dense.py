"""What a fit is compared with: dense covariances, and the same estimate of records that are turned a little."""

from __future__ import annotations

import numpy as np

from piga.calibration.weights import Noise
from tests.calibration.made.scenarios import Array


def increments_covariance(noise: Noise, steps: int, h: float) -> Array:
    """Dense covariance (steps, steps) of the increments of one stretch."""
    neighbours = np.diag(np.ones(steps - 1), 1) + np.diag(np.ones(steps - 1), -1)
    result: Array = np.diag(np.full(steps, noise.walk * h + 2.0 * noise.white)) - noise.white * neighbours
    return result
