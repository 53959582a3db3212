"""Residuals against the rotation of the output: ripple by revolution order, and ripple within one revolution.

A specific force ``c cos(n psi) + s sin(n psi)`` that the model does not know leaves the residual angle
``K (c int cos(n psi) dt + s int sin(n psi) dt)``. Both integrals are taken in closed form between samples (``psi`` is
linear there). So uneven sampling, gaps and changing rates do no harm. Fitting them, an offset and a drift to each
segment gives the amplitude of the ripple as a specific force. A raised cosine over the turns of the segment weights the
samples, so that a strong order does not leak into others (resolution: two orders over the number of turns). Own
derivation.

An output in whole counts makes lines of its own. Where the counts per sample are nearly whole, the rounding error is a slow
saw-tooth that looks like a ripple. Its spectrum follows from the fitted path, rounded to whole counts.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga.calibration.weights import count_size
from piga.records.calibration.diagnostics import Residuals
from piga.results import Array, Result

_STEP = 0.125
"""Spacing of the revolution orders of a spectrum [cycles/rev]."""
_HIGHEST = 6.0
"""Last revolution order [cycles/rev]."""
TURNS = 2.0
"""Fewest cycles of a ripple in a segment: fewer cannot be told from drift or from other orders."""
_SAMPLES = 1 << 16
"""Samples of a segment above which neighbours are averaged."""
_AVERAGED = 0.6
"""Largest turn of the highest order over the samples of an average [rad]: it loses 1.5 % there."""
_BINS = 36
"""Most bins of one revolution."""
_LINE = 3.0
"""An order is a line above this multiple of the expected noise: chance reaches it in one spectrum of a hundred."""

_TAPER = 1.5  # variance of an amplitude under the raised cosine, against equal weights
_STANDING = 1e-7  # turn between samples below which the output stands [rad]
_LEAST = 8


@dataclass(frozen=True, eq=False, repr=False)
class OrderSpectrum(Result):
    """Ripple amplitude [m/s^2] by revolution order [cycles/rev], root mean square over the segments.

    ``noise`` is the amplitude that the stated noise levels alone would show, ``counts`` the amplitude that reading in
    whole counts makes (0: the output is not counted). ``segments`` is how many segments turned far enough to be used;
    orders that none of them can show are nan. ``single`` are these segments by index, each with its own amplitudes after
    calibration.
    """

    order: Array
    before: Array
    after: Array
    noise: Array
    counts: Array
    segments: int
    single: tuple[tuple[int, Array], ...] = ()

    def lines(self) -> list[tuple[float, int, bool]]:
        """Orders that stand out of the noise: their order, the segment that shows each most, and whether counts explain it.

        Counts explain a line if they make at least half of its amplitude.
        """
        ratio = np.nan_to_num(self.after / np.where(self.noise > 0.0, self.noise, np.inf))
        peaks = [k for k in np.flatnonzero(ratio > _LINE) if ratio[k] == ratio[max(k - 2, 0) : k + 3].max()]
        return [
            (
                float(self.order[k]),
                max(self.single, key=lambda one: float(np.nan_to_num(one[1][k])))[0],
                bool(self.counts[k] > 0.5 * self.after[k]),
            )
            for k in peaks
        ]


@dataclass(frozen=True, eq=False, repr=False)
class Ripple(Result):
    """Mean residual specific force [m/s^2] against output angle [rad], per bin of one revolution."""

    psi: Array
    before: Array
    after: Array
    scatter: Array
    segments: int


@dataclass(frozen=True)
class _Segment:
    """Finite samples of one segment; ``residual`` has the rows before, after and of whole counts."""

    t: Array
    psi: Array
    residual: Array
    index: int

    @property
    def turns(self) -> float:
        return float(np.ptp(self.psi)) / (2.0 * math.pi)


def segment_slices(segment: ArrayLike) -> list[slice]:
    """Runs of equal segment index."""
    index = np.asarray(segment)
    if index.size == 0:
        return []
    edges = [0, *(np.flatnonzero(np.diff(index)) + 1).tolist(), index.size]
    return [slice(start, stop) for start, stop in pairwise(edges)]


def order_spectrum(
    residuals: Residuals, scale_factor: float, noise: tuple[float, float] = (0.0, 0.0)
) -> OrderSpectrum:
    """Amplitude spectrum of the residuals in revolution order, as equivalent specific force.

    Parameters
    ----------
    residuals:
        Residual angle per sample before and after calibration [rad].
    scale_factor:
        ``K`` [(rad/s)/(m/s^2)].
    noise:
        White noise of the angle [rad, rms] and angle random walk [rad/sqrt(s)].

    Returns
    -------
    spectrum:
        For each order the amplitudes of the segments, combined as root mean square, each weighted by the information it
        holds on that order. Segments that turn less than half as far as the farthest, or show less than two cycles of
        the order, are left out: they would blur the lines.
    """
    order = np.arange(1.0, round(_HIGHEST / _STEP) + 1.0) * _STEP  # whole orders are among them
    power, weight = np.zeros((4, order.size)), np.zeros(order.size)
    single: list[tuple[int, Array]] = []
    count = count_size(residuals.psi) if noise[0] else 0.0
    excess = max((noise[0] / count) ** 2 - 1.0 / 12.0, 0.0) if count else math.inf
    dither = math.exp(
        -2.0 * math.pi**2 * excess
    )  # what noise before the rounding leaves of the line of whole counts
    segments = _segments(residuals, count)
    enough = 0.499 * max((segment.turns for segment in segments), default=0.0)
    for segment in segments:
        shown = (order * segment.turns >= TURNS) & (segment.turns >= enough)
        if not shown.any():
            continue
        square, information = _segment_power(_averaged(segment), order, scale_factor)
        square[2] *= dither**2
        square = np.vstack((square, _noise_power(segment, order, noise) / scale_factor**2))
        good = shown & (information > 0.0)
        power[:, good] += information[good] * square[:, good]
        weight[good] += information[good]
        single.append((segment.index, np.sqrt(np.where(good, square[1], np.nan))))
    with np.errstate(invalid="ignore", divide="ignore"):
        before, after, counts, level = np.sqrt(power / weight)
    return OrderSpectrum(order, before, after, level, counts, len(single), tuple(single))


def _segments(residuals: Residuals, count: float = 0.0) -> list[_Segment]:
    segments = []
    for part in segment_slices(residuals.segment):
        t, psi, after = residuals.t[part], residuals.psi[part], residuals.after[part]
        residual = np.stack((residuals.before[part], after, np.zeros(t.size)))
        good = np.isfinite(t) & np.isfinite(psi) & np.isfinite(residual).all(axis=0)
        t, psi, residual = t[good], psi[good], residual[:, good]
        if t.size < _LEAST:
            continue
        if count > 0.0:
            path = (psi - residual[1] - psi[0]) / count
            residual[2] = count * (np.round(path) - path)
        segments.append(_Segment(t, psi, residual, int(residuals.segment[part.start])))
    return segments


def _averaged(segment: _Segment) -> _Segment:
    """Means of the residuals over an odd number of samples, about the one in the middle."""
    if segment.t.size < _SAMPLES:
        return segment
    turn = _HIGHEST * float(np.quantile(np.abs(np.diff(segment.psi)), 0.99))
    half = int((_AVERAGED / turn - 1.0) / 2.0) if turn > 0.0 else 0
    width = min(2 * max(half, 0) + 1, 2 * (segment.t.size // _SAMPLES) + 1)
    stop = segment.t.size // width * width
    means = segment.residual[:, :stop].reshape(3, -1, width).mean(axis=2)
    middle = slice(width // 2, stop, width)
    return _Segment(segment.t[middle], segment.psi[middle], means, segment.index)


def _noise_power(segment: _Segment, order: Array, noise: tuple[float, float]) -> Array:
    """Expected squared amplitude [rad^2/s^2] of white angle noise and random walk over the segment."""
    white, walk = noise
    duration = segment.t[-1] - segment.t[0]
    angular = order * float(np.ptp(segment.psi)) / duration
    density = walk**2 + white**2 * duration / segment.t.size * angular**2
    return 4.0 * _TAPER * density / duration


def _segment_power(segment: _Segment, order: Array, scale_factor: float) -> tuple[Array, Array]:
    """Squared amplitudes (before, after, counts) and information of one segment, per order.

    Weighted least squares on the cosine and sine integrals, offset and drift projected out.
    """
    t = (segment.t - segment.t.mean()) / float(np.ptp(segment.t))
    psi = segment.psi - segment.psi[0]
    weight = np.sin(math.pi * (psi - psi.min()) / np.ptp(psi)) ** 2
    base = np.stack((np.ones_like(t), t))
    inverse = np.linalg.inv((base * weight) @ base.T)
    residual = segment.residual - segment.residual @ (base * weight).T @ inverse @ base
    weighted = np.vstack((base, residual)) * weight
    sums, product = np.empty((order.size, 5), complex), np.empty((order.size, 2), complex)
    for k, integral in enumerate(_integrals(segment.t, psi, order)):
        sums[k] = weighted @ integral.view(float).reshape(-1, 2) @ (1.0, 1j)
        heavy = weight * integral
        product[k] = heavy @ integral, np.vdot(integral, heavy)
    plain, size = product[:, 0], product[:, 1].real
    gram = 0.5 * np.array([[size + plain.real, plain.imag], [plain.imag, size - plain.real]]).transpose(2, 0, 1)
    both = np.stack((sums.real, sums.imag), axis=1)
    gram -= both[:, :, :2] @ inverse @ both[:, :, :2].transpose(0, 2, 1)
    information = 0.5 * np.trace(gram, axis1=1, axis2=2)
    seen = np.linalg.det(gram) > 1e-9 * information**2
    gram[~seen] = np.eye(2)
    amplitude = np.linalg.solve(gram, both[:, :, 2:]) / scale_factor
    return np.sum(amplitude**2, axis=1).T, np.where(seen, information, 0.0) * scale_factor**2


def _integrals(t: Array, psi: Array, order: Array) -> Iterator[NDArray[np.complex128]]:
    """``int exp(i n psi) dt`` from the first sample to each, for each order ``n``."""
    step, turned = np.diff(t), np.diff(psi)
    standing = np.abs(turned) < _STANDING
    rate = np.where(standing, 0.0, step / np.where(standing, 1.0, 1j * turned))
    still = np.where(standing, step, 0.0)
    phasor, turn = np.ones(t.size, complex), np.exp(1j * _STEP * psi)
    for n in order:
        phasor *= turn
        pieces = np.diff(phasor) * (rate / n)
        if standing.any():
            pieces += still * phasor[:-1]
        yield np.concatenate(([0.0], np.cumsum(pieces)))


def ripple(residuals: Residuals, scale_factor: float) -> Ripple:
    """Residual specific force against output angle: the mean of each bin over all turns.

    Every segment is turned until its own first-order ripple before calibration points to zero, so that positions with
    different transverse force add up instead of cancelling; ``after`` is turned alike. Segments of less than two turns
    cannot show a ripple and are left out. A revolution has fewer bins where the output turns further between samples.
    """
    segments = [segment for segment in _segments(residuals) if segment.turns >= TURNS]
    bins = _BINS
    if segments:
        stride = max(float(np.median(np.abs(np.diff(segment.psi)))) for segment in segments)
        bins = min(bins, max(12, int(2.0 * math.pi / stride) if stride > 0.0 else bins))
    parts = [_binned(segment, bins) for segment in segments]
    change = np.array([part[:2] for part in parts]).reshape(-1, 2, bins)
    time = np.array([part[2] for part in parts]).reshape(-1, bins)
    centre = (np.arange(bins) + 0.5) * 2.0 * math.pi / bins
    with np.errstate(invalid="ignore", divide="ignore"):
        before, after = change.sum(axis=0) / time.sum(axis=0) / scale_factor
        scatter = _scatter(change[:, 1] / time / scale_factor, time)
    return Ripple(centre, before, after, scatter, len(segments))


def _scatter(means: Array, time: Array) -> Array:
    """Standard uncertainty of the mean of each bin, from the scatter of the segments."""
    if len(means) < 3:
        return np.full(means.shape[1] if len(means) else 0, np.nan)
    value, weight = np.nan_to_num(means), time / time.sum(axis=0)
    spread = value - np.sum(weight * value, axis=0)
    return np.sqrt(np.sum(weight**2 * spread**2, axis=0) * len(means) / (len(means) - 1))


def _binned(segment: _Segment, bins: int) -> Array:
    """Change of the drift-free residual before and after, and time, per bin of the angle turned to its ripple (3, bins)."""
    t = segment.t - segment.t.mean()
    residual = segment.residual[:2]
    change = np.diff(residual - (residual @ t / (t @ t))[:, None] * t)
    middle = 0.5 * (segment.psi[1:] + segment.psi[:-1])
    phase = math.atan2(float(np.sin(middle) @ change[0]), float(np.cos(middle) @ change[0]))
    index = np.floor((middle - phase) / (2.0 * math.pi) * bins).astype(np.int64) % bins
    sums = [np.bincount(index, row, bins) for row in (*change, np.diff(segment.t))]
    return np.array(sums, dtype=float)
