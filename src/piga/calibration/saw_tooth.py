"""Covariance of counting: the saw-tooth of the counts, harmonic by harmonic, along a path known to a fraction of one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from piga.calibration.counted_stretches import Stretch

Array = NDArray[np.float64]

HARMONICS = 8
"""Harmonics of the saw-tooth that white noise damps one by one."""
FINE, SHORT = 24, 10_000
"""Harmonics followed in stretches up to so many samples (else those above); the rest counts as white."""
_NODES = (
    (0.0, 8.0 / 15.0),
    (1.355626, 0.222076),
    (-1.355626, 0.222076),
    (2.856970, 0.011257),
    (-2.856970, 0.011257),
)
"""Gauss-Hermite nodes and weights for a standard normal variable."""
SLOW = 4.0
"""Counts in a stretch up to which all harmonics of the saw-tooth are followed, sample by sample."""
STILL = 0.02
"""Turn of the highest harmonic inside a bin [cycles] below which a bin turns as a whole (misses 7e-4 of it)."""
CHUNK = 1 << 13
"""Samples whose harmonics are formed at a time."""


def harmonic_shares(count: float) -> Array:
    """Variance of each harmonic of the counting followed, and of all others together [rad^2]."""
    found = count**2 / (2.0 * np.pi**2 * np.arange(1, HARMONICS + 1) ** 2)
    return np.append(found, count**2 / 12.0 - found.sum())


def counting_covariance(stretch: Stretch, path: Array, count: float, sigma: float, wander: float) -> Array:
    """Covariance of the contrasts by each harmonic of the counting, and all others (M + 1, K, K).

    The rate is known to ``sigma`` [counts over the stretch]: averaged over by Gauss-Hermite quadrature. The
    random walk about the best line, ``wander`` [counts], dithers the harmonics; what it takes out is white.
    Where the nodes of the quadrature move the path by little inside a bin, they turn the bin's mean as a whole.
    """
    ramp = (stretch.t - stretch.t.mean()) / (stretch.t[-1] - stretch.t[0])
    turned = (path - path[0]) / count
    slow = float(np.ptp(turned)) + 3.0 * sigma < SLOW
    followed = FINE if stretch.t.size <= SHORT else HARMONICS
    order = np.arange(1, followed + 1)
    kept = count**2 / (2.0 * np.pi**2 * order**2) * np.exp(-4.0 * np.pi**2 * (order * wander) ** 2)
    found = np.zeros((HARMONICS + 1, stretch.contrasts.shape[0], stretch.contrasts.shape[0]))
    per_bin = sigma * followed * _NODES[-2][0] / (stretch.edges.size - 1)
    together = per_bin < STILL or stretch.t.size == stretch.edges.size - 1
    still = _harmonic_means(stretch, turned, followed) if together else np.empty(0)
    ramp_means = stretch.mean(ramp)
    for node, weight in _NODES if sigma > 0.01 else ((0.0, 1.0),):
        moved = turned + node * sigma * ramp
        if together:
            means = still * np.exp(2j * np.pi * node * sigma * order[:, None] * ramp_means)
        else:
            means = _harmonic_means(stretch, moved, followed)
        s = stretch.contrasts @ means.T
        low, high = s[:, :HARMONICS].T, s[:, HARMONICS:]
        share = weight * kept[:HARMONICS, None, None]
        found[:-1] += share * (low[:, :, None] * low[:, None, :].conj()).real
        if slow:
            found[-1] += weight * _whole(stretch, moved, count)
        else:
            found[-1] += weight * ((high * kept[HARMONICS:]) @ high.conj().T).real
    if slow:
        found[-1] -= found[:-1].sum(axis=0)
    else:
        rest = count**2 / 12.0 - float(kept.sum())
        found[-1] += rest * (stretch.contrasts / np.diff(stretch.edges)) @ stretch.contrasts.T
    return found


def _whole(stretch: Stretch, turned: Array, count: float) -> Array:
    """Covariance of the contrasts by the whole saw-tooth, ``c^2 (1/12 - {x}(1 - {x})/2)`` between readings."""
    at = stretch.mean(turned)
    apart = at[:, None] - at
    apart -= np.floor(apart)
    return count**2 * stretch.contrasts @ (1.0 / 12.0 - 0.5 * apart * (1.0 - apart)) @ stretch.contrasts.T


def _harmonic_means(stretch: Stretch, turned: Array, followed: int) -> NDArray[np.complex128]:
    """Means over the bins of ``exp(2 pi i m turned)``, m = 1 .. ``followed``; few bins at a time, for the cache."""
    edges, bins = stretch.edges, stretch.edges.size - 1
    out = np.empty((followed, bins), dtype=complex)
    few = max(1, bins * CHUNK // turned.size)
    for at in range(0, bins, few):
        last = min(at + few, bins)
        part = turned[edges[at] : edges[last]]
        angle = 2.0 * np.pi * (part - np.floor(part))
        first = np.empty(angle.size, dtype=complex)
        first.real, first.imag = np.cos(angle), np.sin(angle)
        power, starts = first.copy(), edges[at:last] - edges[at]
        for m in range(followed):
            out[m, at:last] = np.add.reduceat(power, starts)
            power *= first
    out /= np.diff(edges)
    return out
