"""Overlapping Allan deviation of a rate, computed from its angle over separate stretches.

Definitions and equivalent degrees of freedom: [Riley2008], eq. 11 and table 5, after [Howe1981].
The pooling of the stretches is our own derivation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError
from piga.results import Array, Plotted, Result


@dataclass(frozen=True)
class AllanSettings:
    """Settings of the Allan deviation (own choices)."""

    per_decade: int = 8
    """Averaging times per decade."""
    differences: int = 1 << 17
    """Most differences used per averaging time. A longer record uses every second, third, ... difference; the deviation
    is then known to 0.2 %."""
    fewest_degrees: float = 1.0
    """Fewest degrees of freedom of an averaging time that is shown."""
    uneven: float = 0.01
    """Relative scatter of the sampling steps above which a stretch is interpolated to an even grid."""


ALLAN = AllanSettings()


ONE_SIGMA = 0.682689492137
"""Probability of the bands."""


@dataclass(frozen=True, eq=False, repr=False)
class AllanDeviation(Result, Plotted):
    """Overlapping Allan deviation of a rate: one entry per averaging time.

    ``plot()`` shows the deviation with its 68 % band.

    Attributes
    ----------
    tau:
        Averaging times [s].
    deviation, lower, upper:
        Deviation and ends of the 68 % band [rad/s].
    degrees_of_freedom:
        Equivalent degrees of freedom of the variance.
    stretches:
        Stretches that are long enough for each averaging time.
    """

    tau: Array
    deviation: Array
    lower: Array
    upper: Array
    degrees_of_freedom: Array
    stretches: NDArray[np.int64]


def allan_deviation(
    angle: Array, t: Array, begins: NDArray[np.bool_], *, white: float, walk: float
) -> AllanDeviation:
    r"""Overlapping Allan deviation of the rate from samples of its angle.

    In a stretch of N angles x with step h, for the averaging time :math:`\tau = m h`,

    .. math:: \sigma^2(\tau) = \frac{1}{2 \tau^2 (N - 2m)} \sum_i (x_{i+2m} - 2 x_{i+m} + x_i)^2

    ([Riley2008] eq. 11). Each stretch is weighted by its number of differences.

    Parameters
    ----------
    angle:
        Residual angle (n,) [rad].
    t:
        Time (n,) [s].
    begins:
        True where a stretch begins (n,).
    white, walk:
        Variance of the white angle noise [rad^2] and of the random walk [rad^2/s]. Their shares of the Allan
        variance decide which degrees of freedom apply.

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
    from scipy.special import chdtri

    stretches, step = _even_stretches(angle, t, begins)
    longest = max((x.size for x in stretches), default=0)
    every = max(angle.size // ALLAN.differences, 1)
    rows = [
        (m * step, *pooled)
        for m in _multiples(longest)
        if (pooled := _pooled(stretches, m, every, _walking(m * step, white, walk)))[1] >= ALLAN.fewest_degrees
    ]
    table = np.array(rows).reshape(-1, 4)
    tau, degrees = table[:, 0], table[:, 2]
    variance = table[:, 1] / (2.0 * tau**2)
    tail = 0.5 * (1.0 - ONE_SIGMA)
    return AllanDeviation(
        tau=tau,
        deviation=np.sqrt(variance),
        lower=np.sqrt(variance * degrees / chdtri(degrees, tail)),
        upper=np.sqrt(variance * degrees / chdtri(degrees, 1.0 - tail)),
        degrees_of_freedom=degrees,
        stretches=table[:, 3].astype(np.int64),
    )


def model_deviation(tau: Array, white: float, walk: float) -> tuple[Array, Array]:
    r"""Allan deviation of white angle noise and of an angle random walk [rad/s].

    :math:`\sqrt{3 r}/\tau` and :math:`\sqrt{q/\tau}` ([Riley2008], in angle and rate).
    """
    return np.sqrt(3.0 * white) / tau, np.sqrt(walk / tau)


def drift_line(tau: Array, level: float) -> Array:
    r"""Allan deviation :math:`\kappa \sqrt{\tau/3}` of a random walk of the rate, level in rad/s/sqrt(s)."""
    return level * np.sqrt(tau / 3.0)


def _walking(tau: float, white: float, walk: float) -> float:
    """Share of the random walk in the Allan variance."""
    total = 3.0 * white + walk * tau
    return walk * tau / total if total > 0.0 else 0.0


def _even_stretches(angle: Array, t: Array, begins: NDArray[np.bool_]) -> tuple[list[Array], float]:
    """Angles of every stretch at the median step; uneven stretches are interpolated linearly."""
    starts = np.flatnonzero(begins)
    starts = starts if starts.size and starts[0] == 0 else np.append(0, starts)
    steps = np.diff(t)[~begins[1:]]
    if steps.size == 0:
        return [], 1.0
    step = float(np.median(steps))
    stretches = []
    for left, right in zip(starts, np.append(starts[1:], t.size), strict=True):
        time = t[left:right] - t[left]
        even: Array = step * np.arange(time.size, dtype=float)
        if np.abs(time - even).max() > ALLAN.uneven * step:
            even = step * np.arange(int(time[-1] / step + ALLAN.uneven) + 1, dtype=float)
            stretches.append(np.interp(even, time, angle[left:right]))
        else:
            stretches.append(angle[left:right])
    return stretches, step


def _multiples(longest: int) -> list[int]:
    """Averaging times in steps: even on a logarithmic scale, up to a third of the longest stretch."""
    most = (longest - 1) // 3
    if most < 1:
        return []
    count = max(int(ALLAN.per_decade * math.log10(most)) + 1, 1)
    return np.unique(np.round(np.geomspace(1, most, count)).astype(int)).tolist()


def _pooled(stretches: list[Array], m: int, every: int, share: float) -> tuple[float, float, float]:
    """Mean square of second differences, its degrees of freedom, and the number of stretches long enough.

    ``share`` of the variance is random walk. For two noises the variance of the mean square has three parts: one
    of each noise, and twice the product of their shares. The product has the degrees of freedom of the quicker
    noise.
    """
    total, weights, spread, reached = 0.0, 0.0, 0.0, 0
    for x in stretches:
        if x.size < 2 * m + 1:
            continue
        difference = x[2 * m :: every] - 2.0 * x[m:-m:every] + x[: -2 * m : every]
        weight = difference.size
        white, slow = (equivalent_degrees(x.size, m, walking=kind) for kind in (False, True))
        inverse = (1.0 - share) ** 2 / white + share**2 / slow + 2.0 * share * (1.0 - share) / max(white, slow)
        degrees = min(1.0 / inverse, weight)
        total += float(difference @ difference)
        weights += weight
        spread += weight**2 / degrees
        reached += 1
    return (total / weights, weights**2 / spread, float(reached)) if reached else (0.0, 0.0, 0.0)


def equivalent_degrees(samples: int, m: int, *, walking: bool) -> float:
    """Equivalent degrees of freedom of an overlapping Allan variance of ``samples`` angles.

    For white noise of the angle (white phase noise of [Riley2008], table 5) or, if ``walking``, an angle random
    walk (white frequency noise there).
    """
    n = float(samples)
    if walking:
        shape = 4.0 * m**2 / (4.0 * m**2 + 5.0)
        return max((1.5 * (n - 1.0) / m - 2.0 * (n - 2.0) / n) * shape, 1e-9)
    return (n + 1.0) * (n - 2.0 * m) / (2.0 * (n - m))
