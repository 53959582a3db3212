"""Stretches of a coarsely counted record projected on their slowest cosines, block by block.

A stretch is what lies between two breaks of the output. Its samples are averaged over bins and the bins projected on
contrasts; both are sums over samples, so that a record of any length is projected in a bounded memory.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from piga._kernels.counting import add_waves, saw_tooth_covariance
from piga.calibration.design import Block, Design
from piga.calibration.solution import Solution

Array = NDArray[np.float64]

LEAST = 8
"""Samples of a stretch that is used at all."""
HARMONICS = 8
"""Harmonics of the saw-tooth that white noise damps one by one."""
FINE, SHORT = 24, 10_000
"""Harmonics followed in stretches up to so many samples (else those above); the rest counts as white."""
MODES = 24
"""Cosines per stretch at least; four more per turn of the output and order of the model."""
MOST_MODES = 160
MOST_DAMPED = 0.5
"""Damping by the errors of the estimate that is taken out at most, as a share of that by the random walk."""
SLOW, FINEST = 4.0, 96
"""Counts in a stretch up to which so many harmonics of the saw-tooth are followed."""


@dataclass(frozen=True)
class Stretch:
    """Rows ``start`` to ``stop`` of a segment, bin edges counted from ``start``, contrasts (K, bins).

    Filled by one pass over the record: sums over the bins of the angle columns (m + 1, bins) and of the time, the
    angle columns at the end, the first and last time [s], the least and largest reading since the start [rad].
    """

    segment: int
    start: int
    stop: int
    edges: NDArray[np.int64]
    contrasts: Array
    angle: Array
    time: Array
    end: Array
    limits: Array = field(default_factory=lambda: np.zeros(2))
    span: Array = field(default_factory=lambda: np.zeros(2))

    @classmethod
    def of(cls, segment: int, start: int, stop: int, modes: int, columns: int) -> Stretch:
        """An empty one."""
        bins = min(stop - start, 4 * modes)
        edges = np.linspace(0, stop - start, bins + 1).astype(np.int64)
        return cls(
            segment, start, stop, edges, _contrasts(modes, bins), np.zeros((columns, bins)), np.zeros(bins),
            np.zeros(columns),
        )  # fmt: skip

    @property
    def size(self) -> int:
        """Number of samples."""
        return self.stop - self.start

    @property
    def rows(self) -> Array:
        """Contrasts of the mean angle columns (K, m + 1)."""
        return self.contrasts @ self.mean(self.angle).T

    def mean(self, sums: Array) -> Array:
        """Means over the bins from sums over them, last axis."""
        return sums / np.diff(self.edges)

    def add(self, sums: Array, first: int, values: Array) -> None:
        """Add samples (.., n), the first one ``first`` rows behind the start, to sums over the bins."""
        low = int(np.searchsorted(self.edges, first, side="right")) - 1
        high = int(np.searchsorted(self.edges, first + values.shape[-1], side="left"))
        cuts = np.maximum(self.edges[low:high] - first, 0)
        sums[..., low:high] += np.add.reduceat(values, cuts, axis=-1)


def modes_of(design: Design) -> int:
    """Contrasts per stretch: enough for the ripple of the fastest one, no more than the shortest allows; 0: none."""
    run = design.run
    starts = np.flatnonzero(run.begins)
    lengths = np.diff(np.append(starts, run.size))
    ends = starts + lengths - 1
    turns = float(np.abs(run.output[ends] - run.output[starts]).max()) / (2.0 * math.pi)
    order = max((1, *design.request.harmonics))
    usable = lengths[lengths >= LEAST]
    if usable.size == 0:
        return 0
    return int(min(MODES + math.ceil(4.0 * turns * order), MOST_MODES, usable.min() - 2))


def find_stretches(design: Design, modes: int) -> list[Stretch]:
    """All stretches of at least :data:`LEAST` samples with the sums of their angle columns."""
    run = design.run
    starts = np.flatnonzero(run.begins)
    found = [
        Stretch.of(int(run.segment[start]), int(start), int(stop), modes, len(design.names) + 1)
        for start, stop in zip(starts, np.append(starts[1:], run.size), strict=True)
        if stop - start >= LEAST
    ]
    for stretch, first, angle in _pieces(design, found):
        at = stretch.start + first
        t = np.asarray(run.t[at : at + angle.shape[1]])
        stretch.add(stretch.angle, first, angle)
        stretch.add(stretch.time, first, t)
        stretch.end[:] = angle[:, -1]
        reading = run.output[at : at + t.size] - run.output[stretch.start]
        stretch.span[:] = min(stretch.span[0], reading.min()), max(stretch.span[1], reading.max())
        if first == 0:
            stretch.limits[0] = t[0]
        stretch.limits[1] = t[-1]
    return found


def _pieces(design: Design, stretches: list[Stretch]) -> Iterator[tuple[Stretch, int, Array]]:
    """Stretch, rows behind its start, and angle columns (m + 1, n) since its start, in order."""
    index, carry = 0, np.zeros(len(design.names) + 1)
    for block in design.blocks():
        start, columns = _from_zero(block)
        while index < len(stretches) and stretches[index].start < block.stop:
            stretch = stretches[index]
            low, high = max(stretch.start, start), min(stretch.stop, block.stop)
            angle = np.cumsum(columns[:, low - start : high - start], axis=1)
            if low > stretch.start:
                angle += carry[:, None]
            yield stretch, low - stretch.start, angle
            if high < stretch.stop:
                carry = angle[:, -1].copy()
                break
            index += 1


def _from_zero(block: Block) -> tuple[int, Array]:
    """First row and columns of a block; the first row of all, which ends no increment, is put before."""
    if block.start != 1:
        return block.start, block.columns
    return 0, np.concatenate([np.zeros((block.columns.shape[0], 1)), block.columns], axis=1)


def _contrasts(modes: int, bins: int) -> Array:
    """Slowest cosines of the second kind, and the difference of the ends (which a random walk is known by)."""
    at = (np.arange(bins) + 0.5) / bins
    found = math.sqrt(2.0 / bins) * np.cos(np.pi * np.arange(1, modes)[:, None] * at)
    ends = np.zeros(bins)
    ends[0], ends[-1] = -1.0, 1.0
    return np.vstack([found, ends / math.sqrt(2.0)])


def walk_covariance(stretch: Stretch) -> Array:
    """Covariance of the contrasts by a random walk of unit variance [rad^2/s]."""
    tails = np.cumsum(stretch.contrasts[:, ::-1], axis=1)[:, ::-1][:, 1:]
    return (tails * np.diff(stretch.mean(stretch.time))) @ tails.T


def white_covariance(stretch: Stretch) -> Array:
    """Covariance of the contrasts by white noise of unit variance."""
    return (stretch.contrasts / np.diff(stretch.edges)) @ stretch.contrasts.T


class Counting:
    """The saw-tooth of the counts along the path of a stretch, gathered block by block.

    The path wanders by a random walk of ``walk`` [counts^2/s]: what is out of phase by then is not correlated. A
    line along it is uncertain by a further ``spread`` [counts^2] at the ends against each other; a negative one takes
    away damping that is already in the path. Harmonics beyond those followed are white.
    """

    def __init__(self, stretch: Stretch, count: float, spread: float, walk: float) -> None:
        self.stretch, self.count, self.spread, self.walk = stretch, count, spread, walk
        followed = FINE if stretch.size <= SHORT else HARMONICS
        if float(np.ptp(stretch.span)) < SLOW * count:
            followed = FINEST
        self.cosines = np.zeros((followed, stretch.time.size))
        self.sines = np.zeros_like(self.cosines)

    def add(self, first: int, turned: Array) -> None:
        """Add samples of the path since the start [counts]."""
        add_waves(turned, first, self.stretch.edges, self.cosines, self.sines)

    def covariance(self) -> Array:
        """Covariance of the contrasts by each harmonic of the counting, and all others (M + 1, K, K)."""
        stretch, phi = self.stretch, self.stretch.contrasts
        followed, bins = self.cosines.shape
        power: Array = self.count**2 / (2.0 * np.pi**2 * np.arange(1.0, followed + 1.0) ** 2)
        times = stretch.mean(stretch.time)
        ramp = times / (stretch.limits[1] - stretch.limits[0])
        found = np.zeros((HARMONICS + 1, bins, bins))
        saw_tooth_covariance(
            stretch.mean(self.cosines),
            stretch.mean(self.sines),
            power,
            times,
            ramp,
            self.walk,
            self.spread,
            found,
        )
        found[-1].flat[:: bins + 1] += (self.count**2 / 12.0 - float(power.sum())) / np.diff(stretch.edges)
        return phi @ found @ phi.T


def counting_covariances(
    design: Design,
    stretches: list[Stretch],
    count: float,
    solution: Solution,
    groups: tuple[int, ...],
    walk: float,
    spread: float,
) -> Array:
    """Covariances (M + 1, S, K, K) by the counting along the path that a solution gives.

    ``walk`` [rad^2/s] is the random walk, ``spread`` [counts] what the path is uncertain by beside the solution.
    """
    gathered = {s.start: _counting_of(s, count, solution, groups, walk, spread) for s in stretches}
    run = design.run
    for stretch, first, angle in _pieces(design, stretches):
        rows = slice(stretch.start + first, stretch.start + first + angle.shape[1])
        residual = angle[-1] - solution.values[stretch.segment] @ angle[:-1]
        gathered[stretch.start].add(first, (run.output[rows] - run.output[stretch.start] - residual) / count)
    return np.stack([gathered[s.start].covariance() for s in stretches], axis=1)


def _counting_of(
    stretch: Stretch, count: float, solution: Solution, groups: tuple[int, ...], walk: float, spread: float
) -> Counting:
    """Nothing gathered yet, with what the path is uncertain by.

    Waves along estimated paths are on average already damped by the errors of the estimates: that is taken out again.
    """
    jacobian = solution.jacobians[groups[stretch.segment]]
    far = stretch.end[:-1]
    damped = float(far @ (jacobian @ solution.covariance @ jacobian.T) @ far)
    most = MOST_DAMPED * walk * float(stretch.limits[1] - stretch.limits[0])
    return Counting(stretch, count, spread**2 - min(damped, most) / count**2, walk / count**2)
