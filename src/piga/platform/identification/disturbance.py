"""The disturbance that case rotation leaves in the specific force of a base that may move [Hu2010].

A platform off its triad by the small angles ``e`` feels ``f - e x f``. The force ``f`` itself is not known on a
moving base; what is, is where it cannot be: far from the lines of the cases, its slow part follows a spline with
a knot a turn, its fast part does not pass a window of a fifth of a turn.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from piga.platform.identification.observation import Unknowns, exact_platform, misalignment_regressors
from piga.platform.model.simulate import Readouts

Array = NDArray[np.float64]

_WINDOW = 10
"""The window is two Hann windows of a tenth of a turn one after the other."""
_ROWS = 20
"""Rows kept per turn: lines up to the tenth of the case rate stay below the folding frequency."""
_POINTS = 80
"""Points per turn at which regressors are evaluated: they are smooth and need be right to 1e-3 only."""
_TURNS = 16
"""Length of a stretch [turns]; stretches are independent, so that the cost grows with the record only."""


@dataclass(frozen=True)
class Stretch:
    """Part of a record, with what smoothing, whitening and the slow force need; nothing of the unknowns.

    ``readouts`` of the stretch alone; ``window`` weights over samples, a row every ``stride`` samples;
    ``every``: spacing of the points at which regressors are taken; ``spacing`` [s] of the spline's knots.
    """

    readouts: Readouts
    window: Array
    stride: int
    every: int
    spacing: float

    @cached_property
    def times(self) -> Array:
        """Time (r,) [s] at which the window of each row ends: nothing of the row is known before."""
        last = np.arange(len(self.readouts.increments) + 1 - len(self.window))[:: self.stride] + len(
            self.window
        )
        return self.readouts.times[last]

    @cached_property
    def whitening(self) -> Array:
        """Lower triangle (r, r) that makes rows of white noise, smoothed, white again with the samples' level."""
        lags = np.arange(0, len(self.window), self.stride)
        overlap = np.array([self.window[k:] @ self.window[: len(self.window) - k] for k in lags])
        apart = np.abs(np.subtract.outer(*[np.arange(len(self.times))] * 2))
        spread = np.where(apart < len(lags), overlap[np.minimum(apart, len(lags) - 1)], 0.0)
        return np.asarray(np.linalg.inv(np.linalg.cholesky(spread)), dtype=np.float64)

    @cached_property
    def slow(self) -> Array:
        """Orthonormal columns (r, q) that span the slow force along one axis, smoothed and whitened."""
        return self._basis[0]

    @cached_property
    def _basis(self) -> tuple[Array, Array]:
        from_points = _spline_columns(self._phase(self._points), self._pieces)
        orthonormal, triangle = np.linalg.qr(self.whitening @ self._smooth_points(from_points))
        return orthonormal, triangle

    @cached_property
    def _points(self) -> NDArray[np.int64]:
        """Index of the samples at whose middle regressors are taken."""
        first = (len(self.window) // 2) % self.every
        return np.arange(first, len(self.readouts.increments), self.every, dtype=np.int64)

    @cached_property
    def _pieces(self) -> int:
        return max(1, int((self.readouts.times[-1] - self.readouts.times[0]) / self.spacing))

    def _phase(self, samples: NDArray[np.int64]) -> Array:
        """Position 0 to 1 within the stretch of the middle of each sample."""
        return (samples + 0.5) / len(self.readouts.increments)

    def _smooth(self, values: Array) -> Array:
        """Rows from one value a sample, (n, ...) to (r, ...)."""
        return _weighted(values, self.window, self.stride)

    def _smooth_points(self, values: Array) -> Array:
        """Rows from values at the points only."""
        thin = self.window[(len(self.window) // 2) % self.every :: self.every]
        rows = _weighted(values, thin / thin.sum(), self.stride // self.every)
        return rows[: len(self.times)]

    def rows(self, x: Unknowns) -> tuple[Array, Array]:
        """Whitened residuals (r, 3) [m/s^2] and regressors (r, 3, p) by tips, eta0 and eta_rate.

        The step-mean of the predicted force is taken by Simpson's rule on the exact geometry, so that the
        length of the step does not bias the unknowns. Gyro accelerometers read the platform's own turn too.
        """
        r = self.readouts
        half = [_halved(v) for v in (r.times, r.encoder1, r.encoder2)]
        attitude, _ = exact_platform(x, *half)
        force = r.increments / r.step
        undone = np.einsum("nji,nj->ni", attitude[1::2], force)
        orthonormal, triangle = self._basis
        found = np.linalg.solve(triangle, orthonormal.T @ (self.whitening @ self._smooth(undone)))
        slow = _spline(np.linspace(0.0, 1.0, len(half[0])), self._pieces, np.asarray(found, dtype=np.float64))
        felt = np.einsum("nij,nj->ni", attitude, slow)
        predicted = (felt[:-1:2] + 4.0 * felt[1::2] + felt[2::2]) / 6.0
        points = [v[1::2][self._points] for v in half]
        e, _ = misalignment_regressors(x, *points)
        columns = np.cross(slow[1::2][self._points][:, :, None], e, axis=1)
        if r.turn_sensitivity > 0.0:
            predicted -= _turns(attitude[::2]) * (r.turn_sensitivity / r.step)
            columns -= np.gradient(e, points[0], axis=0) * r.turn_sensitivity
        columns[1:-1] += np.diff(columns, 2, axis=0) / (24.0 * self.every**2)  # their mean over the step
        table = [self._smooth(force - predicted)[:, :, None], self._smooth_points(columns)]
        white = np.tensordot(self.whitening, np.concatenate(table, axis=2), axes=1)
        return white[:, :, 0], white[:, :, 1:]

    def without_slow(self, white: Array) -> Array:
        """Whitened rows (r, ...) less their part that a slow force could have caused."""
        flat = white.reshape(len(white), -1)
        return (flat - self.slow @ (self.slow.T @ flat)).reshape(white.shape)


def stretches(readouts: Readouts, turns: tuple[float, float]) -> tuple[Stretch, ...]:
    """Cut a record; ``turns`` (2,) are the periods [s] of the faster and the slower case."""
    fast, slow = turns
    samples = fast / readouts.step
    every = max(1, round(samples / _POINTS))
    stride = every * max(1, round(samples / _ROWS / every))
    hann = np.hanning(max(round(samples / _WINDOW), 3) + 2)[1:-1]
    window = np.convolve(hann, hann) / hann.sum() ** 2
    n = len(readouts.increments)
    count = max(1, round(n * readouts.step / slow / _TURNS))
    edges = np.linspace(0, n, count + 1).astype(np.int64)
    return tuple(
        Stretch(readouts.between(int(a), int(b)), window, stride, every, slow) for a, b in pairwise(edges)
    )


def _weighted(values: Array, weights: Array, stride: int) -> Array:
    flat = values.reshape(len(values), -1)
    rows = sliding_window_view(flat, len(weights), axis=0)[::stride] @ weights
    return rows.reshape(len(rows), *values.shape[1:])


def _halved(nodes: Array) -> Array:
    """Values at nodes and, between them, in the middle of every step."""
    out = np.empty(2 * len(nodes) - 1)
    out[::2], out[1::2] = nodes, 0.5 * (nodes[1:] + nodes[:-1])
    return out


def _turns(attitude: Array) -> Array:
    """Turn (n, 3) [rad] of the platform over each step in its own axes, from ``C_G^P`` (n + 1, 3, 3)."""
    step = np.einsum("nij,nkj->nik", attitude[1:], attitude[:-1])
    return 0.5 * np.stack([step[:, j - 2, j - 1] - step[:, j - 1, j - 2] for j in range(3)], axis=1)


def _cubic(u: Array) -> Array:
    """The four cubic B-splines (n, 4) that reach over a piece, at ``u`` (n,) 0 to 1 within it."""
    v = 1.0 - u
    return np.stack([v**3, 3 * u**3 - 6 * u**2 + 4, 3 * v**3 - 6 * v**2 + 4, u**3], axis=1) / 6.0


def _located(phase: Array, pieces: int) -> tuple[NDArray[np.int64], Array]:
    piece = np.minimum((phase * pieces).astype(np.int64), pieces - 1)
    return piece, _cubic(phase * pieces - piece)


def _spline_columns(phase: Array, pieces: int) -> Array:
    """Values (n, pieces + 3) of all cubic B-splines on equal pieces at ``phase`` 0 to 1."""
    piece, values = _located(phase, pieces)
    columns = np.zeros((len(phase), pieces + 3))
    np.put_along_axis(columns, piece[:, None] + np.arange(4), values, axis=1)
    return columns


def _spline(phase: Array, pieces: int, coefficients: Array) -> Array:
    """The spline (n, 3) with ``coefficients`` (pieces + 3, 3)."""
    piece, values = _located(phase, pieces)
    total = values[:, :1] * coefficients[piece]
    for k in range(1, 4):
        total += values[:, k, None] * coefficients[piece + k]
    return total
