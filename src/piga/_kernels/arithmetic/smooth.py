"""Second derivatives of an input, where its samples show that it is smooth.

The mean of a smooth input over an interval is the mean of both ends less ``h^2/12`` of its second derivative in the
middle. At a step, a kink or a bad sample, second differences change their sign or size from sample to sample. If the
sign changes, the second derivative is taken as zero. It is never more than twice the smaller of two neighbours, so
that nothing rings.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from piga._kernels.jit import exact, inline

Array = NDArray[np.float64]

MOST_GROWTH = 2.0
"""The second derivative in an interval is at most this multiple of the smaller one of its neighbours."""


@inline
def limited(value: float, first: float, second: float) -> float:
    """A second derivative limited by two others; 0 if their signs differ."""
    low, high = min(first, second), max(first, second)
    return min(max(value, 0.0), MOST_GROWTH * max(low, 0.0)) + max(
        min(value, 0.0), MOST_GROWTH * min(high, 0.0)
    )


@exact
def curvature(x: Array, h: Array, i: int) -> float:
    """Second derivative from sample ``i`` of ``x`` and its neighbours; ``h[i]`` is the interval after sample ``i``."""
    return 2.0 * ((x[i + 1] - x[i]) / h[i] - (x[i] - x[i - 1]) / h[i - 1]) / (h[i - 1] + h[i])


@inline
def bow_of(h: float, curved: float) -> float:
    """Mean over an interval ``h`` less the mean of both ends, for a second derivative ``curved``."""
    return -h * h * (1.0 / 12.0) * curved
