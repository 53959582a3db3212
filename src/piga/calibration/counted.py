"""Coarse counts: the exact covariance of quantisation instead of white noise (own derivation, docs/theory).

A reading is ``c round(alpha/c)``. Its error is a saw-tooth of the angle, ``sum_m c/(pi m) sin(2 pi m
alpha/c + ..)``: white only where the angle is dithered by much more than a count. Otherwise its covariance
follows from the path, which the fit knows to a fraction of a count, with the phase of the saw-tooth
unknown and uniform in every stretch:

    cov(e_j, e_k) = sum_m c^2/(2 pi^2 m^2) cos(2 pi m (psi_j - psi_k)/c)

Each stretch is projected on its slowest cosines (all its information on rates and ripple), where random
walk, white noise and quantisation have small full covariance matrices; generalised least squares there
weights a stretch in which few counts change by what it really tells.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from piga.calibration.counted_stretches import Stretch, all_stretches, modes_of, stretches_of
from piga.calibration.design import Design
from piga.calibration.noise import Noise
from piga.calibration.reduction import Reduction
from piga.calibration.saw_tooth import HARMONICS, counting_covariance, harmonic_shares
from piga.calibration.solution import Solution, solve
from piga.records.run import Run

if TYPE_CHECKING:
    from piga.calibration.fit import Fit

Array = NDArray[np.float64]

WHITE = 0.15
"""White noise, in squared counts, above which counting is dithered and the plain whitening is right (one
twelfth of it is the counting itself)."""
WALKS = 0.1
"""Random walk from sample to sample, in squared counts, above which it is dithered too."""
PASSES = 6
"""Alternations between path, noise levels and estimate."""
LEVELS = 13
"""Levels tried, over six decades."""
SIGNIFICANT = 0.5
"""Gain in twice the log-likelihood from which a random walk is taken as real."""
SETTLED = 0.03
"""Relative change of the random walk's variance at which the alternation ends."""
UNSEEN = 0.4
"""A random walk that coarse counts cannot show counts as this share of its standard uncertainty (the mean of the
positive half of a normal distribution)."""
FIRST_SPREAD = 0.5
"""Uncertainty of the path over a stretch [counts] before there is an estimate to trust."""


@dataclass(frozen=True)
class Stretches:
    """All stretches of a record projected on K contrasts: rows (S, K, m + 1), covariances of unit noises.

    ``walk`` (S, K, K) per rad^2/s, ``white`` (S, K, K) per rad^2, ``counting`` (M + 1, S, K, K) per harmonic
    and of all further ones together [rad^2]; ``segment`` (S,) of each.
    """

    rows: Array
    walk: Array
    white: Array
    counting: Array
    segment: NDArray[np.int64]
    count: float
    design: Design

    def covariance(self, noise: Noise) -> Array:
        """Covariance of the rows (S, K, K) for noise besides the counting; white noise dithers the harmonics."""
        order = np.arange(1, HARMONICS + 2)
        kept = np.exp(-4.0 * np.pi**2 * order**2 * noise.white / self.count**2)
        lost = float(harmonic_shares(self.count) @ (1.0 - kept))
        return np.tensordot(kept, self.counting, 1) + noise.walk * self.walk + (noise.white + lost) * self.white


@dataclass(frozen=True)
class Counted:
    """Weights found for a coarsely counted record: its stretches, noise besides the counting, contrasts used.

    ``walk_deviation``: (0, standard uncertainty of the random walk's variance [rad^2/s]).
    """

    stretches: Stretches
    modes: int
    noise: Noise
    walk_deviation: tuple[float, float] = (0.0, 0.0)

    def with_walk(self, walk: float) -> Counted:
        """The same with another random walk [rad^2/s]."""
        return replace(self, noise=Noise(self.noise.white, walk))

    def reduce(self, design: Design) -> list[Reduction]:
        """Summaries per segment of a record of the same sampling, with these weights."""
        rows = self.stretches.rows
        if design is not self.stretches.design:
            rows = np.array([stretch.rows for stretch in stretches_of(design, self.modes)])
        factor = np.linalg.cholesky(self.stretches.covariance(self.noise))
        summaries = [Reduction.empty(design.names) for _ in design.run.labels]
        for stretch, segment in zip(np.linalg.solve(factor, rows), self.stretches.segment, strict=True):
            summaries[segment].absorb(np.ascontiguousarray(stretch.T))
        return summaries


