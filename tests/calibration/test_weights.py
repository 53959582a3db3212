"""Levels that weigh the rows: against dense matrices, and on simulated records."""

from __future__ import annotations

import numpy as np
import pytest

import piga
from piga.calibration.model.reduction import Reduction, triangle
from piga.calibration.weights import (
    RATE,
    Noise,
    counted_rates,
    find_scatter,
    likeliest_levels,
)

H = 0.1


def stretches(count: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Intervals (a stretch begins with 0) and first rows of ``count`` stretches."""
    h = np.full(count * rows, H)
    h[::rows] = 0.0
    return h, np.arange(count + 1) * rows


def increments(rng: np.random.Generator, count: int, rows: int, white: float, walk: float) -> np.ndarray:
    """Increments of white angle noise and random walk; 0 where a stretch begins."""
    angle = white * rng.standard_normal((count, rows))
    angle += walk * np.sqrt(H) * np.cumsum(rng.standard_normal((count, rows)), axis=1)
    return np.diff(angle, axis=1, prepend=angle[:, :1]).ravel()


@pytest.mark.parametrize(("white", "walk"), [(2e-5, 0.0), (2e-5, 2e-5), (1e-6, 3e-5)])
def test_levels_come_back_whatever_the_rates(white: float, walk: float) -> None:
    rng = np.random.default_rng(2)
    h, edges = stretches(12, 300)
    d = increments(rng, 12, 300, white, walk) + h * np.repeat(1e-3 * rng.standard_normal(12), 300)
    noise = likeliest_levels(d, h, edges, H, 2, 0.0)
    assert np.sqrt(noise.white) == pytest.approx(white, rel=0.06 if walk <= white else 1.0)
    assert np.sqrt(noise.walk) == pytest.approx(walk, rel=0.1, abs=2e-6)


def rounding_errors(rng: np.random.Generator, turned: np.ndarray, rows: int, walk: float = 0.0) -> np.ndarray:
    """Errors of readings in whole counts (G, n) where the output turns by ``turned`` (G,) counts from reading to reading."""
    angle = turned[:, None] * np.arange(rows) + rng.uniform(0.0, 1.0, (turned.size, 1))
    noisy = angle + walk * np.sqrt(H) * np.cumsum(rng.standard_normal(angle.shape), axis=1)
    return np.round(noisy) - angle


@pytest.mark.parametrize("walk", [0.0, 0.03])
def test_rounding_that_neighbouring_readings_share_is_no_walk(walk: float) -> None:
    """Two of twelve positions nearly stand: without a floor the walk would be several times that of the record."""
    rows, turned = 1000, np.array([25.4525, 22.04, 12.725, -0.0075, -12.7275, -22.0425] * 2)
    h, edges = stretches(12, rows)
    error = rounding_errors(np.random.default_rng(8), turned, rows, walk)
    d = np.diff(error, axis=1, prepend=error[:, :1]).ravel()
    noise = likeliest_levels(d, h, edges, H, 2, np.sqrt(0.95 / 12.0))
    assert np.sqrt(noise.white) == pytest.approx(np.sqrt(1.0 / 12.0), rel=0.05)
    assert np.sqrt(noise.walk) == pytest.approx(walk, rel=0.3, abs=0.01)
    assert likeliest_levels(d, h, edges, H, 2, 0.0).walk > 0.04


@pytest.mark.parametrize("periods", [2, 5])
def test_slope_of_a_saw_tooth(periods: int) -> None:
    """Slopes fitted to roundings of an output that passes few counts, beside whole counts from reading to reading."""
    rows, count = 400, 1e-3
    turned = np.full(800, 7.0 + periods / rows)
    error = count * rounding_errors(np.random.default_rng(4), turned, rows + 1)
    t = H * np.arange(rows + 1)
    slopes = error @ (t - t.mean()) / np.sum((t - t.mean()) ** 2)
    output = count * np.round(turned[:2, None] * np.arange(rows + 1)).ravel()
    times = np.concatenate([t, t + t[-1] + 5.0])
    segment = np.repeat(np.arange(2), rows + 1)
    options = {"segment": segment, "resolution": count, "units": "SI"}
    run = piga.Run.from_arrays(times, output, np.ones((times.size, 3)), scale_factor=0.09, **options)
    predicted = counted_rates(run, count**2 / 12.0)
    assert predicted == pytest.approx([np.mean(slopes**2)] * 2, rel=0.35)
    assert counted_rates(run, count**2) == (0.0, 0.0)
    run = piga.Run.from_arrays(
        times, output * 1.05, np.ones((times.size, 3)), scale_factor=0.09, **(options | {"resolution": 0.0})
    )
    assert counted_rates(run, count**2 / 12.0) == ()


def positions(rng: np.random.Generator, scatter: float, count: int = 24) -> list[Reduction]:
    """Triangles of positions with 60 rows of unit variance, a mean and a slope, and rates that scatter."""
    names, parts = ("scale_factor", "k0", RATE), []
    for k in range(count):
        a = np.cos(2.0 * np.pi * k / count)
        y = 3.0 * a + 1.0 + scatter * rng.standard_normal() + rng.standard_normal(60)
        rows = np.column_stack([np.tile([a, 1.0, 1.0], (60, 1)), y])
        parts.append(Reduction(names, triangle(rows), 60))
    return parts


def test_scatter_is_that_of_the_rates() -> None:
    found = [find_scatter(positions(np.random.default_rng(seed), 0.5), Noise(1.0, 0.0)) for seed in range(20)]
    assert np.mean([noise.scatter for noise in found]) == pytest.approx(0.25, rel=0.2)
    none = [find_scatter(positions(np.random.default_rng(seed), 0.0), Noise(1.0, 0.0)) for seed in range(20)]
    assert np.mean([noise.scatter for noise in none]) < 0.01


def test_stated_scatter_is_a_floor() -> None:
    parts = positions(np.random.default_rng(7), 0.5)
    stated = find_scatter(parts, Noise(1.0, 0.0, stated=(1.0,) * 24))
    assert stated.scatter == 0.0
    assert stated.rate_variances(24) == pytest.approx(np.ones(24))
    weighted = Reduction.stacked([part.without((RATE,), 1.0) for part in parts]).solve()[1]
    x = np.array([[np.cos(2.0 * np.pi * k / 24.0), 1.0] for k in range(24)])
    assert weighted == pytest.approx(np.linalg.inv(x.T @ x / (1.0 + 1.0 / 60.0)), rel=1e-9, abs=1e-12)
