"""Effective degrees of freedom of the standard uncertainties, from the uncertainty of the noise levels.

The variance of a coefficient is a function of the estimated noise levels. Their covariance is the inverse
Fisher information of the restricted likelihood. First-order propagation gives the variance of the variance.
Satterthwaite's rule (JCGM 100, G.4.1) gives the degrees of freedom ``2 v^2 / var(v)``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga.calibration.model.solution import name_coefficients, solve, variances_of
from piga.calibration.noise.levels import Noise
from piga.calibration.noise.likelihood import information
from piga.calibration.noise.settings import NOISE
from piga.calibration.noise.weighting import reduce_segments
from piga.records.spool import spans
from piga.results import Array

if TYPE_CHECKING:
    from piga.calibration.fit.one_run import Fit


def level_information(lengths: ArrayLike, step: float, noise: Noise, fitted: int) -> Array:
    """Fisher information (2, 2) of white noise [rad^2] and random walk [rad^2/s]; ``lengths`` are samples per stretch.

    The cosine transform of the angle in a stretch has independent values of variance ``r + q h/(4 sin^2(pi
    k/2n))``, k from 1 to n - 1. Each fitted coefficient removes one value; the most informative values are
    removed.
    """
    sizes, counts = np.unique(np.asarray(lengths, dtype=np.int64), return_counts=True)
    information, slow = np.zeros((2, 2)), np.zeros(0)
    for size, count in zip(sizes.tolist(), counts.tolist(), strict=True):
        for part in spans(size - 1):
            half = np.sin(np.arange(part.start + 1.0, part.stop + 1.0) * (0.5 * np.pi / size))
            gain = 0.25 * step / (half * half)
            information += count * _information(gain, noise)
            slow = np.concatenate(
                [slow, np.repeat(gain[: fitted if part.start == 0 else 0], min(count, fitted))]
            )
    return information - _information(np.sort(slow)[slow.size - min(fitted, slow.size) :], noise)


def _information(gain: Array, noise: Noise) -> Array:
    """Fisher information of values with variance ``white + walk gain``."""
    variance = noise.white + noise.walk * gain
    rows = np.empty((2, gain.size))
    np.divide(1.0, variance, out=rows[0], where=variance > 0.0)
    rows[0, ~(variance > 0.0)] = 0.0
    np.multiply(rows[0], gain, out=rows[1])
    return information(rows)


def type_a_degrees(
    fit: Fit,
) -> Array:
    """Degrees of freedom of the Type A variance of every coefficient, in the order of the result."""
    names = name_coefficients(fit.design, fit.solution, fit.covariance)[0]
    rest = float(fit.design.rows - len(names))
    if fit.colour is not None:
        return np.minimum(rest, fit.colour.degrees)
    if fit.mode != "increments":
        return np.full(len(names), rest)
    if fit.design.request.angle_rms is not None:
        return np.full(len(names), math.inf)
    if fit.counted is not None:
        return _by_precision(fit, *fit.counted.walks, rest)
    if fit.faint is not None:
        return _satterthwaite(fit, _directions(np.linalg.inv(fit.faint.information)), rest)
    starts = np.flatnonzero(fit.design.run.begins)
    lengths = np.diff(np.append(starts, fit.design.run.size))
    information = level_information(lengths[lengths > 1], fit.design.run.median_step, fit.noise, len(names))
    scale = np.array([fit.noise.white, fit.noise.walk])
    covariance = np.linalg.pinv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    unseen = fit.noise.walk <= NOISE.degrees_seen * math.sqrt(float(covariance[1, 1]))
    if unseen and fit.noise.slow > 0.0:
        return _satterthwaite(fit, (), rest)
    if unseen:
        return np.full(len(names), min(rest, 2.0 * float(information[0, 0]) * fit.noise.white**2))
    if fit.design.rows > NOISE.degrees_large and fit.noise.slow == 0.0:
        least = 2.0 * fit.noise.walk**2 / float(covariance[1, 1])
        return np.full(len(names), min(rest, least))
    return _satterthwaite(fit, _directions(covariance), rest)


def _directions(covariance: NDArray[np.floating]) -> tuple[tuple[float, float], ...]:
    """Independent changes of (white, walk), each of one standard deviation."""
    values, vectors = np.linalg.eigh(covariance)
    return tuple((float(v[0]), float(v[1])) for v in (vectors * np.sqrt(np.maximum(values, 0.0))).T)


def _satterthwaite(
    fit: Fit,
    directions: tuple[tuple[float, float], ...],
    rest: float,
) -> Array:
    """``2 v^2/sum((dv/ds)^2)``: s are independent unit changes of (white, walk) along ``directions``."""
    variances, levels = _variances(fit), fit.levels
    now = variances(levels)
    spread = np.zeros(now.size)
    for white, walk in directions:
        limits = [abs(level / part) for level, part in ((levels.white, white), (levels.walk, walk)) if part]
        size = NOISE.degrees_step * min([1.0, *(limit for limit in limits if limit > 0.0)])
        moved = variances(replace(levels, white=levels.white + size * white, walk=levels.walk + size * walk))
        spread += ((moved - now) / size) ** 2
    if levels.slow > 0.0:
        moved = variances(levels.slower(1.0 + NOISE.degrees_step))
        spread += ((moved - now) * fit.slow_deviation / (NOISE.degrees_step * levels.slow)) ** 2
    return np.minimum(rest, 2.0 * now**2 / np.maximum(spread, 1e-300))


def _by_precision(fit: Fit, walks: Array, weights: Array, rest: float) -> Array:
    """``2 m^2/var`` of the precision 1/v with mean m, over the random walks that the record allows.

    Exact (Student's t) if the variance comes from the random walk alone.
    """
    variances = _variances(fit)
    precision = np.array([1.0 / variances(replace(fit.noise, walk=walk)) for walk in walks])
    relative = precision / (weights @ precision) - 1.0
    spread = weights @ relative**2
    if fit.noise.slow > 0.0:
        now = variances(fit.noise)
        moved = variances(fit.noise.slower(1.0 + fit.slow_deviation / fit.noise.slow))
        spread += (moved / now - 1.0) ** 2
    return np.minimum(rest, 2.0 / np.maximum(spread, 1e-300))


def _variances(
    fit: Fit,
) -> Callable[[Noise], Array]:
    """Type A variances of the coefficients as a function of the noise levels."""

    def variances(noise: Noise) -> Array:
        if fit.counted is None:
            weights = noise if fit.slow_part is None else noise.without_slow()
            weights = weights if fit.faint is None else replace(weights, walk=fit.noise.walk)
            summaries = reduce_segments(fit.design, fit.mode, weights)
        else:
            summaries = fit.counted.with_walk(noise.walk).reduce(fit.design)
        solution = solve(fit.design, summaries)
        added = np.zeros_like(solution.covariance)
        if fit.slow_part is not None:
            added += noise.slow * fit.slow_part
        if fit.faint is not None:
            added += (noise.walk - fit.noise.walk) * fit.faint.part
        return variances_of(fit.design, solution, solution.covariance + added)

    return variances
