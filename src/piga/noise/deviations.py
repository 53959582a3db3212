"""Overlapping Allan, modified Allan and Hadamard deviation of a rate, computed from its angle over separate stretches.

Definitions: [Riley2008], eq. 11, 16 and 28. Degrees of freedom: [Greenhall2003].
The pooling of the stretches is our own derivation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga.errors import ArgumentError
from piga.results import Array, Plotted, Result
from piga.upper import doors

if TYPE_CHECKING:
    from piga.reports.render.figure import Figure

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
class AllanDeviation(Result, Plotted):
    """Overlapping deviation of a rate: one entry per averaging time.

    ``plot()`` shows the deviation with its 68 % band.

    Attributes
    ----------
    tau:
        Averaging times [s].
    deviation, lower, upper:
        Deviation and ends of the 68 % band, in the unit of the rate [rad/s].
    degrees_of_freedom:
        Equivalent degrees of freedom of the variance.
    stretches:
        Stretches that are long enough for each averaging time.
    kind:
        ``"allan"``, ``"modified"`` or ``"hadamard"``.
    """

    tau: Array
    deviation: Array
    lower: Array
    upper: Array
    degrees_of_freedom: Array
    stretches: NDArray[np.int64]
    kind: Kind = "allan"

    def figure(self) -> Figure:
        """The deviation with its 68 % band."""
        return doors().shown_noise().deviation_figure(self)


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
    stretches, step = _even_stretches(np.asarray(angle, float), np.asarray(t, float), begins)
    most = (max((x.size for x in stretches), default=0) - 1) // 3
    if factors is None:
        count = int(_PER_DECADE * math.log10(most)) + 1 if most >= 1 else 0
        factors = np.unique(np.round(np.geomspace(1, max(most, 1), count)).astype(int)).tolist()
    from scipy.special import chdtri

    summed = [np.concatenate(([0.0], np.cumsum(x))) for x in stretches] if kind == "modified" else stretches
    rows = []
    for m in factors:
        parts = tuple((power, level * (m * step) ** _SLOPES[power]) for power, level in noise.items())
        square, freedom, reached = _pooled(summed, m, parts, kind)
        if freedom >= 1.0:
            rows.append((m * step, square / (m * step) ** 2, freedom, reached))
    tau, variance, degrees, counts = np.array(rows).reshape(-1, 4).T
    tail = 0.5 * (1.0 - ONE_SIGMA)
    return AllanDeviation(
        tau=tau,
        deviation=np.sqrt(variance),
        lower=np.sqrt(variance * degrees / chdtri(degrees, tail)),
        upper=np.sqrt(variance * degrees / chdtri(degrees, 1.0 - tail)),
        degrees_of_freedom=degrees,
        stretches=counts.astype(np.int64),
        kind=kind,
    )


def _even_stretches(angle: Array, t: Array, begins: NDArray[np.bool_]) -> tuple[list[Array], float]:
    """The stretches of an angle at even steps, each without the line through its ends, and the step [s].

    Raises
    ------
    ArgumentError
        If the arrays differ in length.
    """
    if not angle.size == t.size == begins.size:
        raise ArgumentError(
            f"angle, t, begins: {angle.size}, {t.size} and {begins.size} samples",
            remedy="give one angle and one mark for each time",
        )
    steps = np.diff(t)[~begins[1:]]
    step = float(np.median(steps)) if steps.size else 1.0
    edges = [0, *(np.flatnonzero(begins[1:]) + 1).tolist(), t.size]
    return [_even(angle[a:b], t[a:b], step) for a, b in pairwise(edges)], step


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
        covariance += scale * _covariance(lags / m, 1.0 if kind == "modified" else smooth, exponent, order)
    weights = np.gradient(lags) if lags.size > 1 else np.ones(1)
    weights[[0, -1]] = 0.5 * np.diff(lags)[[0, -1]] if lags.size > 1 else 0.5
    squares = (covariance / covariance[0]) ** 2
    return float(count / (2.0 * weights @ ((1.0 - lags / count) * squares)))


def _covariance(lag: Array, smooth: float, exponent: int, order: int) -> Array:
    """Autocovariance of the differences of this order of the smoothed angle (``sz`` of [Greenhall2003])."""
    total = np.zeros_like(lag)
    for k in range(-order, order + 1):
        at = lag + k
        part = 2.0 * _generalised(at, exponent)
        part -= _generalised(at - 1.0 / smooth, exponent) + _generalised(at + 1.0 / smooth, exponent)
        total += (-1.0) ** k * math.comb(2 * order, order + k) * smooth**2 * part
    return total


def _generalised(lag: Array, exponent: int) -> Array:
    """Generalised autocovariance of the angle, up to a factor (``sw`` of [Greenhall2003], table 1)."""
    size = np.abs(lag)
    sign = -1.0 if exponent in (2, -1, -2) else 1.0
    if exponent % 2 == 0:
        return sign * size ** (3 - exponent)
    return sign * size ** (3 - exponent) * np.log(np.where(size > 0.0, size, 1.0))


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
) -> tuple[float, float, int]:
    """Variance times the square of the averaging time, its degrees of freedom, and the number of stretches long enough.

    ``summed`` are the angles of each stretch; for the modified deviation their running sums, from zero.
    """
    times, scale = {"allan": (2, 2.0), "modified": (3, 2.0 * m**2), "hadamard": (3, 6.0)}[kind]
    total, weights, spread, reached = 0.0, 0, 0.0, 0
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
        reached += 1
    return (total / weights / scale, weights**2 / spread, reached) if reached else (0.0, 0.0, 0)
