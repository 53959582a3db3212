"""The fit of one run. Linear estimate and weights are computed in turn until both are stable.

Gross errors of the output are found against a robust fit and taken out of the record, sample by sample. One bad angle sample
spoils two increments. A jump spoils only one. Therefore samples are judged, not increments. A spike is left out, and the
increment spans it. A jump is subtracted from all later readings, and a new stretch begins. A stuck reading is left out for its
whole length. The reference is assumed to be right.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from piga._kernels.estimation import merge_rows, scan_samples
from piga.calibration.intervals import parameter_rows
from piga.calibration.model.design import Design, joined_rows
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.request import Request
from piga.calibration.model.solution import Estimate, Layout, merged_groups, solve_parts
from piga.calibration.summary import MergedRuns, RunSummary
from piga.calibration.weights import (
    RATE,
    Noise,
    Positions,
    Whitener,
    count_of,
    find_noise,
    find_scatter,
    reduce_positions,
    residual_increments,
)
from piga.errors import CalibrationError, DataError
from piga.records.arrays import largest_size
from piga.records.calibration.diagnostics import Event, Outlier
from piga.records.run import Run
from piga.results import Array

Flags = NDArray[np.int8]

_FIRST_NOISE = 1e-9
"""Least count of the first levels [rad]: its quantisation, and a random walk of a hundredth of that per step."""
_REFITS = 4
"""Most fits; the weights are usually stable after two."""
_ROUNDS = 5
"""Most rounds of leaving samples out and fitting again; two or three are usual."""
NORMAL_MEDIAN = 0.6745
"""Median size of a normal deviate of one."""
_NORMAL_QUARTER = 0.3186
"""Size below which a quarter of normal deviates lie."""
_FALSE_ALARMS = 0.05
"""Expected number of good samples left out per record."""
_LARGEST_SHARE = 0.4
"""Share of bad samples above which a record is refused."""
_LEAST_REFUSED = 100
"""Fewest samples of a record that is refused. In a shorter one nothing is left out instead: there the robust fit
follows half of the samples too easily."""
_ROBUST_ROWS = 30_000
"""Increments used by the robust fit."""
_ABSOLUTE_FITS = 20
"""Steps towards the least absolute residuals, before Tukey's weights."""
_TUKEY_FITS = 10
"""Steps with Tukey's weights."""
_TUKEY = 4.685
"""Residual in standard deviations from which on Tukey's weight is zero."""
_NARROW_CORE = 0.6
"""Ratio of core to spread of the residual increments below which bad samples are suspected; 1 for normal noise."""
_LEAST_MISS = 1e-7
"""Smallest error [rad, or rad/s] of a bad sample: 0.02 arcsec, finer than any readout."""
_LEAST_COUNTS = 1.5
"""Smallest error of a bad sample in counts. A sample that toggles on a path known to half a count is not bad."""
_MISFIT_PAIRS = 100
"""Neighbouring bad increments above which the model is checked for misfit, in a long record."""
_MISFIT_PART = 0.1
"""The same as a part of the samples, in a short record."""
_MISFIT_LEAST = 20
"""Fewest of these pairs."""
_MISFIT_SHARE = 0.8
"""Share of these pairs with errors of the same sign, above which the model is at fault."""
_MOVED_COUNTS = 3.0
"""Least motion of the reading within an increment of the robust fit [counts]."""
_PARTS_OF_A_STRETCH = 8
"""Fewest such increments in a stretch."""
_LOOKED = 100_000
"""About as many increments show whether bad samples are suspected."""
_STUCK = 4
"""Equal readings in a row, off the path, that count as stuck."""
_LISTED = 200_000
"""Most outliers listed one by one; all are counted."""
_NAMED = 6
"""Most times named in an event."""


@dataclass(frozen=True)
class Fit:
    """A finished fit of one run.

    ``runs`` holds the triangles of the positions.
    ``values`` (segments, m) are the column coefficients, ``d`` and ``h`` the residual increments and their intervals.
    ``outliers`` are the samples left out.
    """

    design: Design
    runs: MergedRuns
    values: Array
    estimate: Estimate
    d: Array = field(repr=False)
    h: Array = field(repr=False)
    outliers: tuple[Outlier, ...] = ()

    @property
    def noise(self) -> Noise:
        """The levels that weigh the rows."""
        return self.runs.summaries[0].noise


