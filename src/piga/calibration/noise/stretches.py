"""Stretches of a coarsely counted record: their slowest cosines, and the saw-tooth of the counts along them.

A stretch is the record between two breaks of the output. Its samples are averaged over bins, and the bins are
projected on contrasts. Both are sums over samples, so memory is bounded for any length of record.
The waves ``exp(2 pi i m alpha/c)`` of the saw-tooth are summed over the bins of every stretch once per path. Their
covariance for any random walk follows from these sums.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga._kernels.estimation.noise import WAVES, add_waves, saw_tooth_covariance
from piga.calibration.model.design import Block, Design
from piga.calibration.model.solution import Solution
from piga.calibration.noise.settings import NOISE
from piga.records.run import Run
from piga.records.spool import extent
from piga.results import Array


@dataclass(frozen=True)
class Stretch:
    """Rows ``start`` to ``stop`` of a segment, bin edges counted in its good samples, contrasts (K, bins).

    ``limits`` are the first and last time [s]; ``span`` is largest minus smallest reading [rad]. One pass over the record
    fills the sums over the bins, of the angle columns (m + 1, bins) and of the time, and the angle columns at the end.
    """

    segment: int
    start: int
    stop: int
    edges: NDArray[np.int64]
    contrasts: Array
    angle: Array
    time: Array
    end: Array
    limits: tuple[float, float]
    span: float

    @classmethod
    def of(cls, run: Run, start: int, stop: int, size: int, modes: int, columns: int) -> Stretch:
        """An empty stretch of ``size`` good samples."""
        bins = min(size, 4 * modes)
        edges = np.linspace(0, size, bins + 1).astype(np.int64)
        least, most = extent(run.output[start:stop])
        return cls(
            segment=int(run.segment_index[start]),
            start=start,
            stop=stop,
            edges=edges,
            contrasts=_contrasts(modes, bins),
            angle=np.zeros((columns, bins)),
            time=np.zeros(bins),
            end=np.zeros(columns),
            limits=(float(run.t[start]), float(run.t[stop - 1])),
            span=most - least,
        )

    @property
    def size(self) -> int:
        """Number of good samples."""
        return int(self.edges[-1])

    @property
    def rows(self) -> Array:
        """Contrasts of the mean angle columns (K, m + 1)."""
        return self.contrasts @ self.mean(self.angle).T

    def mean(self, sums: Array) -> Array:
        """Means over the bins (last axis) from sums."""
        return sums / np.diff(self.edges)

    def add(self, sums: Array, first: int, values: Array) -> None:
        """Add good samples (.., n) that follow the first ``first`` ones to sums over the bins."""
        low = int(np.searchsorted(self.edges, first, side="right")) - 1
        high = int(np.searchsorted(self.edges, first + values.shape[-1], side="left"))
        cuts = np.maximum(self.edges[low:high] - first, 0)
        sums[..., low:high] += np.add.reduceat(values, cuts, axis=-1)


def modes_of(design: Design) -> int:
    """Contrasts per stretch: enough for the fastest ripple, but no more than the shortest stretch allows; 0: none."""
    run = design.run
    starts, stops, _ = _limits(run)
    turns = float(np.abs(run.output[stops - 1] - run.output[starts]).max()) / (2.0 * math.pi)
    order = max((1, *design.request.harmonics))
    return max(min(NOISE.modes + math.ceil(4.0 * turns * order), NOISE.most_modes, most_modes(run)), 0)


def most_modes(run: Run) -> int:
    """Most contrasts for all stretches, except the shortest ones that together contain a hundredth of the samples."""
    sizes = np.sort(_limits(run)[2])
    usable = sizes[(np.cumsum(sizes) > NOISE.stretch_lost * sizes.sum()) & (sizes >= NOISE.stretch_least)]
    return int(usable.min()) - 2 if usable.size else 0


def _limits(run: Run) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """First row, end row and number of good samples of every stretch."""
    starts = np.flatnonzero(run.begins)
    stops = np.append(starts[1:], run.size)
    if run.left_out is None:
        return starts, stops, stops - starts
    bad = [int(np.count_nonzero(run.left_out[a:b])) for a, b in zip(starts, stops, strict=True)]
    return starts, stops, stops - starts - np.array(bad)


def empty_stretches(run: Run, modes: int, columns: int) -> list[Stretch]:
    """All stretches that are long enough for this number of contrasts."""
    return [
        Stretch.of(run, int(start), int(stop), int(size), modes, columns)
        for start, stop, size in zip(*_limits(run), strict=True)
        if size >= max(NOISE.stretch_least, modes + 2)
    ]


def find_stretches(design: Design, modes: int) -> list[Stretch]:
    """The stretches of a record with the sums of their angle columns."""
    stretches = empty_stretches(design.run, modes, len(design.names) + 1)
    for stretch, first, rows, angle in angle_pieces(stretches, ((b, b.columns) for b in design.blocks())):
        stretch.add(stretch.angle, first, angle)
        stretch.add(stretch.time, first, np.asarray(design.run.t[rows]))
        stretch.end[:] = angle[:, -1]
    return stretches


def angle_pieces(
    stretches: list[Stretch], parts: Iterator[tuple[Block, Array]]
) -> Iterator[tuple[Stretch, int, NDArray[np.int64] | slice, Array]]:
    """In order: stretch, its number of earlier good samples, rows of the next ones, and their angles since its start.

    The angles have shape (.., n). ``parts`` are the blocks of a record with the increments (.., n) to sum.
    """
    index, carry, seen = 0, np.zeros(0), 0
    for block, increments in parts:
        start, columns = _from_zero(block, increments)
        while index < len(stretches) and stretches[index].start < block.stop:
            stretch = stretches[index]
            low, high = max(stretch.start, start), min(stretch.stop, block.stop)
            angle = np.cumsum(columns[..., low - start : high - start], axis=-1)
            if low > stretch.start:
                angle += carry
            else:
                seen = 0
            rows, good = _good(block, low, high)
            if angle[..., good].size:
                yield stretch, seen, rows, angle[..., good]
            seen += angle[..., good].shape[-1]
            if high < stretch.stop:
                carry = angle[..., -1:].copy()
                break
            index += 1


def _good(block: Block, low: int, high: int) -> tuple[NDArray[np.int64] | slice, NDArray[np.int64] | slice]:
    """Good samples among rows ``low`` to ``high``, counted in the record and from ``low``."""
    left_out = block.h[max(low - block.start, 0) : high - block.start] < 0.0
    if not left_out.any():
        return slice(low, high), slice(None)
    rows = np.flatnonzero(~left_out) + max(low, block.start)
    rows = np.append(low, rows) if low < block.start else rows
    return rows, rows - low


def _from_zero(block: Block, increments: Array) -> tuple[int, Array]:
    """First row and increments of a block. The first row of the record, which ends no increment, is prepended."""
    if block.start != 1:
        return block.start, increments
    return 0, np.concatenate([np.zeros_like(increments[..., :1]), increments], axis=-1)


def _contrasts(modes: int, bins: int) -> Array:
    """Slowest cosines of the second kind, and the difference of the ends, which shows a random walk."""
    at = (np.arange(bins) + 0.5) / bins
    cosines = math.sqrt(2.0 / bins) * np.cos(np.pi * np.arange(1, modes)[:, None] * at)
    ends = np.zeros(bins)
    ends[0], ends[-1] = -1.0, 1.0
    return np.vstack([cosines, ends / math.sqrt(2.0)])


def walk_covariance(stretch: Stretch) -> Array:
    """Covariance of the contrasts by a random walk of unit variance [rad^2/s]."""
    tails = np.cumsum(stretch.contrasts[:, ::-1], axis=1)[:, ::-1][:, 1:]
    return (tails * np.diff(stretch.mean(stretch.time))) @ tails.T


def white_covariance(stretch: Stretch) -> Array:
    """Covariance of the contrasts by white noise of unit variance."""
    return (stretch.contrasts / np.diff(stretch.edges)) @ stretch.contrasts.T


@dataclass(frozen=True)
class SawTooth:
    """The saw-tooth along the path of a stretch: sums over bins of cosines and sines (M, bins) of its harmonics."""

    stretch: Stretch
    count: float
    cosines: Array
    sines: Array

    @classmethod
    def of(cls, stretch: Stretch, count: float) -> SawTooth:
        """An empty saw-tooth."""
        followed = NOISE.harmonics_short if stretch.size <= NOISE.short_stretch else NOISE.harmonics
        if stretch.span < NOISE.slow_counts * count:
            followed = NOISE.harmonics_slow
        shape = (followed, stretch.time.size)
        return cls(stretch, count, np.zeros(shape), np.zeros(shape))

    @property
    def power(self) -> Array:
        """Variance of each harmonic (M,) [rad^2]."""
        variances: Array = self.count**2 / (2.0 * np.pi**2 * np.arange(1.0, len(self.cosines) + 1.0) ** 2)
        return variances

    def covariance(self, walk: float, spread: float) -> Array:
        """Covariance of the contrasts by each harmonic, and by all others (harmonics + 1, K, K) [rad^2].

        The path moves by a random walk of ``walk`` [counts^2/s], which reduces the correlation of the waves. The ends of a
        line along the path have a further relative uncertainty ``spread`` [counts^2]. A negative ``spread`` removes
        damping that is already in the path. Harmonics beyond those followed are white.
        """
        stretch, phi, bins = self.stretch, self.stretch.contrasts, self.stretch.time.size
        times = stretch.mean(stretch.time)
        ramp = times / (stretch.limits[1] - stretch.limits[0])
        harmonics = np.zeros((NOISE.harmonics + 1, bins, bins))
        cosines, sines = stretch.mean(self.cosines), stretch.mean(self.sines)
        saw_tooth_covariance(cosines, sines, self.power, times, ramp, walk, spread, harmonics)
        rest = self.count**2 / 12.0 - float(self.power.sum())
        harmonics[-1].flat[:: bins + 1] += rest / np.diff(stretch.edges)
        return phi @ harmonics @ phi.T

    def over_white(self) -> Array:
        """Power of the followed harmonics in each contrast (K,), relative to white noise of the same variance."""
        stretch, phi = self.stretch, self.stretch.contrasts
        waves = [phi @ stretch.mean(part).T for part in (self.cosines, self.sines)]
        white = (phi**2 / np.diff(stretch.edges)).sum(axis=1) * self.power.sum()
        return sum(wave**2 @ self.power for wave in waves) / white


def follow(
    run: Run, stretches: list[Stretch], count: float, residuals: Iterator[tuple[Block, Array]]
) -> list[SawTooth]:
    """The saw-tooth of every stretch along a path; ``residuals`` are observed less modelled increments, block by block."""
    teeth = {stretch.start: SawTooth.of(stretch, count) for stretch in stretches}
    output, work = run.output, np.empty((4, WAVES))
    for stretch, first, rows, residual in angle_pieces(stretches, residuals):
        tooth = teeth[stretch.start]
        turned = (output[rows] - output[stretch.start] - residual) / count
        add_waves(turned, first, stretch.edges, work, tooth.cosines, tooth.sines)
    return list(teeth.values())


def residual_blocks(design: Design, values: Array) -> Iterator[tuple[Block, Array]]:
    """Blocks with observed minus modelled increments, for column coefficients ``values`` (segments, m)."""
    for block in design.blocks():
        yield block, block.columns[-1] - values[block.segment] @ block.columns[:-1]


def looks_white(teeth: list[SawTooth]) -> bool:
    """True if the saw-tooth has the power of white noise in slow and fast contrasts."""
    over = np.stack([tooth.over_white()[:-1] for tooth in teeth])
    even = all(
        abs(part.mean() - 1.0) < NOISE.white_even for part in np.array_split(over, NOISE.white_groups, axis=1)
    )
    return bool(even and over.max() < NOISE.white_rare + math.log(over.size))


def counting_covariances(
    teeth: list[SawTooth], solution: Solution, groups: tuple[int, ...], walk: float, spread: float
) -> Array:
    """Covariances (harmonics + 1, S, K, K) by the counting along a path [rad^2].

    ``walk`` [rad^2/s] is the random walk; ``spread`` [counts] is the uncertainty of the path besides the solution.
    """
    covariances = []
    for tooth in teeth:
        error = spread**2 - _damped(tooth.stretch, solution, groups, walk) / tooth.count**2
        covariances.append(tooth.covariance(walk / tooth.count**2, error))
    return np.stack(covariances, axis=1)


def _damped(stretch: Stretch, solution: Solution, groups: tuple[int, ...], walk: float) -> float:
    """Mean variance [rad^2] by which waves along the estimated path are already damped."""
    jacobian = solution.jacobians[groups[stretch.segment]]
    far = stretch.end[:-1]
    damped = float(far @ (jacobian @ solution.covariance @ jacobian.T) @ far)
    return min(damped, NOISE.most_damped * walk * float(stretch.limits[1] - stretch.limits[0]))
