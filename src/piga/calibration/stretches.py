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

from piga._kernels.counting import add_waves
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
SLOW = 4.0
"""Counts in a stretch up to which all harmonics of the saw-tooth are followed, sample by sample."""
KNOWN = 0.01
"""Uncertainty of the path over a stretch [counts] that is not averaged over."""
_NODES = (
    (0.0, 8.0 / 15.0),
    (1.355626, 0.222076),
    (-1.355626, 0.222076),
    (2.856970, 0.011257),
    (-2.856970, 0.011257),
)
"""Gauss-Hermite nodes and weights for a standard normal variable."""


@dataclass(frozen=True)
class Stretch:
    """Rows ``start`` to ``stop`` of a segment, bin edges counted from ``start``, contrasts (K, bins).

    Filled by one pass over the record: sums over the bins of the angle columns (m + 1, bins) and of the time, the
    angle columns at the end, and the first and last time [s].
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

    @classmethod
    def of(cls, segment: int, start: int, stop: int, modes: int, columns: int) -> Stretch:
        """An empty one."""
        bins = min(stop - start, 8 * modes)
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

    The rate is known to ``sigma`` [counts over the stretch]: averaged over by Gauss-Hermite quadrature. The
    random walk about the best line, ``wander`` [counts], dithers the harmonics; what it takes out is white.
    """

    def __init__(self, stretch: Stretch, count: float, sigma: float, wander: float) -> None:
        self.stretch, self.count, self.sigma, self.wander = stretch, count, sigma, wander
        self.nodes = _NODES if sigma > KNOWN else ((0.0, 1.0),)
        self.followed = FINE if stretch.size <= SHORT else HARMONICS
        bins = stretch.contrasts.shape[1]
        self.cosines = np.zeros((len(self.nodes), self.followed, bins))
        self.sines = np.zeros_like(self.cosines)
        self.turned = np.zeros(bins)
        self.ramp = np.zeros(bins)
        self.least, self.most = math.inf, -math.inf
        self.middle = float(stretch.time.sum()) / stretch.size

    def add(self, first: int, t: Array, turned: Array) -> None:
        """Add samples: time [s] and path since the start [counts]."""
        stretch = self.stretch
        ramp = (t - self.middle) / (stretch.limits[1] - stretch.limits[0])
        stretch.add(self.turned, first, turned)
        stretch.add(self.ramp, first, ramp)
        self.least, self.most = min(self.least, float(turned.min())), max(self.most, float(turned.max()))
        for at, (node, _) in enumerate(self.nodes):
            slope = node * self.sigma
            add_waves(turned, ramp, slope, first, stretch.edges, self.cosines[at], self.sines[at])

    def covariance(self) -> Array:
        """Covariance of the contrasts by each harmonic of the counting, and all others (M + 1, K, K)."""
        stretch, phi = self.stretch, self.stretch.contrasts
        slow = self.most - self.least + 3.0 * self.sigma < SLOW
        order = np.arange(1, self.followed + 1)
        kept = self.count**2 / (2.0 * np.pi**2 * order**2)
        kept *= np.exp(-4.0 * np.pi**2 * (order * self.wander) ** 2)
        found = np.zeros((HARMONICS + 1, phi.shape[0], phi.shape[0]))
        turned, ramp = stretch.mean(self.turned), stretch.mean(self.ramp)
        for at, (node, weight) in enumerate(self.nodes):
            for sums in (self.cosines[at], self.sines[at]):
                s = phi @ stretch.mean(sums).T
                for m in range(HARMONICS):
                    found[m] += weight * kept[m] * np.outer(s[:, m], s[:, m])
                if not slow:
                    found[-1] += weight * (s[:, HARMONICS:] * kept[HARMONICS:]) @ s[:, HARMONICS:].T
            if slow:
                found[-1] += weight * _whole(phi, turned + node * self.sigma * ramp, self.count)
        if slow:
            found[-1] -= found[:-1].sum(axis=0)
        else:
            found[-1] += (self.count**2 / 12.0 - float(kept.sum())) * white_covariance(stretch)
        return found


def _whole(phi: Array, at: Array, count: float) -> Array:
    """Covariance of the contrasts by the whole saw-tooth, ``c^2 (1/12 - {x}(1 - {x})/2)`` between readings."""
    apart = at[:, None] - at
    apart -= np.floor(apart)
    return count**2 * phi @ (1.0 / 12.0 - 0.5 * apart * (1.0 - apart)) @ phi.T


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
        turned = (run.output[rows] - run.output[stretch.start] - residual) / count
        gathered[stretch.start].add(first, np.asarray(run.t[rows]), turned)
    return np.stack([gathered[s.start].covariance() for s in stretches], axis=1)


def _counting_of(
    stretch: Stretch, count: float, solution: Solution, groups: tuple[int, ...], walk: float, spread: float
) -> Counting:
    """Nothing gathered yet, with what the path is uncertain by."""
    jacobian = solution.jacobians[groups[stretch.segment]]
    far = stretch.end[:-1]
    known = float(far @ (jacobian @ solution.covariance @ jacobian.T) @ far)
    duration = float(stretch.limits[1] - stretch.limits[0])
    return Counting(
        stretch, count, math.sqrt(known) / count + spread, math.sqrt(walk * duration / 15.0) / count
    )
