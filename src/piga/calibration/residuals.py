"""Residuals of an estimate: per sample and per segment, with tests of the model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from piga.calibration.model.design import Design
from piga.calibration.weights import Noise, Whitener, rate_share, residual_increments
from piga.records.arrays import changes, largest_size, middles, stored
from piga.records.calibration.diagnostics import COUNTED, Diagnostics, Residuals, SegmentScatter, SegmentSummary
from piga.records.run import Run
from piga.results import Array
from piga.units import G0

LAGS = 20
"""Lags of the portmanteau test."""
_WHITE = 1e-3
"""Probability below which whitened residuals are called not white."""
_ROUNDED = 1.0 / 3.0
"""Variance of the noise in counts squared below which neighbouring readings may share their rounding: above it, what is left
of the line of the rounding is below 1 % of a count, ``exp(-2 pi^2 (1/3 - 1/12))``."""


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
        _stretch_angle(d, run.begins)
        _stretch_angle(before, run.begins)
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


def _stretch_angle(increments: Array, begins: NDArray[np.bool_]) -> None:
    """Running sum of increments; the mean of every stretch is subtracted. In place."""
    np.cumsum(increments, out=increments)
    starts = np.union1d(0, np.flatnonzero(begins))
    sizes = np.diff(np.append(starts, begins.size))
    increments -= np.repeat(np.add.reduceat(increments, starts) / sizes, sizes)


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
    """Angle of one count [rad]: as stated, or seen from steps that are all multiples of one value; else 0."""
    if run.resolution > 0.0 or run.kind == "rate":
        return run.resolution
    steps = np.abs(np.diff(run.output[:4096]))
    formed = ~run.begins[1 : steps.size + 1]
    if run.left_out is not None:
        formed &= ~(run.left_out[: steps.size] | run.left_out[1 : steps.size + 1])
    steps = steps[formed]
    different = np.unique(np.round(steps, 12))
    if different.size < 2 or different.size > steps.size // 8:
        return 0.0
    count = float(np.diff(np.unique(np.concatenate(([0.0], different)))).min())
    turns = steps / count
    return count if np.abs(turns - np.round(turns)).max() < 1e-3 else 0.0


def lagged_products(x: Array, lags: int) -> Array:
    """``sum x[i] x[i + k]`` for k = 0 .. lags."""
    return np.array([x[: max(x.size - k, 0)] @ x[k:] for k in range(lags + 1)])
