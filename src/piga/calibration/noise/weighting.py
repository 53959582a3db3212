"""Weight rows: whiten blocks and reduce them to summaries per segment; residuals of an estimate.

Slow noise of the rate enters as a few angle columns: a random walk, or an independent rate error in every segment. A segment
has ``size`` such columns, which are whitened with its rows. The factor of a record has ``count`` columns. ``placed`` puts the
columns of a segment into this factor. Own derivation, docs/theory.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from piga._kernels.estimation.noise import innovation_weights, whiten
from piga.calibration.model.design import Block, Design
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.solution import DRIFT_NAMES, KNOTS
from piga.calibration.noise.levels import Noise
from piga.calibration.noise.settings import NOISE
from piga.records.run import Run
from piga.records.spool import arrays_like
from piga.results import Array


class NoiseColumns(Protocol):
    """Columns of slow noises: independent random numbers change the rate."""

    @property
    def size(self) -> int:
        """Number of noise columns of a segment."""

    @property
    def count(self) -> int:
        """Number of noise columns in the factor of a record: the independent numbers."""

    def angle(self, t: Array) -> Array:
        """Angle (size, n) at the times ``t`` (n,) if the numbers are one."""

    def increments(self, t: Array, h: Array) -> Array:
        """Columns (size, n) of the increments that end at ``t`` and last ``h``."""

    def placed(self, factor: Array, segment: int) -> Array:
        """A segment's factor ``[noise | rest]``, its ``size`` noise columns expanded to ``count``."""


class SlowBasis(NoiseColumns, Protocol):
    """Columns of one slow noise; its numbers have equal variance."""

    def noise(self, other: Noise, variance: float) -> Noise:
        """The levels ``other`` with this noise; its numbers have ``variance`` [rad^2/s^2]."""

    def unit(self) -> float:
        """Variance of the numbers at level one."""


@dataclass(frozen=True)
class DriftBasis:
    """The rate is a sum of KNOTS ramps and is zero at the middle. A ramp rises from 0 to its step in ``spacing`` [s].

    The steps of a random walk are independent with equal variance. Because the drift is zero at the middle of the
    record, an estimated bias is the bias there.
    """

    start: float
    spacing: float
    size: int = field(default=KNOTS, init=False)
    count: int = field(default=KNOTS, init=False)

    @classmethod
    def of(cls, run: Run) -> DriftBasis:
        """Basis for one record, over all its stretches and the gaps between them."""
        first, last = float(run.t[0]), float(run.t[-1])
        return cls(first, (last - first) / KNOTS)

    def angle(self, t: Array) -> Array:
        """Angle (KNOTS, n) at the times ``t`` (n,) by unit steps from the start."""
        at = (t - self.start) / self.spacing
        since = np.maximum(at - np.arange(KNOTS)[:, None], 0.0)
        ramp = np.where(since < 1.0, 0.5 * since**2, since - 0.5)
        before = np.arange(KNOTS)[:, None] < KNOTS // 2
        angle: Array = self.spacing * (ramp - before * at)
        return angle

    def increments(self, t: Array, h: Array) -> Array:
        """Columns (KNOTS, n) of the increments that end at ``t`` and last ``h``; zero without an increment."""
        formed = h > 0.0
        columns: Array = (self.angle(t) - self.angle(t - h * formed)) * formed
        return columns

    def placed(self, factor: Array, segment: int) -> Array:  # noqa: ARG002 - as every basis
        """All segments share the steps."""
        return factor

    def noise(self, other: Noise, variance: float) -> Noise:
        """The levels ``other`` with a bias drift; its steps have ``variance`` [rad^2/s^2]."""
        return replace(other, drift=variance / self.spacing, scatter=0.0)

    def unit(self) -> float:
        """Variance of the steps for a drift of one."""
        return self.spacing


@dataclass(frozen=True)
class SegmentBasis:
    """Rates that scatter from segment to segment, independent and with equal variance."""

    starts: Array = field(repr=False)
    size: int = field(default=1, init=False)

    @classmethod
    def of(cls, run: Run) -> SegmentBasis:
        """Basis for one run."""
        return cls(np.asarray(run.t[run.segment_edges()[:-1]]))

    @property
    def count(self) -> int:
        """One number for each segment."""
        return self.starts.size

    def angle(self, t: Array) -> Array:
        """Time since the beginning of the segment (1, n)."""
        own = np.maximum(np.searchsorted(self.starts, t, side="right") - 1, 0)
        angle: Array = (t - self.starts[own])[None]
        return angle

    def increments(self, t: Array, h: Array) -> Array:  # noqa: ARG002 - as every basis
        """The intervals (1, n)."""
        return h[None]

    def placed(self, factor: Array, segment: int) -> Array:
        """One column per segment, zero in all other segments."""
        own = np.zeros((len(factor), self.count))
        own[:, segment] = factor[:, 0]
        return np.hstack([own, factor[:, 1:]])

    def noise(self, other: Noise, variance: float) -> Noise:
        """The levels ``other`` with rates that scatter with ``variance`` [rad^2/s^2]."""
        return replace(other, drift=0.0, scatter=variance)

    def unit(self) -> float:
        """The level is the variance."""
        return 1.0


