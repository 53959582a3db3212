"""Rows of a segment in the parameters of a finished fit, linear about its solution.

With one phase the parameters are the column coefficients, and nothing is approximated. With a phase per
segment they are the amplitudes, and the phase of a segment is taken out of its own rows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from piga.calibration.model.solution import Layout, Solution

Array = NDArray[np.float64]


def has_phases(layout: Layout, groups: tuple[int, ...]) -> bool:
    """True when the segments have phases of their own."""
    return layout.local > 0 and len(set(groups)) > 1


def parameter_rows(
    layout: Layout, solution: Solution, groups: tuple[int, ...], segment: int, rows: Array
) -> Array:
    """Rows of a segment, reduced to a factor ``[parameters | rest]``.

    Parameters
    ----------
    layout, solution, groups:
        Of the fit, with the phase group of each segment.
    segment:
        Index of the segment.
    rows:
        (k, m + r): weighted columns of the model in the order of ``layout.columns``, then any others.

    Returns
    -------
    ndarray
        At most (n + r, n + r): n column coefficients with one phase, n amplitudes with several.
    """
    m = len(layout.columns)
    if not has_phases(layout, groups):
        return np.asarray(np.linalg.qr(rows, mode="r"))
    derivative = rows[:, :m] @ solution.jacobians[segment]
    phase = derivative[:, layout.size + groups[segment]]
    both = np.column_stack([phase, derivative[:, : layout.size], rows[:, m:]])
    factor = np.asarray(np.linalg.qr(both, mode="r"))
    return factor[1:, 1:] if phase.any() else factor[:, 1:]
