"""Levels of the noise of a rate, by maximum likelihood of its cosine spectrum.

Definitions of the levels: [IEEE952], annex C. The cosine transform makes white noise and a random walk of the rate exactly
independent at all frequencies [Strang1999]; flicker and white angle noise nearly so.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError
from piga.results import Array, Result

SOURCES = ("quantisation", "random_walk", "bias_instability", "rate_random_walk")
"""Noises with a spectrum, in the order of the columns of the model. The drift is a line."""
_ROUNDING = 10.0 * float(np.finfo(float).eps)
"""Rounding of a spectral value over the largest value of the record and the root of its length."""
FEWEST = 16
"""Rates of the shortest stretch whose spectrum is taken."""
_FALL = 0.5 * 3.841458820694124
"""Fall of the log-likelihood at the ends of an interval of 95 %: half the quantile of chi-square with one degree of freedom."""
_OUTSIDE = 0.05
"""Probability that a level is above the largest one that the spectrum allows."""
APART = 40
"""Frequencies that are kept apart; higher ones are put together where they differ by less than one in so many."""
_BANDS = 3.0
"""Bands of an octave in which the spectrum is compared with the levels."""
_DOUBT = 0.01
"""Probability below which the spectrum of a record does not fit the levels."""
_ROUNDS, _HALVINGS, _SMALL = 60, 20, 1e-6
"""Most rounds of a fit, most halvings of a step, and gain in log-likelihood or change of the spectrum that ends it."""


@dataclass(frozen=True)
class NoiseLevel(Result):
    """A level with its interval of 95 %, in the unit of the rate times a power of the second.

    ``lower`` is 0 where the record does not tell the level from none. A drift has a sign; its interval may hold 0.
    """

    name: str
    value: float
    lower: float
    upper: float

    @property
    def seen(self) -> bool:
        """Whether the record tells it from none."""
        return self.lower > 0.0 or self.upper < 0.0


@dataclass(frozen=True, eq=False, repr=False)
class NoiseSpectrum(Result):
    """Two-sided spectral density of the rate, averaged over bands, and that of the levels.

    Attributes
    ----------
    frequency:
        Middle of each band [Hz].
    density, model:
        Density without the drift, and that of the levels [rate^2/Hz].
    count:
        Spectral values in each band: their mean has this many degrees of freedom.
    misfit:
        Band that fits the levels least: lower and upper frequency [Hz] and ratio to the model; None if all fit.
    """

    frequency: Array
    density: Array
    model: Array
    count: Array
    misfit: tuple[float, float, float] | None


def noise_levels(
    stretches: Sequence[Array], step: float, *, source: str = "the output"
) -> tuple[tuple[NoiseLevel, ...], NoiseSpectrum]:
    r"""Levels of the noise of a rate, and the spectrum they are from.

    The density of the rate is the sum of quantisation Q, random walk N, bias instability B and rate random walk K,

    .. math:: S(f) = Q^2 (2 \pi f)^2 + N^2 + \frac{B^2}{2 \pi f} + \frac{K^2}{(2 \pi f)^2},

    with sines in place of the squares of f at high frequencies; a drift R is a line. The cosine transforms of the
    stretches have these variances. Levels are those of the largest likelihood, none below zero, with that of the drift
    taken out (restricted likelihood). The first and last value of a stretch are free: of the differences of angles they
    have a quantisation that the cosine transform does not tell from white noise. An interval ends where the likelihood,
    maximised over all other levels, falls to that of 95 %. Where the levels do not describe the record, it ends no lower
    than the largest level that the spectrum allows; a level above that is not seen, unless it is quantisation.

    Parameters
    ----------
    stretches:
        Mean rates over the steps, of each stretch.
    step:
        Time between them [s].
    source:
        Where they are from, for an error.

    Raises
    ------
    ArgumentError
        If the values repeat exactly, so that most of the spectrum is rounding.
    """
    parts = [_Part.of(y, step) for y in stretches if y.size > FEWEST]
    rounding = _ROUNDING * max(math.sqrt(y.size) * float(np.abs(y).max()) for y in stretches)
    edges = _edges(np.concatenate([part.share for part in parts]))
    places = [np.searchsorted(edges, part.share, side="right") - 1 for part in parts]
    count = np.bincount(np.concatenate(places), minlength=edges.size).astype(float)

    def mean(values: Sequence[Array]) -> Array:
        held: Array = np.bincount(np.concatenate(places), np.concatenate(values), edges.size) / count
        return held

    share = mean([part.share for part in parts])
    columns = np.column_stack([mean([_columns(p.share, step)[k] for p in parts]) for k in range(len(SOURCES))])
    model, drift = mean([part.value**2 for part in parts]), 0.0
    for _ in range(_ROUNDS):
        if not model.min() + _SMALL * model.mean() > rounding**2:
            raise ArgumentError(
                f"{source}: the samples repeat exactly: no noise is seen",
                remedy="log with a finer resolution, or while the output turns at another rate",
            )
        model = np.maximum(model, _SMALL * model.mean())
        spectra = [model[place] for place in places]
        freed = [part.freed(spectrum) for part, spectrum in zip(parts, spectra, strict=True)]
        information = sum(float(line @ (line / s)) for (_, line, _), s in zip(freed, spectra, strict=True))
        drift = sum(float(line @ (c / s)) for (c, line, _), s in zip(freed, spectra, strict=True)) / information
        bends = mean([line**2 for _, line, _ in freed])
        cross = mean([line * (c - drift * line) for c, line, _ in freed])
        square = mean([(c - drift * line) ** 2 + lost for c, line, lost in freed]) + bends / information
        fit = _Fit(columns, square, count)
        squares = fit.best()
        before, model = model, columns @ squares
        if np.abs(model - before).max() <= _SMALL * model.max():
            break
    frequency = share / (2.0 * step)
    misfit = _misfit(frequency, square / model, count)
    most = _most(frequency, columns, square, count)
    levels = []
    for k, name in enumerate(SOURCES):
        lower, upper = fit.interval(k, squares)
        if misfit is not None:
            lines = name == "quantisation"  # of counts of a steady output: some bands are empty
            lower, upper = lower if lines or lower < most[k] else 0.0, max(upper, most[k])
        levels.append(NoiseLevel(name, *map(math.sqrt, (squares[k], lower, upper))))
    unit = 1.0 / math.sqrt(information)
    off = [_fall(partial(fit.moved, cross * sign, bends), unit) for sign in (-1.0, 1.0)]
    levels.append(NoiseLevel("drift", drift, drift - off[0], drift + off[1]))
    return tuple(levels), NoiseSpectrum(frequency, square * step, model * step, count, misfit)


@dataclass(frozen=True, eq=False)
class _Part:
    """Cosine transforms of a stretch: of its rates, of a line, and of its first and last value; without the mean."""

    share: Array
    value: Array
    line: Array
    ends: Array

    @staticmethod
    def of(y: Array, step: float) -> _Part:
        """That of mean rates."""
        from scipy.fft import dct

        share = np.arange(1, y.size) / y.size
        line = dct(step * np.arange(y.size), norm="ortho")[1:]
        first = np.sqrt(2.0 / y.size) * np.cos(0.5 * np.pi * share)
        last = first * np.where(np.arange(1, y.size) % 2, -1.0, 1.0)
        return _Part(share, dct(y, norm="ortho")[1:], line, np.stack((first, last)))

    def freed(self, spectrum: Array) -> tuple[Array, Array, Array]:
        """Value and line without what the end values explain, and the variance that this takes from each value."""
        weighed = self.ends / spectrum
        inverse = np.linalg.inv(weighed @ self.ends.T)
        value, line = (one - (inverse @ (weighed @ one)) @ self.ends for one in (self.value, self.line))
        return value, line, np.einsum("ik,ij,jk->k", self.ends, inverse, self.ends)


ALLAN = {
    "quantisation": (2, 3.0),
    "random_walk": (0, 1.0),
    "bias_instability": (-1, 2.0 * math.log(2.0) / math.pi),
    "rate_random_walk": (-2, 1.0 / 3.0),
}
"""Exponent of the spectrum and Allan variance at 1 s of each level of 1 ([IEEE952] annex C)."""


def level_variances(tau: Array, levels: Sequence[NoiseLevel]) -> dict[str, Array]:
    """Allan variance of each level at averaging times, by name."""
    powers = {"quantisation": -2, "random_walk": -1, "bias_instability": 0, "rate_random_walk": 1, "drift": 2}
    factors = {name: factor for name, (_, factor) in ALLAN.items()} | {"drift": 0.5}
    return {one.name: one.value**2 * factors[one.name] * tau ** float(powers[one.name]) for one in levels}


def _columns(share: Array, step: float) -> tuple[Array, ...]:
    """Variance of the transform for each squared level of 1, at shares k/n of the Nyquist frequency."""
    sine = 4.0 * np.sin(0.5 * np.pi * share) ** 2
    return sine / step**2, np.full_like(share, 1.0 / step), 1.0 / (np.pi * share), step / sine


def _edges(share: Array) -> Array:
    """Lower edges of the groups of frequencies: the lowest ones alone, higher ones in equal ratios."""
    low = np.unique(share)[:APART]
    ratios = max(int(math.log(share.max() / low[-1]) * APART), 1)
    edges = np.concatenate((low, np.geomspace(low[-1], share.max(), ratios + 1)[1:-1]))
    held = np.bincount(np.searchsorted(edges, share, side="right") - 1, minlength=edges.size)
    return edges[held > 0]


def _fall(above: Callable[[float], float], unit: float, start: float = 0.0) -> float:
    """Where a function that is positive at ``start`` falls through zero."""
    from scipy.optimize import brentq

    high = start + unit
    while above(high) > 0.0:
        high = start + 2.0 * (high - start)
    return float(brentq(above, start, high, xtol=1e-4 * unit))


class _Fit:
    """Likelihood of means of squares, each of ``count`` normal values whose variance is a sum of columns."""

    def __init__(self, columns: Array, square: Array, count: Array) -> None:
        self.scale = 1.0 / np.sqrt((columns**2).sum(axis=0))
        self.columns, self.square, self.count = columns * self.scale, square, count
        self.least = max(1e-15 * float(square.max(initial=0.0)), 1e-300)

    def best(self, start: Array | None = None, fixed: int | None = None) -> Array:
        """Squared levels of the largest likelihood, none below zero. The ``fixed`` one stays as in ``start``.

        Scoring: least squares with the weights of the spectrum before, whose equations are those of the maximum. A step
        that lowers the likelihood is halved.
        """
        from scipy.optimize import nnls

        free = np.arange(self.scale.size) != fixed
        squares = np.zeros(self.scale.size) if start is None else start / self.scale
        model = self.square if start is None else self.columns @ squares
        before = -math.inf if start is None else self.likelihood(start)
        for _ in range(_ROUNDS):
            root = np.sqrt(self.count) / np.maximum(model, self.least)
            held = self.columns[:, ~free] @ squares[~free]
            new = squares.copy()
            new[free] = nnls(self.columns[:, free] * root[:, None], (self.square - held) * root)[0]
            now = self.likelihood(new * self.scale)
            for _ in range(_HALVINGS):
                if now >= before:
                    break
                new = 0.5 * (new + squares)
                now = self.likelihood(new * self.scale)
            if now - before <= _SMALL:
                break
            squares, model, before = new, self.columns @ new, now
        return squares * self.scale

    def likelihood(self, squares: Array) -> float:
        """Logarithm of the likelihood, up to a constant."""
        model = np.maximum(self.columns @ (squares / self.scale), self.least)
        return -0.5 * float(self.count @ (np.log(model) + self.square / model))

    def interval(self, k: int, squares: Array) -> tuple[float, float]:
        """Squared ends of the interval of a level, by its profile likelihood."""
        top = self.likelihood(squares) - _FALL
        unit = float(squares[k]) or self.scale[k] * float(np.min(self.square / self.columns[:, k]))

        def above(value: float) -> float:
            start = squares.copy()
            start[k] = value
            return self.likelihood(self.best(start, k)) - top

        lower = 0.0 if above(0.0) >= 0.0 else squares[k] - _fall(lambda d: above(squares[k] - d), squares[k])
        return lower, _fall(above, unit, squares[k])

    def moved(self, cross: Array, bends: Array, drift: float) -> float:
        """Fall of the likelihood for a drift that is off by this much, above that of the interval."""
        off = _Fit(self.columns / self.scale, self.square - 2.0 * drift * cross + drift**2 * bends, self.count)
        return off.likelihood(off.best()) - self.likelihood(self.best()) + _FALL


def _bands(frequency: Array, *values: Array) -> tuple[NDArray[np.int64], list[Array]]:
    """Index of the first frequency of each band, and the sums over the bands."""
    band = np.floor(_BANDS * np.log2(frequency)).astype(int)
    start = np.flatnonzero(np.diff(band, prepend=band[0] - 1))
    return start, [np.add.reduceat(each, start) for each in values]


def _most(frequency: Array, columns: Array, square: Array, count: Array) -> Array:
    """Largest squared levels (k,) that the spectrum allows: no band has a level above it, whatever else is there."""
    from scipy.special import chdtri

    start, (numbers, sums, *of_one) = _bands(frequency, count, count * square, *(count * columns.T))
    least = chdtri(numbers, 1.0 - _OUTSIDE / start.size) / numbers
    return np.array([float(np.min(sums / (one * least))) for one in of_one])


def _misfit(frequency: Array, ratio: Array, count: Array) -> tuple[float, float, float] | None:
    """The band in which the spectrum differs most from the levels, if no chance explains it.

    The sum of the spectral values of a band over those of the levels is chi-square; of all bands the least probable counts.
    """
    from scipy.special import chdtr, chdtrc

    start, (numbers, sums) = _bands(frequency, count, count * ratio)
    chance = 2.0 * np.minimum(chdtr(numbers, sums), chdtrc(numbers, sums))
    worst = int(np.argmin(chance))
    if chance[worst] * start.size > _DOUBT:
        return None
    ends = np.append(start[1:], frequency.size) - 1
    return float(frequency[start[worst]]), float(frequency[ends[worst]]), float(sums[worst] / numbers[worst])
