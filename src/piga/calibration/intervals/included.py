"""All noise of a fit, in the order in which it is looked for (the rules: docs/theory/noise)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from piga.calibration.fit.one_run import Fit
from piga.calibration.intervals.coloured_noise import include_coloured_noise
from piga.calibration.intervals.faint_walk import include_faint_walk
from piga.calibration.intervals.slow_noise import include_slow_noise, include_stated_scatter
from piga.calibration.noise.settings import NOISE

Array = NDArray[np.float64]


def include_noise(fit: Fit, stated: Array, clear: float = NOISE.slow_in_weights) -> Fit:
    """The fit with the noise that its record shows, in the covariance and, where it is clear, in the weights.

    Parameters
    ----------
    fit:
        The fit by white noise, random walk and counting.
    stated:
        Stated variance of the rate of each segment (m,) [rad^2/s^2].
    clear:
        Gain above which a drift enters the weights; inf if it must not.
    """
    fit = include_coloured_noise(include_stated_scatter(fit, stated))
    if fit.colour is not None:
        return fit
    return include_faint_walk(include_slow_noise(fit, clear=clear))
