"""Weights of the rows of a record: white angle noise, random walk, a scatter of the rates of the positions; and residuals.

The noise of an angle increment over h seconds has the variance ``2 r + q h``, with ``-r`` between neighbours: r is white
noise of the angle, q a random walk. Each position may also have a rate error of its own, of variance tau. The three levels
have the largest restricted likelihood and are not negative. They decide the weights, nothing else: the intervals come from the
scatter of the positions (:mod:`piga.calibration.intervals`). Formulas: docs/theory/calibration.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga._kernels.estimation import innovation_weights, rate_sums, whiten
from piga.calibration.model.design import Block, Design, MeanDesign, joined_rows
from piga.calibration.model.reduction import Reduction, triangle
from piga.records.arrays import changes, empty, largest_size, middles, spans, stored
from piga.records.calibration.coefficient import Level
from piga.records.calibration.diagnostics import COUNTED, Diagnostics, Residuals, SegmentSummary
from piga.records.run import Run
from piga.records.terms import integral_unit
from piga.results import Array

RATE = "rate"
"""Name of the column of a rate of its own in the triangle of a position."""
BLOCKS = 20
"""Blocks of equal length in place of positions, in a record of one segment (Bell and McCaffrey's rule needs repetitions)."""
_WALK_GAIN = 1.5
"""Gain of twice the log-likelihood from which on a random walk is in the weights."""


@dataclass(frozen=True)
class Noise:
    """Variances: white angle noise ``white`` = r [rad^2], random walk ``walk`` = q [rad^2/s].

    ``scatter`` [rad^2/s^2] is the variance of the rate from position to position. ``stated`` [rad^2/s^2] is that of each
    position by the run file (sources with a new value at each position), ``counted`` that by rounding; empty if there is none.
    """

    white: Level
    walk: Level
    scatter: Level = 0.0
    stated: tuple[Level, ...] = ()
    counted: tuple[Level, ...] = ()

    def stated_rates(self, count: int) -> tuple[float, ...]:
        """The part of :meth:`rate_variances` that the run file states."""
        return self.stated or (0.0,) * count

    def rate_variances(self, count: int) -> Array:
        """Variance of the rate of each of ``count`` positions [rad^2/s^2]."""
        counted = np.array(self.counted) if self.counted else np.zeros(count)
        return np.array(self.stated_rates(count)) + counted + self.scatter

    def close_to(self, other: Noise, step: float, rows: int, tolerance: float = 0.05) -> bool:
        """True if both give nearly the same weights: an increment, and the mean rate over ``rows`` increments."""
        short, long = (
            (2.0 * n.white + n.walk * step, n.walk * step + 12.0 * n.white / rows**2) for n in (self, other)
        )
        return abs(math.log(short[0] / long[0])) < tolerance and abs(math.log(short[1] / long[1])) < tolerance


@dataclass(frozen=True)
class Positions:
    """The repetitions of a record: its segments, or blocks of equal length if it has one segment.

    ``edges`` (G + 1,) are their first rows and the end; ``segments`` (G,) the segment of each.
    """

    edges: NDArray[np.int64]
    segments: NDArray[np.int64]

    @classmethod
    def of(cls, run: Run) -> Positions:
        """The positions of a run."""
        edges = run.segment_edges().astype(np.int64)
        if len(run.labels) == 1:
            edges = np.unique(np.linspace(0, run.size, BLOCKS + 1).astype(np.int64))
        return cls(edges, run.segment_index[edges[:-1]].astype(np.int64))

    @property
    def count(self) -> int:
        """Number of positions."""
        return self.segments.size

    @property
    def continuous(self) -> bool:
        """True if the positions are blocks of one segment."""
        return self.count > 1 and bool((self.segments == 0).all())

    def cut(self, parts: int) -> Positions:
        """Each position in this number of parts."""
        cuts = np.linspace(self.edges[:-1], self.edges[1:], parts, endpoint=False).T.astype(np.int64).ravel()
        return Positions(np.append(cuts, self.edges[-1]), np.repeat(self.segments, parts))

    def times(self, run: Run) -> tuple[Array, Array]:
        """Begin and end of each position [s]."""
        return np.asarray(run.t[self.edges[:-1]]), np.asarray(run.t[self.edges[1:] - 1])


def counted_rates(run: Run, white: float) -> tuple[float, ...]:
    """Variance of the rate of each position by rounding that its readings share [rad^2/s^2]; empty without counts.

    Rounding is a saw-tooth of m periods in a position, m: counts passed, beside whole counts per reading. A fitted slope
    has the mean square ``count^2/(5 m^2 T^2)``, less where white noise hides the saw-tooth; 0 where ``white`` makes more.
    """
    positions, count = Positions.of(run), run.resolution
    if count == 0.0 or run.kind == "rate" or positions.continuous:
        return ()
    begin, end = positions.times(run)
    first, last = positions.edges[:-1], positions.edges[1:] - 1
    passed, rows = (run.output[last] - run.output[first]) / count, np.maximum(last - first, 1)
    left = 0.2 * math.exp(-4.0 * math.pi**2 * max(white / count**2 - 1.0 / 12.0, 0.0))
    shared = left * count**2 / (1.0 + (passed - rows * np.round(passed / rows)) ** 2)
    rates = np.where(shared * rows > 12.0 * white, shared, 0.0) / np.maximum(end - begin, 1e-9) ** 2
    return tuple(rates.tolist())


@dataclass(frozen=True)
class Extra:
    """More columns of a record: their names, and a function that gives their rows in a block (names, n)."""

    names: tuple[str, ...]
    columns: Callable[[Block], Array]


class Whitener:
    """Whitens blocks in order; its state continues from block to block.

    ``mode`` is ``"increments"`` (white angle noise and random walk), ``"rates"`` (each increment divided by its
    interval, equal weights: the rate method) or ``"samples"`` (a rate log, equal weights). ``step`` is the usual interval [s].
    ``logarithm`` is that of the determinant of the covariance of the rows so far.
    """

    def __init__(self, mode: str, noise: Noise, size: int, step: float = 1.0) -> None:
        self.mode, self.noise, self.step = mode, noise, step
        self.logarithm = 0.0
        self._state = np.zeros(size)
        self._variance = 0.0

    def apply(self, columns: Array, h: Array) -> Array:
        """Weighted columns (m, n) for intervals ``h``, a new array; rows have unit variance."""
        white, walk = self.noise.white, self.noise.walk
        carry, scale = np.zeros(h.size), np.ones(h.size)
        if self.mode == "increments":
            self._variance = innovation_weights(h, white, walk, self._variance, carry, scale)
        else:
            variance = walk / self.step + (2.0 * white / self.step**2 if self.mode == "rates" else 0.0)
            scale = np.where(h > 0.0, 1.0 / math.sqrt(variance or 1.0), 0.0)
            if self.mode == "rates":
                scale /= np.where(h > 0.0, h, 1.0)
        self.logarithm -= 2.0 * float(np.log(scale[h > 0.0]).sum())
        out = np.empty(columns.shape)
        whiten(columns, carry, scale, self._state, out)
        return out

    def column(self, values: Array, h: Array) -> Array:
        """One weighted column (n,) of a whole record."""
        out = empty(values.size)
        for rows in spans(values.size):
            out[rows] = self.apply(values[None, rows], h[rows])[0]
        return out


def rate_share(variance: ArrayLike, square: ArrayLike) -> Array:
    """Share c for which ``x - c b (b'x)`` whitens rows that are white but for a rate along b; ``b'b = square``.

    The rate has ``variance`` v. ``(I + v b b')^-1/2 = I - c b b'``, ``c = (1 - (1 + v b'b)^-1/2)/b'b``.
    """
    size = np.asarray(square, dtype=float)
    root = 1.0 / np.sqrt(1.0 + np.asarray(variance) * size)
    return np.divide(1.0 - root, size, out=np.zeros_like(root), where=size > 0.0)


def reduce_between(
    design: Design, noise: Noise, edges: NDArray[np.int64], extra: Extra | None = None
) -> tuple[list[Reduction], float]:
    """One triangle ``[model | rate | extra | y]`` of rows with unit variance between each two ``edges`` (G + 1,).

    With them comes the logarithm of the determinant of the covariance of all rows. The scatter is not in it.
    """
    names = (*design.names, RATE, *(() if extra is None else extra.names))
    parts = [Reduction.empty(names) for _ in edges[:-1]]
    design, own = design.means, Noise(noise.white, noise.walk)
    if isinstance(design, MeanDesign):
        edges, own = design.rows_of(edges), Noise(*design.noise_of_rows(noise.white, noise.walk))
    whitener = Whitener(design.mode, own, len(names) + 1, design.run.median_step)
    for block in design.blocks():
        more = [] if extra is None else [extra.columns(block)]
        rate = np.maximum(block.h, 0.0)[None]
        columns = whitener.apply(np.vstack([block.columns[:-1], rate, *more, block.columns[-1:]]), block.h)
        first, last = np.searchsorted(edges, [block.start, block.stop - 1], side="right") - 1
        for index in range(int(first), int(last) + 1):
            low, high = max(int(edges[index]), block.start), min(int(edges[index + 1]), block.stop)
            rows = slice(low - block.start, high - block.start)
            parts[index].absorb(columns[:, rows], count=int(np.count_nonzero(block.h[rows] > 0.0)))
    return parts, whitener.logarithm


def reduce_positions(
    design: Design,
    noise: Noise,
    positions: Positions | None = None,
    extra: Extra | None = None,
) -> list[Reduction]:
    """One triangle ``[model | rate | extra | y]`` per position."""
    edges = (positions or Positions.of(design.run)).edges
    return reduce_between(design, noise, edges, extra)[0]


def residual_increments(design: Design, values: Array) -> tuple[Array, Array]:
    """Observed minus modelled increments and their intervals, for ``values`` (segments, m)."""
    d, h = stored(np.zeros(design.run.size)), stored(np.zeros(design.run.size))
    for block in design.blocks():
        rows = slice(block.start, block.stop)
        d[rows] = block.columns[-1] - values[block.segment] @ block.columns[:-1]
        h[rows] = block.h
    return d, h


def find_noise(design: Design, d: Array, h: Array, fitted: int) -> Noise:
    """White noise and random walk of residual increments ``d`` over intervals ``h``, from within the segments.

    The rate of each segment is free, so that neither a scatter of the rates nor most of the model matters. ``fitted`` is
    the number of further parameters.
    """
    step, edges = design.run.median_step, design.run.segment_edges().astype(np.int64)
    rounding = 4.0 * float(np.finfo(float).eps) * max(largest_size(design.run.output), 1e-3)
    if design.point:
        starts, square, freedom = edges[:-1], float(d @ d), design.rows - fitted
        count = 0.5 * (np.add.reduceat(h, starts) + np.diff(edges))  # h of a sample that is left out: -1
        if freedom > starts.size:  # otherwise the samples of a segment are too few to show their own noise
            square -= float((np.add.reduceat(d, starts) ** 2 / np.maximum(count, 1.0)).sum())
            freedom -= starts.size
        variance = square / max(freedom, 1)
        return Noise(0.0, max(variance, rounding**2) * step)
    least = math.sqrt(_ROUNDED / 12.0) * design.run.resolution
    noise = likeliest_levels(d, h, edges, step, fitted, max(rounding, least))
    return noise if design.mode == "rates" else replace(noise, counted=counted_rates(design.run, noise.white))


_SPACING = 1.5
"""Distance of the ratios of walk to white noise in the first search [natural logarithm]."""
_LARGEST_RATIO = 1e6
"""Largest ratio of walk to white noise in an increment."""
_FIRST_ROWS = 1 << 16
"""Rows of the search; of a longer record neighbouring increments are joined."""
_TOLERANCE = 0.02
"""Tolerance of the ratio [natural logarithm]."""
_ROUNDED = 0.95
"""Least white noise, as a share of the variance of rounding to counts, q^2/12 (own choice: chance in 1500 readings)."""
_FEWEST_JOINED = 16
"""Increments in the longest position that are not joined further (own choice)."""
_SCATTER_RANGE = (-5.0, 14.0)
"""Range of the scatter over the noise of a mean rate [natural logarithm of the variance]."""


def likeliest_levels(
    d: Array,
    h: Array,
    edges: NDArray[np.int64],
    step: float,
    fitted: int,
    floor: float,
) -> Noise:
    """Levels of the largest restricted likelihood; the rate of each stretch between ``edges`` is free.

    ``floor`` [rad] is the smallest white noise. The ratio of walk to white noise is found with neighbouring increments of a long
    record joined. White noise at the floor says that neighbouring readings share their rounding, which would pass for a walk:
    then increments are joined by two until their rounding is white.
    """
    from scipy.optimize import minimize_scalar

    count = int(np.count_nonzero(h > 0.0))
    longest = max(b - a for a, b in pairwise(edges.tolist()))

    def deviance(ratio: float, rows: tuple[Array, Array, NDArray[np.int64]], count: int) -> tuple[float, float]:
        sums = np.zeros((rows[2].size - 1, 3))
        logarithm = rate_sums(rows[0], rows[1], rows[2], ratio / step, sums)
        hh, hd, dd = sums[sums[:, 0] > 0.0].T
        freedom = max(count - hh.size - fitted, 1)
        square = float((dd - hd**2 / hh).sum())
        white = max(square / freedom, floor**2)
        return freedom * math.log(white) + square / white + logarithm + float(np.log(hh).sum()), white

    low, high = math.log((math.pi / longest) ** 2 / longest) - 4.0, math.log(_LARGEST_RATIO)
    grid = np.arange(low, high + _SPACING, _SPACING)
    searched = joined(d, h, edges, max(1, d.size // _FIRST_ROWS))
    few = int(np.count_nonzero(searched[1] > 0.0))
    best = float(grid[int(np.argmin([deviance(math.exp(x), searched, few)[0] for x in grid]))])
    found = minimize_scalar(
        lambda x: deviance(math.exp(x), searched, few)[0],
        bounds=(best - _SPACING, best + _SPACING),
        method="bounded",
        options={"xatol": _TOLERANCE},
    )
    ratio = math.exp(float(found.x))
    (none, white), (least, beside) = (deviance(value, (d, h, edges), count) for value in (0.0, ratio))
    still = none < least + _WALK_GAIN
    if (white if still else beside) <= floor**2 and longest >= 2 * _FEWEST_JOINED:
        return likeliest_levels(*joined(d, h, edges, 2), 2.0 * step, fitted, floor)
    if still:
        return Noise(white, 0.0)
    return Noise(beside, beside * ratio / step)


def joined(d: Array, h: Array, edges: NDArray[np.int64], every: int) -> tuple[Array, Array, NDArray[np.int64]]:
    """Increments, intervals and edges with ``every`` neighbouring increments joined; stretches begin as before."""
    if every == 1:
        return d, h, edges
    starts, total = joined_rows(h, every)
    return np.add.reduceat(d, starts), total, np.searchsorted(starts, edges)


def find_scatter(parts: Sequence[Reduction], noise: Noise, *, phases: bool = False) -> Noise:
    """``noise`` with the likeliest scatter of the rates of the positions, not negative.

    Parameters
    ----------
    parts:
        Triangles ``[parameters | rate | residual]`` of the positions.
    noise:
        White noise, walk and stated scatter.
    phases:
        Each position has a phase of its own, which is not among the parameters.
    """
    from scipy.optimize import minimize_scalar

    m = len(parts[0].names) - 1
    if len(parts) <= 2:
        return replace(noise, scatter=0.0)
    total = triangle(np.vstack([part.factor[:, [*range(m), m + 1]] for part in parts]))
    size = np.linalg.norm(total[:, :m], axis=0)
    size[size == 0.0] = 1.0
    fitted = np.linalg.lstsq(total[:m, :m] / size, total[:m, m], rcond=1e-12)[0] / size
    grams = []
    for part in parts:
        rows = np.column_stack(
            [part.factor[:, :m] / size, part.factor[:, m], part.factor[:, m + 1] - part.factor[:, :m] @ fitted]
        )
        grams.append(rows.T @ rows)
    gram = np.array(grams)
    A, b, c = gram[:, :m, :m], gram[:, :m, m + 1], gram[:, m + 1, m + 1]
    u, s, z = gram[:, :m, m], gram[:, m, m], gram[:, m, m + 1]
    freedom = max(sum(part.count for part in parts) - m - phases * len(parts), 1)
    stated = replace(noise, scatter=0.0).rate_variances(len(parts))

    def deviance(scatter: float) -> float:
        tau = stated + scatter
        share = tau / (1.0 + tau * s)
        information = (A - share[:, None, None] * u[:, :, None] * u[:, None, :]).sum(axis=0)
        right = (b - share[:, None] * u * z[:, None]).sum(axis=0)
        square = float((c - share * z**2).sum() - right @ np.linalg.lstsq(information, right, rcond=1e-12)[0])
        sign, logarithm = np.linalg.slogdet(information)
        if sign <= 0.0:
            return math.inf
        return freedom * math.log(max(square, 1e-300) / freedom) + float(np.log1p(tau * s).sum() + logarithm)

    unit = 1.0 / float(np.median(s[s > 0.0])) if (s > 0.0).any() else 0.0
    found = minimize_scalar(
        lambda x: deviance(unit * math.exp(x)),
        bounds=_SCATTER_RANGE,
        method="bounded",
        options={"xatol": 0.1},
    )
    better = float(found.fun) < deviance(0.0)
    return replace(noise, scatter=unit * math.exp(float(found.x)) if better else 0.0)


# -- residuals -----------------------------------------------------------------------------------------------

LAGS = 20
"""Lags of the portmanteau test."""
_WHITE = 1e-3
"""Probability below which whitened residuals are called not white."""
_SHARED_ROUNDING = 1.0 / 3.0
"""Variance of the noise in counts squared below which neighbouring readings may share their rounding: above it, what is left
of the line of the rounding is below 1 % of a count, ``exp(-2 pi^2 (1/3 - 1/12))``."""


def residual_angles(residuals: Residuals, kind: str) -> Residuals:
    """The residuals as angles (of a direct instrument: its count): those of ``kind`` rate integrated over each segment."""
    if kind != "rate":
        return residuals
    step = np.diff(residuals.t, prepend=residuals.t[:1])
    step[np.diff(residuals.segment, prepend=residuals.segment[:1]) != 0] = 0.0
    before, after = (
        np.cumsum(step * 0.5 * (rate + np.concatenate((rate[:1], rate[:-1]))))
        for rate in (residuals.before, residuals.after)
    )
    return replace(residuals, before=before, after=after, unit=integral_unit(residuals.unit))


def count_size(psi: Array) -> float:
    """Angle of one count [rad], if all angles lie on the grid of one count; else 0."""
    part = np.unique(psi[np.isfinite(psi)][:20_000])
    steps = np.unique(np.append(np.diff(part), 0.0))
    steps = np.diff(steps)[np.diff(steps) > 1e-9]  # counts by which two distances of angles differ
    if not steps.size:
        return 0.0
    reach = float(part[-1] - part[0])
    count = reach / round(reach / float(steps.min()))
    off = (part - part[0]) / count
    return count if float(np.abs(off - np.round(off)).max()) < 0.01 else 0.0


def find_residuals(design: Design, values: Array, noise: Noise) -> Residuals:
    """Residual angle of every sample before and after calibration, and the whitened residual.

    'Before' is the nominal instrument: ``alpha' = K a_x - Omega_x`` with the nominal K. The residual angle of every
    stretch has zero mean, because the zero of a stretch contains no information. For a rate log the residuals are rates
    [rad/s].
    """
    run = design.run
    d, h = residual_increments(design, values)
    before = _nominal_increments(design)
    whitened = Whitener(design.mode, noise, 1, run.median_step).column(d, h)
    variances, segment = noise.rate_variances(len(run.labels)), run.segment_index
    if design.mode == "increments" and variances.any():
        rates = Whitener(design.mode, noise, 1, run.median_step).column(h, h)
        square = np.bincount(segment, rates**2, minlength=variances.size)
        product = np.bincount(segment, rates * whitened, minlength=variances.size)
        whitened -= (rate_share(variances, square) * product)[segment] * rates
    if not design.point:
        stretch_angles(d, run.begins)
        stretch_angles(before, run.begins)
    columns = (run.row, run.t, design.phase_angle, run.f[:, 0], before, d, whitened, segment)
    return Residuals(*columns, unit=run.output_unit)


def _nominal_increments(design: Design) -> Array:
    run = design.run
    if design.point:
        step = run.output - run.scale_factor * run.f[:, 0]
        if run.base_rate is not None:
            step += run.base_rate[:, 0]
        return stored(step)
    h = changes(run.t)
    turn = middles(run.f[:, 0])
    turn *= -run.scale_factor
    if run.base_rate is not None:
        turn += middles(run.base_rate[:, 0])
    turn *= h
    del h
    step = changes(run.output)
    step += turn
    step[run.begins] = 0.0
    return stored(step)


def stretch_angles(increments: Array, begins: NDArray[np.bool_]) -> None:
    """Running sums of increments (..., n); the mean of every stretch is subtracted. In place."""
    np.cumsum(increments, axis=-1, out=increments)
    starts = np.union1d(0, np.flatnonzero(begins))
    sizes = np.diff(np.append(starts, begins.size))
    increments -= np.repeat(np.add.reduceat(increments, starts, axis=-1) / sizes, sizes, axis=-1)


def segment_table(design: Design, residuals: Residuals) -> tuple[SegmentSummary, ...]:
    """One row per segment."""
    run, rows = design.run, []
    for left, right in pairwise(run.segment_edges().tolist()):
        part, inside = slice(left, right), ~run.begins[left + 1 : right]
        step, output = np.diff(run.t[part])[inside], run.output[part]
        moved = step * middles(output)[1:][inside] if design.point else np.diff(output)[inside]
        rows.append(
            SegmentSummary(
                label=run.labels[int(run.segment_index[left])],
                rows=right - left,
                duration=float(step.sum()),
                mean_a_x=float(run.f[part, 0].mean()),
                turns=None if run.direct else float(moved.sum()) / (2.0 * math.pi),
                rms=root_mean_square(residuals.after[part]),
                rms_before=root_mean_square(residuals.before[part]),
                max_after=largest_size(residuals.after[part]),
            )
        )
    return tuple(rows)


def root_mean_square(values: Array) -> float:
    """Root mean square of values (n,)."""
    return math.sqrt(float(values @ values) / values.size)


def residual_figures(residuals: Residuals) -> dict[str, float]:
    """Root mean square and largest residual before and after (the units of the residuals)."""
    return {
        "residual_rms": root_mean_square(residuals.after),
        "residual_rms_before": root_mean_square(residuals.before),
        "residual_max_before": largest_size(residuals.before),
        "residual_max_after": largest_size(residuals.after),
    }


def diagnose(innovations: Sequence[Array], plain: Diagnostics, *, rounded: bool) -> Diagnostics:
    """``plain`` with tests of the whitened residuals of all runs: variance, lag-1 correlation, portmanteau, shape.

    ``ljung_box`` is the Ljung-Box statistic over 20 lags with its probability. ``excess_kurtosis`` and ``skewness`` are
    0 for normal residuals. ``rounded``: rounding to whole counts may correlate them; a test that fails then says nothing.
    """
    from scipy.special import gammaincc

    x = np.concatenate([own[own != 0.0] for own in innovations])
    n = x.size
    if n < 50:
        return replace(plain, samples=n)
    x -= x.mean()
    square = x * x
    sums = float(square.sum()), float(square @ x), float(square @ square)
    variance = sums[0] / n
    lags = min(LAGS, n // 5)
    products = lagged_products(x, lags)
    correlation = products[1:] / products[0]
    statistic = float(n * (n + 2) * np.sum(correlation**2 / (n - np.arange(1, lags + 1))))
    probability = float(gammaincc(0.5 * lags, 0.5 * statistic))
    white = probability > _WHITE
    return replace(
        plain,
        samples=n,
        variance=variance,
        lag1_correlation=float(correlation[0]),
        ljung_box=statistic,
        ljung_box_lags=lags,
        ljung_box_probability=probability,
        skewness=sums[1] / n / variance**1.5,
        excess_kurtosis=sums[2] / n / variance**2 - 3.0,
        verdict="white"
        if white
        else COUNTED
        if rounded
        else "not white: the model or the noise description is incomplete",
    )


def is_rounded(run: Run, noise: Noise) -> bool:
    """True if the noise of the readings is so small that their rounding to whole counts may correlate."""
    return (
        run.kind != "rate"
        and noise.white + noise.walk * run.median_step < _SHARED_ROUNDING * count_of(run) ** 2
    )


def count_of(run: Run) -> float:
    """Angle of one count [rad]: as stated, or seen from readings that all lie on the grid of one; else 0."""
    if run.resolution > 0.0 or run.kind == "rate":
        return run.resolution
    return count_size(run.output if run.left_out is None else run.output[~run.left_out])


def lagged_products(x: Array, lags: int) -> Array:
    """``sum x[i] x[i + k]`` for k = 0 .. lags."""
    return np.array([x[: max(x.size - k, 0)] @ x[k:] for k in range(lags + 1)])
