"""Gross errors of the output. They are detected against a robust fit and left out, sample by sample.

One bad angle sample spoils two increments. A jump spoils only one. Therefore samples are judged, not increments. A
spike is left out, and the increment spans it. A jump begins a new stretch. A stuck reading is left out
for its whole length. The reference is assumed to be right.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga._kernels.estimation.outliers import merge_rows, scan_samples
from piga.calibration.model.design import Design
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.solution import solve
from piga.calibration.noise.levels import Noise
from piga.calibration.noise.weighting import Whitener, residual_increments
from piga.errors import DataError
from piga.reading.signal_checks import largest_size
from piga.records.run import Run
from piga.records.spool import arrays_like, gathered, spans, steps
from piga.results import Array

Flags = NDArray[np.int8]

NORMAL_MEDIAN = 0.6745
"""Median size of a normal deviate of one."""


@dataclass(frozen=True)
class OutlierSettings:
    """Limits for bad samples of the output, and settings of their search (own choices)."""

    false_alarms: float = 0.05
    """Expected number of good samples left out per record."""
    largest_share: float = 0.4
    """Share of bad samples above which a record is refused."""
    least_refused: int = 100
    """Fewest samples of a record that is refused. In a shorter one nothing is left out instead: there the robust fit
    follows half of the samples too easily."""
    robust_rows: int = 200_000
    """Increments used by the robust fit."""
    narrow_core: float = 0.6
    """Ratio of core to spread of the residual increments below which bad samples are suspected; 1 for normal noise."""
    least_miss: float = 1e-7
    """Smallest error [rad, or rad/s] of a bad sample: 0.02 arcsec, finer than any readout."""
    least_counts: float = 1.5
    """Smallest error of a bad sample in counts. A sample that toggles on a path known to half a count is not bad."""
    misfit_pairs: int = 100
    """Neighbouring bad increments above which the model is checked for misfit, in a long record."""
    misfit_part: float = 0.1
    """The same as a part of the samples, in a short record."""
    misfit_least: int = 20
    """Fewest of these pairs."""
    misfit_share: float = 0.8
    """Share of these pairs with errors of the same sign, above which the model is at fault."""
    moved_counts: float = 3.0
    """Least motion of the reading within an increment of the robust fit [counts]."""
    parts_of_a_stretch: int = 8
    """Fewest such increments in a stretch."""
    samples_for_motion: int = 4096
    """Samples used to measure this motion."""
    median_samples: int = 500_000
    """Most increments used for a median."""
    stuck: int = 4
    """Equal readings in a row, off the path, that count as stuck."""
    listed: int = 200_000
    """Most outliers listed one by one; all are counted."""
    named: int = 6
    """Most times named in an event."""
    slip_cost: float = 5.0
    """Chi-square that the choice of a counter slip must gain over wrong readings."""
    wrong_cost: float = 20.0
    """Chi-square that the choice of wrong readings must gain per share of their stretch. If the phases do not decide,
    less than a quarter of a stretch is taken as wrong."""
    judged: int = 100
    """Most stretches with jumps for the comparison of phases, and most segments for its noise levels."""
    sweeps: int = 5
    """Rounds over all stretches."""
    refits: int = 2
    """Fits for the noise levels of this comparison."""


OUTLIERS = OutlierSettings()


@dataclass(frozen=True)
class Misses:
    """Residual increments ``d`` (n,) and their intervals ``h``; samples for a rate log."""

    d: Array
    h: Array
    point: bool

    def small_sample(self, parameters: int) -> float:
        """Factor by which the core of few residuals is too narrow, because the fit has followed it.

        Source: [Rousseeuw1987].
        """
        formed = sum(int(np.count_nonzero(self.h[rows] > 0.0)) for rows in spans(self.h.size))
        return 1.0 + 5.0 / max(formed - parameters, 1)

    @property
    def step(self) -> float:
        """Usual interval [s]."""
        return float(np.median(self._thinned(lambda rows: self.h[rows][self.h[rows] > 0.0])))

    def sizes(self, flags: Flags | None = None) -> Array:
        """Absolute residuals of formed increments, thinned to about ``median_samples``; with ``flags``, good ones only."""

        def chosen(rows: slice) -> Array:
            usable = self.h[rows] > 0.0
            return np.abs(self.d[rows][usable if flags is None else usable & (flags[rows] == 0)])

        return self._thinned(chosen)

    def _thinned(self, part: Callable[[slice], Array]) -> Array:
        every = max(1, self.d.size // OUTLIERS.median_samples)
        return np.concatenate([part(rows)[::every].copy() for rows in spans(self.d.size)])


def limit(count: int, parameters: int) -> float:
    """Standard deviations above which a sample is bad. Of ``count`` good samples ``false_alarms`` exceed it.

    Student's t: the noise level of few samples is itself uncertain.
    """
    from scipy.special import stdtrit

    share = 0.5 * OUTLIERS.false_alarms / max(count, 100)
    return float(-stdtrit(max(count - parameters, 1), share))


def suspicious(d: Array, h: Array, mode: str, noise: Noise, run: Run, parameters: int) -> bool:
    """True if the residuals of a plain fit have tails or a core that normal noise does not have.

    Needs one pass. Half the limit is enough for the tails if the core is narrower than the noise level, because bad
    samples inflate that level. Equal bad samples without tails also inflate it; then the core is far narrower
    than the noise level.
    """
    every = max(1, d.size // 100_000)
    whitener = Whitener("increments", noise, 1)
    largest = biggest = 0.0
    misses, whitened = [np.zeros(0)], [np.zeros(0)]
    for rows in spans(d.size):
        part, interval = np.asarray(d[rows]), np.asarray(h[rows])
        looked = np.flatnonzero(interval > 0.0)[::every]
        white = part if mode == "samples" else whitener.apply_columns(part[None, :], interval)[0]
        for values, kept in ((part, misses), (white, whitened)):
            kept.append(np.abs(values[looked]))
        biggest, largest = max(biggest, largest_size(part)), max(largest, largest_size(white))
    size, shown = np.concatenate(misses), np.concatenate(whitened)
    spread = float(np.sqrt(np.mean(size**2))) if size.size else 0.0
    if biggest <= OUTLIERS.least_miss or spread == 0.0:
        return False
    narrow = (
        float(np.median(size)) / NORMAL_MEDIAN < OUTLIERS.narrow_core * spread
        and spread > 10.0 * OUTLIERS.least_miss
    )
    if narrow and spread > 1.5 * resolution_of(run):
        return True
    unit = spread if mode == "samples" else 1.0
    core = float(np.median(shown)) / NORMAL_MEDIAN / unit
    return largest / unit > limit(d.size, parameters) * min(max(core, 0.5), 1.0)


def robust_values(design: Design) -> Array:
    """Column coefficients (segments, m) of a fit that bad samples do not affect.

    Least absolute residuals by reweighting. A spike spoils two increments by opposite amounts. Bad increments are
    therefore symmetric for any spikes. Then the better half of the increments is fitted alone, twice.
    """
    parts = _thinned(design)
    every = np.concatenate([columns[-1] for _, columns in parts])
    scale = float(np.median(np.abs(every - np.median(every)))) or 1.0
    values = _weighted(design, parts, None, scale)
    for _ in range(40):
        values = _weighted(design, parts, values, scale)
        size = np.concatenate([np.abs(_miss(columns, values[s])) for s, columns in parts])
        smaller = float(np.quantile(size, 0.25)) / 3.0
        if smaller <= 0.0 or smaller > 0.98 * scale:
            break
        scale = smaller
    for _ in range(3):
        bound = float(np.quantile(np.concatenate([np.abs(_miss(c, values[s])) for s, c in parts]), 0.4))
        values = _trimmed(design, parts, values, max(bound, 1e-300))
    return values


def _thinned(design: Design) -> list[tuple[int, Array]]:
    """Columns of about ``robust_rows`` increments at most, each divided by the root of its interval; with segments.

    If a reading mostly stays constant, its increments are joined first. Otherwise their median would be zero.
    """
    count = 1 if design.point else _joined(design.run)
    every = max(1, design.rows // count // OUTLIERS.robust_rows)
    parts = []
    for block in design.blocks():
        starts, h = block.joins(count)
        formed = np.flatnonzero(h > 0.0)[::every]
        columns = block.columns if count == 1 else np.add.reduceat(block.columns, starts, axis=1)
        parts.append((block.segment, columns[:, formed] / np.sqrt(h[formed])))
    return parts


def _joined(run: Run) -> int:
    """Number of increments to join so that half of them move by ``moved_counts``; within a stretch."""
    least, starts = OUTLIERS.moved_counts * resolution_of(run), np.flatnonzero(run.begins)
    longest = int(np.median(np.diff(np.append(starts, run.size)))) // OUTLIERS.parts_of_a_stretch
    at = np.unique(np.linspace(0, run.size - 1, OUTLIERS.samples_for_motion).astype(np.int64))
    stretch = np.searchsorted(starts, at, side="right")
    before, count = gathered(run.output, at), 1
    while least > 0.0 and 2 * count <= longest:
        after = np.minimum(at + count, run.size - 1)
        inside = (np.searchsorted(starts, after, side="right") == stretch) & (after > at)
        if np.median(np.abs(gathered(run.output, after) - before)[inside]) >= least:
            break
        count *= 2
    return count


def _miss(columns: Array, values: Array) -> Array:
    return columns[-1] - values @ columns[:-1]


def _weighted(design: Design, parts: list[tuple[int, Array]], values: Array | None, scale: float) -> Array:
    """One step towards the least absolute residuals; the first step starts from the nominal instrument."""
    summaries = [Reduction.empty(design.names) for _ in design.run.labels]
    for segment, columns in parts:
        weight = np.ones(columns.shape[1])
        if values is not None:
            weight = 1.0 / np.sqrt(np.maximum(np.abs(_miss(columns, values[segment])), scale))
        summaries[segment].absorb(columns * weight)
    return solve(design, summaries).values


def _trimmed(design: Design, parts: list[tuple[int, Array]], values: Array, bound: float) -> Array:
    """Least squares of the increments with residuals up to ``bound``."""
    summaries = [Reduction.empty(design.names) for _ in design.run.labels]
    for segment, columns in parts:
        near = np.abs(_miss(columns, values[segment])) <= bound
        summaries[segment].absorb(np.ascontiguousarray(columns[:, near]))
    try:
        return solve(design, summaries).values
    except np.linalg.LinAlgError:
        return values


def misses_of(design: Design, values: Array) -> Misses:
    """Residuals of the raw record for given column coefficients."""
    d, h = residual_increments(design, values)
    return Misses(d, h, design.point)


def first_noise(misses: Misses, parameters: int) -> Noise:
    """First noise levels: half the core of the increments is angle noise, half is random walk.

    If equal readings give a core of no width, the smallest error of a bad sample replaces it.
    """
    core = float(np.quantile(misses.sizes(), 0.25)) / 0.3186 * misses.small_sample(parameters)
    sigma = max(core, OUTLIERS.least_miss)
    if misses.point:
        return Noise(0.0, sigma**2)
    return Noise(sigma**2 / 3.0, sigma**2 / (3.0 * misses.step))


def later_noise(misses: Misses, noise: Noise, flags: Flags, parameters: int) -> Noise:
    """Noise levels of a fit without bad samples, from the core of its residuals; remaining bad samples have no effect."""
    widened = misses.small_sample(parameters)
    if misses.point:
        good = misses.sizes(flags)
        return Noise(0.0, (float(np.median(good)) / NORMAL_MEDIAN * widened) ** 2)
    whitener = Whitener("increments", noise, 1)
    every = max(1, misses.d.size // OUTLIERS.median_samples)
    whitened = [np.zeros(0)]
    for rows in spans(misses.d.size):
        d, h = misses.d[rows].copy()[None, :], misses.h[rows].copy()
        d[:, flags[rows] == 2], h[flags[rows] == 2] = 0.0, 0.0
        merge_rows(d, h, flags[rows] == 1)
        whitened.append(np.abs(whitener.apply_columns(d, h)[0][h > 0.0][::every]))
    shown = np.concatenate(whitened)
    core = float(np.median(shown)) / NORMAL_MEDIAN * widened if shown.size else 1.0
    factor = min(max(core, 0.2), 1.0) ** 2
    return Noise(noise.white * factor, noise.walk * factor)


def find_flags(misses: Misses, noise: Noise, resolution: float, parameters: int) -> Flags:
    """0 good, 1 left out, 2 first after a jump, for every sample."""
    flags: Flags = arrays_like(misses.d).zeros(misses.d.size, np.int8)
    bound = limit(misses.d.size, parameters)
    if misses.point:
        largest = max(bound * float(np.sqrt(noise.walk)), OUTLIERS.least_miss)
        for rows in spans(flags.size):
            flags[rows] = np.abs(misses.d[rows]) > largest
    else:
        floor = max(OUTLIERS.least_counts * resolution, OUTLIERS.least_miss)
        scan_samples(misses.d, misses.h, noise.white, noise.walk, bound, floor, flags)
    return flags


def is_misfit(run: Run, misses: Misses, flags: Flags) -> bool:
    """True if the marked samples are errors of the model, not of the reading: smooth waves.

    A bad reading changes the sign of the residual from increment to increment, or not at all. If the residuals keep one
    sign while the reading moves, a motion is missing in the model.
    """
    count = alike = 0
    for part in spans(flags.size):
        rows = slice(max(part.start - 1, 0), part.stop)
        moves = (steps(run.output, rows) != 0.0) & (flags[rows] == 1) & (misses.h[rows] > 0.0)
        pairs = moves[1:] & moves[:-1]
        sign = np.sign(misses.d[rows])
        count += int(pairs.sum())
        alike += int(np.count_nonzero((sign[1:] == sign[:-1]) & pairs))
    fewest = max(OUTLIERS.misfit_least, int(OUTLIERS.misfit_part * flags.size))
    return count > min(OUTLIERS.misfit_pairs, fewest) and alike > OUTLIERS.misfit_share * count


def is_too_many(flags: Flags) -> bool:
    """True if a short record has more than the largest share of bad samples.

    Raises
    ------
    DataError
        For a longer record. Gives the share.
    """
    share = count_flags(flags, 1) / flags.size
    if share > OUTLIERS.largest_share and flags.size >= OUTLIERS.least_refused:
        raise DataError(
            f"{100.0 * share:.0f} % of the samples contradict the reference; at most "
            f"{100.0 * OUTLIERS.largest_share:.0f} % can be left out",
            remedy="check the wiring of the output, its unit and the reference, or calibrate a sound part of "
            "the record",
        )
    return share > OUTLIERS.largest_share


def count_flags(flags: Flags, kind: int) -> int:
    """Number of samples with a flag."""
    return sum(int(np.count_nonzero(flags[part] == kind)) for part in spans(flags.size))


def resolution_of(run: Run) -> float:
    """Angle of one count, as stated in the record or as seen from repeated readings."""
    if run.resolution > 0.0 or run.kind == "rate":
        return run.resolution
    every = max(1, run.size // OUTLIERS.median_samples)
    sizes = np.concatenate([np.abs(steps(run.output, part)[::every]) for part in spans(run.size)])
    moved = sizes[sizes > 0.0]
    return float(np.quantile(moved, 0.01)) if moved.size and moved.size < 0.95 * sizes.size else 0.0