def fit_run(run: Run, request: Request, stated: tuple[float, ...] = ()) -> Fit:
    """Fit a run. Samples that do not lie on the path of the output are left out first.

    ``stated`` [rad^2/s^2] is the variance of the rate of each segment by the run file.
    """
    fit = plain = _fit(run, request, stated)
    if request.phase_source == "input" or not _is_suspicious(fit):
        return fit
    parameters, resolution, raw = fit.estimate.parameters, count_of(run), Design(run, request, run.scale_factor)
    plain.design.forget()
    robust = residual_increments(raw, _robust_values(raw, plain.runs.layout))
    misses = _Misses(*robust, raw.point, parameters)
    if fit.noise.rate_variances(len(run.labels)).any():
        misses = _without_rates(misses, Positions.of(run).edges, resolution)
    raw.forget()
    flags = _find_flags(misses, _first_noise(misses), resolution)
    for _ in range(_ROUNDS):
        if not flags.any() or _is_misfit(run, misses, flags) or _is_too_many(flags):
            return plain
        cleaned, outliers = _leave_out(run, misses, flags, free=request.phases == "per-segment")
        fit.design.forget()
        fit = replace(_fit(cleaned, request, stated), outliers=outliers)
        raw = raw.with_phase_of(fit.design)
        d, h = residual_increments(raw, fit.values)
        misses = _Misses(d - _scattered(fit), h, raw.point, parameters)
        raw.forget()
        again = _find_flags(misses, _later_noise(misses, fit.noise, flags), resolution)
        if np.array_equal(again, flags):
            break
        flags = again
    return fit


