"""Overlapping Allan, modified Allan and Hadamard deviation of a rate over separate stretches, and the levels of its noise.

Definitions: [Riley2008], eq. 11, 16 and 28. Degrees of freedom: [Greenhall2003].
The pooling of the stretches is our own derivation.

The levels are those of the maximum likelihood of the cosine spectrum. Definitions: [IEEE952], annex C. The cosine transform makes
white noise and a random walk of the rate exactly independent at all frequencies [Strang1999]; flicker and white angle noise nearly
so.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga.errors import ArgumentError
from piga.results import Array, Result

Kind = Literal["allan", "modified", "hadamard"]
ORDERS: dict[Kind, int] = {"allan": 2, "modified": 2, "hadamard": 3}
"""Each kind of deviation, and the order of its differences of the angle."""
_PER_DECADE = 8
"""Averaging times per decade."""
_UNEVEN = 0.01
"""Distance of a sample from an even grid [steps] above which a stretch is interpolated to that grid."""
ONE_SIGMA = 0.682689492137
"""Probability of the bands."""
_SLOPES = {2: -2, 1: -2, 0: -1, -1: 0, -2: 1, -3: 2, -4: 3}
"""Power of the averaging time that the Allan variance goes with, by the exponent of the spectrum of the rate."""
_LAGS = 200
"""Lags between two whole averaging times at which a covariance is evaluated."""
_FINEST = 1000.0
"""Largest factor of the filter of noise without white angle noise: beyond it nothing changes by 1e-6."""


@dataclass(frozen=True, eq=False, repr=False)
class AllanDeviation(Result):
    """Overlapping deviation of a rate: one entry per averaging time.

    Attributes
    ----------
    tau:
        Averaging times [s].
    deviation, lower, upper:
        Deviation and ends of the 68 % band, in the unit of the rate [rad/s].
    degrees_of_freedom:
        Equivalent degrees of freedom of the variance.
    kind:
        ``"allan"``, ``"modified"`` or ``"hadamard"``.
    """

    tau: Array
    deviation: Array
    lower: Array
    upper: Array
    degrees_of_freedom: Array
    kind: Kind = "allan"


def allan_deviation(
    angle: ArrayLike,
    t: ArrayLike,
    begins: NDArray[np.bool_],
    *,
    noise: Mapping[int, float],
    kind: Kind = "allan",
    factors: Sequence[int] | None = None,
) -> AllanDeviation:
    r"""Overlapping deviation of the rate from samples of its angle. Every difference counts.

    In a stretch of N angles x with step h, for the averaging time :math:`\tau = m h` and :math:`\Delta_m x_i = x_{i+m} - x_i`,
    the variances are means over i:

    .. math:: \frac{\langle(\Delta_m^2 x_i)^2\rangle}{2 \tau^2}, \quad
        \frac{\langle(\Delta_m^3 \textstyle\sum_{j<i} x_j)^2\rangle}{2 m^2 \tau^2}, \quad
        \frac{\langle(\Delta_m^3 x_i)^2\rangle}{6 \tau^2}

    for ``"allan"``, ``"modified"`` and ``"hadamard"`` ([Riley2008] eq. 11, 16, 28). Each stretch is weighted by its number
    of differences. An averaging time with fewer than one degree of freedom is not shown.

    Parameters
    ----------
    angle:
        Residual angle (n,) [rad], or any integral of a rate.
    t:
        Time (n,) [s].
    begins:
        True where a stretch begins (n,).
    noise:
        Kinds of noise for the degrees of freedom: exponent of the spectrum of the rate (2 white angle noise, 0 white rate,
        -1 flicker, -2 random walk) and its Allan variance at 1 s. Only their ratios count.
    kind:
        Which of the three.
    factors:
        Averaging times in steps; None: eight per decade, up to a third of the longest stretch.

    Raises
    ------
    ArgumentError
        If the arrays differ in length.
    """
    angle, t = np.asarray(angle, float), np.asarray(t, float)
    if not angle.size == t.size == begins.size:
        raise ArgumentError(
            f"angle, t, begins: {angle.size}, {t.size} and {begins.size} samples",
            remedy="give one angle and one mark for each time",
        )
    steps = np.diff(t)[~begins[1:]]
    step = float(np.median(steps)) if steps.size else 1.0
    edges = [0, *(np.flatnonzero(begins[1:]) + 1).tolist(), t.size]
    stretches = [_even(angle[a:b], t[a:b], step) for a, b in pairwise(edges)]
    most = (max((x.size for x in stretches), default=0) - 1) // 3
    if factors is None:
        count = int(_PER_DECADE * math.log10(most)) + 1 if most >= 1 else 0
        factors = np.unique(np.round(np.geomspace(1, max(most, 1), count)).astype(int)).tolist()
    from scipy.special import chdtri

    summed = [np.concatenate(([0.0], np.cumsum(x))) for x in stretches] if kind == "modified" else stretches
    rows = []
    for m in factors:
        parts = tuple((power, level * (m * step) ** _SLOPES[power]) for power, level in noise.items())
        square, freedom = _pooled(summed, m, parts, kind)
        if freedom >= 1.0:
            rows.append((m * step, square / (m * step) ** 2, freedom))
    tau, variance, degrees = np.array(rows).reshape(-1, 3).T
    tail = 0.5 * (1.0 - ONE_SIGMA)
    return AllanDeviation(
        tau=tau,
        deviation=np.sqrt(variance),
        lower=np.sqrt(variance * degrees / chdtri(degrees, tail)),
        upper=np.sqrt(variance * degrees / chdtri(degrees, 1.0 - tail)),
        degrees_of_freedom=degrees,
        kind=kind,
    )


@lru_cache(maxsize=1024)
def equivalent_degrees(
    samples: int, m: int, noise: tuple[tuple[int, float], ...], kind: Kind = "allan"
) -> float:
    """Equivalent degrees of freedom of an overlapping variance of ``samples`` angles ([Greenhall2003], eq. 11 to 13).

    The differences are a stationary process with a known autocovariance z; the variance of the mean of their squares is
    a sum of z^2 over all lags. Covariances of several noises add up. Of long averaging times the sum is taken over a part
    of the lags.

    Parameters
    ----------
    samples, m:
        Number of angles, and averaging time in steps.
    noise:
        Exponents of the spectrum of the rate, from -4 (``"hadamard"``) or -2 to 2, each with its Allan variance.
    kind:
        Which deviation.
    """
    order = ORDERS[kind]
    count = samples - (3 if kind == "modified" else order) * m + (kind == "modified")
    if count < 1:
        return 0.0
    last = min(count, (order + 1) * m)
    fine = np.round(np.geomspace(1, max(m, 2), _LAGS)) if m > _LAGS else np.arange(1, m + 1)
    lags = np.concatenate([k * m + sign * fine for k in range(order + 2) for sign in (-1, 1)])
    lags = np.unique(np.clip(np.append(lags, 0), 0, last))
    covariance = np.zeros(lags.size)
    for exponent, variance in noise:
        smooth = float(m) if exponent > 0 else min(float(m), _FINEST)
        scale = variance / abs(float(_covariance(np.zeros(1), smooth, exponent, 2)[0]))
        one = _covariance(lags / m, 1.0 if kind == "modified" else smooth, exponent, order)
        covariance += scale * math.copysign(1.0, one[0]) * one
    weights = np.gradient(lags) if lags.size > 1 else np.ones(1)
    weights[[0, -1]] = 0.5 * np.diff(lags)[[0, -1]] if lags.size > 1 else 0.5
    squares = (covariance / covariance[0]) ** 2
    return float(count / (2.0 * weights @ ((1.0 - lags / count) * squares)))


def _covariance(lag: Array, smooth: float, exponent: int, order: int) -> Array:
    """Autocovariance of the differences of this order of the smoothed angle, up to its sign (``sz`` of [Greenhall2003])."""

    def generalised(at: Array) -> Array:  # ``sw``, table 1
        size = np.abs(at)
        return size ** (3 - exponent) * (np.log(np.where(size > 0.0, size, 1.0)) if exponent % 2 else 1.0)

    total = np.zeros_like(lag)
    for k in range(-order, order + 1):
        at = lag + k
        part = 2.0 * generalised(at) - generalised(at - 1.0 / smooth) - generalised(at + 1.0 / smooth)
        total += (-1.0) ** k * math.comb(2 * order, order + k) * smooth**2 * part
    return total


def _even(angle: Array, t: Array, step: float) -> Array:
    """Angles of a stretch at even steps, without the line through its ends. An uneven one is interpolated linearly."""
    time = t - t[0]
    even: Array = step * np.arange(time.size, dtype=float)
    if np.abs(time - even).max() > _UNEVEN * step:
        even = step * np.arange(int(time[-1] / step + _UNEVEN) + 1, dtype=float)
        angle = np.interp(even, time, angle)
    return angle - np.linspace(angle[0], angle[-1], angle.size)


def _pooled(
    summed: list[Array], m: int, noise: tuple[tuple[int, float], ...], kind: Kind
) -> tuple[float, float]:
    """Variance times the square of the averaging time, and its degrees of freedom, of the stretches that are long enough.

    ``summed`` are the angles of each stretch; for the modified deviation their running sums, from zero.
    """
    times, scale = {"allan": (2, 2.0), "modified": (3, 2.0 * m**2), "hadamard": (3, 6.0)}[kind]
    total, weights, spread = 0.0, 0, 0.0
    for x in summed:
        if x.size <= times * m:
            continue
        difference = x
        for _ in range(times):
            difference = difference[m:] - difference[:-m]
        samples = x.size - (kind == "modified")
        freedom = equivalent_degrees(samples, m, noise, kind)
        total += float(difference @ difference)
        weights += difference.size
        spread += difference.size**2 / freedom
    return (total / weights / scale, weights**2 / spread) if weights else (0.0, 0.0)


# -- levels ------------------------------------------------------------------------------------------------

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
    scale = 1.0 / np.sqrt((columns**2).sum(axis=0))
    columns *= scale
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
        fit = _Fit(square, count)
        squares, best = fit.best(columns)
        before, model = model, columns @ squares
        if np.abs(model - before).max() <= _SMALL * model.max():
            break
    frequency, levels = share / (2.0 * step), []
    misfit, most = _judged(frequency, columns, square, model, count)
    for k, name in enumerate(SOURCES):
        lower, upper = fit.interval(columns, k, squares)
        if misfit is not None:
            lines = name == "quantisation"  # of counts of a steady output: some bands are empty
            lower, upper = lower if lines or lower < most[k] else 0.0, max(upper, most[k])
        levels.append(NoiseLevel(name, *(math.sqrt(one * scale[k]) for one in (squares[k], lower, upper))))

    def above(off: float) -> float:
        """Likelihood of a drift that is off by this much, above that of the ends of its interval."""
        return _Fit(square - 2.0 * off * cross + off**2 * bends, count).best(columns)[1] - best + _FALL

    unit = 1.0 / math.sqrt(information)
    lower, upper = (drift + sign * _fall(lambda off: above(sign * off), unit) for sign in (-1.0, 1.0))  # noqa: B023
    levels.append(NoiseLevel("drift", drift, lower, upper))
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
    "drift": (-3, 0.5),
}
"""Exponent of the spectrum and Allan variance at 1 s of each level of 1 ([IEEE952] annex C); a drift goes as an exponent of -3."""


def level_variances(tau: Array, levels: Sequence[NoiseLevel]) -> dict[str, Array]:
    """Allan variance of each level at averaging times, by name."""
    told = {one.name: (one.value, *ALLAN[one.name]) for one in levels}
    return {name: value**2 * at * tau ** float(_SLOPES[power]) for name, (value, power, at) in told.items()}


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

    def __init__(self, square: Array, count: Array) -> None:
        self.square, self.count = square, count
        self.least = max(1e-15 * float(square.max(initial=0.0)), 1e-300)

    def best(
        self, columns: Array, given: Array | float = 0.0, start: Array | None = None
    ) -> tuple[Array, float]:
        """Factors of the columns of the largest likelihood, none below zero, and its logarithm.

        ``given`` is a part of the variance that stays. Scoring: least squares with the weights of the spectrum before,
        whose equations are those of the maximum. A step that lowers the likelihood is halved.
        """
        from scipy.optimize import nnls

        squares = np.zeros(columns.shape[1]) if start is None else start
        model = self.square if start is None else columns @ squares + given
        before = -math.inf if start is None else self.likelihood(model)
        for _ in range(_ROUNDS):
            root = np.sqrt(self.count) / np.maximum(model, self.least)
            new = nnls(columns * root[:, None], (self.square - given) * root)[0]
            now = self.likelihood(columns @ new + given)
            for _ in range(_HALVINGS):
                if now >= before:
                    break
                new = 0.5 * (new + squares)
                now = self.likelihood(columns @ new + given)
            if now - before <= _SMALL:
                break
            squares, model, before = new, columns @ new + given, now
        return squares, before

    def likelihood(self, model: Array) -> float:
        """Logarithm of the likelihood, up to a constant."""
        model = np.maximum(model, self.least)
        return -0.5 * float(self.count @ (np.log(model) + self.square / model))

    def interval(self, columns: Array, k: int, squares: Array) -> tuple[float, float]:
        """Ends of the interval of a factor, by its profile likelihood."""
        top, others = self.likelihood(columns @ squares) - _FALL, np.delete(columns, k, axis=1)
        unit, start = float(squares[k]) or float(np.min(self.square / columns[:, k])), np.delete(squares, k)

        def above(value: float) -> float:
            return self.best(others, value * columns[:, k], start)[1] - top

        lower = 0.0 if above(0.0) >= 0.0 else squares[k] - _fall(lambda d: above(squares[k] - d), squares[k])
        return lower, _fall(above, unit, squares[k])


def _judged(
    frequency: Array, columns: Array, square: Array, model: Array, count: Array
) -> tuple[tuple[float, float, float] | None, Array]:
    """Band in which the spectrum differs most from the levels, if no chance explains it; largest factors that it allows.

    The sum of the spectral values of a band over those of the levels is chi-square; of all bands the least probable counts.
    No band has a column above the largest factor, whatever else is there.
    """
    from scipy.special import chdtr, chdtrc, chdtri

    band = np.floor(_BANDS * np.log2(frequency)).astype(int)
    start = np.flatnonzero(np.diff(band, prepend=band[0] - 1))
    table = np.column_stack((count, count * square / model, count * square, count[:, None] * columns))
    numbers, ratios, sums, *of_one = np.add.reduceat(table, start).T
    least = chdtri(numbers, 1.0 - _OUTSIDE / start.size) / numbers
    most = np.array([float(np.min(sums / (one * least))) for one in of_one])
    chance = 2.0 * np.minimum(chdtr(numbers, ratios), chdtrc(numbers, ratios))
    worst = int(np.argmin(chance))
    if chance[worst] * start.size > _DOUBT:
        return None, most
    ends = frequency[start[worst]], frequency[np.append(start[1:], frequency.size)[worst] - 1]
    return (float(ends[0]), float(ends[1]), float(ratios[worst] / numbers[worst])), most
