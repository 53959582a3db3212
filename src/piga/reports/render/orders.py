"""Residuals against the rotation of the output: spectrum in revolution order, ripple per revolution.

A specific force ``c cos(n psi) + s sin(n psi)`` that the model does not know leaves the residual angle
``K (c int cos(n psi) dt + s int sin(n psi) dt)``. Both integrals are taken in closed form between samples
(``psi`` linear there), so uneven sampling, gaps and changing rates do no harm; fitting them, an offset and
a drift to each segment gives the amplitude of the ripple in units of specific force. The samples are
weighted by a raised cosine over the turns of the segment, so that a strong order does not leak into the
others (resolution: two orders over the number of turns). Own derivation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga.records.calibration import Residuals
from piga.results import Result

Array = NDArray[np.float64]

TURNS_NEEDED = 2.0
"""Cycles of a ripple that a segment must hold: fewer cannot be told from drift or from other orders."""

STEP, HIGHEST = 0.125, 6.0
"""Spacing of the revolution orders of a spectrum, and the last one."""
BINS = 36
"""Most bins of one revolution."""

_TAPER_LOSS = 1.5  # variance of an amplitude under the raised cosine, against equal weights

LONG, JOINED = 1 << 16, 0.6
"""Samples from which neighbours are joined for the spectrum, and how far the highest order may turn [rad] over those
joined: the floor beside a strong line changes by less than 1 % of that line."""

_CHUNK, _LEAST = 8192, 8
_STANDING = 1e-7


@dataclass(frozen=True, eq=False, repr=False)
class OrderSpectrum(Result):
    """Ripple amplitude [m/s^2] by revolution order, root-mean-square over the segments.

    ``noise`` is the amplitude that the stated noise levels alone would show. ``segments`` is how many
    segments turned far enough to be used; orders that none of them can show are nan. ``single`` are these segments by
    index, each with its own amplitudes after calibration.
    """

    order: Array
    before: Array
    after: Array
    noise: Array
    segments: int
    single: tuple[tuple[int, Array], ...] = ()


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
    """Finite samples of one segment; ``residual`` has the rows before and after, ``index`` is that of the segment."""

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


def _segments(residuals: Residuals) -> list[_Segment]:
    segments = []
    for part in segment_slices(residuals.segment):
        t, psi = residuals.t[part], residuals.psi[part]
        residual = np.stack((residuals.before[part], residuals.after[part]))
        index = int(residuals.segment[part.start])
        if all(math.isfinite(values.sum()) for values in (t, psi, residual)):
            segment = _Segment(t, psi, residual, index)  # nothing to leave out, nothing to copy
        else:
            good = np.isfinite(t) & np.isfinite(psi) & np.isfinite(residual).all(axis=0)
            segment = _Segment(t[good], psi[good], residual[:, good], index)
        if segment.t.size >= _LEAST:
            segments.append(segment)
    return segments


def order_grid() -> Array:
    """Revolution orders from :data:`STEP` to :data:`HIGHEST`; whole orders are among them."""
    return np.arange(1.0, round(HIGHEST / STEP) + 1.0) * STEP


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
        For each order the amplitudes of the segments, combined as root mean square, each weighted by the
        information it holds on that order. Segments that turn less than half as far as the farthest, or
        show less than two cycles of the order, are left out: they would blur the lines.
    """
    return _spectrum(_segments(residuals), scale_factor, noise)


def spectrum_and_ripple(
    residuals: Residuals, scale_factor: float, noise: tuple[float, float]
) -> tuple[OrderSpectrum, Ripple]:
    """:func:`order_spectrum` and the ripple of the same residuals; their samples are gathered once."""
    segments = _segments(residuals)
    return _spectrum(segments, scale_factor, noise), _ripple(segments, scale_factor)


def _spectrum(segments: list[_Segment], scale_factor: float, noise: tuple[float, float]) -> OrderSpectrum:
    order = order_grid()
    power, weight = np.zeros((3, order.size)), np.zeros(order.size)
    single: list[tuple[int, Array]] = []
    enough = 0.499 * max((segment.turns for segment in segments), default=0.0)
    for segment in segments:
        shown = (order * segment.turns >= TURNS_NEEDED) & (segment.turns >= enough)
        if not shown.any():
            continue
        joined = _joined(segment)
        square, information = _segment_power(joined, order.size, scale_factor)
        square /= _left_by_joining(segment, joined, order) ** 2
        square = np.vstack((square, _noise_power(segment, order, noise) / scale_factor**2))
        good = shown & (information > 0.0)
        power[:, good] += information[good] * square[:, good]
        weight[good] += information[good]
        single.append((segment.index, np.sqrt(np.where(good, square[1], np.nan))))
    with np.errstate(invalid="ignore", divide="ignore"):
        amplitude = np.sqrt(power / weight)
    return OrderSpectrum(order, amplitude[0], amplitude[1], amplitude[2], len(single), tuple(single))


