"""Predicted readouts for given unknowns, and the least-squares rows of each source of observation.

Predictions use the exact nulled geometry; regressors are their differences.

Unknowns, in this order: polar ``u v`` (``m1 cos, m1 sin`` of its phase) and harmonics ``A_k B_k`` over the
encoder angle; the same for the equatorial gyro; ``eta0, eta_rate``; triad attitude (3), triad drift (3),
base attitude about Earth axes (3). The angles alone cannot separate the third base angle from the triad's.

Sources: gimbal angles, pick-off, and the disturbance by case rotation in the specific force, also on a moving base, whose
unknown force is a slow spline [Hu2010] (docs/theory/platform.md section 5). Alignment takes the known force at ``rest``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.linalg import toeplitz

from piga.errors import ArgumentError
from piga.frames import rotation_vector_to_matrix
from piga.platform import geometry
from piga.platform.scenario import Gyro, Harmonic, Place
from piga.platform.simulate import Readouts
from piga.results import Array, Result

SOURCES = ("gimbals", "pick-off", "force")
STATIC_SOURCES = ("gimbals", "pick-off")
MOVING_SOURCES = ("force", "pick-off")


def tip_of(gyro: Gyro, orders: int) -> Array:
    """Misalignment over the encoder angle: ``u, v, A_1, B_1, A_2, B_2, ...`` [rad], with harmonics up to ``orders``."""
    waves = np.zeros(1 + orders, dtype=complex)
    waves[0] = gyro.misalignment * np.exp(-1j * gyro.phase)
    for h in gyro.harmonics:
        if h.order <= orders:
            waves[h.order] += h.amplitude * np.exp(1j * (h.order * gyro.phase + h.phase))
    return np.stack([waves.real, -waves.imag], axis=1).ravel()


def gyro_of(tip: Array) -> Gyro:
    """The gyro with misalignment, phase and harmonics over the case angle."""
    phase, pairs = float(np.arctan2(tip[1], tip[0])), enumerate(tip[2:].reshape(-1, 2), start=1)
    waves = [(k, np.hypot(a, b), np.arctan2(-b, a) - k * phase) for k, (a, b) in pairs]
    harmonics = tuple(Harmonic(k, float(size), float(np.remainder(p, 2.0 * np.pi))) for k, size, p in waves)
    return Gyro(float(np.hypot(*tip[:2])), phase, harmonics)


@dataclass(frozen=True, eq=False, repr=False)
class Unknowns(Result):
    """All unknowns of a record; ``polar, equatorial`` as of :func:`tip_of`, ``triad`` ``C_i^G`` at time zero, ``base`` ``C_b^e``.

    The methods take times (n,) [s] and the angles (n,) [rad] of the two encoders.
    """

    polar: Array
    equatorial: Array
    eta0: float
    eta_rate: float
    triad: Array
    drift: Array
    base: Array

    def moved(self, step: Array) -> Unknowns:
        """The unknowns after a step, in the order of the module's docstring."""
        size = len(self.polar)
        polar, equatorial, eta, triad, drift, base = np.split(step, 2 * size + np.array([-size, 0, 2, 5, 8]))
        return Unknowns(
            self.polar + polar,
            self.equatorial + equatorial,
            self.eta0 + eta[0],
            self.eta_rate + eta[1],
            rotation_vector_to_matrix(-triad) @ self.triad,
            self.drift + drift,
            rotation_vector_to_matrix(base) @ self.base,
        )

    def platform(self, times: Array, encoder1: Array, encoder2: Array) -> tuple[Array, Array]:
        """Exact ``C_G^P`` (n, 3, 3) and pick-off (n,) [rad]."""
        polar, equatorial = gyro_of(self.polar), gyro_of(self.equatorial)
        eta = self.eta0 + self.eta_rate * times
        return geometry.nulled_attitude(
            polar, equatorial, encoder1 + polar.phase, encoder2 + equatorial.phase, eta
        )

    def from_earth(self, attitude: Array, times: Array) -> Array:
        """``C_e^P`` (n, 3, 3) from ``C_G^P``, with the turn of the triad by drift."""
        return (
            attitude @ rotation_vector_to_matrix(-times[:, None] * self.drift) @ self.triad
        ) @ geometry.earth_to_inertial(times)


