"""Coloured noise of the rate: flicker and first-order Markov noise, in the covariance and in the degrees of freedom.

The weights stay those of white noise and random walk. On the slow rates of the record
(:class:`~piga.calibration.noise.components.RateBins`), whitened and without the model, every component is a known
covariance. The restricted likelihood gives the levels of white noise, walk and one component at a time. A record of a
few positions can seldom separate the components, and their effects on a coefficient differ. So the precision of
each coefficient is averaged over the components, weighted by their likelihood. The degrees of freedom include the
difference between the components (own derivation, docs/theory/noise).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from piga.calibration.fit.one_run import Colour, Fit
from piga.calibration.intervals.slow_noise import means_of_bins, moved_by, slow_factor, without_model
from piga.calibration.model.solution import variances_of
from piga.calibration.noise.components import RATES, RateBins, markov_times
from piga.calibration.noise.likelihood import Contrasts, Levels, estimate
from piga.calibration.noise.settings import NOISE
from piga.results import Array

JUMPING = ("drift", "scatter")
"""Components that angle logs may be weighted by (:mod:`~piga.calibration.intervals.slow_noise`)."""


@dataclass(frozen=True)
class _ColourCandidate:
    """A component with a time, its estimated levels, its gain, and its prior weight; ``name`` is empty for none."""

    name: str
    time: float
    levels: Levels
    gain: float
    prior: float


def include_coloured_noise(fit: Fit) -> Fit:
    """Include coloured noise in the covariance of a fit if the record shows it; else the fit is unchanged.

    In angle logs a drift or a scatter that is likelier is left to
    :func:`~piga.calibration.intervals.slow_noise.include_slow_noise`, which can weight by it. Not done with given noise
    levels and with methods other than whitened least squares in one go.
    """
    run = fit.design.run
    bins = bins_of(fit) if fit.seeks_noise and not fit.noise.stated else None
    if bins is None:
        return fit
    segments = len(run.labels)
    coarse = RateBins.of(run, coarse=True)
    if fit.design.rows > NOISE.restricted_rows and not _suspected(
        _bin_contrasts(fit, coarse), coarse, segments
    ):
        return fit
    factor = slow_factor(fit, fit.noise, bins)
    contrasts = contrasts_of(fit, factor, fit.design.rows, bins)
    moved = moved_by(factor, bins, fit.solution.parameters)
    if contrasts is None or moved is None or not _suspected(contrasts, bins, segments):
        return fit
    candidates = _candidates(contrasts, bins, segments)
    shown = [candidate for candidate in candidates if candidate.name]
    if not shown:
        return fit
    best = max(shown, key=lambda candidate: candidate.gain)
    other = max((c.gain for c in shown if c.name in JUMPING), default=0.0)
    left = best.name in JUMPING or best.gain < other + NOISE.colour_ahead
    if best.gain < NOISE.colour_in_covariance or (fit.mode == "increments" and left):
        return fit
    return _averaged(fit, bins, moved, candidates, best)


def bins_of(fit: Fit, *, coarse: bool = False) -> RateBins | None:
    """Parts of a record for its slow rates; None if it has too many segments, or too few increments in a part."""
    if len(fit.design.run.labels) > NOISE.most_segments:
        return None
    bins = RateBins.of(fit.design.run, coarse=coarse)
    few = fit.design.rows < NOISE.colour_least * bins.count
    return None if few or bins.widths.min() <= 0.0 else bins


def contrasts_of(fit: Fit, factor: Array, rows: int, bins: RateBins) -> Contrasts | None:
    """Slow values of a record without its model, from the triangular ``factor`` of ``rows`` rows ``[slow rates | model | y]``."""
    block, y, rest, _ = without_model(factor, bins.count)
    scale = 1.0 / fit.sample_variance if fit.mode == "samples" else 1.0
    if fit.counted is not None:
        stretches = fit.counted.stretches
        rows = stretches.rows.shape[0] * stretches.rows.shape[1]
    fast = rows - (factor.shape[1] - 1)
    if len(block) < bins.count or fast <= 0:
        return None
    return _contrasts(block * np.sqrt(scale), y * np.sqrt(scale), rest * scale, fast)


def _contrasts(block: Array, y: Array, rest: float, fast: int) -> Contrasts:
    """Contrasts with white noise alone; ``block`` leads from the slow rates to the values."""
    return Contrasts(y, np.eye(y.size)[None], rest, fast, block)


def _bin_contrasts(fit: Fit, bins: RateBins) -> Contrasts:
    """Contrasts of a long record from the means of the residual angle over a few parts of every stretch."""
    (rows,) = means_of_bins(fit, [bins], NOISE.colour_means * bins.size)
    block, y, rest, _ = without_model(rows, bins.count)
    return _contrasts(block, y, rest, max(len(rows) - bins.count, 1))


def _suspected(contrasts: Contrasts, bins: RateBins, segments: int) -> bool:
    """True if a component gains beyond white noise and walk. One Markov process is tried: with the time of one part."""
    base = _estimated(contrasts, bins, "")
    if base is None:
        return False
    for name in ("flicker", "markov", *_allowed(segments)):
        levels = _estimated(contrasts, bins, name, float(np.median(bins.widths)), base)
        gain = 0.0 if levels is None or levels.values[-1] <= 0.0 else base.deviance - levels.deviance
        if gain > NOISE.colour_suspected:
            return True
    return False


def _allowed(segments: int) -> tuple[str, ...]:
    return JUMPING if segments >= NOISE.fewest_segments else ("drift",)


def _estimated(
    contrasts: Contrasts, bins: RateBins, name: str, time: float = 0.0, start: Levels | None = None
) -> Levels | None:
    """Levels of white noise, walk (angle logs) and a component."""
    units = [] if bins.point else [contrasts.turned(RATES["walk"](bins, 0.0))]
    if name:
        units.append(contrasts.turned(RATES[name](bins, time)))
    held = replace(contrasts, units=np.concatenate([contrasts.units, *(unit[None] for unit in units)]))
    first = np.zeros(len(held.units))
    known = np.ones(1) if start is None else start.values
    first[: known.size] = known
    return estimate(held, first)


def _candidates(contrasts: Contrasts, bins: RateBins, segments: int) -> list[_ColourCandidate]:
    """No component, and every component with a level above zero."""
    base = _estimated(contrasts, bins, "")
    if base is None:
        return []
    times = markov_times(bins)
    tried = [("flicker", 0.0, 1.0)]
    tried += [(name, 0.0, NOISE.colour_prior) for name in _allowed(segments)]
    tried += [("markov", float(time), NOISE.colour_prior / times.size) for time in times]
    candidates = [_ColourCandidate("", 0.0, base, 0.0, 1.0)]
    for name, time, prior in tried:
        levels = _estimated(contrasts, bins, name, time, base)
        if levels is not None and levels.values[-1] > 0.0:
            candidates.append(_ColourCandidate(name, time, levels, base.deviance - levels.deviance, prior))
    return candidates


def _averaged(
    fit: Fit, bins: RateBins, moved: Array, candidates: list[_ColourCandidate], best: _ColourCandidate
) -> Fit:
    """The fit with the covariance averaged over the candidates.

    Levels may be negative, so that the variances are right on average; the correlations are those of the levels from zero
    on, so that the matrix is a covariance.
    """
    white = fit.solution.covariance * (fit.sample_variance if fit.mode == "samples" else 1.0)
    kept, covariances, own, variances, relative = [], [], [], [], []
    for candidate in candidates:
        parts = [white]
        if not bins.point:
            parts.append(moved @ RATES["walk"](bins, 0.0) @ moved.T)
        if candidate.name:
            parts.append(moved @ RATES[candidate.name](bins, candidate.time) @ moved.T)
        stack = np.array(parts)
        shares = np.array([variances_of(fit.design, fit.solution, part) for part in stack])
        variance = candidate.levels.values @ shares
        uncertain = np.einsum("ik,ij,jk->k", shares, candidate.levels.covariance, shares)
        diagonal = candidate.levels.values @ np.einsum("kii->ki", stack)
        if variance.min() <= 0.0 or diagonal.min() <= 0.0:
            continue
        kept.append(candidate)
        own.append(diagonal)
        covariances.append(np.tensordot(np.maximum(candidate.levels.values, 0.0), stack, 1))
        variances.append(variance)
        relative.append(uncertain / variance**2)
    if not kept:
        return fit
    gains = np.array([candidate.gain for candidate in kept])
    weights = np.array([candidate.prior for candidate in kept]) * np.exp(0.5 * (gains - gains.max()))
    weights /= weights.sum()
    precision = 1.0 / np.array(variances)
    mean = weights @ precision
    spread = weights @ ((precision / mean - 1.0) ** 2 + (precision / mean) ** 2 * np.array(relative))
    average = np.tensordot(weights, np.array(covariances), 1)
    size = np.sqrt(1.0 / (weights @ (1.0 / np.array(own))) / np.diag(average))
    colour = _colour(bins, best, 2.0 / spread)
    return replace(fit, covariance=average * np.outer(size, size), colour=colour)


def _colour(bins: RateBins, best: _ColourCandidate, degrees: Array) -> Colour:
    """The likeliest component."""
    level, deviation = float(best.levels.values[-1]), float(np.sqrt(best.levels.covariance[-1, -1]))
    rms = float(np.sqrt(level * np.diag(RATES[best.name](bins, best.time)).mean()))
    colour = Colour(best.name, level, deviation, best.time, best.gain, 0.0, rms, degrees)
    if bins.point:
        return colour
    known = best.levels.covariance
    return replace(
        colour,
        walk=float(best.levels.values[1]),
        walk_deviation=float(np.sqrt(known[1, 1])),
        walk_shared=float(known[1, -1]),
    )
