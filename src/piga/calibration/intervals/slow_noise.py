"""Slow noise of the rate, estimated by restricted likelihood and added to the covariance: a bias drift or a scatter.

A bias drift is a walk of the rate over the whole record. Positions are then not independent. A scatter is an independent
rate error in every segment, for example when stand and servo are set again at each position. The noise with the larger
likelihood is chosen. Its columns (:mod:`~piga.calibration.noise.weighting`) are whitened and reduced with those of the
model. After the model is projected out, only independent numbers and unit white noise remain. The likelihood of their
variance is then a sum over eigenvalues (own derivation, docs/theory). Long records are first tested with the means of the
residual angle over a few bins of every stretch. If this test shows no slow noise, the search ends.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import cast

import numpy as np

from piga._kernels.estimation.noise import CANDIDATES
from piga.calibration.fit.one_run import Fit, whitened_rows
from piga.calibration.model.reduction import solve_upper
from piga.calibration.model.solution import KNOTS, solve
from piga.calibration.noise.levels import Noise, deviance_sums, least_on_grid
from piga.calibration.noise.likelihood import information, restricted
from piga.calibration.noise.settings import NOISE
from piga.calibration.noise.weighting import (
    BesideStated,
    DriftBasis,
    NoiseColumns,
    SegmentBasis,
    SlowBasis,
    reduce_segments,
    residual_increments,
    slow_bases,
)
from piga.results import Array


@dataclass(frozen=True)
class Level:
    """Variance of the numbers that change the rate [rad^2/s^2], its standard uncertainty, gain of likelihood."""

    variance: float
    deviation: float
    gain: float


@dataclass(frozen=True)
class _SlowCandidate:
    """A slow noise, the white noise and random walk estimated with it, and its gain."""

    basis: SlowBasis
    noise: Noise
    gain: float


def include_stated_scatter(fit: Fit, variance: Array) -> Fit:
    """Include the stated variance (m,) [rad^2/s^2] of the rate of each segment in levels and weights of a fit.

    A stated scatter is then not mistaken for noise of the record. The fit is unchanged if the scatter is below
    ``stated_lost`` of the noise of the mean rates, or if the noise levels are not estimated. Coarse counts keep their weights.
    """
    able = fit.seeks_noise and fit.mode == "increments"
    if not able or not variance.any() or variance.size > NOISE.most_segments:
        return fit
    basis = SegmentBasis.of(fit.design.run)
    factor = slow_factor(fit, fit.noise, basis)
    factor[:, : basis.count] *= np.sqrt(variance)
    values = projected(factor, basis)[0]
    if values.size == 0 or values[0] < NOISE.stated_lost:
        return fit
    noise = replace(fit.noise, stated=tuple(variance.tolist()))
    if fit.counted is not None:
        return replace(fit, noise=noise)
    for below in (NOISE.stated_below, NOISE.slow_below):
        noise = _levels_beside_stated(fit, noise, below)
    refit = _solved(fit, noise)
    d, h = residual_increments(fit.design, refit.solution.values)
    return replace(refit, d=d, h=h)


def include_slow_noise(fit: Fit, clear: float = NOISE.slow_in_weights) -> Fit:
    """Include a slow noise in the covariance of a fit, if the record shows one: drift or scatter, whichever is likelier.

    It enters the weights from a gain of ``slow_in_weights`` on, a drift from ``clear``. Below this gain the weights stay
    those of the other noise, and its effect on the estimates is added to their covariance. With coarse counts the weights
    stay at any gain.
    The search is not done with given noise levels, nor with methods other than whitened least squares in one pass.
    """
    if not fit.seeks_noise or fit.mode != "increments" or fit.design.rows < 8 * KNOTS:
        return fit
    bases = slow_bases(fit.design.run)
    if fit.counted is None and fit.design.rows > NOISE.restricted_rows:
        levels = quick_looks(fit, bases)
        bases = tuple(b for b, level in zip(bases, levels, strict=True) if level.gain >= NOISE.slow_suspected)
    candidates = [candidate for basis in bases if (candidate := _looked_for(fit, basis))]
    best = max(candidates, key=lambda candidate: candidate.gain, default=None)
    if best is None or best.gain < NOISE.slow_in_covariance:
        return fit
    basis, plain = best.basis, _solved(fit, best.noise)
    factor = slow_factor(plain, best.noise, basis)
    level = likely_level(factor, basis)
    moved = moved_by(factor, basis, fit.solution.parameters)
    slow, deviation = basis.noise(best.noise, level.variance), level.deviation / basis.unit()
    limit = clear if isinstance(basis, DriftBasis) else NOISE.slow_in_weights
    if fit.counted is None and (best.gain >= limit or moved is None):
        return replace(_solved(fit, slow), slow_deviation=deviation)
    if moved is None:
        return fit
    part = basis.unit() * moved @ moved.T
    return replace(
        plain,
        noise=slow,
        covariance=plain.covariance + slow.slow * part,
        slow_deviation=deviation,
        slow_part=part,
    )


def _solved(fit: Fit, noise: Noise) -> Fit:
    """The fit with other levels and weights; coarse counts keep their weights."""
    if fit.counted is not None:
        return replace(fit, noise=noise)
    summaries = reduce_segments(fit.design, fit.mode, noise)
    solution = solve(fit.design, summaries)
    return replace(fit, noise=noise, summaries=summaries, solution=solution, covariance=solution.covariance)


def _looked_for(fit: Fit, basis: SlowBasis) -> _SlowCandidate | None:
    """A slow noise and the levels estimated with it; None if there is hardly any.

    Coarse counts keep their weights and random walk.
    """
    if fit.counted is not None:
        return _SlowCandidate(basis, fit.noise, likely_level(slow_factor(fit, fit.noise, basis), basis).gain)
    if likely_level(slow_factor(fit, fit.noise, basis), basis).gain < NOISE.slow_suspected:
        return None
    return _SlowCandidate(basis, *_levels_together(fit, basis))


def slow_factor(fit: Fit, noise: Noise, basis: NoiseColumns) -> Array:
    """Triangular factor of the weighted rows ``[slow noise | model | y]``; the slow noise is free.

    The model is linear about the fit: its columns are those of amplitudes and phases, y is the residual. The weights
    include a stated scatter of the segments.
    """
    return _factor_and_size(fit, noise, basis)[0]


def _factor_and_size(fit: Fit, noise: Noise, basis: NoiseColumns) -> tuple[Array, float]:
    """The factor, and the log-determinant that a stated scatter adds to the covariance of its rows."""
    solution, m = fit.solution, len(fit.design.names)
    segments = SegmentBasis.of(fit.design.run)
    wide: NoiseColumns = BesideStated(segments, basis) if noise.stated else basis
    parts = []
    for segment, columns in whitened_rows(fit, fit.design, noise, wide):
        model, slow = columns[:m], columns[m:-1]
        y = columns[-1] - solution.values[segment] @ model
        turned = solution.jacobians[fit.design.groups[segment]].T @ model
        parts.append(wide.placed(triangle(np.vstack([slow, turned, y]).T), segment))
    factor, size = triangle(np.vstack(parts)), 0.0
    if noise.stated:
        stated = factor[:, : segments.count] * np.sqrt(np.array(noise.stated))
        lower = np.linalg.cholesky(np.eye(len(factor)) + stated @ stated.T)
        factor = triangle(np.asarray(np.linalg.solve(lower, factor[:, segments.count :]), dtype=np.float64))
        size = 2.0 * float(np.log(np.diag(lower)).sum())
    kept = np.ones(factor.shape[1], dtype=bool)
    kept[basis.count : -1] = factor[:, basis.count : -1].any(axis=0)
    return factor[:, kept], size


def triangle(rows: Array) -> Array:
    """Triangular factor of rows."""
    return cast("Array", np.linalg.qr(rows, mode="r"))


def moved_by(factor: Array, basis: NoiseColumns, parameters: int) -> Array | None:
    """Change of each parameter by numbers of one (parameters, count); None if a parameter is not determined."""
    model = factor[:, basis.count : -1]
    size = np.linalg.norm(model, axis=0)
    if model.shape[1] < parameters:
        return None
    rows = triangle(np.hstack([model / size, factor[:, : basis.count]]))[:parameters]
    if np.abs(np.diag(rows)).min() < NOISE.slow_undetermined:
        return None
    return solve_upper(rows[:, :parameters], rows[:, parameters:]) / size[:, None]


def _levels_together(fit: Fit, basis: SlowBasis) -> tuple[Noise, float]:
    """White noise and random walk with a slow noise, and the gain by it: restricted likelihood of all three.

    The search uses a grid of ``log10(q h/r)``, concentrated over the scale. Each point has its best slow noise.
    """
    table = _deviances(fit, basis, fit.noise, NOISE.slow_below)
    return table.levels(fit.noise, table.best), float(table.without.min() - table.best.min())


def _levels_beside_stated(fit: Fit, noise: Noise, below: float) -> Noise:
    """White noise and random walk with a stated scatter, searched down to ``below`` decades under ``noise``."""
    table = _deviances(fit, SegmentBasis.of(fit.design.run), noise, below)
    return table.levels(noise, table.without)


@dataclass(frozen=True)
class _Deviances:
    """Deviance on a ``grid`` of ``log10(q h/r)``, without slow noise and with the best one, and both residual squares.

    ``step`` h [s], ``freedom`` degrees of freedom.
    """

    grid: Array
    without: Array
    best: Array
    squares: dict[bool, Array]
    step: float
    freedom: int

    def levels(self, noise: Noise, deviance: Array) -> Noise:
        """White noise and random walk at the least ``deviance``, with the stated scatter of ``noise``."""
        ratio = least_on_grid(self.grid, deviance)
        white = float(np.interp(ratio, self.grid, self.squares[deviance is self.best])) / self.freedom
        return Noise(white, white * 10.0**ratio / self.step, stated=noise.stated)


def _deviances(fit: Fit, basis: SlowBasis, noise: Noise, below: float) -> _Deviances:
    step = fit.design.run.median_step
    freedom = fit.design.rows - fit.solution.parameters
    centre = math.log10(max(noise.walk * step / noise.white, 1e-9))
    grid = np.linspace(centre - below, centre + NOISE.slow_above, CANDIDATES)
    logarithms = deviance_sums(fit.d, fit.h, 10.0**grid / step)[0]
    stated = tuple(variance / noise.white for variance in noise.stated)
    table = []
    for ratio, logarithm in zip(grid, logarithms, strict=True):
        factor, stated_size = _factor_and_size(fit, Noise(1.0, 10.0**ratio / step, stated=stated), basis)
        values, square, rest, model = projected(factor, basis)
        levels = np.append(0.0, 10.0 ** np.linspace(-4.0, 4.0, NOISE.slow_levels) / max(values[0], 1e-300))
        size = 1.0 + levels[:, None] * values
        total = rest + (square / size).sum(axis=1)
        deviance = restricted(logarithm, total, freedom) + model + np.log(size).sum(axis=1) + stated_size
        at = int(np.argmin(deviance))
        table.append((float(deviance[0]), float(deviance[at]), float(total[0]), float(total[at])))
    without, best, plain, left = np.array(table).T
    return _Deviances(grid, without, best, {False: plain, True: left}, step, freedom)


def quick_looks(fit: Fit, bases: Sequence[SlowBasis]) -> list[Level]:
    """Slow noises in the means of the residual angle over a few bins of every stretch; the model is kept fixed."""
    starts = int(np.count_nonzero(fit.design.run.begins))
    parts = means_of_bins(fit, bases, int(np.clip(NOISE.look_most_bins // starts, 2, NOISE.look_bins)))
    return [
        likely_level(triangle(rows), basis) if len(rows) > basis.count else Level(0.0, 0.0, 0.0)
        for rows, basis in zip(parts, bases, strict=True)
    ]


def means_of_bins(fit: Fit, bases: Sequence[NoiseColumns], bins: int) -> list[Array]:
    """Independent rows ``[slow noise | residual]`` (rows, count + 1) from the means of the residual angle over bins.

    One array for each slow noise.
    """
    run = fit.design.run
    parts = [[np.zeros((0, basis.count + 1))] for basis in bases]
    for left, right in pairwise(np.append(np.flatnonzero(run.begins), run.size)):
        if right - left < 2 * bins:
            continue
        for basis, part, rows in zip(bases, parts, _whitened_means(fit, bases, left, right, bins), strict=True):
            part.append(basis.placed(rows, int(run.segment_index[left])))
    return [np.concatenate(part) for part in parts]


def _whitened_means(
    fit: Fit, bases: Sequence[NoiseColumns], left: int, right: int, bins: int
) -> Iterator[Array]:
    """Differences of neighbouring bin means as independent rows ``[slow noise | residual]`` (bins - 1, size + 1)."""
    edges = np.linspace(0, right - left, bins + 1).astype(np.int64)
    sizes = np.diff(edges)
    t = np.asarray(fit.design.run.t[left:right])
    angle = np.cumsum(fit.d[left:right])
    middles, angles = (np.add.reduceat(part, edges[:-1]) / sizes for part in (t - t[0], angle))
    widths = sizes * (t[-1] - t[0]) / t.size
    covariance = fit.noise.walk * (np.minimum.outer(middles, middles) - np.diag(widths) / 6.0)
    covariance += np.diag(fit.noise.white / sizes)
    difference = np.diff(np.eye(bins), axis=0)
    lower = np.linalg.cholesky(difference @ covariance @ difference.T)
    for basis in bases:
        rows = np.diff(np.vstack([basis.angle(middles + t[0]), angles]), axis=1).T
        yield np.linalg.solve(lower, rows)


def likely_level(factor: Array, basis: SlowBasis) -> Level:
    """Likely variance of the numbers, from a triangular factor of ``[slow noise | model | y]`` rows of unit variance."""
    values, square, _, _ = projected(factor, basis)
    if values.size < NOISE.slow_enough:
        return Level(0.0, 0.0, 0.0)
    levels = 10.0 ** np.linspace(-4.0, 4.0, NOISE.slow_levels) / values[0]
    size = 1.0 + levels[:, None] * values
    gains = -restricted(np.log(size), square / size - square).sum(axis=1)
    at = int(np.argmax(gains))
    known = float(information(values[None] / size[at])[0, 0])
    return Level(float(levels[at]), 1.0 / math.sqrt(known), float(gains[at]))


def projected(factor: Array, basis: SlowBasis) -> tuple[Array, Array, float, float]:
    """Project out the model: eigenvalues of the slow noise, squared component of y on each, the rest, ``log|X'X|``.

    Then ``y = B s + e``. Components on the eigenvectors of ``B B'`` have variance ``1 + v lambda``. Directions that the model
    absorbs are left out; for a scatter their number is that of the coefficients of mean rates.
    """
    block, y, left, diagonal = without_model(factor, basis.count)
    vectors, values, _ = np.linalg.svd(block)
    square = (vectors.T @ y) ** 2
    seen = values > NOISE.slow_undetermined * math.sqrt(float(np.sum(factor[:, : basis.count] ** 2)))
    rest = float(square[~seen].sum()) + left
    return values[seen] ** 2, square[seen], rest, 2.0 * float(np.log(diagonal).sum())


def without_model(factor: Array, count: int) -> tuple[Array, Array, float, Array]:
    """Project out the model of rows ``[slow noise | model | y]`` with ``count`` columns of slow noise.

    Returns the triangle that leads from the slow noise to the slow values, these values, the sum of squares that is left, and
    the diagonal of the model.
    """
    size = factor.shape[1] - 1
    model = size - count
    turned = triangle(factor[:, [*range(count, size), *range(count), size]])
    left = float(turned[size, -1] ** 2) if turned.shape[0] > size else 0.0
    return turned[model:size, model:size], turned[model:size, -1], left, np.abs(np.diag(turned)[:model])
