"""Predicted readouts for given unknowns, and the least-squares rows of each source of observation.

Predictions use the exact nulled geometry. Regressors use the small-angle matrices. This is enough for Gauss-Newton
steps: their relative error is the size of the misalignment, 1e-3.

Unknowns, in this order: polar ``u v`` (``m1 cos, m1 sin`` of its phase) and harmonics ``A_k B_k`` over the
encoder angle; the same for the equatorial gyro; ``eta0, eta_rate``; triad attitude (3), triad drift (3),
base attitude about two Earth axes (2). The angles alone cannot separate the third base angle from the triad's.

Sources: gimbal angles, pick-off, and the disturbance by case rotation in the specific force, also on a moving base, whose
unknown force is a slow spline [Hu2010] (docs/theory/platform.md section 5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from piga import earth
from piga.errors import ArgumentError
from piga.frames import axis_turn, rotation_vector_to_matrix
from piga.platform.geometry import (
    encoder_harmonics,
    exact_attitude,
    gimbal_attitude,
    over_case_angle,
    turns_to_gimbals,
    wrapped,
)
from piga.platform.scenario import Gyro, Harmonic
from piga.platform.simulate import Readouts
from piga.results import Array, Result


@dataclass(frozen=True)
class Tip:
    """One gyro's misalignment over the encoder angle: ``u, v`` [rad] and harmonics ``A_k, B_k`` (K,) [rad]."""

    u: float
    v: float
    cosines: Array
    sines: Array

    @classmethod
    def of(cls, gyro: Gyro, orders: int) -> Tip:
        """The unknowns that describe ``gyro``, with harmonics up to ``orders``."""
        m, phase = gyro.misalignment, gyro.phase
        return cls(m * float(np.cos(phase)), m * float(np.sin(phase)), *encoder_harmonics(gyro, orders))

    @property
    def vector(self) -> Array:
        """``u, v, A_1, B_1, A_2, B_2, ...``."""
        return np.concatenate([[self.u, self.v], np.stack([self.cosines, self.sines], axis=1).ravel()])

    @classmethod
    def from_vector(cls, p: Array) -> Tip:
        """Inverse of :attr:`vector`."""
        return cls(float(p[0]), float(p[1]), p[2::2].copy(), p[3::2].copy())

    @property
    def phase(self) -> float:
        """Phase of the fundamental [rad]."""
        return float(np.arctan2(self.v, self.u))

    def gyro(self) -> Gyro:
        """The gyro with misalignment, phase and harmonics over the case angle."""
        harmonics = []
        for k, (a, b) in enumerate(zip(self.cosines, self.sines, strict=True), start=1):
            phase = np.arctan2(-b, a) - k * self.phase
            harmonics.append(Harmonic(k, float(np.hypot(a, b)), float(np.remainder(phase, 2.0 * np.pi))))
        return Gyro(float(np.hypot(self.u, self.v)), self.phase, tuple(harmonics))

    def series(self, encoder: Array) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """``m(c) exp(i c)`` (n,) and its derivatives by the unknowns (n, 2 + 2K)."""
        turn = np.exp(1j * encoder)
        m = float(np.hypot(self.u, self.v))
        unit = complex(self.u, self.v) / m if m > 0.0 else 1.0 + 0.0j
        orders = np.arange(1, len(self.cosines) + 1)
        c, s = np.cos(np.outer(encoder, orders)), np.sin(np.outer(encoder, orders))
        wobble = c @ self.cosines + s @ self.sines
        twist = 1j * unit * wobble / m if m > 0.0 else 0.0 * turn
        columns = np.empty((len(encoder), 2 + 2 * len(orders)), dtype=complex)
        columns[:, 0] = turn * (1.0 - twist * unit.imag)
        columns[:, 1] = turn * (1j + twist * unit.real)
        columns[:, 2::2], columns[:, 3::2] = (turn * unit)[:, None] * c, (turn * unit)[:, None] * s
        return turn * unit * (m + wobble), columns


