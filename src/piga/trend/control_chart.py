"""Control chart of scores: exponentially weighted moving average with its limit."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SMOOTHING = 0.2
"""Weight of the newest score in the moving average of the control chart."""
LIMIT = 3.0
"""Control limit of scores and of their moving average, in its standard deviations."""


def moving_average(scores: Array, weight: float = SMOOTHING) -> tuple[Array, Array]:
    """Exponentially weighted moving average of the scores, and its control limit.

    For independent standard normal scores the variance after ``n`` of them is
    ``w/(2 - w) (1 - (1 - w)^(2 n))``.
    """
    averages, limits = np.full(scores.size, np.nan), np.full(scores.size, np.nan)
    average, seen = 0.0, 0
    for i, score in enumerate(scores):
        if math.isnan(score):
            continue
        seen += 1
        average = weight * float(np.clip(score, -LIMIT, LIMIT)) + (1.0 - weight) * average
        averages[i] = average
        limits[i] = LIMIT * math.sqrt(weight / (2.0 - weight) * (1.0 - (1.0 - weight) ** (2 * seen)))
    return averages, limits
