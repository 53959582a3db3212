"""The rows of a fit with its weights, those of a slow noise among them, however they are found."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from piga.calibration.fit.one_run import Fit
from piga.calibration.model.design import Design
from piga.calibration.noise.levels import Noise
from piga.calibration.noise.slow_bases import Columns
from piga.calibration.noise.weighting import weighted_blocks

Array = NDArray[np.float64]


def whitened_rows(fit: Fit, design: Design, noise: Noise, basis: Columns) -> Iterator[tuple[int, Array]]:
    """Segment and whitened columns (m + size + 1, n) of model, slow noise and observation, piece by piece.

    ``noise`` is what increments are whitened with; coarse counts have the covariance that was found for them.
    """
    if fit.counted is not None:
        yield from fit.counted.whitened(design, basis)
        return
    for block, columns in weighted_blocks(design, fit.mode, noise, basis):
        yield block.segment, columns
