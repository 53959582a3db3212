"""The fit of one run, and its residuals. Linear estimate and weights are computed in turn until both are stable."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from piga.calibration.intervals import parameter_rows
from piga.calibration.model.design import Design
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.request import Request
from piga.calibration.model.solution import Estimate
from piga.calibration.orders import count_size
from piga.calibration.outliers import (
    find_flags,
    first_noise,
    is_misfit,
    is_too_many,
    later_noise,
    leave_out,
    misses_of,
    resolution_of,
    robust_values,
    suspicious,
    without_rates,
)
from piga.calibration.summary import MergedRuns, RunSummary
from piga.calibration.weights import (
    RATE,
    Noise,
    Positions,
    Whitener,
    find_noise,
    find_scatter,
    rate_share,
    reduce_positions,
    residual_increments,
    starting_noise,
    weighting_mode,
)
from piga.errors import CalibrationError
from piga.records.arrays import changes, largest_size, middles, stored
from piga.records.calibration.diagnostics import (
    COUNTED,
    Diagnostics,
    Outlier,
    Residuals,
    SegmentScatter,
    SegmentSummary,
)
from piga.records.run import Run
from piga.results import Array
from piga.units import G0

_REFITS = 4
"""Most fits; the weights are usually stable after two."""
_ROUNDS = 5
"""Most rounds of leaving samples out and fitting again; two or three are usual."""
LAGS = 20
"""Lags of the portmanteau test."""
_WHITE = 1e-3
"""Probability below which whitened residuals are called not white."""
_ROUNDED = 1.0 / 3.0
"""Variance of the noise in counts squared below which neighbouring readings may share their rounding: above it, what is left
of the line of the rounding is below 1 % of a count, ``exp(-2 pi^2 (1/3 - 1/12))``."""


@dataclass(frozen=True)
class Fit:
    """A finished fit of one run.

    ``runs`` holds the triangles of the positions.
    ``values`` (segments, m) are the column coefficients, ``d`` and ``h`` the residual increments and their intervals.
    ``outliers`` are the samples left out.
    """

    design: Design
    mode: str
    runs: MergedRuns
    values: Array
    estimate: Estimate
    d: Array = field(repr=False)
    h: Array = field(repr=False)
    outliers: tuple[Outlier, ...] = ()

    @property
    def run(self) -> Run:
        """The record as used."""
        return self.design.run

    @property
    def request(self) -> Request:
        """The request with the terms of the fit."""
        return self.design.request

    @property
    def summary(self) -> RunSummary:
        """The triangles ``[model | rate | y]`` of the positions, with what is needed to solve them."""
        return replace(self.runs.summaries[0], outliers=self.outliers)

    @property
    def noise(self) -> Noise:
        """The levels that weigh the rows."""
        return self.runs.summaries[0].noise


def fit_run(run: Run, request: Request, stated: tuple[float, ...] = ()) -> Fit:
    """Fit a run. Samples that do not lie on the path of the output are left out first.

    ``stated`` [rad^2/s^2] is the variance of the rate of each segment by the run file.
    """
    fit = plain = _fit(run, request, stated)
    parameters = fit.estimate.parameters
    d = fit.d - _scattered(fit)
    if request.phase_source == "input" or not suspicious(d, fit.h, fit.mode, fit.noise, run, parameters):
        return fit
    plain.design.forget()
    raw = Design(run, request, run.scale_factor)
    resolution = resolution_of(run)
    misses = misses_of(raw, robust_values(raw, plain.runs.layout))
    if fit.noise.rate_variances(len(run.labels)).any():
        misses = without_rates(misses, Positions.of(run).edges, resolution)
    raw.forget()
    noise = first_noise(misses, parameters)
    flags = find_flags(misses, noise, resolution, parameters)
    for _ in range(_ROUNDS):
        if not flags.any() or is_misfit(run, misses, flags) or is_too_many(flags):
            return plain
        cleaned, outliers = leave_out(run, misses, flags, free=request.phases == "per-segment")
        fit.design.forget()
        fit = replace(_fit(cleaned, request, stated), outliers=outliers)
        raw = raw.with_phase_of(fit.design)
        misses = misses_of(raw, fit.values)
        misses = replace(misses, d=misses.d - _scattered(fit))
        raw.forget()
        noise = later_noise(misses, fit.noise, flags, parameters)
        again = find_flags(misses, noise, resolution, parameters)
        if np.array_equal(again, flags):
            break
        flags = again
    return fit


def _fit(run: Run, request: Request, stated: tuple[float, ...]) -> Fit:
    """Alternate between the linear fit and the weights until they agree."""
    raw = Design(run, request, run.scale_factor)
    mode = weighting_mode(raw, request.method)
    if raw.rows <= len(raw.names) + len(set(raw.groups)):
        raise CalibrationError(
            f"the record has {raw.rows} increments, too few for {len(raw.names)} parameters",
            remedy="record longer, or leave terms out",
        )
    positions, given = Positions.of(run), None
    if request.angle_rms is not None and request.angle_random_walk is not None:
        given = Noise(request.angle_rms**2, request.angle_random_walk**2)
    own = () if positions.continuous or not stated else stated
    noise = replace(given or starting_noise(run.resolution, run.median_step), stated=own)
    for refit in range(_REFITS):
        of_rows = replace(noise, scatter=0.0, stated=(), counted=())
        summary = RunSummary.of_rows(raw, of_rows, reduce_positions(raw, mode, noise))
        fit = _solved(raw, mode, summary)
        refined = raw.with_scale_factor(fit.runs.scale_factor_of(fit.estimate))
        levels = given or find_noise(fit.design, fit.d, fit.h, fit.estimate.parameters, mode)
        step = run.median_step
        settled = refined is raw and levels.close_to(noise, step, raw.rows // len(run.labels))
        if settled or refit == _REFITS - 1:
            break
        noise, raw = replace(levels, stated=own), refined
    if given is None and mode != "rates" and not positions.continuous:
        noise = find_scatter(_linear_parts(fit), noise, phases=raw.has_phases)
    weighted = summary.weighted(noise)
    if noise.rate_variances(positions.count).any():
        return _solved(raw, mode, weighted)
    return replace(fit, runs=replace(fit.runs, summaries=(weighted,)))


def _solved(raw: Design, mode: str, summary: RunSummary) -> Fit:
    """The fit with these weights; raises if the record cannot determine what is asked."""
    runs = MergedRuns.of([summary], raw.request.terms)
    _, estimate = runs.solved()
    values = runs.values_in_segments(raw, estimate)
    d, h = residual_increments(raw, values)
    return Fit(raw, mode, runs, values, estimate, d, h)


def _linear_parts(fit: Fit) -> list[Reduction]:
    """Triangles ``[parameters | rate | residual]`` of the positions about the fit, each without a phase of its own."""
    layout, estimate = fit.runs.layout, fit.estimate
    at = list(range(layout.size + (0 if fit.design.has_phases else estimate.phases.size)))
    names, positions = (*map(str, at), RATE), fit.runs.positions(0, estimate)
    return [
        Reduction(names, parameter_rows(layout, estimate, p, at, local=fit.design.has_phases), p.part.count)
        for p in positions
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
    increments = np.repeat(rates, np.diff(positions.edges))
    increments *= np.maximum(fit.h, 0.0)
    return increments


def find_residuals(design: Design, values: Array, noise: Noise, mode: str) -> Residuals:
    """Residual angle of every sample before and after calibration, and the whitened residual.

    'Before' is the nominal instrument: ``alpha' = K a_x - Omega_x`` with the nominal K. The residual angle of every
    stretch has zero mean, because the zero of a stretch contains no information. For a rate log the residuals are rates
    [rad/s].
    """
    run = design.run
    d, h = residual_increments(design, values)
    before = _nominal_increments(design)
    whitened = Whitener(mode, noise, 1, run.median_step).column(d, h)
    variances, segment = noise.rate_variances(len(run.labels)), run.segment_index
    if mode == "increments" and variances.any():
        rates = Whitener(mode, noise, 1, run.median_step).column(h, h)
        square = np.bincount(segment, rates**2, minlength=variances.size)
        product = np.bincount(segment, rates * whitened, minlength=variances.size)
        whitened -= (rate_share(variances, square) * product)[segment] * rates
    if mode != "samples":
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


def segment_scatter(design: Design, residuals: Residuals, noise: Noise) -> SegmentScatter:
    """Scatter of the mean rates of the segments, relative to the scatter expected from the noise.

    In a segment of duration T with n samples, the slope of the residual angle has the variance ``12 r/(n T^2) + q/T`` for
    white noise r and random walk q (an upper bound of the second part is 6/5 of it). Where the output turns by d counts in a
    sample, beside whole ones, the errors of counting repeat d n times, and as many are independent. A scatter of the
    segments, stated or estimated, adds its own variance. The ratio is the root mean square of slope over expected standard
    deviation.
    """
    slopes, expected, slow = [], [], []
    count = count_of(design.run)
    counted = min(noise.white, count**2 / 12.0)
    variances = replace(noise, counted=()).rate_variances(len(design.run.labels))
    for left, right in pairwise(design.run.segment_edges()):
        t = residuals.t[left:right]
        duration = float(t.max() - t.min())
        if right - left < 10 or design.run.begins[left + 1 : right].any() or duration == 0.0:
            continue
        centred = t - t.mean()
        slopes.append(float(centred @ residuals.after[left:right]) / float(centred @ centred))
        slow.append(variances[int(design.run.segment_index[left])])
        rows = right - left
        white = (noise.white - counted) / rows
        if counted > 0.0:
            turned = float(np.diff(design.run.output[left:right]).mean()) / count
            white += counted / max(1.0, rows * abs(turned - round(turned)))
        expected.append(12.0 * white / duration**2 + 1.2 * noise.walk / duration)
    if design.point or len(slopes) < 4 or min(expected) == 0.0:
        return SegmentScatter()
    slope, variance = np.array(slopes), np.array(expected)
    return SegmentScatter(
        root_mean_square(slope / np.sqrt(variance + np.array(slow))),
        root_mean_square(slope) / design.run.scale_factor / G0,
        root_mean_square(slope / np.sqrt(variance)) if noise.scatter > 0.0 else None,
    )


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
    return run.kind != "rate" and noise.white + noise.walk * run.median_step < _ROUNDED * count_of(run) ** 2


def count_of(run: Run) -> float:
    """Angle of one count [rad]: as stated, or seen from readings that all lie on the grid of one; else 0."""
    if run.resolution > 0.0 or run.kind == "rate":
        return run.resolution
    return count_size(run.output if run.left_out is None else run.output[~run.left_out])


def lagged_products(x: Array, lags: int) -> Array:
    """``sum x[i] x[i + k]`` for k = 0 .. lags."""
    return np.array([x[: max(x.size - k, 0)] @ x[k:] for k in range(lags + 1)])
