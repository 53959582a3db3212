"""From a counter or a folded angle to an unwrapped output angle, or the reason why not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Unwrapped:
    """An unwrapped reading.

    ``value``: unwrapped reading; ``wraps``: roll-overs met; ``lost``: samples where the whole count of
    revolutions since the sample before cannot be known (``psi`` keeps its phase only when the range is a
    whole number of revolutions).
    """

    value: Array
    wraps: int
    lost: NDArray[np.bool_]


def unwrap(reading: Array, span: float, begins: NDArray[np.bool_]) -> Unwrapped:
    """Unwrap a reading that folds back at ``span`` by the nearest turn inside stretches.

    Parameters
    ----------
    reading:
        Counts or angle, shape (n,).
    span:
        Range at which it folds, in the reading's unit (``2**bits`` counts, or e.g. 2 pi rad).
    begins:
        True where a stretch begins: what happened before is not known, ``lost`` is set there.

    Notes
    -----
    Between samples the reading must move by less than half the range; the caller checks that with the
    largest rate the reference allows.
    """
    step = np.diff(reading)
    folded = step - span * np.round(step / span)
    wraps = int(np.count_nonzero((np.abs(step - folded) > 0.5 * span) & ~begins[1:]))
    value = np.concatenate(([reading[0]], reading[0] + np.cumsum(folded)))
    lost = begins.copy()
    lost[0] = False
    return Unwrapped(value, wraps, lost)
