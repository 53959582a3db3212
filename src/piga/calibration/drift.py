"""Bias drift: a random walk of the rate, found by restricted likelihood and taken into the covariance.

The rate walks over the whole record, so that positions are no longer independent. Its few columns
(:class:`~piga.calibration.drift_basis.DriftBasis`) are whitened and reduced with those of the model; projected on what
the model leaves, the steps of the walk and white noise of one are all there is, and the likelihood of their variance is
a sum over eigenvalues (own derivation, docs/theory). In long records a quick look at the means of the residual angle
over a few bins of every stretch comes first: one without drift pays nothing else.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import cast

import numpy as np
from numpy.typing import NDArray

from piga._kernels.whitening import LANES
from piga.calibration.drift_basis import KNOTS, DriftBasis
from piga.calibration.fit import SMALL, Fit
from piga.calibration.noise import Noise, deviance_sums, least_on_grid
from piga.calibration.reduction import solve_upper
from piga.calibration.solution import solve
from piga.calibration.weighting import reduce_segments
from piga.calibration.whitened_rows import whitened_rows

Array = NDArray[np.float64]

SUSPECTED = 0.3
"""Gain in twice the log-likelihood, the other levels as found, from which a drift is looked for with all of them."""
SIGNIFICANT = 2.0
"""Gain from which a drift is taken into the covariance."""
CLEAR = 9.0
"""Gain from which it is weighted by, too: weights for a drift that is not there cost up to six times the variance."""
BELOW, ABOVE = 0.7, 0.35
"""Decades below and above the random walk found without a drift in which it is looked for with one."""
LEVELS = 41
"""Levels tried, over eight decades."""
UNDETERMINED = 1e-9
"""Part of a parameter's column that the others leave, below which nothing is said of it."""
BINS, MOST_BINS = 16, 2048
"""Bins of a stretch at the quick look, and of all stretches together."""


@dataclass(frozen=True)
class Steps:
    """Variance of the steps of the rate between knots [rad^2/s^2], its standard uncertainty, gain of likelihood."""

    variance: float
    deviation: float
    gain: float


def include_drift(fit: Fit, groups: tuple[int, ...], clear: float = CLEAR) -> Fit:
    """The same fit with a bias drift in its covariance, where the record shows one.

    Weighted by from a gain of ``clear`` on; below, the weights stay those of the other noise, and what the drift adds to
    the estimates is added to their covariance; so it is with coarse counts, however clear. Left out with given noise levels
    and methods other than whitened least squares in one go.
    """
    request = fit.design.request
    able = fit.mode == "increments" and request.method == "information"
    if not able or request.angle_rms is not None or fit.design.rows < 8 * KNOTS:
        return fit
    if fit.counted is not None:
        return _beside_counts(fit, groups)
    if fit.design.rows > SMALL and quick_look(fit).gain < SUSPECTED:
        return fit
    if likely_steps(drifting_factor(fit, groups, fit.noise)).gain < SUSPECTED:
        return fit
    noise, gain = _levels_together(fit, groups)
    if gain < SIGNIFICANT:
        return fit
    spacing = DriftBasis.of(fit.design.run).spacing
    factor = drifting_factor(fit, groups, noise)
    steps = likely_steps(factor)
    drifting = replace(noise, drift=steps.variance / spacing)
    moved = _moved_by_steps(factor, len(fit.solution.amplitudes) + len(fit.solution.phases))
    part = None if gain >= clear or moved is None else spacing * moved @ moved.T
    summaries = reduce_segments(fit.design, fit.mode, drifting if part is None else noise)
    solution = solve(fit.design, summaries, groups)
    return replace(
        fit,
        noise=drifting,
        summaries=summaries,
        solution=solution,
        covariance=solution.covariance + (0.0 if part is None else drifting.drift * part),
        drift_deviation=steps.deviation / spacing,
        drift_part=part,
    )


def _beside_counts(fit: Fit, groups: tuple[int, ...]) -> Fit:
    """Coarse counts keep their weights and the random walk found; a drift goes into the covariance."""
    factor = drifting_factor(fit, groups, fit.noise)
    steps = likely_steps(factor)
    moved = _moved_by_steps(factor, len(fit.solution.amplitudes) + len(fit.solution.phases))
    if steps.gain < SIGNIFICANT or moved is None:
        return fit
    spacing = DriftBasis.of(fit.design.run).spacing
    drift, part = steps.variance / spacing, spacing * moved @ moved.T
    return replace(
        fit,
        noise=replace(fit.noise, drift=drift),
        covariance=fit.covariance + drift * part,
        drift_deviation=steps.deviation / spacing,
        drift_part=part,
    )


def drifting_factor(fit: Fit, groups: tuple[int, ...], noise: Noise) -> Array:
    """Triangular factor of the weighted rows ``[drift | model | y]``, the drift left free.

    The model is linear about the fit: its columns are those of amplitudes and phases, y is the residual.
    """
    design, solution, m = fit.design, fit.solution, len(fit.design.names)
    size = KNOTS + len(solution.amplitudes) + len(solution.phases) + 1
    factor = np.zeros((0, size))
    for segment, columns in whitened_rows(fit, design, noise):
        model, drift = columns[:m], columns[m:-1]
        y = columns[-1] - solution.values[segment] @ model
        turned = solution.jacobians[groups[segment]].T @ model
        factor = np.asarray(np.linalg.qr(np.vstack([factor, np.vstack([drift, turned, y]).T]), mode="r"))
    kept = np.ones(size, dtype=bool)
    kept[KNOTS:-1] = factor[:, KNOTS:-1].any(axis=0)
    return factor[:, kept]