@dataclass(frozen=True)
class BesideStated:
    """Columns of the scatter from segment to segment, followed by those of another slow noise, if any."""

    segments: SegmentBasis
    other: NoiseColumns | None

    @property
    def size(self) -> int:
        """Number of noise columns of a segment."""
        return 1 + (0 if self.other is None else self.other.size)

    @property
    def count(self) -> int:
        """One number per segment, and those of the other noise."""
        return self.segments.count + (0 if self.other is None else self.other.count)

    def angle(self, t: Array) -> Array:
        """Angle (size, n) at the times ``t`` (n,) if the numbers are one."""
        own = self.segments.angle(t)
        return own if self.other is None else np.vstack([own, self.other.angle(t)])

    def increments(self, t: Array, h: Array) -> Array:
        """Columns (size, n) of the increments that end at ``t`` and last ``h``."""
        own = self.segments.increments(t, h)
        return own if self.other is None else np.vstack([own, self.other.increments(t, h)])

    def placed(self, factor: Array, segment: int) -> Array:
        """One column per segment, then those of the other noise, then the rest."""
        own = self.segments.placed(factor[:, :1], segment)
        rest = factor[:, 1:] if self.other is None else self.other.placed(factor[:, 1:], segment)
        return np.hstack([own, rest])


def slow_bases(run: Run) -> tuple[SlowBasis, ...]:
    """Slow noises to search in a record: bias drift, and scatter if there are enough segments."""
    drift = DriftBasis.of(run)
    few = not NOISE.fewest_segments <= len(run.labels) <= NOISE.most_segments
    return (drift,) if few else (drift, SegmentBasis.of(run))


class Whitening(NamedTuple):
    """Weights of rows: ``carry`` (n,) on the innovation before, ``scale`` (n,), and ``state`` (m + 1,), the last innovations."""

    carry: Array
    scale: Array
    state: Array

    def apply(self, columns: Array) -> Array:
        """Whitened columns (m + 1, n), a new array; the state moves on."""
        out = np.empty(columns.shape)
        whiten(columns, self.carry, self.scale, self.state, out)
        return out


RATE = "rate of the segment"
"""Name of the scatter column before it is integrated out."""


@dataclass
class Whitener:
    """Whitens blocks in order; its state continues from block to block.

    ``mode`` is ``"increments"`` (moving-average noise), ``"rates"`` (each increment divided by its
    interval, equal weights: the rate method) or ``"samples"`` (a rate log, equal weights).
    """

    mode: str
    noise: Noise
    size: int

    def __post_init__(self) -> None:
        self._state = np.zeros(self.size)
        self._variance = 0.0

    def weights(self, h: Array) -> Whitening:
        """Weights of the next rows, which have the intervals ``h``. They are to be applied in this order."""
        carry, scale = np.zeros(h.size), np.ones(h.size)
        if self.mode == "rates":
            scale = np.divide(1.0, h, out=np.zeros_like(h), where=h > 0.0)
        elif self.mode == "increments":
            white, walk = self.noise.white, self.noise.walk
            self._variance = innovation_weights(h, white, walk, self._variance, carry, scale)
        return Whitening(carry, scale, self._state)

    def apply_columns(self, columns: Array, h: Array) -> Array:
        """Weighted columns for intervals ``h``, a new array."""
        return self.weights(h).apply(columns)


def weighting_mode(design: Design, method: str) -> str:
    """Weighting mode of the rows for a method and a kind of output."""
    if design.point:
        return "samples"
    return "rates" if method == "rate" else "increments"


def weighted_blocks(
    design: Design, mode: str, noise: Noise, basis: NoiseColumns | None = None
) -> Iterator[tuple[Block, Array]]:
    """Blocks with their weighted columns in order; columns of a slow noise precede the last."""
    for block, columns, weights in _blocks_and_weights(design, mode, noise, basis):
        yield block, weights.apply(columns)