def count_of(run: Run) -> float:
    """Angle of one count [rad]: as stated, or seen in a log whose steps are all multiples of one; else 0."""
    if run.resolution > 0.0 or run.kind == "rate":
        return run.resolution
    steps = np.abs(np.diff(run.output[:4096]))
    steps = steps[~run.begins[1 : steps.size + 1]]
    different = np.unique(np.round(steps, 12))
    if different.size < 2 or different.size > steps.size // 8:
        return 0.0
    count = float(np.diff(np.unique(np.concatenate(([0.0], different)))).min())
    turns = steps / count
    return count if np.abs(turns - np.round(turns)).max() < 1e-3 else 0.0


def refine_counted(fit: Fit, groups: tuple[int, ...]) -> Fit:
    """The same fit with the covariance of its coarse counts; unchanged where plain whitening is right.

    A record with samples left out keeps the plain whitening: its stretches have holes.
    """
    design, count = fit.design, count_of(fit.design.run)
    step = design.run.median_step
    dithered = fit.noise.white > WHITE * count**2 or fit.noise.walk * step > WALKS * count**2
    if fit.mode != "increments" or count == 0.0 or dithered or design.request.angle_rms is not None:
        return fit
    if design.run.left_out is not None:
        return fit
    modes = modes_of(design)
    if modes < 3:
        return fit
    solution, noise, spread = fit.solution, Noise(0.0, 0.0), FIRST_SPREAD
    kept = all_stretches(design, modes)
    for index in range(PASSES):
        stretches = _project(design, modes, count, solution, groups, noise, spread, kept)
        before = noise
        noise = _levels(stretches, noise.white, solution.values if max(groups) else None, again=index == 1)
        if index > 1:
            noise = Noise(noise.white, 0.5 * (noise.walk + before.walk))
        counted = Counted(stretches, modes, noise)
        summaries = counted.reduce(design)
        solution, spread = solve(design, summaries, groups), 0.0
        if index > 1 and abs(noise.walk - before.walk) <= SETTLED * before.walk:
            break
    deviation = _walk_deviation(stretches, noise)
    counted = replace(counted, walk_deviation=(0.0, deviation))
    if noise.walk < UNSEEN * deviation:
        counted = counted.with_walk(UNSEEN * deviation)
        summaries = counted.reduce(design)
        solution = solve(design, summaries, groups)
    return replace(
        fit,
        noise=Noise(counted.noise.white + count**2 / 12.0, counted.noise.walk),
        summaries=summaries,
        solution=solution,
        covariance=solution.covariance,
        counted=counted,
    )


def _project(
    design: Design,
    modes: int,
    count: float,
    solution: Solution,
    groups: tuple[int, ...],
    noise: Noise,
    spread: float,
    kept: list[Stretch] | None,
) -> Stretches:
    """Rows and covariances of all stretches along the path of an estimate."""
    rows, walks, whites, countings, segments = [], [], [], [], []
    for stretch in kept if kept is not None else stretches_of(design, modes):
        phi, group = stretch.contrasts, groups[stretch.segment]
        times = stretch.mean(stretch.t)
        tails = np.cumsum(phi[:, ::-1], axis=1)[:, ::-1][:, 1:]
        rows.append(stretch.rows)
        walks.append((tails * np.diff(times)) @ tails.T)
        whites.append((phi / np.diff(stretch.edges)) @ phi.T)
        jacobian = solution.jacobians[group]
        far = stretch.columns[:-1, -1] - stretch.columns[:-1, 0]
        known = float(far @ (jacobian @ solution.covariance @ jacobian.T) @ far)
        duration = float(stretch.t[-1] - stretch.t[0])
        sigma = math.sqrt(known) / count + spread
        wander = math.sqrt(noise.walk * duration / 15.0) / count
        residual = stretch.columns[-1] - solution.values[stretch.segment] @ stretch.columns[:-1]
        path = design.run.output[stretch.start : stretch.start + stretch.t.size] - residual
        countings.append(counting_covariance(stretch, path, count, sigma, wander))
        segments.append(stretch.segment)
    return Stretches(
        np.array(rows),
        np.array(walks),
        np.array(whites),
        np.stack(countings, axis=1),
        np.array(segments),
        count,
        design,
    )


