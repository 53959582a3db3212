"""A random walk of the rate as a few columns: what it adds to the angle between knots (own derivation)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga.records.run import Run

Array = NDArray[np.float64]

KNOTS = 32
"""Steps in which the rate wanders over a record; it is linear in time between them."""
DRIFT_NAMES = tuple(f"drift step {k + 1}" for k in range(KNOTS))
"""Names of their columns in a summary."""


@dataclass(frozen=True)
class DriftBasis:
    """The rate is a sum of KNOTS ramps, each from 0 to its own step within ``spacing`` [s], zero at the middle.

    The steps of a random walk are independent and of one variance. Zero at the middle of the record: a bias
    estimated with it is the bias there.
    """

    start: float
    spacing: float

    @classmethod
    def of(cls, run: Run) -> DriftBasis:
        """That of a record, over all its stretches and the time between them."""
        first, last = float(run.t[0]), float(run.t[-1])
        return cls(first, (last - first) / KNOTS)

    def angle(self, t: Array) -> Array:
        """Angle (KNOTS, n) that unit steps add from the start to the times ``t`` (n,)."""
        at = (t - self.start) / self.spacing
        since = np.maximum(at - np.arange(KNOTS)[:, None], 0.0)
        ramp = np.where(since < 1.0, 0.5 * since**2, since - 0.5)
        before = np.arange(KNOTS)[:, None] < KNOTS // 2
        found: Array = self.spacing * (ramp - before * at)
        return found

    def increments(self, t: Array, h: Array) -> Array:
        """Columns (KNOTS, n) of the increments that end at ``t`` and last ``h``; zero where none is formed."""
        formed = h > 0.0
        found: Array = (self.angle(t) - self.angle(t - h * formed)) * formed
        return found
