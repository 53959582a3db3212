"""Simulated tests with known truth for the statistics of the estimator: cheap, independent of the product's motion code.

Every scenario has constant force in each segment, so that one step of the motion is the closed form of a
2x2 matrix exponential (docs/theory/motion); the random walk is part of the motion, white noise and
counting of the reading. The gimbal starts anywhere in every segment.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

import piga
from piga._kernels.jit import kernel
from piga.units import G0, to_si

Array = NDArray[np.float64]

SCALE = 0.8884
"""True scale factor [(rad/s)/g]."""
PHI = 0.48


@kernel
def _motion(a: float, y: float, z: float, start: float, noise: Array, out: Array) -> None:
    """Angle after every step of increments a, y, z (rad, tan_beta included in y, z), noise added after each."""
    x = 0.25 * (y * y + z * z - a * a)
    root = math.sqrt(abs(x))
    if x >= 0.0:
        c, s = math.cosh(root), (math.sinh(root) / root if root > 1e-9 else 1.0)
    else:
        c, s = math.cos(root), (math.sin(root) / root if root > 1e-9 else 1.0)
    alpha = start
    out[0] = alpha
    for i in range(noise.size):
        sine, cosine = math.sin(alpha), math.cos(alpha)
        step = 2.0 * math.atan2(0.5 * s * (a + y * sine - z * cosine), c - 0.5 * s * (y * cosine + z * sine))
        alpha += step + noise[i]
        out[i + 1] = alpha


@dataclass(frozen=True)
class Scenario:
    """A test: forces [g] of its segments, sampling, noise, terms and truth (file units)."""

    name: str
    forces: Array
    seconds: float = 20.0
    rate: float = 10.0
    white: float = 0.0
    walk: float = 0.0
    count: float = 0.0
    tan_beta: float = 3.6e-4
    truth: dict[str, float] = field(default_factory=lambda: {"k0": 1.6e-3})
    terms: tuple[str, ...] = ("scale_factor", "tan_beta", "k0")
    turning: Array | None = None
    phi: float = PHI
    drift: float = 0.0
    scatter: float = 0.0

    def true_value(self, name: str) -> float:
        """Truth in file units."""
        fixed = {"scale_factor": SCALE, "tan_beta": self.tan_beta, "phi": self.phi}
        return fixed[name] if name in fixed else self.truth.get(name, 0.0)

    def indicated(self) -> Array:
        """Indicated specific force along X0 less the coupling, per segment [g]."""
        a, y, z = self.forces.T
        products = _products(a, y, z)
        return a + sum(value * products[name] for name, value in self.truth.items())

    def record(self, rng: np.random.Generator) -> piga.Run:
        """One simulated test."""
        steps, h = round(self.seconds * self.rate), 1.0 / self.rate
        count = len(self.forces)
        psi = np.empty((count, steps + 1))
        omega = np.zeros((count, 3)) if self.turning is None else self.turning
        a = SCALE * self.indicated() - omega[:, 0]
        y = self.tan_beta * (SCALE * self.forces[:, 1] - omega[:, 1])
        z = self.tan_beta * (SCALE * self.forces[:, 2] - omega[:, 2])
        noise = self.walk * math.sqrt(h) * rng.standard_normal((count, steps))
        starts = rng.uniform(-math.pi, math.pi, count)
        if self.drift:
            noise += h * self._wandering(rng)
        if self.scatter:
            noise += h * self.scatter * rng.standard_normal((count, 1))
        for s in range(count):
            _motion(a[s] * h, y[s] * h, z[s] * h, starts[s], noise[s], psi[s])
        output = psi.ravel() - self.phi
        if self.white:
            output = output + self.white * rng.standard_normal(output.size)
        if self.count:
            output = np.round(output / self.count) * self.count
        t = (np.arange(count)[:, None] * (self.seconds + 5.0) + h * np.arange(steps + 1)).ravel()
        base = None if self.turning is None else np.repeat(self.turning, steps + 1, axis=0)
        return piga.Run.from_arrays(
            t,
            output,
            np.repeat(self.forces * G0, steps + 1, axis=0),
            scale_factor=to_si(f"{SCALE} rad/s/g", "rad/s/g"),
            base_rate=base,
            segment=np.repeat(np.arange(count, dtype=np.int32), steps + 1),
            resolution=self.count,
            serial="synthetic",
        )

    def _times(self) -> Array:
        """Middle of every step, from the middle of the test, (segments, steps) [s]."""
        steps, count = round(self.seconds * self.rate), len(self.forces)
        whole = count * (self.seconds + 5.0) - 5.0
        starts = (self.seconds + 5.0) * np.arange(count)[:, None]
        times: Array = starts + (np.arange(steps) + 0.5) / self.rate - 0.5 * whole
        return times

    def _wandering(self, rng: np.random.Generator) -> Array:
        """A random walk of the rate at ``_times``, zero in the middle of the test [rad/s]."""
        t = self._times().ravel()
        steps = np.sqrt(np.diff(np.append(t[0], t)))
        walk = self.drift * np.cumsum(steps * rng.standard_normal(t.size))
        return (walk - np.interp(0.0, t, walk)).reshape(self._times().shape)

    def calibrate(self, run: piga.Run) -> piga.Calibration:
        """The estimate that is put to the test."""
        return piga.calibrate(run, self.terms)

    def errors(self, found: piga.Calibration) -> Array:
        """Error of every coefficient in file units, in the order of the result."""
        errors = np.array([c.value - self.true_value(c.name) for c in found.coefficients])
        return _nearest(found, errors)

    def bound(self, run: piga.Run) -> Array:
        """Cramer-Rao covariance (file units) for the true noise levels, computed densely, white reading noise."""
        return np.linalg.inv(self.information(run))

    def information(self, run: piga.Run) -> Array:
        """Fisher information of the coefficients (file units).

        ``r = white^2 + count^2/12`` and ``q = walk^2``; the increments' full covariance is inverted. With a drift
        the segments are not independent; a scatter moves all increments of a segment alike.
        """
        steps, h = round(self.seconds * self.rate), 1.0 / self.rate
        r = self.white**2 + self.count**2 / 12.0
        V = np.diag(np.full(steps, self.walk**2 * h + 2.0 * r)) - r * (
            np.diag(np.ones(steps - 1), 1) + np.diag(np.ones(steps - 1), -1)
        )
        V += (self.scatter * h) ** 2
        parts = [
            self._derivatives(run.output[run.segment == s] + self.phi, s, h) for s in range(len(self.forces))
        ]
        if self.drift:
            t = self._times().ravel()
            together = np.minimum.outer(np.abs(t), np.abs(t)) * (np.multiply.outer(t, t) > 0.0)
            whole = np.kron(np.eye(len(parts)), V) + (self.drift * h) ** 2 * together
            columns = np.concatenate(parts)
            found: Array = columns.T @ np.linalg.solve(whole, columns)
            return found
        return sum((part.T @ np.linalg.solve(V, part) for part in parts), np.zeros((len(self.names),) * 2))

    @property
    def names(self) -> tuple[str, ...]:
        """Coefficients in the order of a result: phi behind tan_beta."""
        return tuple(n for term in self.terms for n in ((term, "phi") if term == "tan_beta" else (term,)))

    def _derivatives(self, alpha: Array, segment: int, h: float) -> Array:
        """Derivative of the increments by the coefficients (file units), trapezoid."""
        a, y, z = self.forces[segment]
        w = np.zeros(3) if self.turning is None else self.turning[segment]
        sine, cosine = np.sin(alpha), np.cos(alpha)
        u_y, u_z = SCALE * y - w[1], SCALE * z - w[2]
        known = {
            "scale_factor": self.indicated()[segment] + self.tan_beta * (y * sine - z * cosine),
            "tan_beta": u_y * sine - u_z * cosine,
            "phi": self.tan_beta * (u_y * cosine + u_z * sine),
        }
        products = _products(a, y, z)
        rows = [known[n] if n in known else SCALE * products[n] + 0.0 * sine for n in self.names]
        return np.array([0.5 * h * (rate[1:] + rate[:-1]) for rate in rows]).T


def _nearest(found: piga.Calibration, errors: Array) -> Array:
    """Errors, those of phases to the nearest whole turn."""
    angles = np.array([c.name == "phi" for c in found.coefficients])
    return np.where(angles, np.angle(np.exp(1j * errors)), errors)


@dataclass(frozen=True)
class Joint:
    """Several tests of one instrument calibrated together, each with its own noise and phase."""

    name: str
    runs: tuple[Scenario, ...]

    def record(self, rng: np.random.Generator) -> list[piga.Run]:
        """One simulated test of each kind."""
        return [run.record(rng) for run in self.runs]

    def calibrate(self, runs: list[piga.Run]) -> piga.Calibration:
        """The estimate that is put to the test."""
        return piga.calibrate(runs, self.runs[0].terms)

    @property
    def names(self) -> tuple[str, ...]:
        """Coefficients in the order of a result: the phases of all runs behind tan_beta."""
        phases = tuple(f"phi[run {i + 1}]" for i in range(len(self.runs)))
        return tuple(n for name in self.runs[0].names for n in (phases if name == "phi" else (name,)))

    def errors(self, found: piga.Calibration) -> Array:
        """Error of every coefficient in file units, in the order of the result."""
        phases = {f"phi[run {i + 1}]": run.phi for i, run in enumerate(self.runs)}
        truth = [phases.get(c.key, self.runs[0].true_value(c.name)) for c in found.coefficients]
        return _nearest(found, np.array([c.value for c in found.coefficients]) - truth)

    def bound(self, records: list[piga.Run]) -> Array:
        """Cramer-Rao covariance (file units): the information of the tests adds."""
        total = np.zeros((len(self.names), len(self.names)))
        for index, (scenario, record) in enumerate(zip(self.runs, records, strict=True)):
            own = [f"phi[run {index + 1}]" if name == "phi" else name for name in scenario.names]
            at = [self.names.index(name) for name in own]
            total[np.ix_(at, at)] += scenario.information(record)
        return np.linalg.inv(total)


def _products(a: Array, y: Array, z: Array) -> dict[str, Array]:
    """What every coefficient but K and tan_beta multiplies [g^n]."""
    return {
        "k0": a * 0.0 + 1.0, "k1": a, "k2": a**2, "k3": a**3, "k2o": a * np.abs(a), "m_Y": y, "m_Z": z,
        "k_XY": a * y, "k_XZ": a * z, "k_YY": y**2, "k_ZZ": z**2, "k_YZ": y * z,
    }  # fmt: skip


def tumble(count: int, levels: tuple[float, ...] = (1.0,), start: float = 0.13, side: float = 0.02) -> Array:
    """Forces of a tumble in one plane [g]."""
    angle = start + 2.0 * np.pi * np.arange(count) / count
    one = np.stack([np.cos(angle), -np.sin(angle), np.full(count, side)], axis=1)
    return np.vstack([level * one for level in levels])


def _centrifuge() -> tuple[Array, Array]:
    """Levels of a centrifuge with both signs: force [g] and base rate [rad/s] (arm 1 m, turning about Z0)."""
    levels = np.array([-10.0, -6.0, -3.0, -1.0, 1.0, 3.0, 6.0, 10.0])
    rate = np.sqrt(np.abs(levels) * G0)
    forces = np.stack([levels, np.zeros(8), np.ones(8)], axis=1)
    return forces, np.stack([rate * 0, rate * 0, rate], axis=1)


def _near_critical() -> Array:
    """Positions about the separatrix of tan_beta = 5e-3, and six that hold the scale factor."""
    ratio = np.array([-3.0, -2.0, -1.4, -1.15, 1.15, 1.4, 2.0, 3.0])
    near = np.stack([5e-3 * ratio, np.cos(np.arange(8.0)), np.sin(np.arange(8.0))], axis=1)
    return np.vstack([near, tumble(6)])


_STATIC = {"k0": 1.6e-3, "k2": 2.0e-4, "m_Y": 2.4e-4}
_TERMS = ("scale_factor", "tan_beta", "k0", "k2", "m_Y")
_ARM, _RATES = _centrifuge()

_JOINT_TERMS = ("scale_factor", "tan_beta", "k0", "k2", "k_YY", "m_Y")
_JOINT = _STATIC | {"k_YY": -1.1e-4}
_LEVELS = np.array([0.5, 1.0, -1.5, 2.0, -3.0, 4.0, -5.0, 6.0])
_SPUN = np.stack([_LEVELS, np.full(8, 0.3), np.ones(8)], axis=1)

_MIXES = ((0.0, 1e-4), (1e-5, 1e-4), (3e-5, 6e-5), (1e-4, 3e-5), (3e-4, 0.0), (1e-3, 0.0))
"""Random walk [rad/sqrt(s)] and white noise of reading [rad] beside counts of 36 arcsec."""

SCENARIOS: dict[str, Scenario | Joint] = {
    found.name: found
    for found in (
        Scenario("static", tumble(8, (0.5, 1.0)), white=2.5e-5, walk=2e-5, truth=_STATIC, terms=_TERMS),
        Scenario(
            "centrifuge", _ARM, rate=50.0, seconds=8.0, white=2.5e-5, walk=3e-5, turning=_RATES,
            truth={"k0": 1.6e-3, "k2": 2e-5, "k3": 1e-6},
            terms=("scale_factor", "tan_beta", "k0", "k2", "k3"),
        ),
        Scenario(
            "near-critical", _near_critical(), white=2.5e-5, walk=2e-5, tan_beta=5e-3, seconds=30.0,
            truth={"k0": 1e-4},
        ),
        Scenario(
            "coarse", tumble(8, (0.5, 1.0)), count=2 * np.pi / 3600, walk=2e-5, truth=_STATIC, terms=_TERMS
        ),
        Scenario(
            "coarse-slow", tumble(12, start=0.0), count=2 * np.pi / 3600, walk=1e-5, rate=20.0,
            truth={"k0": 1e-4, "k2": 1e-5, "m_Y": 2.4e-4}, terms=_TERMS,
        ),
        Scenario("white", tumble(8, (0.5, 1.0)), white=2.5e-5, truth=_STATIC, terms=_TERMS),
        Scenario("walk", tumble(8, (0.5, 1.0)), white=1e-9, walk=3e-5, truth=_STATIC, terms=_TERMS),
        Scenario(
            "drift", tumble(8, (0.5, 1.0)), white=2.5e-5, walk=1e-5, drift=1e-6, truth=_STATIC, terms=_TERMS
        ),
        Scenario(
            "scatter", tumble(8, (0.5, 1.0)), white=2.5e-5, walk=1e-5, scatter=8e-6, truth=_STATIC, terms=_TERMS
        ),
        *(
            Scenario(
                f"mix-{walk:g}", tumble(8, (0.5, 1.0)), count=2 * np.pi / 36000, white=white, walk=walk,
                truth=_STATIC, terms=_TERMS,
            )
            for walk, white in _MIXES
        ),
        Joint(
            "joint",
            (
                Scenario("head", tumble(12), white=2.5e-5, walk=1e-5, truth=_JOINT, terms=_JOINT_TERMS),
                Scenario("spun", _SPUN, white=6e-5, walk=2e-5, truth=_JOINT, terms=_JOINT_TERMS, phi=-1.9),
            ),
        ),
    )
}  # fmt: skip

FAINT: dict[str, Scenario | Joint] = {
    f"faint-{walk:g}": replace(SCENARIOS["white"], name=f"faint-{walk:g}", walk=walk)
    for walk in (5e-7, 1e-6, 2e-6, 4e-6)
}
"""White noise beside a random walk that hardly shows: for campaigns only."""