def _levels(stretches: Stretches, white: float, values: Array | None, *, again: bool) -> Noise:
    """Noise besides the counting by restricted likelihood: the random walk, ``again`` with the white noise.

    ``values`` (segments, m): column coefficients to take as they are (several phases); None: those that fit.
    """
    rows = stretches.rows
    if values is not None:
        modelled = np.einsum("skm,sm->sk", rows[:, :, :-1], values[stretches.segment])
        rows = (rows[:, :, -1] - modelled)[:, :, None]
    walk = _best_walk(rows, stretches, white)
    if again:
        levels = stretches.count**2 * 10.0 ** np.linspace(-3.0, 0.0, LEVELS // 2)
        white = _best(lambda white: _deviance(rows, stretches.covariance(Noise(white, walk))), levels)
        walk = _best_walk(rows, stretches, white)
    return Noise(white, walk)


def _best_walk(rows: Array, stretches: Stretches, white: float) -> float:
    """Random walk of least deviance; the covariances are made diagonal together, once."""
    flat, eigen = _diagonal(rows, stretches, white)

    def deviance(walk: float) -> float:
        size = 1.0 + walk * eigen
        return float(np.log(size).sum()) + _restricted(flat / np.sqrt(size)[:, None])

    strongest = float(np.median(eigen.reshape(len(rows), -1)[:, -1]))
    return _best(deviance, 10.0 ** np.linspace(-2.0, 5.0, 2 * LEVELS) / strongest)


def _diagonal(rows: Array, stretches: Stretches, white: float) -> tuple[Array, Array]:
    """Rows of all stretches made independent (S K, m + 1), and the share of the random walk in each."""
    factor = np.linalg.inv(np.linalg.cholesky(stretches.covariance(Noise(white, 0.0))))
    values, vectors = np.linalg.eigh(factor @ stretches.walk @ factor.transpose(0, 2, 1))
    turned = vectors.transpose(0, 2, 1) @ (factor @ rows)
    return turned.reshape(-1, rows.shape[2]), np.maximum(values, 0.0).ravel()


def _walk_deviation(stretches: Stretches, noise: Noise) -> float:
    """Standard uncertainty of the random walk's variance: the restricted likelihood's Fisher information."""
    flat, eigen = _diagonal(stretches.rows, stretches, noise.white)
    size = 1.0 + noise.walk * eigen
    share = eigen / size
    basis = np.linalg.qr(flat[:, :-1] / np.sqrt(size)[:, None])[0]
    inner = basis.T * share @ basis
    information = 0.5 * float(share @ share - 2.0 * np.sum((share[:, None] * basis) ** 2) + np.sum(inner**2))
    return 1.0 / math.sqrt(max(information, 1e-300))


def _best(deviance: Callable[[float], float], levels: Array) -> float:
    """Level of least deviance (parabola through the best on the logarithmic grid); 0 unless that is clearly worse."""
    found = np.array([deviance(level) for level in levels])
    at = int(np.argmin(found))
    best = float(levels[at])
    if 0 < at < levels.size - 1:
        left, middle, right = found[at - 1 : at + 2]
        curvature = left - 2.0 * middle + right
        shift = 0.5 * (left - right) / curvature if curvature > 0.0 else 0.0
        best *= float((levels[1] / levels[0]) ** shift)
    return best if deviance(0.0) - found[at] > SIGNIFICANT else 0.0


def _deviance(rows: Array, covariance: Array) -> float:
    """Minus twice the restricted log-likelihood of rows ``[x | y]`` (S, K, m + 1)."""
    factor = np.linalg.cholesky(covariance)
    logarithm = 2.0 * float(np.log(np.diagonal(factor, axis1=1, axis2=2)).sum())
    return logarithm + _restricted(np.linalg.solve(factor, rows).reshape(-1, rows.shape[2]))


def _restricted(white: Array) -> float:
    """Residual sum of squares of whitened rows ``[x | y]``, and ``log|X'X|``."""
    diagonal = np.abs(np.diag(np.linalg.qr(white, mode="r")))
    return 2.0 * float(np.log(diagonal[:-1]).sum()) + float(diagonal[-1] ** 2)
