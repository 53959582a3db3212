"""From blocks to per-segment summaries: whitening, and the residuals of an estimate."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from piga._kernels.whitening import innovation_weights, whiten
from piga.calibration.design import Block, Design
from piga.calibration.drift_basis import KNOTS, DriftBasis
from piga.calibration.noise import Noise
from piga.calibration.reduction import Reduction
from piga.calibration.workers import workers
from piga.records.spool import arrays_like

Array = NDArray[np.float64]


@dataclass
class Whitener:
    """Whitens blocks in order; carries the recursion from block to block.

    ``mode`` is ``"increments"`` (moving-average noise), ``"rates"`` (each increment divided by its
    interval, equal weights: the rate method) or ``"samples"`` (a rate log, equal weights).
    """

    mode: str
    noise: Noise
    size: int

    def __post_init__(self) -> None:
        self._state = np.zeros(self.size)
        self._variance = 0.0

    def apply(self, block: Block) -> Array:
        """Weighted columns of a block, a new array (m + 1, n)."""
        return self.apply_columns(block.columns, block.h)

    def apply_columns(self, columns: Array, h: Array) -> Array:
        """Weighted columns for intervals ``h``."""
        if self.mode == "samples":
            return columns.copy()
        if self.mode == "rates":
            return columns * np.divide(1.0, h, out=np.zeros_like(h), where=h > 0.0)
        carry, scale = np.empty(h.size), np.empty(h.size)
        self._variance = innovation_weights(h, self.noise.white, self.noise.walk, self._variance, carry, scale)
        out = np.empty_like(columns)
        whiten(columns, carry, scale, self._state, out)
        return out


def weighting_mode(design: Design, method: str) -> str:
    """How the rows are weighted for a method and a kind of output."""
    if design.point:
        return "samples"
    return "rates" if method == "rate" else "increments"


def weighted_blocks(design: Design, mode: str, noise: Noise) -> Iterator[tuple[Block, Array]]:
    """Blocks with their weighted columns, in order."""
    whitener = Whitener(mode, noise, len(design.names) + 1)
    for block in design.blocks():
        yield block, whitener.apply(block)


def reduce_segments(design: Design, mode: str, noise: Noise) -> list[Reduction]:
    """One summary per segment of the weighted rows.

    The reduction of a block runs beside the whitening of the next. With a bias drift the segments are not
    independent: the first summary then holds them all.
    """
    if noise.drift > 0.0 and mode == "increments":
        return _reduce_drifting(design, noise)
    summaries = [Reduction.empty(design.names) for _ in design.run.labels]
    with workers(design.run.size, 1) as pool:
        jobs = []
        for block, columns in weighted_blocks(design, mode, noise):
            count = int(np.count_nonzero(block.h > 0.0))
            jobs.append(pool.submit(summaries[block.segment].absorb, columns, count=count))
            if len(jobs) > 4:
                jobs.pop(0).result()
        for job in jobs:
            job.result()
    return summaries


def drifting_factor(design: Design, noise: Noise) -> Array:
    """Triangular factor of the weighted rows ``[drift | model | y]``, the drift left free."""
    basis = DriftBasis.of(design.run)
    factor = np.zeros((0, KNOTS + len(design.names) + 1))
    whitener = Whitener("increments", noise, factor.shape[1])
    for block in design.blocks():
        drift = basis.increments(np.asarray(design.run.t[block.start : block.stop]), block.h)
        rows = whitener.apply_columns(np.vstack([drift, block.columns]), block.h).T
        factor = cast("Array", np.linalg.qr(np.vstack([factor, rows]), mode="r"))
    return factor


def _reduce_drifting(design: Design, noise: Noise) -> list[Reduction]:
    """Summaries with the drift integrated out: what its steps, of known variance, leave to the model."""
    factor = drifting_factor(design, noise)
    prior = np.zeros((KNOTS, factor.shape[1]))
    prior[:, :KNOTS] = np.eye(KNOTS) / np.sqrt(noise.drift * DriftBasis.of(design.run).spacing)
    rest = cast("Array", np.linalg.qr(np.vstack([factor, prior]), mode="r"))[KNOTS:, KNOTS:]
    summaries = [Reduction.empty(design.names) for _ in design.run.labels]
    summaries[0].absorb(np.ascontiguousarray(rest.T), count=design.rows)
    return summaries


def residual_increments(design: Design, values: Array) -> tuple[Array, Array]:
    """Observed less modelled increments and their intervals; ``values`` (segments, m) per segment."""
    arrays = arrays_like(design.run.t)
    d, h = arrays.zeros(design.run.size), arrays.zeros(design.run.size)
    for block in design.blocks():
        rows = slice(block.start, block.stop)
        d[rows] = block.columns[-1] - values[block.segment] @ block.columns[:-1]
        h[rows] = block.h
    return d, h
