"""Residuals of a fit: their figures and tests, and the scatter of the segments."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from piga.calibration.intervals import Repetition
from piga.calibration.model.design import Design
from piga.calibration.weights import Noise, Whitener, rate_share, residual_increments
from piga.records.arrays import changes, largest_size, middles, stored
from piga.records.calibration.diagnostics import (
    COUNTED,
    Diagnostics,
    Residuals,
    SegmentSummary,
)
from piga.records.run import Run
from piga.records.terms import integral_unit
from piga.results import Array
from piga.units import G0

LAGS = 20
"""Lags of the portmanteau test."""
_WHITE = 1e-3
"""Probability below which whitened residuals are called not white."""
_ROUNDED = 1.0 / 3.0
"""Variance of the noise in counts squared below which neighbouring readings may share their rounding: above it, what is left
of the line of the rounding is below 1 % of a count, ``exp(-2 pi^2 (1/3 - 1/12))``."""
_FEWEST_SEGMENTS = 4
"""Fewest segments whose scatter is told."""


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


def segment_scatter(positions: Sequence[Repetition], values: Array, noise: Noise, run: Run) -> Diagnostics:
    """Scatter of the mean rates of the positions, over the scatter that the noise explains.

    ``values`` (positions, m) are the column coefficients. The ratio is the root mean square of a residual rate over the
    standard deviation that its rows give it. A scatter of the segments, stated or estimated, adds its own variance. Where the
    output turns by m counts beside whole ones in each reading, m readings share their rounding.
    """
    if len(positions) < _FEWEST_SEGMENTS or positions[0].block:
        return Diagnostics()
    m = values.shape[1]
    rows = np.array([p.part.factor for p in positions])
    along, missed = rows[:, :, m], rows[:, :, -1] - np.einsum("jkm,jm->jk", rows[:, :, :m], values)
    known, count = (along**2).sum(axis=1), count_of(run)
    if not known.all():
        return Diagnostics()
    rate, variance = (along * missed).sum(axis=1) / known, 1.0 / known + [p.variance for p in positions]
    if count > 0.0:
        edges, duration = run.segment_edges(), np.array([p.end - p.begin for p in positions])
        turned, rows = run.output[edges[1:] - 1] - run.output[edges[:-1]], np.diff(edges)
        beside = np.abs(turned / count - rows * np.round(turned / count / rows))
        variance += min(12.0 * noise.white, count**2) / np.maximum(1.0, beside) / duration**2
    return Diagnostics(
        root_mean_square(rate / np.sqrt(variance)),
        root_mean_square(rate) / run.scale_factor / G0,
        root_mean_square(rate / np.sqrt(variance - noise.scatter)) if noise.scatter > 0.0 else None,
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
