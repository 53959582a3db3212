"""How the instruments of a set are mounted: calibration and axes of each, checked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga.compensation.model import Phase
from piga.errors import ArgumentError
from piga.records.calibration import Calibration

Array = NDArray[np.float64]

ORTHOGONAL = 1e-6
"""Largest deviation of an axes matrix from a rotation that is taken for a rotation."""


@dataclass(frozen=True)
class Mounted:
    """An instrument in a set: its calibration and its axes.

    Attributes
    ----------
    calibration:
        Coefficients of the instrument.
    axes:
        Rows X0, Y0, Z0 of the instrument in the common frame, shape (3, 3), a rotation.
    phase:
        Phase of the output zero when it is not the calibration's.
    segment:
        Segment whose phase is used (per-segment calibrations).
    """

    calibration: Calibration
    axes: Array
    phase: Phase | None = None
    segment: str | None = None


def rotation(axes: ArrayLike, index: int) -> Array:
    """The axes matrix of an instrument as the nearest exact rotation.

    Raises
    ------
    ArgumentError
        If it is no right-handed set of orthogonal unit vectors.
    """
    matrix = np.asarray(axes, dtype=float)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise ArgumentError(
            f"axes of instrument {index}: shape {matrix.shape}", remedy="rows X0, Y0, Z0 of 3 numbers each"
        )
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > ORTHOGONAL or np.linalg.det(matrix) < 0.0:
        raise ArgumentError(
            f"axes of instrument {index}: the rows are no right-handed set of orthogonal unit vectors",
            remedy="give X0, Y0, Z0 of the instrument in the common frame, to six digits or more",
        )
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)


def check_spread(axes: Array) -> None:
    """Refuse fewer than three instruments, and input axes that lie in one plane; ``axes`` (N, 3, 3).

    Raises
    ------
    ArgumentError
        In both cases.
    """
    if axes.shape[0] < 3:
        raise ArgumentError(
            f"a set of {axes.shape[0]} instruments cannot give three components",
            remedy="use three or more instruments",
        )
    smallest = np.linalg.svd(axes[:, 0, :], compute_uv=False)[-1]
    if smallest < 0.05:
        raise ArgumentError(
            f"the input axes lie in one plane (smallest singular value {smallest:.3g})",
            remedy="check axes, first rows",
        )
