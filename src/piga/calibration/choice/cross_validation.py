"""Cross-validation over the parts of a record. Each part is predicted exactly from the others, from summaries.

The whitened rows of a part have unit variance. The prediction error of a part needs only the triangular factors.
Own derivation, docs/theory.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.calibration.model.reduction import Reduction, solve_upper
from piga.records.run import Run
from piga.results import Array, Result


@dataclass(frozen=True)
class FoldSettings:
    """Parts that cross-validation leaves out (own choices)."""

    fewest_segments: int = 4
    """Fewest segments for leaving out segments. A record with fewer segments is cut into blocks."""
    blocks: int = 10
    """Number of blocks for a record of fewer segments; each has about the same number of rows."""
    most: int = 50
    """Most parts that are left out one by one. With more parts, neighbours are left out together."""
    dependent: float = 1e-9
    """Largest independent share of a column's length for which the column counts as dependent on the others."""


FOLDS = FoldSettings()


@dataclass(frozen=True, eq=False, repr=False)
class HeldOutPrediction(Result):
    """Prediction of parts that were left out.

    Attributes
    ----------
    chi_square:
        Sum of squares of the whitened prediction errors. If there is only noise: the number of observations.
    force_error:
        Mean prediction error of each part as specific force, root mean square over the parts [m/s^2].
    per_fold:
        ``chi_square`` of each fold.
    above_best, standard_error:
        Excess of ``chi_square`` over the best set, and its standard error from the scatter of the folds.
    """

    chi_square: float
    force_error: float
    per_fold: Array
    above_best: float = 0.0
    standard_error: float = 0.0

    def against(self, best: HeldOutPrediction) -> HeldOutPrediction:
        """The prediction with its excess over the best one."""
        excess = self.per_fold - best.per_fold
        error = math.sqrt(excess.size) * float(np.std(excess, ddof=1)) if excess.size > 1 else 0.0
        return replace(self, above_best=float(excess.sum()), standard_error=error)

    @property
    def as_good_as_best(self) -> bool:
        """True within one standard error of the best prediction; rounding errors are allowed for."""
        return self.above_best <= self.standard_error + 1e-9 * self.chi_square

    def document(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {
            "prediction_chi_square": self.chi_square,
            "prediction_above_best": self.above_best,
            "prediction_standard_error": self.standard_error,
            "prediction_force_error": self.force_error,
        }


def row_edges(run: Run, per_segment: bool) -> tuple[NDArray[np.int64], str]:
    """First row of every part and the end row; the kind of the parts (segments or blocks)."""
    edges = run.segment_edges()
    if per_segment or edges.size > FOLDS.fewest_segments:
        return edges, "segment"
    blocks = np.linspace(0, run.size, min(FOLDS.blocks, run.size) + 1).astype(np.int64)
    return np.unique(np.concatenate((edges, blocks))), "block"


def fold_of(parts: int) -> NDArray[np.int64]:
    """Fold of each part: one per part, or one for several neighbours if there are many parts."""
    return np.arange(parts) * min(parts, FOLDS.most) // parts


def predict(
    parts: list[Reduction],
    columns: list[int],
    probe: tuple[int, float],
    fixed: tuple[int, float] | None,
) -> HeldOutPrediction | None:
    """Predict every part from the others.

    Parameters
    ----------
    parts:
        Summaries of the parts over the union of columns.
    columns:
        Indices of the columns of the set.
    probe:
        Column of a constant force, and the scale factor that converts its coefficient to a force.
    fixed:
        A column that is not estimated, and its coefficient.

    Returns
    -------
    Prediction or None
        None when there are fewer than two parts, or when the set cannot be determined without one of the parts.
    """
    if len(parts) < 2:
        return None
    factors = np.array([part.factor for part in parts])
    right = factors[:, :, -1] - (fixed[1] * factors[:, :, fixed[0]] if fixed else 0.0)
    rows = np.concatenate((factors[:, :, columns], right[:, :, None]), axis=2)
    folds = fold_of(len(parts))
    squares, forces = np.zeros(int(folds[-1]) + 1), []
    for fold in range(squares.size):
        estimate = _least_squares(rows[folds != fold].reshape(-1, rows.shape[2]))
        if estimate is None:
            return None
        for part in np.flatnonzero(folds == fold):
            missed = rows[part, :, -1] - rows[part, :, :-1] @ estimate
            constant = factors[part, :, probe[0]]
            squares[fold] += float(missed @ missed)
            forces.append(float(constant @ missed) / float(constant @ constant) / probe[1])
    return HeldOutPrediction(float(squares.sum()), float(np.sqrt(np.mean(np.square(forces)))), squares)


def _least_squares(rows: Array) -> Array | None:
    """Estimate from rows ``[x | y]``; None when the columns are dependent."""
    size = np.linalg.norm(rows[:, :-1], axis=0)
    if (size == 0.0).any():
        return None
    triangle: Array = np.linalg.qr(rows / np.append(size, 1.0))[1]
    m = size.size
    if np.abs(np.diag(triangle)[:m]).min() <= FOLDS.dependent:
        return None
    return solve_upper(triangle[:m, :m], triangle[:m, m]) / size
