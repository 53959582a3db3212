"""Coarse counts: the exact covariance of quantisation instead of white noise (own derivation, docs/theory).

A reading is ``c round(alpha/c)``. Its error is a saw-tooth of the angle, ``sum_m c/(pi m) sin(2 pi m
alpha/c + ..)``. The error is white only where the noise moves the angle by much more than a count. Otherwise its
covariance follows from the path. The fit gives the path to a fraction of a count. The phase of the saw-tooth is
unknown and assumed uniform in every stretch:

    cov(e_j, e_k) = sum_m c^2/(2 pi^2 m^2) cos(2 pi m (psi_j - psi_k)/c) exp(-2 pi^2 m^2 v_jk/c^2)

v_jk is the variance of the path from j to k: by the uncertainty of its estimated rate, and by the random walk.

Each stretch is projected on its slowest cosines, which contain all its information on rates and ripple. In this
projection random walk, white noise and quantisation have small full covariance matrices. Generalised least squares then
gives a stretch with few count changes its correct weight.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from piga.calibration.model.design import Design
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.solution import Solution, solve
from piga.calibration.noise.levels import Noise
from piga.calibration.noise.likelihood import restricted
from piga.calibration.noise.settings import NOISE
from piga.calibration.noise.stretches import (
    SawTooth,
    Stretch,
    counting_covariances,
    empty_stretches,
    find_stretches,
    follow,
    looks_white,
    modes_of,
    most_modes,
    residual_blocks,
    walk_covariance,
    white_covariance,
)
from piga.calibration.noise.weighting import NoiseColumns
from piga.records.run import Run
from piga.results import Array


@dataclass(frozen=True)
class Stretches:
    """All stretches of a record projected on K contrasts: rows (S, K, m + 1) and covariances of unit noises.

    ``walk`` (S, K, K) per rad^2/s, ``white`` (S, K, K) per rad^2. ``counting`` (M + 1, S, K, K) per harmonic,
    and for all further harmonics together [rad^2]. ``segment`` (S,) of each stretch.
    """

    rows: Array
    walk: Array
    white: Array
    counting: Array
    segment: NDArray[np.int64]
    count: float
    design: Design
    parts: list[Stretch] = field(repr=False)

    @classmethod
    def of(cls, design: Design, modes: int, count: float) -> Stretches:
        """Rows and covariances of a design, without the covariances of the counting."""
        parts = find_stretches(design, modes)
        return cls(
            np.array([part.rows for part in parts]),
            np.array([walk_covariance(part) for part in parts]),
            np.array([white_covariance(part) for part in parts]),
            np.zeros((NOISE.harmonics + 1, 0, 0, 0)),
            np.array([part.segment for part in parts]),
            count,
            design,
            parts,
        )

    def along(self, path: Path, noise: Noise, spread: float) -> Stretches:
        """The stretches with the covariances of the counting along a path."""
        counting = counting_covariances(path.teeth, path.solution, self.design.groups, noise.walk, spread)
        return replace(self, counting=counting)

    def moved(self, change: Array) -> float:
        """Largest angle [rad] by which changed column coefficients (segments, m) move the path of a stretch."""
        return max(
            float(np.abs(change[part.segment] @ part.mean(part.angle)[:-1]).max()) for part in self.parts
        )

    def covariance(self, noise: Noise) -> Array:
        """Covariance of the rows (S, K, K) for noise besides the counting; white noise dithers the harmonics."""
        order = np.arange(1, NOISE.harmonics + 2)
        kept = np.exp(-4.0 * np.pi**2 * order**2 * noise.white / self.count**2)
        lost = float(_shares(self.count) @ (1.0 - kept))
        return np.tensordot(kept, self.counting, 1) + noise.walk * self.walk + (noise.white + lost) * self.white


@dataclass(frozen=True)
class Path:
    """The path of a solution, and the saw-tooth of the counting along it or along a nearly equal path."""

    solution: Solution
    teeth: list[SawTooth] = field(repr=False)
    followed: Array

    @classmethod
    def of(cls, stretches: Stretches, solution: Solution) -> Path:
        """The saw-tooth of every stretch, followed through the record."""
        residuals = residual_blocks(stretches.design, solution.values)
        teeth = follow(stretches.design.run, stretches.parts, stretches.count, residuals)
        return cls(solution, teeth, solution.values)

    def next(self, stretches: Stretches, solution: Solution) -> Path:
        """The path of another solution; it is followed again only if it differs."""
        finest = max(len(tooth.cosines) for tooth in self.teeth)
        if stretches.moved(solution.values - self.followed) < NOISE.counting_same * stretches.count / finest:
            return replace(self, solution=solution)
        return Path.of(stretches, solution)


def _shares(count: float) -> Array:
    """Variance of each harmonic of the counting followed, and of all others together [rad^2]."""
    shares = count**2 / (2.0 * np.pi**2 * np.arange(1, NOISE.harmonics + 1) ** 2)
    return np.append(shares, count**2 / 12.0 - shares.sum())


@dataclass(frozen=True)
class Counted:
    """Weights for a coarsely counted record: its stretches, noise besides the counting, number of contrasts.

    ``walks``: random walks [rad^2/s] that the record allows, and their probabilities.
    """

    stretches: Stretches
    modes: int
    noise: Noise
    walks: tuple[Array, Array]

    def with_walk(self, walk: float) -> Counted:
        """These weights with another random walk [rad^2/s]."""
        return replace(self, noise=Noise(self.noise.white, walk))

    def reduce(self, design: Design) -> list[Reduction]:
        """Summaries per segment of a record of the same sampling, with these weights."""
        summaries = [Reduction.empty(design.names) for _ in design.run.labels]
        for segment, columns in self.whitened(design):
            summaries[segment].absorb(columns)
        return summaries

    def whitened(self, design: Design, basis: NoiseColumns | None = None) -> Iterator[tuple[int, Array]]:
        """Segment and whitened columns (m + 1, K) of every stretch; those of a slow noise come before the last."""
        held = self.stretches
        parts, rows = held.parts, held.rows
        if design is not held.design:
            parts = find_stretches(design, self.modes)
            rows = np.array([part.rows for part in parts])
        if basis is not None:
            slow = [part.contrasts @ basis.angle(part.mean(part.time)).T for part in parts]
            rows = np.concatenate([rows[:, :, :-1], np.array(slow), rows[:, :, -1:]], axis=2)
        factor = np.linalg.cholesky(held.covariance(self.noise))
        for part, columns in zip(parts, np.linalg.solve(factor, rows), strict=True):
            yield part.segment, np.ascontiguousarray(columns.T)


def count_of(run: Run) -> float:
    """Angle of one count [rad]: as stated, or seen from steps that are all multiples of one value; else 0."""
    if run.resolution > 0.0 or run.kind == "rate":
        return run.resolution
    steps = np.abs(np.diff(run.output[:4096]))
    formed = ~run.begins[1 : steps.size + 1]
    if run.left_out is not None:
        formed &= ~(run.left_out[: steps.size] | run.left_out[1 : steps.size + 1])
    steps = steps[formed]
    different = np.unique(np.round(steps, 12))
    if different.size < 2 or different.size > steps.size // 8:
        return 0.0
    count = float(np.diff(np.unique(np.concatenate(([0.0], different)))).min())
    turns = steps / count
    return count if np.abs(turns - np.round(turns)).max() < 1e-3 else 0.0


@dataclass(frozen=True)
class CountedFit:
    """What the covariance of coarse counts changes in a fit of one run, under the names it has there."""

    counted: Counted
    noise: Noise
    summaries: list[Reduction]
    solution: Solution


def fit_counted(design: Design, mode: str, noise: Noise, solution: Solution, d: Array) -> CountedFit | None:
    """Fit with the covariance of coarse counts; None where plain whitening with ``noise`` is right.

    ``d`` (n,) are the residual increments of the solution.
    """
    count = count_of(design.run)
    step = design.run.median_step
    dithered = (
        noise.white > NOISE.counting_white * count**2 or noise.walk * step > NOISE.counting_walk * count**2
    )
    if mode != "increments" or count == 0.0 or dithered or design.request.angle_rms is not None:
        return None
    modes = modes_of(design)
    if modes < 3 or (design.run.size > NOISE.counting_long and _is_white(design, d, modes, count)):
        return None
    stretches = Stretches.of(design, modes, count)
    noise = Noise(0.0, 0.0)
    path = Path.of(stretches, solution)
    for index in range(NOISE.counting_passes):
        spread = NOISE.counting_spreads[index] if index < len(NOISE.counting_spreads) else 0.0
        dither = noise if index >= NOISE.counting_trusted else Noise(0.0, 0.0)
        path = path.next(stretches, solution)
        stretches = stretches.along(path, dither, spread)
        before = noise
        rows = _rows(stretches, solution.values if design.has_phases else None)
        noise, walks = _levels(rows, stretches, noise.white, again=index == NOISE.counting_trusted)
        if index > NOISE.counting_trusted:
            noise = Noise(noise.white, 0.5 * (noise.walk + before.walk))
        counted = Counted(stretches, modes, noise, walks)
        summaries = counted.reduce(design)
        solution = solve(design, summaries)
        if (
            index > NOISE.counting_trusted
            and abs(noise.walk - before.walk) <= NOISE.counting_settled * before.walk
        ):
            break
    levels = Noise(counted.noise.white + count**2 / 12.0, counted.noise.walk)
    return CountedFit(counted, levels, summaries, solution)


def _is_white(design: Design, d: Array, modes: int, count: float) -> bool:
    """True where the saw-tooth along the path of the plain fit, with the residual increments ``d``, is white."""
    run = design.run
    most = min(NOISE.white_contrasts // int(np.count_nonzero(run.begins)), most_modes(run))
    stretches = empty_stretches(run, max(modes, most), 0)
    residuals = ((block, d[block.start : block.stop]) for block in design.blocks())
    return looks_white(follow(run, stretches, count, residuals))


def _rows(stretches: Stretches, values: Array | None) -> Array:
    """Rows ``[x | y]``; with ``values`` (segments, m) (several phases), only the residual rows ``[y]``."""
    if values is None:
        return stretches.rows
    modelled = np.einsum("skm,sm->sk", stretches.rows[:, :, :-1], values[stretches.segment])
    return (stretches.rows[:, :, -1] - modelled)[:, :, None]


def _levels(
    rows: Array, stretches: Stretches, white: float, *, again: bool
) -> tuple[Noise, tuple[Array, Array]]:
    """Noise besides the counting by restricted likelihood: the random walk; with ``again`` also white noise."""
    walk, walks = _likely_walks(rows, stretches, white)
    if again:
        levels = stretches.count**2 * 10.0 ** np.linspace(-3.0, 0.0, NOISE.counting_levels)
        white = _best(lambda white: _deviance(rows, stretches.covariance(Noise(white, walk))), levels)
        walk, walks = _likely_walks(rows, stretches, white)
    return Noise(white, walk), walks


def _likely_walks(rows: Array, stretches: Stretches, white: float) -> tuple[float, tuple[Array, Array]]:
    """The random walk for the weights, the random walks that the record allows, and their probabilities.

    Restricted likelihood times Jeffreys' prior (the root of its Fisher information). It gives Student's t if there is
    only random walk. The random walk for the weights has the mean precision of the slowest contrast.
    """
    flat, eigen = _diagonal(rows, stretches, white)
    strongest = float(np.median(eigen.reshape(len(rows), -1)[:, -1]))
    low, high = -3.0, 5.0
    for _ in range(3):
        grid = np.linspace(low, high, NOISE.counting_walks)
        levels = 10.0**grid / strongest
        likelihoods = np.array([_log_probability(flat, eigen, level) for level in levels]) + 2.0 * np.log(
            levels
        )
        likely = np.flatnonzero(likelihoods > likelihoods.max() - NOISE.counting_unlikely)
        low, high = grid[max(likely[0] - 1, 0)], grid[min(likely[-1] + 1, grid.size - 1)]
    weights = np.exp(0.5 * (likelihoods - likelihoods.max()))
    weights /= weights.sum()
    precision = float(weights @ (1.0 / (1.0 + strongest * levels)))
    return (1.0 / precision - 1.0) / strongest, (levels, weights)


def _log_probability(flat: Array, eigen: Array, walk: float) -> float:
    """Twice the log of restricted likelihood times root of Fisher information, for a random walk."""
    size = 1.0 + walk * eigen
    q, r = np.linalg.qr(flat / np.sqrt(size)[:, None])
    diagonal, share, basis = np.abs(np.diag(r)), eigen / size, q[:, :-1]
    logarithm = float(np.log(size).sum()) + 2.0 * float(np.log(diagonal[:-1]).sum())
    deviance = float(restricted(logarithm, diagonal[-1] ** 2))
    inner = basis.T * share @ basis
    information = float(share @ share - 2.0 * np.sum((share[:, None] * basis) ** 2) + np.sum(inner**2))
    return math.log(max(information, 1e-300)) - deviance


def _diagonal(rows: Array, stretches: Stretches, white: float) -> tuple[Array, Array]:
    """Rows of all stretches made independent (S K, m + 1), and the share of the random walk in each."""
    factor = np.linalg.inv(np.linalg.cholesky(stretches.covariance(Noise(white, 0.0))))
    values, vectors = np.linalg.eigh(factor @ stretches.walk @ factor.transpose(0, 2, 1))
    turned = vectors.transpose(0, 2, 1) @ (factor @ rows)
    return turned.reshape(-1, rows.shape[2]), np.maximum(values, 0.0).ravel()


def _best(deviance: Callable[[float], float], levels: Array) -> float:
    """Level of least deviance (parabola through the best on the logarithmic grid); 0 unless 0 is clearly worse."""
    deviances = np.array([deviance(level) for level in levels])
    at = int(np.argmin(deviances))
    best = float(levels[at])
    if 0 < at < levels.size - 1:
        left, middle, right = deviances[at - 1 : at + 2]
        curvature = left - 2.0 * middle + right
        shift = 0.5 * (left - right) / curvature if curvature > 0.0 else 0.0
        best *= float((levels[1] / levels[0]) ** shift)
    return best if deviance(0.0) - deviances[at] > NOISE.counting_in_covariance else 0.0


def _deviance(rows: Array, covariance: Array) -> float:
    """Minus twice the restricted log-likelihood of rows ``[x | y]`` (S, K, m + 1)."""
    factor = np.linalg.cholesky(covariance)
    logarithm = 2.0 * float(np.log(np.diagonal(factor, axis1=1, axis2=2)).sum())
    return logarithm + _restricted(np.linalg.solve(factor, rows).reshape(-1, rows.shape[2]))


def _restricted(white: Array) -> float:
    """Residual sum of squares of whitened rows ``[x | y]``, and ``log|X'X|``."""
    diagonal = np.abs(np.diag(np.linalg.qr(white, mode="r")))
    return float(restricted(2.0 * np.log(diagonal[:-1]).sum(), diagonal[-1] ** 2))