@dataclass(frozen=True, eq=False, repr=False)
class Unknowns(Result):
    """All unknowns of a static record; ``triad`` is ``C_i^G`` at time zero, ``base`` is ``C_b^e``."""

    polar: Tip
    equatorial: Tip
    eta0: float
    eta_rate: float
    triad: Array
    drift: Array
    base: Array

    def moved(self, step: Array) -> Unknowns:
        """The unknowns after a step, in the order of the module's docstring. Missing entries at the end are unchanged."""
        size = len(self.polar.vector)
        full = np.zeros(2 * size + 10)
        full[: len(step)] = step
        rest = full[2 * size :]
        return replace(
            self,
            polar=Tip.from_vector(self.polar.vector + full[:size]),
            equatorial=Tip.from_vector(self.equatorial.vector + full[size : 2 * size]),
            eta0=self.eta0 + rest[0],
            eta_rate=self.eta_rate + rest[1],
            triad=rotation_vector_to_matrix(-rest[2:5]) @ self.triad,
            drift=self.drift + rest[5:8],
            base=rotation_vector_to_matrix(np.array([rest[8], rest[9], 0.0])) @ self.base,
        )


def names(orders: int) -> tuple[str, ...]:
    """Names of the unknowns for ``orders`` harmonics."""
    tip = [f"{letter}{k}" for k in range(1, orders + 1) for letter in ("A", "B")]
    gyros = [f"{gyro}.{name}" for gyro in ("polar", "equatorial") for name in ("u", "v", *tip)]
    axes = [f"{what}.{axis}" for what in ("triad", "drift") for axis in "xyz"]
    return (*gyros, "eta0", "eta_rate", *axes, "base.1", "base.2")


def misalignment_regressors(x: Unknowns, times: Array, encoder1: Array, encoder2: Array) -> tuple[Array, Array]:
    """Derivatives of the small angles ``e`` (n, 3, p) and of the pick-off (n, p) by tips, eta0 and eta_rate."""
    first, d1 = x.polar.series(encoder1)
    second, d2 = x.equatorial.series(encoder2)
    eta = x.eta0 + x.eta_rate * times
    tangent, secant = np.tan(eta), 1.0 / np.cos(eta)
    n, size = d1.shape
    e, pick = np.zeros((n, 3, 2 * size + 2)), np.zeros((n, 2 * size + 2))
    e[:, 0, :size], e[:, 1, :size] = d1.real, d1.imag
    e[:, 2, :size] = -d1.real * tangent[:, None]
    e[:, 2, size : 2 * size] = d2.imag * secant[:, None]
    e[:, 2, -2] = second.imag * secant * tangent - first.real * secant**2
    e[:, 2, -1] = e[:, 2, -2] * times
    pick[:, :size], pick[:, size : 2 * size] = -d1.imag, d2.real
    pick[:, -2], pick[:, -1] = 1.0, times
    return e, pick


def _exact_platform(x: Unknowns, times: Array, encoder1: Array, encoder2: Array) -> tuple[Array, Array]:
    """Exact ``C_G^P`` (n, 3, 3) and pick-off (n,) for the unknowns."""
    polar, equatorial = over_case_angle(x.polar.gyro()), over_case_angle(x.equatorial.gyro())
    c1, c2 = encoder1 + x.polar.phase, encoder2 + x.equatorial.phase
    return exact_attitude(polar, c1, equatorial, c2, x.eta0 + x.eta_rate * times)


def _earth_to_inertial(times: Array) -> Array:
    """``C_e^i`` (n, 3, 3) at ``times`` [s]."""
    return axis_turn(2, -earth.EARTH_RATE * times)


def _triad_at(x: Unknowns, times: Array) -> Array:
    """``C_i^G`` (n, 3, 3), including the rotation by drift."""
    return rotation_vector_to_matrix(-times[:, None] * x.drift) @ x.triad


def gimbal_rows(x: Unknowns, readouts: Readouts) -> tuple[Array, Array]:
    """Residuals (n, 3) and regressors (n, 3, p) of the gimbal angles."""
    t = readouts.times
    attitude, _ = _exact_platform(x, t, readouts.encoder1, readouts.encoder2)
    to_platform = attitude @ _triad_at(x, t) @ _earth_to_inertial(t)
    e, _ = misalignment_regressors(x, t, readouts.encoder1, readouts.encoder2)
    turn = np.concatenate([e, attitude, attitude * t[:, None, None], -to_platform[:, :, :2]], axis=2)
    residual = wrapped(readouts.gimbals - gimbals_of(to_platform @ x.base))
    return residual, turns_to_gimbals(readouts.gimbals, turn)


