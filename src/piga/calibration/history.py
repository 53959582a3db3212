"""The estimate while the record comes in, for the plot of its convergence."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from piga.calibration.fit.one_run import Fit
from piga.calibration.model.identifiability import examine
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.solution import name_coefficients, solve
from piga.calibration.weights import RATE, weighted_blocks
from piga.results import Array

POINTS = 400
"""Points of the history; a tenth of it when every segment has its own phase."""


def history_of(fit: Fit) -> dict[str, Array]:
    """Estimate and standard uncertainty after the first samples, up to the whole record (file units)."""
    rows, samples = [], []
    keys: tuple[str, ...] = ()
    for mark, summaries in _growing(fit):
        if examine(fit.design, summaries).null_terms:
            continue
        solution = solve(fit.design, summaries)
        named, covariance = name_coefficients(fit.design, solution, solution.covariance)
        plain = [i for i, c in enumerate(named) if c.name != "phi" or not fit.design.has_phases]
        keys = tuple(named[i].name for i in plain)
        std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        rows.append([*(named[i].value for i in plain), *std[plain]])
        samples.append(mark)
    table = np.array(rows)
    result = {"sample": np.array(samples, dtype=float)}
    for i, key in enumerate(keys):
        result[key] = table[:, i]
        result[f"u({key})"] = table[:, len(keys) + i]
    return result


def _growing(fit: Fit) -> Iterator[tuple[int, list[Reduction]]]:
    """Number of samples, and one summary for each segment begun; the last item is that of the whole record."""
    design, total = fit.design, fit.design.run.size
    points = POINTS if not design.has_phases else POINTS // 10
    marks = np.unique(np.linspace(min(total, 2 * len(design.names)), total, points).astype(np.int64))
    variances = fit.noise.rate_variances(len(design.run.labels)).tolist()
    parts: list[Reduction] = []
    segment = -1
    for block, columns in weighted_blocks(design, fit.mode, fit.noise, rate=True):
        if block.segment != segment:
            segment = block.segment
            parts.append(Reduction.empty((*design.names, RATE)))
        inside = marks[(marks > block.start) & (marks <= block.stop)].tolist()
        for start, stop in pairwise([block.start, *inside, block.stop]):
            parts[-1].absorb(np.ascontiguousarray(columns[:, start - block.start : stop - block.start]))
            if stop in inside:
                yield stop, [part.without((RATE,), own) for part, own in zip(parts, variances, strict=False)]
