"""Second derivatives of an input that its samples show to be smooth.

A smooth input lies off the straight line between two samples: its mean over the interval is that of both ends less
``h^2/12`` of its second derivative in the middle. A step, a kink and a bad sample make second differences that change
their sign or size from sample to sample. Where the sign changes nothing is taken, and never more than twice the smaller of
two neighbours, so that nothing rings.
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
    """A second derivative made of two others, no larger than both agree on; 0 where their signs differ."""
    low, high = min(first, second), max(first, second)
    return min(max(value, 0.0), MOST_GROWTH * max(low, 0.0)) + max(
        min(value, 0.0), MOST_GROWTH * min(high, 0.0)
    )


@exact
def curvature(x: Array, h: Array, i: int) -> float:
    """Second derivative by sample ``i`` of ``x`` and its neighbours; ``h[i]`` is the interval behind sample ``i``."""
    return 2.0 * ((x[i + 1] - x[i]) / h[i] - (x[i] - x[i - 1]) / h[i - 1]) / (h[i - 1] + h[i])


@inline
def bow_of(h: float, curved: float) -> float:
    """Mean over an interval ``h`` less that of both ends, for a second derivative ``curved``."""
    return -h * h * (1.0 / 12.0) * curved