def gimbals_of(body_to_platform: Array) -> Array:
    """Gimbal angles (n, 3) outer, middle, inner [rad] of ``C_b^P`` (n, 3, 3)."""
    c = body_to_platform
    return np.stack(
        [
            np.arctan2(c[:, 2, 1], c[:, 2, 0]),
            np.arctan2(np.hypot(c[:, 2, 0], c[:, 2, 1]), c[:, 2, 2]),
            np.arctan2(c[:, 1, 2], -c[:, 0, 2]),
        ],
        axis=1,
    )


def force_rows(x: Unknowns, readouts: Readouts, force_earth: Array) -> tuple[Array, Array]:
    """Residuals and regressors of the mean specific force over each step (n, 3) [m/s^2], on a base at rest.

    ``force_earth`` (3,): known specific force in Earth axes.
    """
    middle = 0.5 * (readouts.times[1:] + readouts.times[:-1])
    half = [0.5 * (angle[1:] + angle[:-1]) for angle in (readouts.encoder1, readouts.encoder2)]
    attitude, force = _felt(x, middle, half[0], half[1], force_earth)
    _, ends = _felt(x, readouts.times, readouts.encoder1, readouts.encoder2, force_earth)
    mean = (ends[:-1] + 4.0 * force + ends[1:]) / 6.0
    e, _ = misalignment_regressors(x, middle, *half)
    turn = np.concatenate(
        [e, attitude, attitude * middle[:, None, None], np.zeros((len(middle), 3, 2))], axis=2
    )
    return readouts.increments / readouts.step - mean, np.cross(force[:, :, None], turn, axis=1)


def _felt(
    x: Unknowns, times: Array, encoder1: Array, encoder2: Array, force_earth: Array
) -> tuple[Array, Array]:
    """``C_G^P`` and the specific force in platform axes at ``times``."""
    attitude, _ = _exact_platform(x, times, encoder1, encoder2)
    return attitude, (attitude @ _triad_at(x, times) @ _earth_to_inertial(times)) @ force_earth


