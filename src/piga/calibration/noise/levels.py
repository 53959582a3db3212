"""Noise levels of the output, estimated from the residual increments by maximum likelihood."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from piga._kernels.estimation.noise import CANDIDATES, likelihoods
from piga.calibration.noise.likelihood import restricted
from piga.calibration.noise.settings import NOISE
from piga.reading.checks import largest_size
from piga.records.run import Run
from piga.records.spool import spans
from piga.results import Array

Information = Callable[[Array], Array]
"""``log|X' V^-1 X|`` (up to a constant) as a function of ``log10(q h/r)``."""


@dataclass(frozen=True)
class Noise:
    """Variances: white angle noise ``white`` = r [rad^2], random walk ``walk`` = q [rad^2/s].

    There may also be one of two slow noises. A bias ``drift`` [rad^2/s^3] is a random walk of the rate. ``scatter``
    [rad^2/s^2] is the variance of the rate from segment to segment. ``stated`` [rad^2/s^2] is the variance of the rate of
    each segment by the run file (sources with a new value at each position); empty if it states none.
    """

    white: float
    walk: float
    drift: float = 0.0
    scatter: float = 0.0
    stated: tuple[float, ...] = ()

    @property
    def scattered(self) -> Array | None:
        """Variance of the rate of each segment, stated and estimated [rad^2/s^2]; None without a stated part."""
        return np.array(self.stated) + self.scatter if self.stated else None

    @property
    def angle_rms(self) -> float:
        """Standard deviation of the white angle noise [rad]."""
        return math.sqrt(self.white)

    @property
    def angle_random_walk(self) -> float:
        """Angle random walk [rad/sqrt(s)]."""
        return math.sqrt(self.walk)

    @property
    def bias_drift(self) -> float:
        """Random walk of the rate [rad/s/sqrt(s)]."""
        return math.sqrt(self.drift)

    @property
    def segment_scatter(self) -> float:
        """Standard deviation of the rate from segment to segment [rad/s]."""
        return math.sqrt(self.scatter)

    @property
    def slow(self) -> float:
        """Level of the slow noise, drift or scatter."""
        return self.drift + self.scatter

    def slower(self, factor: float) -> Noise:
        """The levels with ``factor`` times the slow noise."""
        return replace(self, drift=factor * self.drift, scatter=factor * self.scatter)

    def without_slow(self) -> Noise:
        """White noise, random walk and the stated scatter."""
        return replace(self, drift=0.0, scatter=0.0)

    def close_to(self, other: Noise, step: float, rows: int, tolerance: float = 0.02) -> bool:
        """True if both give nearly the same weights: equal variances of an increment and of a long span.

        The span of a long record is the whole record of ``rows`` increments; white noise then adds ``12/rows^2``.
        """
        short = (2.0 * self.white + self.walk * step) / (2.0 * other.white + other.walk * step)
        share = 12.0 / rows**2 if is_long(rows) else NOISE.settled_share
        total = self.walk * step + share * self.white
        other_total = other.walk * step + share * other.white
        return abs(math.log(short)) < tolerance and abs(math.log(total / other_total)) < 2.0 * tolerance


def is_long(rows: int) -> bool:
    """True for a record whose first rows alone give its noise levels roughly."""
    return rows > 4 * NOISE.first_rows


def rounding(run: Run) -> float:
    """Least angle noise that is estimated [rad]: the rounding of the output."""
    return 4.0 * float(np.finfo(float).eps) * max(largest_size(run.output), 1e-3)


def starting_noise(resolution: float, step: float) -> Noise:
    """Levels for the first fit: quantisation of one count, and a random walk of a hundredth of it per step."""
    white = max(resolution, 1e-9) ** 2 / 12.0
    return Noise(white, 0.01 * white / step)