def _fit(run: Run, request: Request, stated: tuple[float, ...]) -> Fit:
    """Alternate between the linear fit and the weights until they agree."""
    raw = Design(run, request, run.scale_factor)
    if raw.rows <= len(raw.names) + len(set(raw.groups)):
        raise CalibrationError(
            f"the record has {raw.rows} increments, too few for {len(raw.names)} parameters",
            remedy="record longer, or leave terms out",
        )
    positions, given = Positions.of(run), None
    if request.angle_rms is not None and request.angle_random_walk is not None:
        given = Noise(request.angle_rms**2, request.angle_random_walk**2)
    own = () if positions.continuous or not stated else stated
    white = max(run.resolution, _FIRST_NOISE) ** 2 / 12.0
    noise = replace(given or Noise(white, 0.01 * white / run.median_step), stated=own)
    for refit in range(_REFITS):
        of_rows = replace(noise, scatter=0.0, stated=(), counted=())
        summary = RunSummary.of_rows(raw, of_rows, reduce_positions(raw, noise))
        fit = _solved(raw, summary)
        refined = raw.with_scale_factor(fit.runs.scale_factor_of(fit.estimate))
        levels = given or find_noise(fit.design, fit.d, fit.h, fit.estimate.parameters)
        step = run.median_step
        settled = refined is raw and levels.close_to(noise, step, raw.rows // len(run.labels))
        if settled or refit == _REFITS - 1:
            break
        noise, raw = replace(levels, stated=own), refined
    if given is None and raw.mode != "rates" and not positions.continuous:
        noise = find_scatter(_linear_parts(fit), noise, phases=fit.estimate.phases.size > 1)
    weighted = summary.weighted(noise)
    if noise.rate_variances(positions.count).any():
        return _solved(raw, weighted)
    return replace(fit, runs=replace(fit.runs, summaries=(weighted,)))


def _solved(raw: Design, summary: RunSummary) -> Fit:
    """The fit with these weights; raises if the record cannot determine what is asked."""
    runs = MergedRuns.of([summary], raw.request.terms)
    _, estimate = runs.solved()
    values = runs.values_in_segments(raw, estimate)
    return Fit(raw, runs, values, estimate, *residual_increments(raw, values))


def _linear_parts(fit: Fit) -> list[Reduction]:
    """Triangles ``[parameters | rate | residual]`` of the positions about the fit, each without a phase of its own."""
    layout, estimate, local = fit.runs.layout, fit.estimate, fit.estimate.phases.size > 1
    at = list(range(layout.size + (0 if local else estimate.phases.size)))
    names, positions = (*map(str, at), RATE), fit.runs.positions(0, estimate)
    return [
        Reduction(names, parameter_rows(layout, estimate, p, at, local=local), p.part.count) for p in positions
    ]


def _scattered(fit: Fit) -> Array:
    """Increments by the likeliest rates of the positions, where they scatter; otherwise they would look like bad samples."""
    positions, m = Positions.of(fit.design.run), len(fit.design.names)
    rates = np.zeros(positions.count)
    pairs = zip(fit.runs.positions(0, fit.estimate), positions.segments.tolist(), strict=True)
    for k, (position, segment) in enumerate(pairs):
        rows, variance = position.part.factor, position.variance
        own, missed = rows[:, m], rows[:, -1] - rows[:, :m] @ fit.values[segment]
        rates[k] = variance * (own @ missed) / (1.0 + variance * (own @ own))
    return np.asarray(np.repeat(rates, np.diff(positions.edges)) * np.maximum(fit.h, 0.0))


# -- gross errors of the output ------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Misses:
    """Residual increments ``d`` (n,) and their intervals ``h``; samples for a rate log."""

    d: Array
    h: Array
    point: bool
    parameters: int

    def core(self, sizes: Array, share: float, normal: float) -> float:
        """Standard deviation by the size below which a share of the residuals lie, ``normal`` for a deviation of one.

        The core of few residuals is too narrow, because the fit has followed it. Source: [Rousseeuw1987].
        """
        widened = 1.0 + 5.0 / max(int(np.count_nonzero(self.h > 0.0)) - self.parameters, 1)
        return float(np.quantile(sizes, share)) / normal * widened


def limit(count: int, parameters: int) -> float:
    """Standard deviations above which a sample is bad. Of ``count`` good samples ``_FALSE_ALARMS`` exceed it.

    Student's t: the noise level of few samples is itself uncertain.
    """
    from scipy.special import stdtrit

    share = 0.5 * _FALSE_ALARMS / max(count, 100)
    return float(-stdtrit(max(count - parameters, 1), share))


def _without_rates(misses: _Misses, edges: NDArray[np.int64], resolution: float) -> _Misses:
    """The residuals less the mean rate of each position between ``edges``, where the rates of the positions scatter.

    Increments far from the median of their position do not count. A wrong reading therefore does not tilt its position.
    """
    d, h = misses.d.copy(), misses.h
    for start, stop in pairwise(edges.tolist()):
        formed = start + np.flatnonzero(h[start:stop] > 0.0)
        if not formed.size:
            continue
        away = d[formed] - h[formed] * np.median(d[formed] / h[formed])
        spread = float(np.quantile(np.abs(away), 0.25)) / _NORMAL_QUARTER
        near = formed[np.abs(away) <= max(_TUKEY * spread, 2.0 * resolution)]
        d[start:stop] -= d[near].sum() / h[near].sum() * np.maximum(h[start:stop], 0.0)
    return replace(misses, d=d)


def _is_suspicious(fit: Fit) -> bool:
    """True if the residuals of a plain fit have tails or a core that normal noise does not have.

    Needs one pass. Half the limit is enough for the tails if the core is narrower than the noise level, because bad
    samples inflate that level. Equal bad samples without tails also inflate it; then the core is far narrower
    than the noise level.
    """
    d, h, samples = fit.d - _scattered(fit), fit.h, fit.design.point
    white = d if samples else Whitener("increments", fit.noise, 1).column(d, h)
    looked = np.flatnonzero(h > 0.0)[:: max(1, d.size // _LOOKED)]
    size, shown = np.abs(d[looked]), np.abs(white[looked])
    spread = float(np.sqrt(np.mean(size**2))) if size.size else 0.0
    if largest_size(d) <= _LEAST_MISS or spread == 0.0:
        return False
    narrow = float(np.median(size)) / NORMAL_MEDIAN < _NARROW_CORE * spread and spread > 10.0 * _LEAST_MISS
    if narrow and spread > 1.5 * count_of(fit.design.run):
        return True
    unit = spread if samples else 1.0
    core = float(np.median(shown)) / NORMAL_MEDIAN / unit
    return largest_size(white) / unit > limit(d.size, fit.estimate.parameters) * min(max(core, 0.5), 1.0)


def _robust_values(design: Design, layout: Layout) -> Array:
    """Column coefficients (segments, m) of a fit that bad samples do not affect: iteratively reweighted least squares.

    The weights of the least absolute residuals come first, then Tukey's. A spike spoils two increments by opposite amounts.
    Bad increments are therefore symmetric for any spikes. The spread is that of the best quarter of the increments, because more
    than half of them may be bad.
    """
    parts = _parts(design)
    values = _weighted(design, layout, parts, [np.ones(columns.shape[1]) for _, columns in parts])
    for step in range(_ABSOLUTE_FITS + _TUKEY_FITS):
        sizes = [np.abs(columns[-1] - values[s] @ columns[:-1]) for s, columns in parts]
        spread = max(float(np.quantile(np.concatenate(sizes), 0.25)) / _NORMAL_QUARTER, 1e-300)
        if step < _ABSOLUTE_FITS:
            weights = [1.0 / np.sqrt(np.maximum(size, 0.1 * spread) / spread) for size in sizes]
        else:
            weights = [1.0 - np.minimum(size / (_TUKEY * spread), 1.0) ** 2 for size in sizes]
        try:
            values = _weighted(design, layout, parts, weights)
        except np.linalg.LinAlgError:
            return values
    return values


def _parts(design: Design) -> list[tuple[int, Array]]:
    """Columns of about ``_ROBUST_ROWS`` increments at most, each divided by the root of its interval; with segments.

    If a reading mostly stays constant, its increments are joined first. Otherwise their median would be zero.
    """
    count = 1 if design.point else _joined(design.run)
    every = max(1, design.rows // count // _ROBUST_ROWS)
    parts = []
    for block in design.blocks():
        starts, h = joined_rows(block.h, count)
        formed = np.flatnonzero(h > 0.0)[::every]
        columns = block.columns if count == 1 else np.add.reduceat(block.columns, starts, axis=1)
        parts.append((block.segment, columns[:, formed] / np.sqrt(h[formed])))
    return parts


def _joined(run: Run) -> int:
    """Number of increments to join so that half of them move by ``_MOVED_COUNTS``; within a stretch."""
    least, starts = _MOVED_COUNTS * count_of(run), np.flatnonzero(run.begins)
    longest = int(np.median(np.diff(np.append(starts, run.size)))) // _PARTS_OF_A_STRETCH
    count, home = 1, np.cumsum(run.begins)
    while least > 0.0 and 2 * count <= longest:
        inside = home[count:] == home[:-count]
        if np.median(np.abs(run.output[count:] - run.output[:-count])[inside]) >= least:
            break
        count *= 2
    return count


def _weighted(design: Design, layout: Layout, parts: list[tuple[int, Array]], weights: list[Array]) -> Array:
    """Column coefficients (segments, m) of weighted least squares; ``weights`` are roots."""
    summaries = [Reduction.empty(design.names) for _ in design.run.labels]
    for (segment, columns), weight in zip(parts, weights, strict=True):
        used = weight > 0.0
        summaries[segment].absorb(np.ascontiguousarray(columns[:, used] * weight[used]))
    groups = merged_groups(summaries, design.groups)
    estimate = solve_parts(layout, groups)
    phases = estimate.phases if layout.coupled else np.zeros(len(groups))
    return np.array([layout.linear(estimate.amplitudes, phases[g], g) for g in design.groups])


def _first_noise(misses: _Misses) -> Noise:
    """First noise levels: half the core of the increments is angle noise, half is random walk.

    If equal readings give a core of no width, the smallest error of a bad sample replaces it.
    """
    formed = misses.h > 0.0
    sigma = max(misses.core(np.abs(misses.d[formed]), 0.25, _NORMAL_QUARTER), _LEAST_MISS)
    if misses.point:
        return Noise(0.0, sigma**2)
    return Noise(sigma**2 / 3.0, sigma**2 / (3.0 * float(np.median(misses.h[formed]))))


def _later_noise(misses: _Misses, noise: Noise, flags: Flags) -> Noise:
    """Noise levels of a fit without bad samples, from the core of its residuals; remaining bad samples have no effect."""
    if misses.point:
        good = np.abs(misses.d[(misses.h > 0.0) & (flags == 0)])
        return Noise(0.0, misses.core(good, 0.5, NORMAL_MEDIAN) ** 2)
    d, h = misses.d[None, :].copy(), misses.h.copy()
    d[:, flags == 2], h[flags == 2] = 0.0, 0.0
    merge_rows(d, h, flags == 1)
    shown = np.abs(Whitener("increments", noise, 1).column(d[0], h)[h > 0.0])
    core = misses.core(shown, 0.5, NORMAL_MEDIAN) if shown.size else 1.0
    factor = min(max(core, 0.2), 1.0) ** 2
    return Noise(noise.white * factor, noise.walk * factor)


def _find_flags(misses: _Misses, noise: Noise, resolution: float) -> Flags:
    """0 good, 1 left out, 2 first after a jump, for every sample."""
    bound = limit(misses.d.size, misses.parameters)
    if misses.point:
        largest = max(bound * float(np.sqrt(noise.walk)), _LEAST_MISS)
        return (np.abs(misses.d) > largest).astype(np.int8)
    flags: Flags = np.zeros(misses.d.size, np.int8)
    floor = max(_LEAST_COUNTS * resolution, _LEAST_MISS)
    scan_samples(misses.d, misses.h, noise.white, noise.walk, bound, floor, flags)
    return flags


def _is_misfit(run: Run, misses: _Misses, flags: Flags) -> bool:
    """True if the marked samples are errors of the model, not of the reading: smooth waves.

    A bad reading changes the sign of the residual from increment to increment, or not at all. If the residuals keep one
    sign while the reading moves, a motion is missing in the model.
    """
    moves = (np.diff(run.output, prepend=run.output[0]) != 0.0) & (flags == 1) & (misses.h > 0.0)
    pairs, sign = moves[1:] & moves[:-1], np.sign(misses.d)
    count, alike = int(pairs.sum()), int(np.count_nonzero((sign[1:] == sign[:-1]) & pairs))
    fewest = max(_MISFIT_LEAST, int(_MISFIT_PART * flags.size))
    return count > min(_MISFIT_PAIRS, fewest) and alike > _MISFIT_SHARE * count


def _is_too_many(flags: Flags) -> bool:
    """True if a short record has more than the largest share of bad samples.

    Raises
    ------
    DataError
        For a longer record. Gives the share.
    """
    share = float(np.mean(flags == 1))
    if share > _LARGEST_SHARE and flags.size >= _LEAST_REFUSED:
        raise DataError(
            f"{100.0 * share:.0f} % of the samples contradict the reference; at most "
            f"{100.0 * _LARGEST_SHARE:.0f} % can be left out",
            remedy="check the wiring of the output, its unit and the reference, or calibrate a sound part of "
            "the record",
        )
    return share > _LARGEST_SHARE


def _leave_out(run: Run, misses: _Misses, flags: Flags, *, free: bool) -> tuple[Run, tuple[Outlier, ...]]:
    """The record without bad samples, and the outliers.

    The output of bad samples is replaced by the prediction of the model; only the phase of the coupling uses it. A jump
    is subtracted from all later samples, and a new stretch begins there. ``free``: each segment has a phase of its own, so
    no jump reaches into the next segment.
    """
    anew = run.segment_edges()[:-1] if free else np.zeros(0, dtype=np.int64)
    wrong = (
        np.where(flags == 0, 0.0, misses.d)
        if misses.point
        else _errors_of_readings(misses.d, run.begins, flags, anew)
    )
    left_out, begins = flags == 1, run.begins | (flags == 2)
    good, starts = np.flatnonzero(~left_out), np.flatnonzero(begins & left_out)
    later = np.searchsorted(good, starts)
    begins[good[later[later < good.size]]] = True
    found, count = tuple(_findings(run, flags, wrong)), int(left_out.sum())
    quality = replace(
        run.quality,
        used=run.quality.used - count,
        masked=run.quality.masked + count,
        events=(*run.quality.events, *_events(found, run.direct)),
    )
    cleaned = replace(run, output=run.output - wrong, begins=begins, left_out=left_out, quality=quality)
    return cleaned, found[:_LISTED]


def _errors_of_readings(d: Array, begins: NDArray[np.bool_], flags: Flags, anew: NDArray[np.int64]) -> Array:
    """Error of every reading (n,) [rad]: the jumps so far, and spikes relative to their good neighbours.

    ``d`` (n,) are residual increments. A jump (flag 2) is the change of the residual angle since the last good sample. The
    residual angle without jumps is linear between good samples of a stretch and constant outside them. From the rows
    ``anew`` on no earlier jump counts.
    """
    wrong, shift = np.zeros(d.size), 0.0
    starts = np.union1d(np.flatnonzero(begins), np.append(0, anew))
    fresh = np.isin(starts, anew)
    for k, (start, stop) in enumerate(pairwise([*starts.tolist(), d.size])):
        shift = 0.0 if fresh[k] else shift
        kind = flags[start:stop]
        if not kind.any():
            wrong[start:stop] = shift
            continue
        angle, jumped = np.cumsum(d[start:stop]) - d[start], np.zeros(stop - start)
        calm, good, bad = np.flatnonzero(kind == 0), np.flatnonzero(kind != 1), np.flatnonzero(kind == 1)
        for at in np.flatnonzero(kind == 2):
            before = int(np.searchsorted(calm, at)) - 1
            if before >= 0:
                jumped[at:] += angle[at] - angle[calm[before]] - (jumped[at] - jumped[calm[before]])
        wrong[start:stop] = shift + jumped
        if good.size:
            wrong[start + bad] = shift + angle[bad] - np.interp(bad, good, angle[good] - jumped[good])
        shift += float(jumped[-1])
    return wrong


def _findings(run: Run, flags: Flags, wrong: Array) -> Iterator[Outlier]:
    """Runs of bad samples, and jumps, in order of time."""
    edges = np.append(np.flatnonzero((np.diff(flags, prepend=np.int8(0)) != 0) | (flags == 2)), flags.size)
    for start, stop in pairwise(edges.tolist()):
        if flags[start] == 0:
            continue
        first, near = max(start - 1, 0), max(start - 1000, 0)
        kind, samples = "spike", stop - start
        size = float(np.abs(wrong[start:stop] - wrong[first]).max())
        if flags[start] == 2:
            good = near + np.flatnonzero(flags[near:start] != 1)
            size = float(abs(wrong[start] - (wrong[good[-1]] if good.size else 0.0)))
            kind, samples = "jump", 0
        elif samples >= _STUCK and (np.diff(run.output[first:stop]) == 0.0).mean() > 0.5:
            kind = "stuck"
        if samples or size:
            yield Outlier(kind, float(run.t[start]), int(run.row[start]), samples, size)


_WORDS = {
    "spike": "samples off the path of the output are left out",
    "stuck": "samples during which the output stood still are left out",
    "jump": "no increment is formed across it, and all later readings are corrected by it",
}
_ANOTHER_PHASE = (
    ". If only the readings before or after it are wrong, the phase after it is another one: "
    "phases = 'per-segment' shows it"
)
"""What follows for a jump, if the instrument has a phase that it may lose."""


def _events(found: tuple[Outlier, ...], direct: bool) -> Iterator[Event]:
    """Events for the findings, by kind."""
    for kind, words in _WORDS.items():
        those = [outlier for outlier in found if outlier.kind == kind]
        if those:
            times = ", ".join(f"{outlier.time:.6g}" for outlier in those[:_NAMED])
            more = " and more" if len(those) > _NAMED else ""
            also = _ANOTHER_PHASE if kind == "jump" and not direct else ""
            count = sum(max(outlier.samples, 1) for outlier in those)
            yield Event(f"outlier-{kind}", count, those[0].row, f"t = {times}{more} s: {words}{also}")