def coarse_unknowns(readouts: Readouts, force_earth: Array, orders: int) -> Unknowns:
    """First guess from a static record: triad from the gravity cone, base from the first gimbal angles.

    Gravity at the two ends of the record gives two directions known in both frames (TRIAD method). The error is the
    size of the misalignments, which are still unknown.
    """
    n = len(readouts.increments)
    ends = [slice(0, max(1, n // 20)), slice(n - max(1, n // 20), n)]
    t = 0.5 * (readouts.times[1:] + readouts.times[:-1])
    seen = [readouts.increments[part].mean(axis=0) for part in ends]
    expected = [(_earth_to_inertial(t[part]) @ force_earth).mean(axis=0) for part in ends]
    triad = _triad(seen) @ _triad(expected).T
    zero = Tip(0.0, 0.0, np.zeros(orders), np.zeros(orders))
    base = triad.T @ gimbal_attitude(readouts.gimbals[0])
    rate, eta0 = np.polyfit(readouts.times, readouts.pickoff, 1)
    return Unknowns(zero, zero, float(eta0), float(rate), triad, np.zeros(3), base)


def _triad(pair: list[Array]) -> Array:
    first = pair[0] / np.linalg.norm(pair[0])
    across = np.cross(pair[0], pair[1])
    across /= np.linalg.norm(across)
    return np.stack([first, across, np.cross(first, across)], axis=1)


@dataclass(frozen=True)
class ForceFilter:
    """Filtering and thinning of the specific force of a moving base, in turns of the case. The values are own choices."""

    window: int = 10
    """Length of a Hann window, as a part of a turn. Two are applied in sequence."""
    rows: int = 20
    """Rows kept per turn. Lines up to order ten of the case rate stay below the folding frequency."""
    points: int = 80
    """Points per turn at which regressors are evaluated. They are smooth, and an accuracy of 1e-3 is enough."""
    turns: int = 16
    """Turns in a stretch. Stretches are independent, so the cost is proportional to the length of the record."""
    fewest: int = 20
    """Fewest samples per turn of the faster case."""


FORCE_FILTER = ForceFilter()


@dataclass(frozen=True)
class _ObservedStretch:
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
        """Time (r,) [s] at which the window of each row ends. The row is not known earlier."""
        last = np.arange(len(self.readouts.increments) + 1 - len(self.window))[:: self.stride] + len(
            self.window
        )
        return self.readouts.times[last]

    @cached_property
    def whitening(self) -> Array:
        """Lower triangle (r, r) that whitens the rows of smoothed white noise, to the noise level of the samples."""
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
        splines = BSpline.design_matrix(self._phase(self._points), _knots(self._pieces), 3).toarray()
        orthonormal, triangle = np.linalg.qr(self.whitening @ self._smooth_points(splines))
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
        attitude, _ = _exact_platform(x, *half)
        force = r.increments / r.step
        undone = np.einsum("nji,nj->ni", attitude[1::2], force)
        orthonormal, triangle = self._basis
        solution = np.linalg.solve(triangle, orthonormal.T @ (self.whitening @ self._smooth(undone)))
        slow = BSpline(_knots(self._pieces), solution, 3)(np.linspace(0.0, 1.0, len(half[0])))
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
        """Whitened rows (r, ...) without the part that a slow force can explain."""
        flat = white.reshape(len(white), -1)
        return (flat - self.slow @ (self.slow.T @ flat)).reshape(white.shape)


def stretches(readouts: Readouts, turns: tuple[float, float]) -> tuple[_ObservedStretch, ...]:
    """Cut a record; ``turns`` (2,) are the periods [s] of the faster and the slower case."""
    fast, slow = turns
    samples = fast / readouts.step
    every = max(1, round(samples / FORCE_FILTER.points))
    stride = every * max(1, round(samples / FORCE_FILTER.rows / every))
    hann = np.hanning(max(round(samples / FORCE_FILTER.window), 3) + 2)[1:-1]
    window = np.convolve(hann, hann) / hann.sum() ** 2
    n = len(readouts.increments)
    count = max(1, round(n * readouts.step / slow / FORCE_FILTER.turns))
    edges = np.linspace(0, n, count + 1).astype(np.int64)
    return tuple(
        _ObservedStretch(readouts.between(int(a), int(b)), window, stride, every, slow)
        for a, b in pairwise(edges)
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


def _knots(pieces: int) -> Array:
    """Knots of the cubic B-splines on equal pieces of 0 to 1."""
    return np.arange(-3.0, pieces + 4.0) / pieces


@dataclass(frozen=True)
class Reduced:
    """Rows of one kind with one noise level: their triangular ``factor`` (p + 1, p + 1), number of independent rows.

    An estimate needs nothing else.
    """

    name: str
    factor: Array
    rows: float

    @classmethod
    def of(cls, name: str, residual: Array, regressors: Array, rows: float | None = None) -> Reduced:
        """From a residual (n,) and regressors (n, p); ``rows`` is less than n if a trend was removed from them."""
        factor: Array = np.linalg.qr(np.column_stack([regressors, residual]), mode="r")  # type: ignore[assignment]
        return cls(name, factor, float(len(residual)) if rows is None else rows)

    def squares(self, step: Array) -> float:
        """Sum of squares of the residuals after ``step`` (p,)."""
        left = self.factor[:, -1] - self.factor[:, :-1] @ step
        return float(left @ left)


STATIC_SOURCES = ("gimbals", "pick-off")
MOVING_SOURCES = ("force", "pick-off")


@dataclass(frozen=True)
class ObservedRecord:
    """A record, the sources taken from it, and the highest harmonic looked for."""

    readouts: Readouts
    sources: tuple[str, ...]
    orders: int

    @classmethod
    def checked(cls, readouts: Readouts, sources: Sequence[str], orders: int) -> ObservedRecord:
        """Check the sources and the rotation of the cases; refuse an unknown source and too few or too fast turns."""
        unknown = [s for s in sources if s not in {"gimbals", "pick-off", "force"}]
        if unknown or not sources:
            raise ArgumentError(
                f"identification: sources {list(sources)!r}", remedy="name some of gimbals, pick-off, force"
            )
        record = cls(readouts, tuple(sources), orders)
        fast, slow = record.periods
        span = float(readouts.times[-1] - readouts.times[0])
        if np.isinf(slow):
            raise ArgumentError(
                "identification needs both cases turning, one is at rest",
                remedy="give [case_rotation] period and equatorial_period, or [compensation] misalignment = 'true'",
            )
        if not span >= 2.0 * slow:
            raise ArgumentError(
                f"identification needs two turns of the cases ({2.0 * slow:g} s), the record has {span:g} s",
                remedy="lengthen [identification] duration, or [compensation] misalignment = 'true'",
            )
        if "force" in sources and fast < FORCE_FILTER.fewest * readouts.step:
            raise ArgumentError(
                f"identification from the specific force needs {FORCE_FILTER.fewest} samples a case turn, the record has "
                f"{fast / readouts.step:.1f}",
                remedy=f"shorten [run] step to {fast / FORCE_FILTER.fewest:g} s",
            )
        return record

    @cached_property
    def periods(self) -> tuple[float, float]:
        """Periods [s] of the faster and the slower case; infinite if a case rests."""
        r = self.readouts
        rates = [float(np.abs(np.diff(angle[:3])).max()) / r.step for angle in (r.encoder1, r.encoder2)]
        fast, slow = max(rates), min(rates)
        return (2.0 * np.pi / fast if fast > 0.0 else np.inf, 2.0 * np.pi / slow if slow > 0.0 else np.inf)

    @cached_property
    def seen(self) -> NDArray[np.int64]:
        """True for unknowns that the sources together can observe (columns of every group)."""
        tips = 4 + 4 * self.orders
        eta = range(tips, tips + 2) if "pick-off" in self.sources else ()
        slow = range(tips + 2, tips + 10) if "gimbals" in self.sources else ()
        return np.array([*range(tips), *eta, *slow])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the observable unknowns."""
        every = names(self.orders)
        return tuple(every[k] for k in self.seen)

    @cached_property
    def stretches(self) -> tuple[_ObservedStretch, ...]:
        """Parts of the record for the specific force; none if it is not a source."""
        return stretches(self.readouts, self.periods) if "force" in self.sources else ()

    def moved(self, x: Unknowns, step: Array) -> Unknowns:
        """The unknowns after a step in the observable ones.

        If the pick-off is not a source, its mean and trend still give the redundancy angle.
        """
        whole = np.zeros(len(names(self.orders)))
        whole[self.seen] = step
        x = x.moved(whole)
        if "pick-off" in self.sources:
            return x
        r = self.readouts
        _, ring = _exact_platform(x, r.times, r.encoder1, r.encoder2)
        rate, start = np.polyfit(r.times, r.pickoff - ring, 1)
        return replace(x, eta0=x.eta0 + float(start), eta_rate=x.eta_rate + float(rate))

    def groups(self, x: Unknowns) -> list[Reduced]:
        """Rows of every source about ``x``. The rows of the force exclude what a slow force can explain."""
        r, groups = self.readouts, []
        if "gimbals" in self.sources:
            residual, regressors = gimbal_rows(x, r)
            groups.append(Reduced.of("gimbals", residual.ravel(), self._cut(regressors)))
        if "pick-off" in self.sources:
            _, ring = _exact_platform(x, r.times, r.encoder1, r.encoder2)
            _, pick = misalignment_regressors(x, r.times, r.encoder1, r.encoder2)
            groups.append(Reduced.of("pick-off", r.pickoff - ring, self._cut(pick)))
        if self.stretches:
            parts = [(s, *s.rows(x)) for s in self.stretches]
            residual = np.concatenate([s.without_slow(r).ravel() for s, r, _ in parts])
            columns = np.concatenate([self._cut(s.without_slow(c)) for s, _, c in parts])
            rows = 3.0 * sum(len(s.times) - s.slow.shape[1] for s in self.stretches)
            groups.append(Reduced.of("force", residual, columns, rows))
        return groups

    def _cut(self, columns: Array) -> Array:
        """Columns (n, p) of the observable unknowns; zero if the source does not contain them."""
        flat = columns.reshape(-1, columns.shape[-1])
        there = self.seen < flat.shape[1]
        out = np.zeros((len(flat), len(self.seen)))
        out[:, there] = flat[:, self.seen[there]]
        return out
