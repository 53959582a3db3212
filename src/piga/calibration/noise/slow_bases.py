"""Slow noise of the rate as a few angle columns: a random walk, or a rate of its own in every segment.

A segment has ``size`` such columns, which are whitened with its rows. The factor of a record has ``count`` columns;
``placed`` puts the columns of a segment there. Own derivation, docs/theory.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from piga.calibration.model.solution import KNOTS
from piga.calibration.noise.levels import Noise
from piga.calibration.noise.settings import NOISE
from piga.records.run import Run

Array = NDArray[np.float64]


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