def _moved_by_steps(factor: Array, parameters: int) -> Array | None:
    """By how much a unit step moves each parameter (parameters, KNOTS); None where one is not determined."""
    model = factor[:, KNOTS:-1]
    size = np.linalg.norm(model, axis=0)
    if model.shape[1] < parameters:
        return None
    rows = np.asarray(np.linalg.qr(np.hstack([model / size, factor[:, :KNOTS]]), mode="r"))[:parameters]
    if np.abs(np.diag(rows)).min() < UNDETERMINED:
        return None
    return solve_upper(rows[:, :parameters], rows[:, parameters:]) / size[:, None]


def _levels_together(fit: Fit, groups: tuple[int, ...]) -> tuple[Noise, float]:
    """White noise and random walk beside a drift, and the gain by it: restricted likelihood of all three.

    On a grid of ``log10(q h/r)``, concentrated over the scale, the drift at its best for each.
    """
    step = fit.design.run.median_step
    freedom = fit.design.rows - len(fit.solution.amplitudes) - len(fit.solution.phases)
    centre = math.log10(max(fit.noise.walk * step / fit.noise.white, 1e-9))
    grid = np.linspace(centre - BELOW, centre + ABOVE, LANES)
    logarithms = deviance_sums(fit.d, fit.h, 10.0**grid / step)[0]
    table = []
    for ratio, logarithm in zip(grid, logarithms, strict=True):
        factor = drifting_factor(fit, groups, Noise(1.0, 10.0**ratio / step))
        values, square, rest, model = projected(factor)
        levels = np.append(0.0, 10.0 ** np.linspace(-4.0, 4.0, LEVELS) / values[0])
        size = 1.0 + levels[:, None] * values
        total = rest + (square / size).sum(axis=1)
        deviance = freedom * np.log(total) + logarithm + model + np.log(size).sum(axis=1)
        at = int(np.argmin(deviance))
        table.append((float(deviance[0]), float(deviance[at]), float(total[at])))
    without, best, total = np.array(table).T
    ratio = least_on_grid(grid, best)
    white = float(np.interp(ratio, grid, total)) / freedom
    return Noise(white, white * 10.0**ratio / step), float(without.min() - best.min())


def quick_look(fit: Fit) -> Steps:
    """Drift in the means of the residual angle over a few bins of every stretch, the model taken as it is."""
    run, basis = fit.design.run, DriftBasis.of(fit.design.run)
    starts = np.flatnonzero(run.begins)
    bins = int(np.clip(MOST_BINS // starts.size, 2, BINS))
    rows = [
        _whitened_means(fit, basis, int(left), int(right), bins)
        for left, right in pairwise(np.append(starts, run.size))
        if right - left >= 2 * bins
    ]
    if sum(len(part) for part in rows) <= KNOTS:
        return Steps(0.0, 0.0, 0.0)
    return likely_steps(cast("Array", np.linalg.qr(np.concatenate(rows), mode="r")))


def _whitened_means(fit: Fit, basis: DriftBasis, left: int, right: int, bins: int) -> Array:
    """Differences of neighbouring bin means as independent rows ``[drift | residual]`` (bins - 1, KNOTS + 1)."""
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


def likely_steps(factor: Array) -> Steps:
    """Likely variance of the steps from a triangular factor of ``[drift | model | y]`` rows of unit variance."""
    values, square, _, _ = projected(factor)
    levels = 10.0 ** np.linspace(-4.0, 4.0, LEVELS) / values[0]
    size = 1.0 + levels[:, None] * values
    gains = (square - square / size - np.log(size)).sum(axis=1)
    at = int(np.argmax(gains))
    information = 0.5 * float(np.sum((values / size[at]) ** 2))
    return Steps(float(levels[at]), 1.0 / math.sqrt(information), float(gains[at]))


def projected(factor: Array) -> tuple[Array, Array, float, float]:
    """Eigenvalues of the drift with the model projected out, squares of what is seen of each, the rest, ``log|X'X|``.

    There ``y = B s + e``; eigenvectors of ``B B'`` have variance ``1 + v lambda``.
    """
    size = factor.shape[1] - 1
    model = size - KNOTS
    order = [*range(KNOTS, size), *range(KNOTS), size]
    turned = cast("Array", np.linalg.qr(factor[:, order], mode="r"))
    block, y = turned[model:size, model:size], turned[model:size, -1]
    vectors, values, _ = np.linalg.svd(block)
    rest = float(turned[size, -1] ** 2) if turned.shape[0] > size else 0.0
    diagonal = np.abs(np.diag(turned)[:model])
    return values**2, (vectors.T @ y) ** 2, rest, 2.0 * float(np.log(diagonal).sum())
