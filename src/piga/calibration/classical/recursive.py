"""Recursive estimation: the same whitened rows one at a time, with the history of the estimate."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from piga._kernels.estimation.square_root import absorb_rows
from piga.calibration.model.design import Design
from piga.calibration.model.reduction import Reduction
from piga.calibration.noise.levels import Noise
from piga.calibration.noise.weighting import weighted_blocks

Array = NDArray[np.float64]

HISTORY = 400
"""Points of the stored history; a tenth of it when every segment has its own phase."""


def recursive_history(
    design: Design, mode: str, noise: Noise, groups: tuple[int, ...]
) -> Iterator[tuple[int, list[Reduction], tuple[int, ...]]]:
    """Summaries of the rows seen so far, at ``HISTORY`` samples spread over the record.

    Yields the number of samples, one summary per segment begun, and their phase groups. The last one holds
    the whole record: the recursive estimate is the batch estimate.
    """
    total = design.run.size
    points = HISTORY if max(groups) == 0 else HISTORY // 10
    marks = np.unique(np.linspace(min(total, 2 * len(design.names)), total, points).astype(np.int64))
    size = len(design.names) + 1
    summaries: list[Reduction] = []
    factor = np.zeros((size, size))
    current = -1
    for block, columns in weighted_blocks(design, mode, noise):
        if block.segment != current:
            current, factor = block.segment, np.zeros((size, size))
            summaries.append(Reduction.empty(design.names))
        inside = marks[(marks > block.start) & (marks <= block.stop)]
        snapshots = np.empty((inside.size, size, size))
        absorb_rows(factor, columns, inside - block.start, snapshots)
        for mark, snapshot in zip(inside, snapshots, strict=True):
            yield int(mark), [*summaries[:-1], _summary(design, snapshot)], groups[: len(summaries)]
        summaries[-1] = _summary(design, factor)


def _summary(design: Design, factor: Array) -> Reduction:
    summary = Reduction.empty(design.names)
    summary.absorb(factor.T)
    return summary
