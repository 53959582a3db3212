"""What the readouts should be, given the unknowns: exact predictions and first-order regressors.

Predictions use the exact nulled geometry; regressors are those of the small-angle matrices, which is
enough for Gauss-Newton steps (they are right to the size of the misalignment, 1e-3).

Unknowns, in this order: polar ``u v`` (``m1 cos, m1 sin`` of its phase) and harmonics ``A_k B_k`` over the
encoder angle; the same for the equatorial gyro; ``eta0, eta_rate``; triad attitude (3), triad drift (3),
base attitude about two Earth axes (2). The third base angle cannot be told from the triad's by angles alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from piga import earth
from piga._kernels.platform.geometry import exact_geometry_series
from piga.frames import axis_turn, rotation_vector_to_matrix
from piga.platform.model.geometry import gimbal_attitude, turns_to_gimbals
from piga.platform.model.scenario import Gyro, Harmonic
from piga.platform.model.simulate import Readouts

Array = NDArray[np.float64]


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
        from piga.platform.model.models import encoder_harmonics

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
        """As a gyro with misalignment, phase and harmonics over the case angle."""
        harmonics = []
        for k, (a, b) in enumerate(zip(self.cosines, self.sines, strict=True), start=1):
            phase = np.arctan2(-b, a) - k * self.phase
            harmonics.append(Harmonic(k, float(np.hypot(a, b)), float(np.remainder(phase, 2.0 * np.pi))))
        return Gyro(float(np.hypot(self.u, self.v)), self.phase, tuple(harmonics))

    def over_case_angle(self) -> tuple[Array, Array]:
        """Cosine and sine coefficients over the case angle ``c = theta + phase`` (for the exact geometry)."""
        k = np.arange(1, len(self.cosines) + 1) * self.phase
        return (
            self.cosines * np.cos(k) - self.sines * np.sin(k),
            self.cosines * np.sin(k) + self.sines * np.cos(k),
        )

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


@dataclass(frozen=True)
class Unknowns:
    """All unknowns of a static record; ``triad`` is ``C_i^G`` at time zero, ``base`` is ``C_b^e``."""

    polar: Tip
    equatorial: Tip
    eta0: float
    eta_rate: float
    triad: Array
    drift: Array
    base: Array

    def moved(self, step: Array) -> Unknowns:
        """The unknowns after a step, in the order of the module's docstring (missing ones at the end stay)."""
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


def exact_platform(x: Unknowns, times: Array, encoder1: Array, encoder2: Array) -> tuple[Array, Array]:
    """Exact ``C_G^P`` (n, 3, 3) and pick-off (n,) for the unknowns."""
    attitude, ring = np.empty((len(times), 3, 3)), np.empty(len(times))
    exact_geometry_series(
        float(np.hypot(x.polar.u, x.polar.v)), *x.polar.over_case_angle(), encoder1 + x.polar.phase,
        float(np.hypot(x.equatorial.u, x.equatorial.v)), *x.equatorial.over_case_angle(),
        encoder2 + x.equatorial.phase, x.eta0 + x.eta_rate * times, attitude, ring,
    )  # fmt: skip
    return attitude, ring


def earth_to_inertial(times: Array) -> Array:
    """``C_e^i`` (n, 3, 3) at ``times`` [s]."""
    return axis_turn(2, -earth.EARTH_RATE * times)


def triad_at(x: Unknowns, times: Array) -> Array:
    """``C_i^G`` (n, 3, 3) with the drift turned in."""
    return rotation_vector_to_matrix(-times[:, None] * x.drift) @ x.triad


def gimbal_rows(x: Unknowns, readouts: Readouts) -> tuple[Array, Array]:
    """Residuals (n, 3) and regressors (n, 3, p) of the gimbal angles."""
    t = readouts.times
    attitude, _ = exact_platform(x, t, readouts.encoder1, readouts.encoder2)
    to_platform = attitude @ triad_at(x, t) @ earth_to_inertial(t)
    e, _ = misalignment_regressors(x, t, readouts.encoder1, readouts.encoder2)
    turn = np.concatenate([e, attitude, attitude * t[:, None, None], -to_platform[:, :, :2]], axis=2)
    residual = np.remainder(readouts.gimbals - gimbals_of(to_platform @ x.base) + np.pi, 2.0 * np.pi) - np.pi
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
    attitude, _ = exact_platform(x, times, encoder1, encoder2)
    return attitude, (attitude @ triad_at(x, times) @ earth_to_inertial(times)) @ force_earth


def coarse_unknowns(readouts: Readouts, force_earth: Array, orders: int) -> Unknowns:
    """First guess from a static record: triad from the gravity cone, base from the first gimbal angles.

    Gravity at the two ends of the record gives two directions known in both frames (TRIAD); the
    misalignments, still unknown, leave an error of their own size.
    """
    n = len(readouts.increments)
    ends = [slice(0, max(1, n // 20)), slice(n - max(1, n // 20), n)]
    t = 0.5 * (readouts.times[1:] + readouts.times[:-1])
    seen = [readouts.increments[part].mean(axis=0) for part in ends]
    known = [(earth_to_inertial(t[part]) @ force_earth).mean(axis=0) for part in ends]
    triad = _triad(seen) @ _triad(known).T
    zero = Tip(0.0, 0.0, np.zeros(orders), np.zeros(orders))
    base = triad.T @ gimbal_attitude(readouts.gimbals[0])
    rate, eta0 = np.polyfit(readouts.times, readouts.pickoff, 1)
    return Unknowns(zero, zero, float(eta0), float(rate), triad, np.zeros(3), base)


def _triad(pair: list[Array]) -> Array:
    first = pair[0] / np.linalg.norm(pair[0])
    across = np.cross(pair[0], pair[1])
    across /= np.linalg.norm(across)
    return np.stack([first, across, np.cross(first, across)], axis=1)