def names(orders: int) -> tuple[str, ...]:
    """Names of the unknowns for ``orders`` harmonics."""
    tip = [f"{letter}{k}" for k in range(1, orders + 1) for letter in ("A", "B")]
    gyros = [f"{gyro}.{name}" for gyro in ("polar", "equatorial") for name in ("u", "v", *tip)]
    axes = [f"{what}.{axis}" for what in ("triad", "drift") for axis in "xyz"]
    return (*gyros, "eta0", "eta_rate", *axes, "base.1", "base.2", "base.3")


def _triad_of(first: Array, second: Array) -> Array:
    """Axes (3, 3) along the first direction, across both, and the third."""
    along, across = first / np.linalg.norm(first), np.cross(first, second)
    across /= np.linalg.norm(across)
    return np.stack([along, across, np.cross(along, across)], axis=1)


_WINDOW, _ROWS, _SAMPLES, _TURNS, _FEWEST = 10, 20, 160, 16, 20
"""Specific force of a moving base, in turns of the case (own choices): a Hann window, applied twice, is this part of a turn;
rows kept and most samples per turn (finer increments are added up); turns in a stretch; fewest samples per turn."""


@dataclass(frozen=True)
class _Stretch:
    """Part of a record, with what smoothing, whitening and the slow force need; nothing of the unknowns.

    ``readouts`` of the stretch alone, each sample the sum of ``added`` of the record; ``window`` weights over samples, a row
    every ``stride`` samples; ``spacing`` [s] of the spline's knots.
    """

    readouts: Readouts
    added: int
    window: Array
    stride: int
    spacing: float

    @cached_property
    def whitening(self) -> Array:
        """Lower triangle (r, r) that whitens the rows of smoothed white noise, to the noise level of the record."""
        w, count = self.window, len(range(0, len(self.readouts.increments) + 1 - len(self.window), self.stride))
        overlap = np.zeros(max(count, len(w)))
        overlap[: -(-len(w) // self.stride)] = [w[k:] @ w[: len(w) - k] for k in range(0, len(w), self.stride)]
        return np.asarray(np.linalg.inv(np.linalg.cholesky(toeplitz(overlap[:count] / self.added))))

    @cached_property
    def knots(self) -> Array:
        """Knots of the cubic B-splines of the slow force on equal pieces of 0 to 1, the stretch."""
        pieces = max(1, int((self.readouts.times[-1] - self.readouts.times[0]) / self.spacing))
        return np.arange(-3.0, pieces + 4.0) / pieces

    @cached_property
    def slow(self) -> tuple[Array, Array]:
        """QR of the columns (r, q) that span the slow force along one axis, smoothed and whitened."""
        n = len(self.readouts.increments)
        splines = BSpline.design_matrix((np.arange(n) + 0.5) / n, self.knots, 3).toarray()
        return np.linalg.qr(self._whitened(splines))

    def _whitened(self, values: Array) -> Array:
        """Smoothed and whitened rows (r, ...) of ``values`` (n, ...)."""
        flat = values.reshape(len(values), -1)
        rows = sliding_window_view(flat, len(self.window), axis=0)[:: self.stride] @ self.window
        return (self.whitening @ rows).reshape(len(rows), *values.shape[1:])

    def residuals(self, x: Unknowns) -> Array:
        """Whitened residuals (r, 3) [m/s^2] without the slow force.

        The step-mean of the predicted force is taken by Simpson's rule on the exact geometry, so that the
        length of the step does not bias the unknowns. Gyro accelerometers read the platform's own turn too.
        """
        r = self.readouts
        half = [geometry.halved(v) for v in _nodes(r)]
        attitude, _ = x.platform(*half)
        force, (orthonormal, triangle) = r.increments / r.step, self.slow
        undone = self._whitened(np.einsum("nji,nj->ni", attitude[1::2], force))
        solution = np.linalg.solve(triangle, orthonormal.T @ undone)
        slow = BSpline(self.knots, solution, 3)(np.linspace(0.0, 1.0, len(half[0])))
        predicted = geometry.step_means(np.einsum("nij,nj->ni", attitude, slow))
        if r.turn_sensitivity > 0.0:  # the turn of the platform over each step, in its own axes
            predicted -= geometry.turns_between(attitude[::2]) * (r.turn_sensitivity / r.step)
        white = self._whitened(force - predicted)
        return white - orthonormal @ (orthonormal.T @ white)


def _nodes(r: Readouts) -> tuple[Array, Array, Array]:
    """Times and encoder angles of a record."""
    return r.times, r.encoder1, r.encoder2


class Reduced(NamedTuple):
    """Rows of one kind with one noise level: their triangular ``factor`` (p + 1, p + 1), and how many are independent."""

    name: str
    factor: Array
    rows: float


_DIFFERENCE = 1e-9
"""Step of the differences [rad], over the record for a rate."""


@dataclass(frozen=True)
class ObservedRecord:
    """A record at a place, the sources taken from it, and the highest harmonic looked for."""

    readouts: Readouts
    place: Place
    sources: tuple[str, ...]
    orders: int

    @classmethod
    def checked(cls, readouts: Readouts, place: Place, sources: Sequence[str], orders: int) -> ObservedRecord:
        """Check the sources and the rotation of the cases; refuse an unknown source and too few or too fast turns."""
        if not sources or set(sources) - set(SOURCES):
            raise ArgumentError(
                f"identification: sources {list(sources)!r}", remedy="name some of gimbals, pick-off, force"
            )
        record = cls(readouts, place, tuple(sources), orders)
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
        if "force" in sources and fast < _FEWEST * readouts.step:
            raise ArgumentError(
                f"identification from the specific force needs {_FEWEST} samples a case turn, the record has "
                f"{fast / readouts.step:.1f}",
                remedy=f"shorten [run] step to {fast / _FEWEST:g} s",
            )
        return record

    @cached_property
    def periods(self) -> tuple[float, float]:
        """Periods [s] of the faster and the slower case; infinite if a case rests."""
        r = self.readouts
        rates = [float(np.abs(np.diff(angle[:3])).max()) / r.step for angle in (r.encoder1, r.encoder2)]
        fast, slow = sorted(2.0 * np.pi / rate if rate > 0.0 else np.inf for rate in rates)
        return fast, slow

    @cached_property
    def seen(self) -> NDArray[np.int64]:
        """Index of the unknowns that the sources together can observe (columns of every group)."""
        tips = 4 + 4 * self.orders
        if "rest" in self.sources:
            return np.arange(tips + 2, tips + 11)
        eta = range(tips, tips + 2) if "pick-off" in self.sources else ()
        slow = range(tips + 2, tips + 10) if "gimbals" in self.sources else ()
        return np.array([*range(tips), *eta, *slow])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the observable unknowns."""
        every = names(self.orders)
        return tuple(every[k] for k in self.seen)

    @cached_property
    def force_at_rest(self) -> Array:
        """Specific force (3,) in Earth axes [m/s^2] of a base at rest."""
        place = self.place
        return geometry.specific_force_at_rest(
            geometry.geodetic_to_earth(place.latitude, place.longitude, place.height)
        )

    @cached_property
    def stretches(self) -> tuple[_Stretch, ...]:
        """Parts of the record for the specific force of any base."""
        (fast, slow), r = self.periods, self.readouts
        every = max(1, int(fast / r.step / _SAMPLES))
        r = r.between(0, len(r.increments) // every * every, every)
        samples, n = fast / r.step, len(r.increments)
        stride = max(1, round(samples / _ROWS))
        hann = np.hanning(max(round(samples / _WINDOW), 3) + 2)[1:-1]
        window = np.convolve(hann, hann) / hann.sum() ** 2
        count = max(1, round(n * r.step / slow / _TURNS))
        edges = np.linspace(0, n, count + 1).astype(np.int64).tolist()
        return tuple(_Stretch(r.between(a, b), every, window, stride, slow) for a, b in pairwise(edges))

    def coarse(self) -> Unknowns:
        """First guess from a static record: triad from the gravity cone, base from the first gimbal angles.

        Gravity at the two ends of the record gives two directions known in both frames (TRIAD method). The error is the
        size of the misalignments, which are still unknown.
        """
        r, few = self.readouts, max(1, len(self.readouts.increments) // 20)
        t = 0.5 * (r.times[1:] + r.times[:-1])
        turned = geometry.earth_to_inertial(t) @ self.force_at_rest
        shown, felt = (
            _triad_of(values[:few].mean(axis=0), values[-few:].mean(axis=0))
            for values in (r.increments, turned)
        )
        triad, zero = shown @ felt.T, np.zeros(2 + 2 * self.orders)
        rate, eta0 = np.polyfit(r.times, r.pickoff, 1)
        base = triad.T @ geometry.gimbal_attitude(r.gimbals[0])
        return Unknowns(zero, zero, float(eta0), float(rate), triad, np.zeros(3), base)

    def moved(self, x: Unknowns, step: Array) -> Unknowns:
        """The unknowns after a step in the observable ones.

        If the pick-off is not a source of an identification, its mean and trend still give the redundancy angle.
        """
        whole = np.zeros(len(names(self.orders)))
        whole[self.seen] = step
        x = x.moved(whole)
        if {"pick-off", "rest"} & set(self.sources):
            return x
        _, ring = x.platform(*_nodes(self.readouts))
        rate, start = np.polyfit(self.readouts.times, self.readouts.pickoff - ring, 1)
        return replace(x, eta0=x.eta0 + float(start), eta_rate=x.eta_rate + float(rate))

    def groups(self, x: Unknowns) -> list[Reduced]:
        """Rows of every source about ``x``. The rows of the force exclude what a slow force can explain."""
        every, span = names(self.orders), float(self.readouts.times[-1] - self.readouts.times[0])
        platform, ends = x.platform(*self._nodes), []
        for k in self.seen:
            size = _DIFFERENCE / (span if "rate" in every[k] or "drift" in every[k] else 1.0)
            moved = x.moved(size * (np.arange(len(every)) == k))
            same = k >= every.index("triad.x")
            left = self._residuals(moved, platform if same else moved.platform(*self._nodes))
            ends.append((size, left))
        made = []
        for name, residual in self._residuals(x, platform).items():
            columns = [(residual - left[name]).ravel() / size for size, left in ends]
            factor: Array = np.linalg.qr(np.column_stack([*columns, residual.ravel()]), mode="r")  # type: ignore[assignment]
            rows = float(residual.size)
            if name == "force" and "force" in self.sources:
                rows = 3.0 * sum(len(s.whitening) - s.slow[0].shape[1] for s in self.stretches)
            made.append(Reduced(name, factor, rows))
        return made

    @cached_property
    def _nodes(self) -> list[Array]:
        """Times and encoder angles of the record, at the half steps, too, where the force of a base at rest is taken."""
        return [geometry.halved(v) if "rest" in self.sources else v for v in _nodes(self.readouts)]

    def _residuals(self, x: Unknowns, platform: tuple[Array, Array]) -> dict[str, Array]:
        """Measured less predicted of each source, with ``x.platform`` at the nodes."""
        r, left, (attitude, ring) = self.readouts, {}, platform
        if {"gimbals", "rest"} & set(self.sources):
            to_platform = x.from_earth(attitude, self._nodes[0])
        if "gimbals" in self.sources:
            shown = geometry.gimbals_of((to_platform[::2] if "rest" in self.sources else to_platform) @ x.base)
            left["gimbals"] = geometry.wrapped(r.gimbals - shown)
        if "pick-off" in self.sources:
            left["pick-off"] = r.pickoff - ring
        if "force" in self.sources:
            left["force"] = np.concatenate([stretch.residuals(x) for stretch in self.stretches])
        if "rest" in self.sources:  # the mean over each step
            left["force"] = r.increments / r.step - geometry.step_means(to_platform @ self.force_at_rest)
        return left