def find_noise(
    d: Array,
    h: Array,
    step: float,
    parameters: int,
    floor: float,
    near: Noise | None = None,
    information: Information | None = None,
) -> Noise:
    """Noise levels of residual increments ``d`` (n,) over intervals ``h`` (n,; 0 begins a stretch), of about ``step`` [s].

    It maximises the restricted likelihood of the first-order moving average (docs/theory/calibration), concentrated
    over its scale, on a grid of the ratio kappa = q/r that is refined until it is fine enough:
    ``(n - m) log S + sum log v + log|X' V^-1 X|``, with m ``parameters`` fitted. The last term is the slow noise that the
    fit took up; it is ``information`` as a function of ``log10(kappa h)``. Without ``information`` it is left
    out. ``floor`` [rad] is the smallest angle noise returned. ``near`` narrows the search to
    earlier levels. In a long record the first rows narrow it.
    """
    count = sum(int(np.count_nonzero(h[rows] > 0.0)) for rows in spans(h.size))
    freedom = max(count - parameters, 1)
    low, high, long = NOISE.lowest_ratio, NOISE.highest_ratio, is_long(d.size)

    def deviance(grid: Array, rows: slice) -> tuple[Array, Array]:
        """The objective and the residual square of the record, judged by some of its rows."""
        log, square = deviance_sums(d[rows], h[rows], 10.0**grid / step)
        share = d.size / d[rows].size
        objective = restricted(log * share, square * share / count, freedom)
        return objective if information is None else objective + information(grid), square * share

    centre, width, passes = None, NOISE.ratio_known, NOISE.refinements
    if near is not None and near.white > 0.0 and near.walk > 0.0:
        centre, passes = math.log10(near.walk * step / near.white), passes - 2
        width = NOISE.ratio_known_long if long else width
    elif long:
        centre, _ = _likeliest(lambda grid: deviance(grid, slice(NOISE.first_rows)), low, high, passes)
    if centre is not None:
        centre = min(max(centre, low + width), high - width) if long else min(max(centre, low), high)
        low, high = max(low, centre - width), min(high, centre + width)
    best, size = _likeliest(lambda grid: deviance(grid, slice(None)), low, high, None if long else passes)
    if information is not None:
        grid = np.append(NOISE.lowest_ratio, np.full(CANDIDATES - 1, best))
        log, square = deviance_sums(d, h, 10.0**grid / step)
        objective = restricted(log, square / count, freedom) + information(grid)
        if NOISE.negligible < objective[0] - objective[1] < NOISE.walk_in_weights:
            best, size = NOISE.lowest_ratio, float(square[0])
    ratio = 0.0 if best <= NOISE.lowest_ratio + 1e-9 else 10.0**best / step
    white = size / freedom
    white = max(white, floor**2 / (1.0 + ratio * step))
    return Noise(white, ratio * white)


def _likeliest(
    deviance: Callable[[Array], tuple[Array, Array]], low: float, high: float, passes: int | None
) -> tuple[float, float]:
    """``log10(q h/r)`` of the least deviance and the residual square there, on a grid from ``low`` to ``high``.

    The grid is refined around its best point in ``passes``. If their number is None, the grid moves where the best point is
    its first or last, and is refined until it is fine enough.
    """
    for _ in range(passes or NOISE.ratio_passes):
        grid = np.linspace(low, high, CANDIDATES)
        objective, square = deviance(grid)
        best = least_on_grid(grid, objective)
        spacing = (high - low) / (CANDIDATES - 1)
        outside = passes is None and (NOISE.lowest_ratio < best == low or NOISE.highest_ratio > best == high)
        if passes is None and spacing <= NOISE.ratio_spacing and not outside:
            break
        reach = high - low if outside else spacing
        low, high = max(best - reach, NOISE.lowest_ratio), min(best + reach, NOISE.highest_ratio)
    return best, float(np.exp(np.interp(best, grid, np.log(np.maximum(square, 1e-300)))))


def least_on_grid(grid: Array, objective: Array) -> float:
    """Grid point of the least objective, refined by a parabola through its neighbours."""
    at = int(np.argmin(objective))
    if at in (0, grid.size - 1):
        return float(grid[at])
    left, middle, right = objective[at - 1 : at + 2]
    curvature = left - 2.0 * middle + right
    shift = 0.5 * (left - right) / curvature if curvature > 0.0 else 0.0
    return float(grid[at] + shift * (grid[1] - grid[0]))


def natural_spline(x: Array, y: Array) -> Information:
    """Natural cubic spline through points (n,); the outer cubics continue outside."""
    h, last = np.diff(x), x.size - 1
    slope, inner = np.diff(y) / h, np.arange(1, last)
    matrix, right = np.eye(x.size), np.zeros(x.size)
    matrix[inner, inner - 1], matrix[inner, inner] = h[:-1], 2.0 * (h[:-1] + h[1:])
    matrix[inner, inner + 1], right[inner] = h[1:], 6.0 * np.diff(slope)
    bend = np.linalg.solve(matrix, right)
    first = slope - h * (2.0 * bend[:-1] + bend[1:]) / 6.0
    third = np.diff(bend) / (6.0 * h)

    def value(at: Array) -> Array:
        i = np.clip(np.searchsorted(x, at) - 1, 0, last - 1)
        s = at - x[i]
        return np.asarray(y[i] + s * (first[i] + s * (0.5 * bend[i] + s * third[i])))

    return value


def deviance_sums(d: Array, h: Array, kappas: Array) -> tuple[Array, Array]:
    """Sums of the likelihood over the record."""
    log, square = np.zeros(CANDIDATES), np.zeros(CANDIDATES)
    likelihoods(d, h, kappas, log, square)
    return log, square
