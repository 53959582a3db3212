"""Slow noise of the rate, found by restricted likelihood and taken into the covariance: a bias drift, or a scatter.

The rate walks over the whole record (a bias drift), so that positions are no longer independent, or has a value of its
own in every segment: what stand and servo do anew at each position. The record tells which is likelier. The columns of
either (:mod:`~piga.calibration.noise.slow_bases`) are whitened and reduced with those of the model; projected on what
the model leaves, independent numbers and white noise of one are all there is, and the likelihood of their variance is
a sum over eigenvalues (own derivation, docs/theory). In long records a quick look at the means of the residual angle
over a few bins of every stretch comes first: one without slow noise pays nothing else.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import cast

import numpy as np
from numpy.typing import NDArray

from piga._kernels.estimation.whitening import LANES
from piga.calibration.fit.one_run import SMALL, Fit, whitened_rows
from piga.calibration.model.reduction import solve_upper
from piga.calibration.model.solution import KNOTS, solve
from piga.calibration.noise.levels import Noise, deviance_sums, least_on_grid
from piga.calibration.noise.slow_bases import (
    MOST_SEGMENTS,
    BesideStated,
    DriftBasis,
    NoiseColumns,
    SegmentBasis,
    SlowBasis,
    slow_bases,
)
from piga.calibration.noise.weighting import reduce_segments, residual_increments

Array = NDArray[np.float64]

SUSPECTED = 0.3
"""Gain in twice the log-likelihood, the other levels as found, from which a slow noise is looked for with all of them."""
SIGNIFICANT = 2.0
"""Gain from which a slow noise is taken into the covariance."""
CLEAR = 9.0
"""Gain from which it is weighted by, too: weights for a drift that is not there cost up to six times the variance."""
BELOW, ABOVE = 0.7, 0.35
"""Decades below and above the random walk found without a drift in which it is looked for with slow noise."""
LEVELS = 41
"""Levels tried, over eight decades."""
UNDETERMINED = 1e-9
"""Part of a column that the others leave, below which nothing is said of it."""
ENOUGH = 3
"""Independent values of a slow noise that the coefficients must leave."""
LOST = 0.2
"""Largest variance of a mean rate by a stated scatter, over that by the noise, up to which it makes no difference to levels
and weights."""
LOWEST = 4.0
"""Decades below the random walk found without it in which it is looked for beside a stated scatter."""
BINS, MOST_BINS = 16, 2048
"""Bins of a stretch at the quick look, and of all stretches together."""


@dataclass(frozen=True)
class Level:
    """Variance of the numbers that move the rate [rad^2/s^2], its standard uncertainty, gain of likelihood."""

    variance: float
    deviation: float
    gain: float


@dataclass(frozen=True)
class _Candidate:
    """A slow noise with the white noise and random walk beside it, and the gain by it."""

    basis: SlowBasis
    noise: Noise
    gain: float


def include_stated_scatter(fit: Fit, variance: Array) -> Fit:
    """The same fit that knows the stated variance (m,) [rad^2/s^2] of the rate of each segment: in levels and weights.

    What is stated is then not taken for noise that the record shows. Unchanged where it is lost in the noise of the mean
    rates (below ``LOST`` of it), and where the levels of the noise are not looked for; coarse counts keep their weights.
    """
    request, count = fit.design.request, len(fit.design.run.labels)
    able = fit.mode == "increments" and request.method == "information" and request.angle_rms is None
    if not able or not variance.any() or count > MOST_SEGMENTS:
        return fit
    basis = SegmentBasis.of(fit.design.run)
    factor = slow_factor(fit, fit.noise, basis)
    factor[:, : basis.count] *= np.sqrt(variance)
    values = projected(factor, basis)[0]
    if values.size == 0 or values[0] < LOST:
        return fit
    noise = replace(fit.noise, stated=tuple(variance.tolist()))
    if fit.counted is not None:
        return replace(fit, noise=noise)
    for below in (LOWEST, BELOW):
        noise = _levels_beside_stated(fit, noise, below)
    refit = _solved(fit, noise)
    d, h = residual_increments(fit.design, refit.solution.values)
    return replace(refit, d=d, h=h)


def include_slow_noise(fit: Fit, clear: float = CLEAR) -> Fit:
    """The same fit with a slow noise in its covariance, where the record shows one: the likelier of the two.

    It is weighted by from a gain of ``CLEAR`` on, a drift from ``clear``. Below, the weights stay those of the other
    noise, and what it adds to the estimates is added to their covariance; so it is with coarse counts, however clear.
    Left out with given noise levels and methods other than whitened least squares in one go.
    """
    request = fit.design.request
    able = fit.mode == "increments" and request.method == "information"
    if not able or request.angle_rms is not None or fit.design.rows < 8 * KNOTS:
        return fit
    looked = _beside_counts if fit.counted is not None else _looked_for
    candidates = [candidate for basis in slow_bases(fit.design.run) if (candidate := looked(fit, basis))]
    best = max(candidates, key=lambda candidate: candidate.gain, default=None)
    if best is None or best.gain < SIGNIFICANT:
        return fit
    basis, plain = best.basis, _solved(fit, best.noise)
    factor = slow_factor(plain, best.noise, basis)
    level = likely_level(factor, basis)
    moved = _moved(factor, basis, len(fit.solution.amplitudes) + len(fit.solution.phases))
    slow, deviation = basis.noise(best.noise, level.variance), level.deviation / basis.unit()
    limit = clear if isinstance(basis, DriftBasis) else CLEAR
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
    """The fit with other levels and, but for coarse counts, weights."""
    if fit.counted is not None:
        return replace(fit, noise=noise)
    summaries = reduce_segments(fit.design, fit.mode, noise)
    solution = solve(fit.design, summaries)
    return replace(fit, noise=noise, summaries=summaries, solution=solution, covariance=solution.covariance)


def _looked_for(fit: Fit, basis: SlowBasis) -> _Candidate | None:
    """A slow noise with the levels beside it; None where a quick look shows nothing of it."""
    if fit.design.rows > SMALL and quick_look(fit, basis).gain < SUSPECTED:
        return None
    if likely_level(slow_factor(fit, fit.noise, basis), basis).gain < SUSPECTED:
        return None
    return _Candidate(basis, *_levels_together(fit, basis))


def _beside_counts(fit: Fit, basis: SlowBasis) -> _Candidate | None:
    """Coarse counts keep their weights and the random walk found."""
    gain = likely_level(slow_factor(fit, fit.noise, basis), basis).gain
    return _Candidate(basis, fit.noise, gain)


def slow_factor(fit: Fit, noise: Noise, basis: SlowBasis) -> Array:
    """Triangular factor of the weighted rows ``[slow noise | model | y]``, the noise left free.

    The model is linear about the fit: its columns are those of amplitudes and phases, y is the residual. A stated
    scatter of the segments is in the weights.
    """
    return _factor_and_size(fit, noise, basis)[0]


def _factor_and_size(fit: Fit, noise: Noise, basis: SlowBasis) -> tuple[Array, float]:
    """The factor, and the logarithm of the determinant of what a stated scatter adds to the covariance of its rows."""
    solution, m = fit.solution, len(fit.design.names)
    segments = SegmentBasis.of(fit.design.run)
    wide: NoiseColumns = BesideStated(segments, basis) if noise.stated else basis
    parts = []
    for segment, columns in whitened_rows(fit, fit.design, noise, wide):
        model, slow = columns[:m], columns[m:-1]
        y = columns[-1] - solution.values[segment] @ model
        turned = solution.jacobians[fit.design.groups[segment]].T @ model
        parts.append(wide.placed(_triangle(np.vstack([slow, turned, y]).T), segment))
    factor, size = _triangle(np.vstack(parts)), 0.0
    if noise.stated:
        stated = factor[:, : segments.count] * np.sqrt(np.array(noise.stated))
        lower = np.linalg.cholesky(np.eye(len(factor)) + stated @ stated.T)
        factor = _triangle(np.asarray(np.linalg.solve(lower, factor[:, segments.count :]), dtype=np.float64))
        size = 2.0 * float(np.log(np.diag(lower)).sum())
    kept = np.ones(factor.shape[1], dtype=bool)
    kept[basis.count : -1] = factor[:, basis.count : -1].any(axis=0)
    return factor[:, kept], size


def _triangle(rows: Array) -> Array:
    return cast("Array", np.linalg.qr(rows, mode="r"))


def _moved(factor: Array, basis: SlowBasis, parameters: int) -> Array | None:
    """By how much a number of one moves each parameter (parameters, count); None where one is not determined."""
    model = factor[:, basis.count : -1]
    size = np.linalg.norm(model, axis=0)
    if model.shape[1] < parameters:
        return None
    rows = _triangle(np.hstack([model / size, factor[:, : basis.count]]))[:parameters]
    if np.abs(np.diag(rows)).min() < UNDETERMINED:
        return None
    return solve_upper(rows[:, :parameters], rows[:, parameters:]) / size[:, None]


def _levels_together(fit: Fit, basis: SlowBasis) -> tuple[Noise, float]:
    """White noise and random walk beside a slow noise, and the gain by it: restricted likelihood of all three.

    On a grid of ``log10(q h/r)``, concentrated over the scale, the slow noise at its best for each.
    """
    table = _deviances(fit, basis, fit.noise, BELOW)
    return table.levels(fit.noise, table.best), float(table.without.min() - table.best.min())


def _levels_beside_stated(fit: Fit, noise: Noise, below: float) -> Noise:
    """White noise and random walk beside a stated scatter alone, looked for ``below`` decades under ``noise``."""
    table = _deviances(fit, SegmentBasis.of(fit.design.run), noise, below)
    return table.levels(noise, table.without)


@dataclass(frozen=True)
class _Deviances:
    """Deviance on a ``grid`` of ``log10(q h/r)``: without a slow noise and with the best, and the squares left by both.

    ``step`` h [s], ``freedom`` degrees of freedom.
    """

    grid: Array
    without: Array
    best: Array
    squares: dict[bool, Array]
    step: float
    freedom: int

    def levels(self, noise: Noise, deviance: Array) -> Noise:
        """White noise and random walk at the least ``deviance``, with what ``noise`` states."""
        ratio = least_on_grid(self.grid, deviance)
        white = float(np.interp(ratio, self.grid, self.squares[deviance is self.best])) / self.freedom
        return Noise(white, white * 10.0**ratio / self.step, stated=noise.stated)


def _deviances(fit: Fit, basis: SlowBasis, noise: Noise, below: float) -> _Deviances:
    step = fit.design.run.median_step
    freedom = fit.design.rows - len(fit.solution.amplitudes) - len(fit.solution.phases)
    centre = math.log10(max(noise.walk * step / noise.white, 1e-9))
    grid = np.linspace(centre - below, centre + ABOVE, LANES)
    logarithms = deviance_sums(fit.d, fit.h, 10.0**grid / step)[0]
    stated = tuple(variance / noise.white for variance in noise.stated)
    table = []
    for ratio, logarithm in zip(grid, logarithms, strict=True):
        factor, stated_size = _factor_and_size(fit, Noise(1.0, 10.0**ratio / step, stated=stated), basis)
        values, square, rest, model = projected(factor, basis)
        levels = np.append(0.0, 10.0 ** np.linspace(-4.0, 4.0, LEVELS) / max(values[0], 1e-300))
        size = 1.0 + levels[:, None] * values
        total = rest + (square / size).sum(axis=1)
        deviance = freedom * np.log(total) + logarithm + model + np.log(size).sum(axis=1) + stated_size
        at = int(np.argmin(deviance))
        table.append((float(deviance[0]), float(deviance[at]), float(total[0]), float(total[at])))
    without, best, plain, left = np.array(table).T
    return _Deviances(grid, without, best, {False: plain, True: left}, step, freedom)


def quick_look(fit: Fit, basis: SlowBasis) -> Level:
    """Slow noise in the means of the residual angle over a few bins of every stretch, the model taken as it is."""
    run = fit.design.run
    starts = np.flatnonzero(run.begins)
    bins = int(np.clip(MOST_BINS // starts.size, 2, BINS))
    rows = [
        basis.placed(_whitened_means(fit, basis, int(left), int(right), bins), int(run.segment[left]))
        for left, right in pairwise(np.append(starts, run.size))
        if right - left >= 2 * bins
    ]
    if sum(len(part) for part in rows) <= basis.count:
        return Level(0.0, 0.0, 0.0)
    return likely_level(_triangle(np.concatenate(rows)), basis)


def _whitened_means(fit: Fit, basis: SlowBasis, left: int, right: int, bins: int) -> Array:
    """Differences of neighbouring bin means as independent rows ``[slow noise | residual]`` (bins - 1, size + 1)."""
    edges = np.linspace(0, right - left, bins + 1).astype(np.int64)
    sizes = np.diff(edges)
    t = np.asarray(fit.design.run.t[left:right])
    angle = np.cumsum(fit.d[left:right])
    means = np.add.reduceat(np.stack([t - t[0], angle]), edges[:-1], axis=1) / sizes
    widths = sizes * (t[-1] - t[0]) / t.size
    covariance = fit.noise.walk * (np.minimum.outer(means[0], means[0]) - np.diag(widths) / 6.0)
    covariance += np.diag(fit.noise.white / sizes)
    difference = np.diff(np.eye(bins), axis=0)
    rows = np.diff(np.vstack([basis.angle(means[0] + t[0]), means[1]]), axis=1).T
    return np.linalg.solve(np.linalg.cholesky(difference @ covariance @ difference.T), rows)


def likely_level(factor: Array, basis: SlowBasis) -> Level:
    """Likely variance of the numbers from a triangular factor of ``[slow noise | model | y]`` rows of unit variance."""
    values, square, _, _ = projected(factor, basis)
    if values.size < ENOUGH:
        return Level(0.0, 0.0, 0.0)
    levels = 10.0 ** np.linspace(-4.0, 4.0, LEVELS) / values[0]
    size = 1.0 + levels[:, None] * values
    gains = (square - square / size - np.log(size)).sum(axis=1)
    at = int(np.argmax(gains))
    information = 0.5 * float(np.sum((values / size[at]) ** 2))
    return Level(float(levels[at]), 1.0 / math.sqrt(information), float(gains[at]))


def projected(factor: Array, basis: SlowBasis) -> tuple[Array, Array, float, float]:
    """Eigenvalues of the slow noise with the model projected out, squares of what is seen of each, the rest, ``log|X'X|``.

    There ``y = B s + e``; eigenvectors of ``B B'`` have variance ``1 + v lambda``. Those that the model takes up are
    left out: of a scatter as many as there are coefficients of mean rates.
    """
    size = factor.shape[1] - 1
    model = size - basis.count
    order = [*range(basis.count, size), *range(basis.count), size]
    turned = _triangle(factor[:, order])
    block, y = turned[model:size, model:size], turned[model:size, -1]
    vectors, values, _ = np.linalg.svd(block)
    square = (vectors.T @ y) ** 2
    seen = values > UNDETERMINED * math.sqrt(float(np.sum(factor[:, : basis.count] ** 2)))
    rest = float(square[~seen].sum()) + (float(turned[size, -1] ** 2) if turned.shape[0] > size else 0.0)
    diagonal = np.abs(np.diag(turned)[:model])
    return values[seen] ** 2, square[seen], rest, 2.0 * float(np.log(diagonal).sum())
