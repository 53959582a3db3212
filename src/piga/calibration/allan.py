"""Overlapping Allan deviation of a rate, computed from its angle over separate stretches.

Definitions and equivalent degrees of freedom: [Riley2008], eq. 11 and table 5, after [Howe1981].
The pooling of the stretches is our own derivation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from piga import doors
from piga.errors import ArgumentError
from piga.results import Array, Plotted, Result

if TYPE_CHECKING:
    from piga.reports.render.figure import Figure

PER_DECADE = 8
"""Averaging times per decade."""
MOST_DIFFERENCES = 1 << 17
"""A longer record uses every second, third, ... difference; the deviation is then known to 0.2 %."""
UNEVEN = 0.01
"""Distance of a sample from an even grid [steps] above which a stretch is interpolated to that grid."""
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

    def figure(self) -> Figure:
        """The deviation with its 68 % band."""
        return doors.noise_figures().deviation_figure(self)


def allan_deviation(
    angle: Array, t: Array, begins: NDArray[np.bool_], *, white: float, walk: float
) -> AllanDeviation:
    r"""Overlapping Allan deviation of the rate from samples of its angle.

    In a stretch of N angles x with step h, for the averaging time :math:`\tau = m h`,

    .. math:: \sigma^2(\tau) = \frac{1}{2 \tau^2 (N - 2m)} \sum_i (x_{i+2m} - 2 x_{i+m} + x_i)^2

    ([Riley2008] eq. 11). Each stretch is weighted by its number of differences. An averaging time with fewer than one
    degree of freedom is not shown.

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

    steps = np.diff(t)[~begins[1:]]
    step = float(np.median(steps)) if steps.size else 1.0
    edges = [0, *(np.flatnonzero(begins[1:]) + 1).tolist(), t.size]
    stretches = [_even(angle[a:b], t[a:b], step) for a, b in pairwise(edges)]
    most = (max((x.size for x in stretches), default=0) - 1) // 3
    count = int(PER_DECADE * math.log10(most)) + 1 if most >= 1 else 0
    every = max(angle.size // MOST_DIFFERENCES, 1)
    rows = []
    for m in np.unique(np.round(np.geomspace(1, max(most, 1), count)).astype(int)).tolist():
        total = 3.0 * white + walk * m * step
        square, freedom, count = _pooled(stretches, m, every, walk * m * step / total if total else 0.0)
        if freedom >= 1.0:
            rows.append((m * step, square / (2.0 * (m * step) ** 2), freedom, count))
    tau, variance, degrees, reached = np.array(rows).reshape(-1, 4).T
    tail = 0.5 * (1.0 - ONE_SIGMA)
    return AllanDeviation(
        tau=tau,
        deviation=np.sqrt(variance),
        lower=np.sqrt(variance * degrees / chdtri(degrees, tail)),
        upper=np.sqrt(variance * degrees / chdtri(degrees, 1.0 - tail)),
        degrees_of_freedom=degrees,
        stretches=reached.astype(np.int64),
    )


def model_deviation(tau: Array, white: float, walk: float) -> tuple[Array, Array]:
    r"""Allan deviation of white angle noise and of an angle random walk [rad/s].

    :math:`\sqrt{3 r}/\tau` and :math:`\sqrt{q/\tau}` ([Riley2008], in angle and rate).
    """
    return np.sqrt(3.0 * white) / tau, np.sqrt(walk / tau)


def drift_line(tau: Array, level: float) -> Array:
    r"""Allan deviation :math:`\kappa \sqrt{\tau/3}` of a random walk of the rate, level in rad/s/sqrt(s)."""
    return level * np.sqrt(tau / 3.0)


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


def _even(angle: Array, t: Array, step: float) -> Array:
    """Angles of a stretch at even steps; an uneven one is interpolated linearly."""
    time = t - t[0]
    even: Array = step * np.arange(time.size, dtype=float)
    if np.abs(time - even).max() <= UNEVEN * step:
        return angle
    return np.interp(step * np.arange(int(time[-1] / step + UNEVEN) + 1, dtype=float), time, angle)


def _pooled(stretches: list[Array], m: int, every: int, share: float) -> tuple[float, float, int]:
    """Mean square of second differences, its degrees of freedom, and the number of stretches long enough.

    ``share`` of the variance is random walk. For two noises the variance of the mean square has three parts: one
    of each noise, and twice the product of their shares. The product has the degrees of freedom of the quicker
    noise.
    """
    total, weights, spread, reached = 0.0, 0, 0.0, 0
    for x in stretches:
        if x.size <= 2 * m:
            continue
        difference = x[2 * m :: every] - 2.0 * x[m:-m:every] + x[: -2 * m : every]
        white, slow = (equivalent_degrees(x.size, m, walking=kind) for kind in (False, True))
        inverse = (1.0 - share) ** 2 / white + share**2 / slow + 2.0 * share * (1.0 - share) / max(white, slow)
        total += float(difference @ difference)
        weights += difference.size
        spread += difference.size**2 / min(1.0 / inverse, difference.size)
        reached += 1
    return (total / weights, weights**2 / spread, reached) if reached else (0.0, 0.0, 0)
