"""Residuals of an estimate: per sample, per segment, and what they say about the model."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from piga._kernels.statistics import lagged_products
from piga.calibration.design import Design
from piga.calibration.noise import Noise
from piga.calibration.weighting import Whitener, residual_increments
from piga.records.calibration import Residuals, SegmentSummary
from piga.units import G0

Array = NDArray[np.float64]


def find_residuals(design: Design, values: Array, noise: Noise, mode: str) -> Residuals:
    """Residual angle of every sample before and after calibration, and the whitened residual.

    'Before' is the nominal instrument: ``alpha' = K a_x - Omega_x`` with the nominal K. In every stretch
    the residual angle starts from its own mean (the zero of a stretch carries no information). For a
    rate log the residuals are rates [rad/s].
    """
    run = design.run
    d, h = residual_increments(design, values)
    before = _nominal_increments(design)
    whitened = Whitener(mode, noise, 1).apply_columns(d[None, :], h)[0]
    if mode == "samples":
        after_angle, before_angle = d, before
        whitened = whitened / (np.sqrt(np.mean(d**2)) or 1.0)
    else:
        after_angle = _stretch_angle(d, run.begins)
        before_angle = _stretch_angle(before, run.begins)
    return Residuals(
        run.row, run.t, design.phase_angle, run.f[:, 0], before_angle, after_angle, whitened, run.segment
    )


def _nominal_increments(design: Design) -> Array:
    run = design.run
    if design.point:
        omega = 0.0 if run.base_rate is None else run.base_rate[:, 0]
        return run.output + omega - run.scale_factor * run.f[:, 0]
    h = np.diff(run.t)
    step = np.diff(run.output) - run.scale_factor * h * 0.5 * (run.f[1:, 0] + run.f[:-1, 0])
    if run.base_rate is not None:
        step += h * 0.5 * (run.base_rate[1:, 0] + run.base_rate[:-1, 0])
    step[run.begins[1:]] = 0.0
    return np.concatenate(([0.0], step))


def _stretch_angle(increments: Array, begins: NDArray[np.bool_]) -> Array:
    """Running sum of increments, with the mean of every stretch taken off."""
    total = np.cumsum(increments)
    starts = np.flatnonzero(begins)
    counts = np.diff(np.append(starts, begins.size))
    means = np.add.reduceat(total, starts) / counts
    return total - np.repeat(means, counts)


def segment_table(design: Design, residuals: Residuals) -> tuple[SegmentSummary, ...]:
    """One row per segment."""
    run = design.run
    edges = np.concatenate(([0], np.flatnonzero(np.diff(run.segment)) + 1, [run.size]))
    rows = []
    for left, right in pairwise(edges):
        part = slice(int(left), int(right))
        inside = ~run.begins[part][1:]
        h = np.diff(run.t[part])
        turned = (
            h * 0.5 * (run.output[part][1:] + run.output[part][:-1])
            if design.point
            else np.diff(run.output[part])
        )
        rows.append(
            SegmentSummary(
                label=run.labels[int(run.segment[left])],
                rows=int(right - left),
                duration=float(h[inside].sum()),
                mean_a_x=float(run.f[part, 0].mean()),
                turns=float(turned[inside].sum() / (2.0 * math.pi)),
                rms=_rms(residuals.after[part]),
                rms_before=_rms(residuals.before[part]),
                max_after=float(np.abs(residuals.after[part]).max()),
            )
        )
    return tuple(rows)


def _rms(values: Array) -> float:
    return float(np.sqrt(values @ values / values.size))


def segment_scatter(design: Design, residuals: Residuals, noise: Noise) -> dict[str, float]:
    """How much the mean rates of the segments scatter, in units of what the noise explains.

    The slope of the residual angle in a segment of duration T with n samples has, for white noise r and
    random walk q, the variance ``12 r/(n T^2) + q/T`` (an upper bound for the second part is 6/5 of it).
    ``segment_scatter_ratio`` is the root mean square of slope over expected, ``segment_scatter`` the root
    mean square slope as specific force [g].
    """
    slopes, expected = [], []
    edges = np.concatenate(([0], np.flatnonzero(np.diff(design.run.segment)) + 1, [design.run.size]))
    for left, right in pairwise(edges):
        t = residuals.t[left:right] - residuals.t[left:right].mean()
        duration = float(np.ptp(t))
        if right - left < 10 or design.run.begins[left + 1 : right].any() or duration == 0.0:
            continue
        slopes.append(float(t @ residuals.after[left:right] / (t @ t)))
        expected.append(
            math.sqrt(12.0 * noise.white / ((right - left) * duration**2) + 1.2 * noise.walk / duration)
        )
    if design.point or len(slopes) < 4 or min(expected) == 0.0:
        return {}
    ratio = np.array(slopes) / np.array(expected)
    return {
        "segment_scatter_ratio": _rms(ratio),
        "segment_scatter_g": _rms(np.array(slopes)) / design.run.scale_factor / G0,
    }


def diagnose(residuals: Residuals) -> dict[str, float | int | str]:
    """Tests of the whitened residual: variance, lag-1 correlation and portmanteau, shape of the distribution.

    ``ljung_box`` is the Ljung-Box statistic over 20 lags with its probability; ``excess_kurtosis`` and
    ``skewness`` are 0 for normal residuals.
    """
    from scipy.special import gammaincc

    x = residuals.innovation[residuals.innovation != 0.0]
    n = x.size
    if n < 50:
        return {"samples": n}
    centred = x - x.mean()
    square = centred * centred
    variance = float(square.mean())
    lags = min(20, n // 5)
    products = np.zeros(lags + 1)
    lagged_products(centred, products)
    correlation = products[1:] / products[0]
    statistic = float(n * (n + 2) * np.sum(correlation**2 / (n - np.arange(1, lags + 1))))
    probability = float(gammaincc(0.5 * lags, 0.5 * statistic))
    return {
        "samples": n,
        "variance": variance,
        "lag1_correlation": float(correlation[0]),
        "ljung_box": statistic,
        "ljung_box_lags": lags,
        "ljung_box_probability": probability,
        "skewness": float(square @ centred) / n / variance**1.5,
        "excess_kurtosis": float(square @ square) / n / variance**2 - 3.0,
        "verdict": "white"
        if probability > 1e-3
        else "not white: the model or the noise description misses something",
    }