def _blocks_and_weights(
    design: Design, mode: str, noise: Noise, basis: NoiseColumns | None = None
) -> Iterator[tuple[Block, Array, Whitening]]:
    """Blocks with their columns, those of a slow noise before the last, and the weights of their rows."""
    whitener = Whitener(mode, noise, len(design.names) + (0 if basis is None else basis.size) + 1)
    for block in design.blocks():
        yield block, _with_slow(design, block, basis), whitener.weights(block.h)


def _with_slow(design: Design, block: Block, basis: NoiseColumns | None) -> Array:
    """Columns of the model, of a slow noise if there is one, and of the observation."""
    if basis is None:
        return block.columns
    slow = basis.increments(np.asarray(design.run.t[block.start : block.stop]), block.h)
    return np.vstack([block.columns[:-1], slow, block.columns[-1:]])


def rate_share(variance: ArrayLike, square: ArrayLike) -> Array:
    """Share c for which ``x - c b (b'x)`` whitens rows that are white but for a rate along b; ``b'b = square``.

    The rate has ``variance`` v. ``(I + v b b')^-1/2 = I - c b b'``, ``c = (1 - (1 + v b'b)^-1/2)/b'b``.
    """
    size = np.asarray(square, dtype=float)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = (1.0 - 1.0 / np.sqrt(1.0 + np.asarray(variance) * size)) / size
    return np.where(size > 0.0, share, 0.0)


def reduce_segments(design: Design, mode: str, noise: Noise) -> list[Reduction]:
    """One summary per segment of the weighted rows.

    A bias drift adds its columns after those of the model. The first summary also contains the prior of its steps;
    :func:`~piga.calibration.model.solution.solve` integrates the drift out. A scatter of the segments, stated or
    estimated, is integrated out of each summary.
    """
    if mode != "increments":
        return _absorbed(design, design.names, _blocks_and_weights(design, mode, noise))
    drift = DriftBasis.of(design.run) if noise.drift > 0.0 else None
    names = design.names if drift is None else (*design.names, *DRIFT_NAMES)
    if noise.scatter > 0.0 or noise.stated:
        summaries = _reduce_scattered(design, mode, noise, drift, names)
    else:
        summaries = _absorbed(design, names, _blocks_and_weights(design, mode, noise, drift))
    if drift is not None:
        summaries[0] = Reduction.stacked([summaries[0], _steps_known(names, noise.drift * drift.spacing)])
    return summaries


def _reduce_scattered(
    design: Design, mode: str, noise: Noise, drift: DriftBasis | None, names: tuple[str, ...]
) -> list[Reduction]:
    """Summaries with scattered rates: the rate of each segment, zero with its variance, is integrated out."""
    m = len(design.names)
    order = [m, *range(m), *range(m + 1, len(names) + 2)]
    segments = SegmentBasis.of(design.run)
    basis = segments if drift is None else BesideStated(segments, drift)
    blocks = ((b, columns[order], w) for b, columns, w in _blocks_and_weights(design, mode, noise, basis))
    summaries = _absorbed(design, (RATE, *names), blocks)
    scattered = noise.scattered
    variance = np.full(len(summaries), noise.scatter) if scattered is None else scattered
    variance = np.maximum(variance, NOISE.fixed_rate * variance.max())
    for part, own in zip(summaries, variance, strict=True):
        known = np.zeros((len(names) + 2, 1))
        known[0] = 1.0 / math.sqrt(own)
        part.absorb(known, count=0)
    return [part.without((RATE,)) for part in summaries]


def _absorbed(
    design: Design, names: tuple[str, ...], blocks: Iterator[tuple[Block, Array, Whitening]]
) -> list[Reduction]:
    """One triangle of the weighted columns per segment."""
    summaries = [Reduction.empty(names) for _ in design.run.labels]
    for block, columns, weights in blocks:
        count = int(np.count_nonzero(block.h > 0.0))
        summaries[block.segment].absorb(weights.apply(columns), count=count)
    return summaries


def _steps_known(names: tuple[str, ...], variance: float) -> Reduction:
    """Prior rows: the steps of the drift, the last columns, are zero with this variance."""
    size = len(names)
    known = np.zeros((size + 1, size + 1))
    at = np.arange(size - KNOTS, size)
    known[at, at] = 1.0 / math.sqrt(variance)
    return Reduction(names, known, 0)


def residual_increments(design: Design, values: Array) -> tuple[Array, Array]:
    """Observed minus modelled increments and their intervals, for ``values`` (segments, m)."""
    arrays = arrays_like(design.run.t)
    d, h = arrays.zeros(design.run.size), arrays.zeros(design.run.size)

    for block in design.blocks():
        rows = slice(block.start, block.stop)
        d[rows] = block.columns[-1] - values[block.segment] @ block.columns[:-1]
        h[rows] = block.h
    return d, h
