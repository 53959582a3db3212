"""Gross errors of the output: found against a robust fit and left out, sample by sample.

In increments of an angle one bad sample spoils two increments and a jump one for good; so samples are
judged, not increments: a spike's sample goes and the increment reaches across it, a jump begins a new
stretch, a stuck reading is left out as long as it lasts. The reference is taken as right.
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
from piga.records.run import Run
from piga.records.spool import arrays_like, gathered, spans, steps

Array = NDArray[np.float64]
Flags = NDArray[np.int8]


@dataclass(frozen=True)
class OutlierSettings:
    """When a sample of the output counts as bad, and how bad samples are looked for (own choices).

    Attributes
    ----------
    false_alarms:
        Good samples left out per record, expected.
    largest_share:
        Share of bad samples above which a record is refused.
    robust_rows:
        Increments that the robust fit looks at.
    narrow_core:
        Core of the residual increments over their spread below which bad samples are suspected; 1 for normal noise.
    least_miss:
        Smallest miss [rad, or rad/s] of a bad sample: 0.02 arcsec, finer than any readout.
    least_counts:
        Counts by which a bad sample must miss: one that toggles on a path known to half a count is not bad.
    misfit_pairs:
        Neighbouring bad increments above which the model may be at fault.
    misfit_share:
        Share of them that miss to the same side, above which the model is at fault.
    moved_counts:
        Counts by which a reading shall move between the ends of an increment of the robust fit.
    parts_of_a_stretch:
        Increments of that kind that a stretch must have.
    samples_for_motion:
        Samples that are looked at for that.
    median_samples:
        Increments that medians are taken of at most.
    stuck:
        Equal readings in a row, off the path, that count as stuck.
    listed:
        Outliers that a result lists one by one; all are counted.
    named:
        Times named in an event.
    slip_cost:
        Chi-square that a slip of the counter must gain over wrong readings.
    wrong_cost:
        Chi-square that wrong readings must gain for each share of their stretch: where phases do not tell, less than a
        quarter of a stretch is taken for wrong.
    judged:
        Stretches with jumps up to which phases are asked, and segments up to which noise is looked at for that.
    sweeps:
        Rounds of asking one stretch after the other.
    refits:
        Fits that give the noise levels for it.
    """

    false_alarms: float = 0.05
    largest_share: float = 0.4
    robust_rows: int = 200_000
    narrow_core: float = 0.6
    least_miss: float = 1e-7
    least_counts: float = 1.5
    misfit_pairs: int = 100
    misfit_share: float = 0.8
    moved_counts: float = 3.0
    parts_of_a_stretch: int = 8
    samples_for_motion: int = 4096
    median_samples: int = 500_000
    stuck: int = 4
    listed: int = 200_000
    named: int = 6
    slip_cost: float = 5.0
    wrong_cost: float = 20.0
    judged: int = 100
    sweeps: int = 5
    refits: int = 2


OUTLIERS = OutlierSettings()


@dataclass(frozen=True)
class Misses:
    """Residual increments (samples of a rate log) ``d`` (n,) and their intervals ``h``."""

    d: Array
    h: Array
    point: bool

    @property
    def step(self) -> float:
        """Usual interval [s]."""
        return float(np.median(self._thinned(lambda rows: self.h[rows][self.h[rows] > 0.0])))

    def sizes(self, flags: Flags | None = None) -> Array:
        """Absolute residuals of increments that were formed, thinned to about ``median_samples``; with ``flags`` of good ones."""

        def chosen(rows: slice) -> Array:
            usable = self.h[rows] > 0.0
            return np.abs(self.d[rows][usable if flags is None else usable & (flags[rows] == 0)])

        return self._thinned(chosen)

    def _thinned(self, part: Callable[[slice], Array]) -> Array:
        every = max(1, self.d.size // OUTLIERS.median_samples)
        return np.concatenate([part(rows)[::every].copy() for rows in spans(self.d.size)])


def limit(count: int) -> float:
    """Standard deviations beyond which a sample is bad: ``false_alarms`` of ``count`` normal ones are."""
    from scipy.special import ndtri

    return float(-ndtri(0.5 * OUTLIERS.false_alarms / max(count, 100)))


def suspicious(d: Array, h: Array, mode: str, noise: Noise, run: Run) -> bool:
    """True when the residuals of a plain fit have tails, or a core, that normal noise has not.

    Cheap: one pass. Half the limit is enough for the tails where the core is narrower than the noise found,
    for bad samples inflate that; so do equal ones without tails, which a core far narrower than all shows.
    """
    every = max(1, d.size // 100_000)
    whitener = Whitener("increments", noise, 1)
    largest = biggest = 0.0
    misses, whitened = [np.zeros(0)], [np.zeros(0)]
    for rows in spans(d.size):
        part, interval = np.asarray(d[rows]), np.asarray(h[rows])
        formed = interval > 0.0
        white = part if mode == "samples" else whitener.apply_columns(part[None, :], interval)[0]
        for values, kept in ((np.abs(part[formed]), misses), (np.abs(white[formed]), whitened)):
            kept.append(values[::every].copy())
        biggest = max(biggest, float(np.abs(part).max()))
        largest = max(largest, float(np.abs(white).max()))
    size, shown = np.concatenate(misses), np.concatenate(whitened)
    spread = float(np.sqrt(np.mean(size**2))) if size.size else 0.0
    if biggest <= OUTLIERS.least_miss or spread == 0.0:
        return False
    narrow = (
        float(np.median(size)) / 0.6745 < OUTLIERS.narrow_core * spread and spread > 10.0 * OUTLIERS.least_miss
    )
    if narrow and spread > 1.5 * resolution_of(run):
        return True
    unit = spread if mode == "samples" else 1.0
    core = float(np.median(shown)) / 0.6745 / unit
    return largest / unit > limit(d.size) * min(max(core, 0.5), 1.0)


def robust_values(design: Design) -> Array:
    """Column coefficients (segments, m) of a fit that bad samples do not move.

    Least absolute residuals by reweighting: a spike spoils two increments by opposite amounts, so that bad
    increments are symmetric whatever the spikes are. Then the half that fits best, alone, twice.
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
    """Columns of at most about ``robust_rows`` increments, each divided by the root of its interval; with their segment.

    Increments of a reading that mostly stands still are joined first: nothing moves their median.
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
    """Increments to be joined so that the reading moves by ``moved_counts`` in half of them; within a stretch."""
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
    """One step towards the least absolute residuals; from the nominal instrument when there is none before."""
    summaries = [Reduction.empty(design.names) for _ in design.run.labels]
    for segment, columns in parts:
        weight = np.ones(columns.shape[1])
        if values is not None:
            weight = 1.0 / np.sqrt(np.maximum(np.abs(_miss(columns, values[segment])), scale))
        summaries[segment].absorb(columns * weight)
    return solve(design, summaries).values


def _trimmed(design: Design, parts: list[tuple[int, Array]], values: Array, bound: float) -> Array:
    """Least squares of the increments that missed by no more than ``bound``."""
    summaries = [Reduction.empty(design.names) for _ in design.run.labels]
    for segment, columns in parts:
        near = np.abs(_miss(columns, values[segment])) <= bound
        summaries[segment].absorb(np.ascontiguousarray(columns[:, near]))
    try:
        return solve(design, summaries).values
    except np.linalg.LinAlgError:
        return values


def misses_of(design: Design, values: Array) -> Misses:
    """Residuals of the raw record under given column coefficients."""
    d, h = residual_increments(design, values)
    return Misses(d, h, design.point)


def first_noise(misses: Misses) -> Noise:
    """Levels for the first look: the core of the increments, half of it angle noise and half random walk.

    A core of equal readings has no width; the smallest miss that can be bad stands for it.
    """
    sigma = max(float(np.quantile(misses.sizes(), 0.25)) / 0.3186, OUTLIERS.least_miss)
    if misses.point:
        return Noise(0.0, sigma**2)
    return Noise(sigma**2 / 3.0, sigma**2 / (3.0 * misses.step))


def later_noise(misses: Misses, noise: Noise, flags: Flags) -> Noise:
    """Levels of a fit without bad samples, by the core of what it leaves: none left over inflates them."""
    if misses.point:
        good = misses.sizes(flags)
        return Noise(0.0, (float(np.median(good)) / 0.6745) ** 2)
    whitener = Whitener("increments", noise, 1)
    every = max(1, misses.d.size // OUTLIERS.median_samples)
    whitened = [np.zeros(0)]
    for rows in spans(misses.d.size):
        d, h = misses.d[rows].copy()[None, :], misses.h[rows].copy()
        d[:, flags[rows] == 2], h[flags[rows] == 2] = 0.0, 0.0
        merge_rows(d, h, flags[rows] == 1)
        whitened.append(np.abs(whitener.apply_columns(d, h)[0][h > 0.0][::every]))
    shown = np.concatenate(whitened)
    core = float(np.median(shown)) / 0.6745 if shown.size else 1.0
    factor = min(max(core, 0.2), 1.0) ** 2
    return Noise(noise.white * factor, noise.walk * factor)


def find_flags(misses: Misses, noise: Noise, resolution: float) -> Flags:
    """0 good, 1 left out, 2 first after a jump, for every sample."""
    flags: Flags = arrays_like(misses.d).zeros(misses.d.size, np.int8)
    bound = limit(misses.d.size)
    if misses.point:
        largest = max(bound * float(np.sqrt(noise.walk)), OUTLIERS.least_miss)
        for rows in spans(flags.size):
            flags[rows] = np.abs(misses.d[rows]) > largest
    else:
        floor = max(OUTLIERS.least_counts * resolution, OUTLIERS.least_miss)
        scan_samples(misses.d, misses.h, noise.white, noise.walk, bound, floor, flags)
    return flags


def is_misfit(run: Run, misses: Misses, flags: Flags) -> bool:
    """True when what was marked is the model's failure, not the reading's: it misses by smooth waves.

    A bad reading changes sign from increment to increment or not at all; increments that go on missing to
    the same side while the reading moves are of a motion that the model does not hold.
    """
    count = alike = 0
    for part in spans(flags.size):
        rows = slice(max(part.start - 1, 0), part.stop)
        moves = (steps(run.output, rows) != 0.0) & (flags[rows] == 1) & (misses.h[rows] > 0.0)
        pairs = moves[1:] & moves[:-1]
        sign = np.sign(misses.d[rows])
        count += int(pairs.sum())
        alike += int(np.count_nonzero((sign[1:] == sign[:-1]) & pairs))
    return count > OUTLIERS.misfit_pairs and alike > OUTLIERS.misfit_share * count


def refuse_if_too_many(flags: Flags) -> None:
    """Raise when more than the largest share of the samples are bad.

    Raises
    ------
    DataError
        With the share.
    """
    share = count_flags(flags, 1) / flags.size
    if share > OUTLIERS.largest_share:
        raise DataError(
            f"{100.0 * share:.0f} % of the samples do not lie on any path that the reference allows; up to "
            f"{100.0 * OUTLIERS.largest_share:.0f} % would be left out",
            remedy="check the wiring of the output, its unit and the reference; calibrate a part that is sound",
        )


def count_flags(flags: Flags, kind: int) -> int:
    """Samples of a kind."""
    return sum(int(np.count_nonzero(flags[part] == kind)) for part in spans(flags.size))


def resolution_of(run: Run) -> float:
    """Angle of a count, also where the record does not say so but repeats its readings."""
    if run.resolution > 0.0 or run.kind == "rate":
        return run.resolution
    every = max(1, run.size // OUTLIERS.median_samples)
    sizes = np.concatenate([np.abs(steps(run.output, part)[::every]) for part in spans(run.size)])
    moved = sizes[sizes > 0.0]
    return float(np.quantile(moved, 0.01)) if moved.size and moved.size < 0.95 * sizes.size else 0.0