def _joined(segment: _Segment) -> _Segment:
    """Means of the residuals over an odd number of samples, about the one in the middle."""
    if segment.t.size < LONG:
        return segment
    turn = HIGHEST * float(np.quantile(np.abs(np.diff(segment.psi)), 0.99))
    half = int((JOINED / turn - 1.0) / 2.0) if turn > 0.0 else 0
    width = min(2 * max(half, 0) + 1, 2 * (segment.t.size // LONG) + 1)
    stop = segment.t.size // width * width
    means = segment.residual[:, :stop].reshape(2, -1, width).mean(axis=2)
    middle = slice(width // 2, stop, width)
    return _Segment(segment.t[middle], segment.psi[middle], means, segment.index)


def _left_by_joining(segment: _Segment, joined: _Segment, order: Array) -> Array:
    """Share of an amplitude that the means over w samples keep, to second order.

    A wave that turns by x between samples keeps ``sin(w x/2)/(w sin(x/2)) = 1 - (w^2 - 1) x^2/24``. Its integral, of
    which the amplitude is estimated, is larger where the output turns slowly: x^2 is averaged with weights 1/x^2.
    """
    width = segment.t.size // joined.t.size
    square = np.maximum((np.diff(joined.psi) / width) ** 2, _STANDING**2)
    return 1.0 - (width**2 - 1.0) * order**2 / float(np.mean(1.0 / square)) / 24.0


def _noise_power(segment: _Segment, order: Array, noise: tuple[float, float]) -> Array:
    """Expected squared amplitude [rad^2/s^2] of white angle noise and random walk over the segment."""
    white, walk = noise
    duration = segment.t[-1] - segment.t[0]
    angular = order * float(np.ptp(segment.psi)) / duration
    density = walk**2 + white**2 * duration / segment.t.size * angular**2
    return 4.0 * _TAPER_LOSS * density / duration


def _segment_power(segment: _Segment, orders: int, scale_factor: float) -> tuple[Array, Array]:
    """Squared amplitudes (before, after) and information of one segment, per order."""
    moments = np.zeros((orders, 6, 2))
    plain = np.zeros((4, 4))
    carry = np.zeros(orders, dtype=complex)
    half = 0.5 * (segment.t[-1] - segment.t[0])
    middle = segment.t[0] + half
    taper = np.sin(math.pi * (segment.psi - segment.psi.min()) / np.ptp(segment.psi)) ** 2
    for start in range(0, segment.t.size, _CHUNK):
        # One sample of overlap: the integral runs on across the chunks.
        rows = slice(max(start - 1, 0), start + _CHUNK)
        fixed = np.stack(
            (np.ones_like(segment.t[rows]), (segment.t[rows] - middle) / half, *segment.residual[:, rows])
        )
        skip = 1 if start else 0
        light = taper[rows].copy()
        light[:skip] = 0.0
        plain += (fixed * light) @ fixed.T
        _add_moments(moments, carry, segment.t[rows], segment.psi[rows] - segment.psi[0], fixed, light)
    per_order = scale_factor / np.arange(1.0, orders + 1.0)[:, None, None]
    moments[:, :4] *= per_order
    moments[:, 4:] *= per_order**2
    return _fit_orders(moments, plain)


def _add_moments(
    moments: Array,
    carry: NDArray[np.complex128],
    t: Array,
    psi: Array,
    fixed: Array,
    weight: Array,
) -> None:
    """Weighted sums of the integrals ``n int exp(i n psi) dt`` with 1, t, the residuals, and themselves."""
    weighted = fixed * weight
    turn = np.exp(1j * STEP * psi)
    dt, dpsi = np.diff(t), np.diff(psi)
    standing = np.abs(dpsi) < _STANDING
    rate = np.where(standing, 0.0, dt / np.where(standing, 1.0, dpsi)) / (1j * STEP)
    still = np.where(standing, dt, 0.0) if standing.any() else None
    root = np.sqrt(weight)
    phasor, pieces, integral = np.ones_like(turn), np.empty_like(turn), np.empty_like(turn)
    for row in range(moments.shape[0]):
        phasor *= turn
        pieces[0] = carry[row]
        np.subtract(phasor[1:], phasor[:-1], out=pieces[1:])
        pieces[1:] *= rate
        if still is not None:
            pieces[1:] += (row + 1.0) * still * phasor[:-1]
        np.cumsum(pieces, out=integral)
        carry[row] = integral[-1]
        moments[row, :4] += weighted @ integral.view(float).reshape(-1, 2)
        integral *= root
        squares, size = np.dot(integral, integral), np.vdot(integral, integral).real
        moments[row, 4] += 0.5 * (size + squares.real), 0.5 * squares.imag
        moments[row, 5] += 0.5 * squares.imag, 0.5 * (size - squares.real)


def _fit_orders(moments: Array, plain: Array) -> tuple[Array, Array]:
    """Least squares of both residuals on cosine and sine integral, offset and drift projected out."""
    base = plain[:2, :2]
    inside = np.linalg.solve(base, moments[:, :2])  # offset and drift in the integrals
    gram = moments[:, 4:] - np.swapaxes(moments[:, :2], 1, 2) @ inside
    right = moments[:, 2:4] - np.swapaxes(np.linalg.solve(base, plain[:2, 2:4]), 0, 1) @ moments[:, :2]
    information = 0.5 * np.trace(gram, axis1=1, axis2=2)
    determinant = np.linalg.det(gram)
    good = determinant > 1e-9 * information**2
    gram[~good] = np.eye(2)
    amplitude = np.linalg.solve(gram, np.swapaxes(right, 1, 2))
    squares = np.swapaxes(np.sum(amplitude**2, axis=1), 0, 1)
    return squares, np.where(good, information, 0.0)


def _ripple(segments: list[_Segment], scale_factor: float) -> Ripple:
    """Residual specific force against output angle: the mean of each bin over all turns.

    Every segment is turned until its own first-order ripple before calibration points to zero, so that
    positions with different transverse force add up instead of cancelling; ``after`` is turned alike.
    Segments of less than two turns cannot show a ripple and are left out. There are :data:`BINS` bins of one revolution,
    fewer where the output turns further between samples.
    """
    segments = [segment for segment in segments if segment.turns >= TURNS_NEEDED]
    bins = BINS
    if segments:
        stride = max(float(np.median(np.abs(np.diff(segment.psi)))) for segment in segments)
        bins = min(bins, max(12, int(2.0 * math.pi / stride) if stride > 0.0 else bins))
    total, span = np.zeros((2, bins)), np.zeros(bins)
    means, weights = [], []
    for segment in segments:
        change, time = _binned(segment, bins)
        total += change
        span += time
        with np.errstate(invalid="ignore", divide="ignore"):
            means.append(change[1] / time / scale_factor)
        weights.append(time)
    centre = (np.arange(bins) + 0.5) * 2.0 * math.pi / bins
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = total / span / scale_factor
    return Ripple(centre, mean[0], mean[1], _scatter(means, weights), len(segments))


def _scatter(means: list[Array], weights: list[Array]) -> Array:
    """Standard uncertainty of the mean of each bin, from the scatter of the segments."""
    if len(means) < 3:
        return np.full(means[0].size if means else 0, np.nan)
    value = np.where(np.isfinite(means), means, 0.0)
    weight = np.asarray(weights) / np.sum(weights, axis=0)
    spread = value - np.sum(weight * value, axis=0)
    return np.sqrt(np.sum(weight**2 * spread**2, axis=0) * len(means) / (len(means) - 1))


def _binned(segment: _Segment, bins: int) -> tuple[Array, Array]:
    """Change of the drift-free residual, and time, per bin of the output angle turned to its ripple."""
    t = segment.t - segment.t.mean()
    drift = segment.residual @ t / (t @ t)
    residual = segment.residual - drift[:, None] * t
    middle = 0.5 * (segment.psi[1:] + segment.psi[:-1])
    change, dt = np.diff(residual), np.diff(segment.t)
    phase = math.atan2(float(np.sin(middle) @ change[0]), float(np.cos(middle) @ change[0]))
    index = np.floor((middle - phase) / (2.0 * math.pi) * bins).astype(np.int64) % bins
    sums = [np.bincount(index, weights=row, minlength=bins) for row in (*change, dt)]
    return np.array(sums[:2], dtype=float), np.array(sums[2], dtype=float)
