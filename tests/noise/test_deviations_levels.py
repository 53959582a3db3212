"""Levels of noise: against covariances from their definition, against the noise put in, against a wave that is no noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.fft import dct
from scipy.signal import lfilter

from piga.errors import PigaError
from piga.noise.deviations import SOURCES, _columns, level_variances, noise_levels

STEP = 0.5


def flicker(rng: np.random.Generator, samples: int, level: float):
    """Noise with the spectrum level^2/(2 pi f), by the filter of J. Kasdin (Proc. IEEE 83, 1995): (1 - z^-1)^(-1/2)."""
    k = np.arange(1, 8 * samples)
    response = np.concatenate(([1.0], np.cumprod((k - 0.5) / k)))
    white = rng.standard_normal(8 * samples) * level
    return lfilter(response[: 2 * samples], [1.0], white[: 2 * samples])[samples:]


def rates(rng: np.random.Generator, samples: int, q=0.0, n=0.0, b=0.0, k=0.0, drift=0.0):
    """Mean rates with known levels."""
    y = n / np.sqrt(STEP) * rng.standard_normal(samples) + drift * STEP * np.arange(samples)
    y += k * np.sqrt(STEP) * np.cumsum(rng.standard_normal(samples))
    y += np.diff(q * rng.standard_normal(samples + 1)) / STEP
    return y + (flicker(rng, samples, b) if b else 0.0)


def test_variances_of_the_transform_are_those_of_the_covariance():
    """White noise and random walk exactly; quantisation but for the two ends."""
    size = 64
    inside = np.eye(size) * STEP**-1
    steps = np.tril(np.ones((size, size)))
    walk = STEP * steps @ steps.T
    ends = 2.0 * np.eye(size) - np.eye(size, k=1) - np.eye(size, k=-1)
    ends[[0, -1], [0, -1]] = 1.0
    columns = _columns(np.arange(1, size) / size, STEP)
    for covariance, column in ((inside, columns[1]), (walk, columns[3]), (ends / STEP**2, columns[0])):
        transformed = dct(dct(covariance, axis=0, norm="ortho"), axis=1, norm="ortho")[1:, 1:]
        assert np.diag(transformed) == pytest.approx(column, rel=1e-9)
        assert np.abs(transformed - np.diag(column)).max() < 1e-9 * column.max()


CASES = {
    "white": {"n": 1.0},
    "quantisation alone": {"q": 2.0},
    "white and flicker": {"n": 1.0, "b": 0.4},
    "walk and drift": {"n": 1.0, "k": 0.05, "drift": 2e-3},
    "counts of a walk": {"q": 20.0, "n": 1.0, "k": 0.02},
}


@pytest.mark.parametrize("name", CASES)
def test_intervals_hold_the_levels_put_in(name: str):
    """In 40 records each interval of 95 % holds at least 33 times (probability of fewer: 0.3 %), in one or three stretches."""
    rng, case, held = np.random.default_rng(11), CASES[name], np.zeros(5)
    truth = [case.get(key, 0.0) for key in ("q", "n", "b", "k", "drift")]
    for trial in range(40):
        y = rates(rng, 3000, **case)
        parts = [y] if trial % 2 else [y[:1000], y[1050:1400], y[1400:]]
        levels, _ = noise_levels(parts, STEP)
        held += [one.lower <= true <= one.upper for one, true in zip(levels, truth, strict=True)]
    assert held.min() >= 33


def test_what_is_not_there_is_not_seen():
    """White noise alone: only the random walk is told from none, and in its unit."""
    levels, spectrum = noise_levels([rates(np.random.default_rng(12), 20_000, n=3.0)], STEP)
    assert [one.seen for one in levels] == [False, True, False, False, False]
    assert levels[1].value == pytest.approx(3.0, rel=0.02)
    assert levels[1].upper - levels[1].lower < 0.15
    assert spectrum.misfit is None
    assert spectrum.density[-20:] == pytest.approx(9.0, rel=0.5)
    assert spectrum.frequency[-1] < 1.0 / (2.0 * STEP)


@pytest.mark.parametrize("rate", [0.0, 1.0])
def test_counts_without_noise_are_refused(rate: float):
    """Whole counts in each step: a traceback before."""
    counts = np.floor(rate * np.arange(3000) + 0.3)
    with pytest.raises(PigaError, match=r"a\.csv: the samples repeat exactly"):
        noise_levels([np.diff(counts) / STEP], STEP, source="a.csv")


def test_the_random_walk_under_counts_is_within_its_bound():
    """Lines of the counts hide a faint walk: before, a number far below it stood as N, and its interval held in 5 %."""
    rng, held = np.random.default_rng(5), 0
    for rate in rng.uniform(0.05, 40.0, 40):
        angle = np.cumsum(rate + STEP * rates(rng, 3000, n=0.05))
        walk = noise_levels([np.diff(np.floor(angle)) / STEP], STEP)[0][1]
        held += walk.lower <= 0.05 <= walk.upper
    assert held >= 33


def test_ends_of_a_rate_do_not_matter():
    """They are free, of rates too: their quantisation passed for a random walk before."""
    y = rates(np.random.default_rng(17), 2000, n=1.0)
    y[[0, -1]] += (500.0, -300.0)
    assert noise_levels([y], STEP)[0][1].value == pytest.approx(1.0, rel=0.06)


@pytest.mark.parametrize("rate", [0.5, 1 / 3, 0.37123, 0.0037123])
def test_counts_of_a_steady_rate_are_no_noise(rate: float):
    """Their lines are not the spectrum of any level: said. A simple fraction of a count ended in a traceback before."""
    counts = np.floor(rate * np.arange(3000) + 0.3)
    assert noise_levels([np.diff(counts) / STEP], STEP)[1].misfit is not None


def test_a_wave_is_named_by_its_frequency():
    t = STEP * np.arange(8000)
    y = rates(np.random.default_rng(14), 8000, n=1.0) + 0.5 * np.sin(2.0 * np.pi * 0.05 * t)
    _, spectrum = noise_levels([y], STEP)
    assert spectrum.misfit is not None
    low, high, ratio = spectrum.misfit
    assert low < 0.05 < high
    assert ratio > 1.5


def test_allan_variances_of_the_levels():
    """Variance of second differences by its definition, for each level alone ([IEEE952] annex C)."""
    rng, m = np.random.default_rng(15), 16
    for name, key in zip(SOURCES, ("q", "n", "b", "k"), strict=True):
        squares = []
        for _ in range(300):
            means = rates(rng, 8 * m, **{key: 1.0}).reshape(8, m).mean(axis=1)
            squares.append(0.5 * np.mean(np.diff(means) ** 2))
        levels, _ = noise_levels([rates(rng, 4000, **{key: 1.0})], STEP)
        one = next(level for level in levels if level.name == name)
        variance = level_variances(np.array([m * STEP]), [one])[name] / one.value**2
        assert float(variance[0]) == pytest.approx(np.mean(squares), rel=0.2)
