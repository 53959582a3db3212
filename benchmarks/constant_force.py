"""Simulated tests with constant force in each segment, and the Cramer-Rao bound of their coefficients.

One step of the motion is a closed form. Motion and noise are computed without piga; units and the record are piga's. A
random walk is part of the motion. White noise and counting belong to the reading. The gimbal starts at a random angle in every
segment. The cases of the accuracy page are in ``benchmarks/cases``.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

import piga
from piga.records.calibration.coefficient import changes
from piga.units import G0, to_si

Array = NDArray[np.float64]

SCALE = 0.8884
"""Default scale factor [(rad/s)/g]."""
PHI = 0.48
"""Default phase of the output zero [rad]."""
PAUSE = 5.0
"""Default time between two segments [s]."""


FORCE_UNITS = {
    "seconds": "s", "pause": "s", "rate": "Hz", "white": "rad", "walk": "rad/sqrt(s)", "count": "rad",
    "drift": "rad/s/sqrt(s)", "scatter": "rad/s", "markov": "rad/s", "flicker": "rad/s",
}  # fmt: skip
"""Unit of each quantity of a case, by its key."""


def constant_steps(a: Array, y: Array, z: Array, start: Array, noise: Array) -> Array:
    """Angle after every step of constant force: the exponential of a 2 x 2 matrix, then noise, (segments, n + 1) [rad].

    Parameters
    ----------
    a, y, z:
        Turn of one step without the coupling, and of the coupling, times its tangent, (segments, n) or (segments, 1) [rad].
    start:
        First angle of each segment [rad].
    noise:
        Added after each step, (segments, n) [rad].
    """
    root = np.emath.sqrt(0.25 * (y * y + z * z - a * a)) + 1e-30
    parts = [
        np.broadcast_to(v, noise.shape).T for v in (a, y, z, np.cosh(root).real, (np.sinh(root) / root).real)
    ]
    angles = [start]
    for a_k, y_k, z_k, c, s, added in zip(*parts, noise.T, strict=True):
        sine, cosine = np.sin(angles[-1]), np.cos(angles[-1])
        turned = np.arctan2(
            0.5 * s * (a_k + y_k * sine - z_k * cosine), c - 0.5 * s * (y_k * cosine + z_k * sine)
        )
        angles.append(angles[-1] + 2.0 * turned + added)
    return np.array(angles).T


def read_cases(path: Path) -> dict[str, ConstantForce | Joint]:
    """The tests of a file of cases (TOML), by name.

    Segments are given by ``forces`` [g], ``tumble`` or ``centrifuge``; several of these are joined in this order. ``truth``
    has the units of calibration.json. ``walk`` is the random walk of the angle, ``white`` the white noise of the reading,
    ``count`` the step of the counter, ``drift`` the random walk of the rate (zero in the middle of the test), ``scatter`` an
    offset of the rate that is new in each segment. ``markov`` and ``flicker`` are errors of the rate with a memory: of 60 s, and
    of 2 to 2000 s. ``swing`` is one continuous segment whose force sways. Tests in ``joint`` are calibrated together.
    """
    document = tomllib.loads(path.read_text(encoding="utf-8"))
    tests: dict[str, ConstantForce | Joint] = {}
    for case in document["case"]:
        name = case["name"]
        runs = tuple(_test(f"{name}-{k}", one) for k, one in enumerate(case.get("joint", ()), start=1))
        tests[name] = Joint(name, runs) if runs else _test(name, case["constant_force"])
    return tests


def _test(name: str, table: dict[str, Any]) -> ConstantForce:
    forces, turning = _segments(table)
    values = {key: to_si(table[key], unit) for key, unit in FORCE_UNITS.items() if key in table}
    truth = dict(table.get("truth", {}))
    fixed = {key: truth.pop(key) for key in ("scale_factor", "tan_beta", "phi") if key in truth}
    return ConstantForce(
        name=name, forces=forces, turning=turning, truth=truth, terms=tuple(table["terms"]),
        swing=table.get("swing", False), **values, **fixed,
    )  # fmt: skip


def _segments(table: dict[str, Any]) -> tuple[Array, Array | None]:
    """Forces [g] of the segments, and the base rates of a centrifuge."""
    parts, turning = [], None
    if "forces" in table:
        parts.append(np.array(table["forces"]))
    if "tumble" in table:
        given = table["tumble"]
        start = to_si(given.get("start", "0.13 rad"), "rad")
        made = tumble(given["positions"], tuple(given.get("levels", (1.0,))), start, given.get("side", 0.02))
        parts.append(np.random.default_rng(1).permutation(made) if given.get("shuffle") else made)
    if "centrifuge" in table:
        given = table["centrifuge"]
        forces, turning = centrifuge(given["levels"], to_si(given.get("radius", "1 m"), "m"))
        parts.append(forces)
    return np.vstack(parts or [np.zeros(3)]), turning


PRODUCTS: dict[str, Callable[[Array, Array, Array], Array]] = {
    "k0": lambda a, _y, _z: a * 0.0 + 1.0,
    "k1": lambda a, _y, _z: a,
    "k2": lambda a, _y, _z: a**2,
    "k3": lambda a, _y, _z: a**3,
    "k2o": lambda a, _y, _z: a * np.abs(a),
    "m_Y": lambda _a, y, _z: y,
    "m_Z": lambda _a, _y, z: z,
    "k_XY": lambda a, y, _z: a * y,
    "k_XZ": lambda a, _y, z: a * z,
    "k_YY": lambda _a, y, _z: y**2,
    "k_ZZ": lambda _a, _y, z: z**2,
    "k_YZ": lambda _a, y, z: y * z,
}
"""What each coefficient multiplies [g^n], by name."""


def tumble(count: int, levels: tuple[float, ...] = (1.0,), start: float = 0.13, side: float = 0.02) -> Array:
    """Forces of a tumble in one plane [g], ``start`` [rad], ``side`` [g] along Z0."""
    angle = start + 2.0 * np.pi * np.arange(count) / count
    one = np.stack([np.cos(angle), -np.sin(angle), np.full(count, side)], axis=1)
    return np.vstack([level * one for level in levels])


def centrifuge(levels: Sequence[float], radius: float = 1.0) -> tuple[Array, Array]:
    """Forces [g] and base rates [rad/s] at the levels of an arm that turns about Z0."""
    along = np.asarray(levels, dtype=float)
    rate = np.sqrt(np.abs(along) * G0 / radius)
    none = np.zeros(along.size)
    return np.stack([along, none, none + 1.0], axis=1), np.stack([none, none, rate], axis=1)


@dataclass(frozen=True)
class ConstantForce:
    """A test: forces [g] of its segments, sampling, noise (SI), terms and truth (file units)."""

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
    scale_factor: float = SCALE
    pause: float = PAUSE
    markov: float = 0.0
    flicker: float = 0.0
    swing: bool = False

    def true_value(self, name: str) -> float:
        """Truth in file units."""
        fixed = {"scale_factor": self.scale_factor, "tan_beta": self.tan_beta, "phi": self.phi}
        return fixed[name] if name in fixed else self.truth.get(name, 0.0)

    def _felt(self, t: Array) -> Array:
        """Force at the times from the beginning of a segment [g], (segments, t, 3); (segments, 1, 3) if it is constant."""
        if not self.swing:
            return self.forces[:, None]
        turn = 2.0 * np.pi * t
        return np.stack([0.7 + 1.5 * np.sin(turn / 50.0), np.cos(turn / 70.0), 0.0 * t], axis=-1)[None]

    def indicated(self, force: Array) -> Array:
        """Indicated specific force along X0 less the coupling [g], of forces (..., 3) [g]."""
        a, y, z = np.moveaxis(force, -1, 0)
        return a + sum(value * PRODUCTS[name](a, y, z) for name, value in self.truth.items())

    def record(self, rng: np.random.Generator) -> piga.Run:
        """One simulated test."""
        steps, h, count = round(self.seconds * self.rate), 1.0 / self.rate, len(self.forces)
        parts = 10 if self.swing else 1
        step = h / parts
        f = self._felt(step * (np.arange(steps * parts) + 0.5))
        omega = np.zeros((count, 3)) if self.turning is None else self.turning
        a = self.scale_factor * self.indicated(f) - omega[:, :1]
        y, z = (self.tan_beta * (self.scale_factor * f[..., k] - omega[:, k : k + 1]) for k in (1, 2))
        noise = self.walk * math.sqrt(step) * rng.standard_normal((count, steps * parts))
        starts = rng.uniform(-math.pi, math.pi, count)
        if self.drift:
            noise += h * self._wandering(rng)
        if self.markov or self.flicker:
            noise += h * self._remembered(rng)
        if self.scatter:
            noise += h * self.scatter * rng.standard_normal((count, 1))
        psi = constant_steps(a * step, y * step, z * step, starts, noise)[:, ::parts]
        output = psi.ravel() - self.phi
        if self.white:
            output = output + self.white * rng.standard_normal(output.size)
        if self.count:
            output = np.round(output / self.count) * self.count
        t = (np.arange(count)[:, None] * (self.seconds + self.pause) + h * np.arange(steps + 1)).ravel()
        base = None if self.turning is None else np.repeat(self.turning, steps + 1, axis=0)
        return piga.Run.from_arrays(
            t,
            output,
            G0 * np.broadcast_to(self._felt(h * np.arange(steps + 1)), (count, steps + 1, 3)).reshape(-1, 3),
            uncertainty={"waived": {"earth_rate": "simulated at rest", "servo": "simulated without"}},
            scale_factor=to_si(f"{self.scale_factor!r} rad/s/g", "rad/s/g"),
            base_rate=base,
            segment=np.repeat(np.arange(count, dtype=np.int32), steps + 1),
            resolution=self.count,
            serial="synthetic",
            units="SI",
        )

    def _times(self) -> Array:
        """Middle of every step, from the middle of the test, (segments, steps) [s]."""
        steps, count = round(self.seconds * self.rate), len(self.forces)
        whole = count * (self.seconds + self.pause) - self.pause
        starts = (self.seconds + self.pause) * np.arange(count)[:, None]
        times: Array = starts + (np.arange(steps) + 0.5) / self.rate - 0.5 * whole
        return times

    def _wandering(self, rng: np.random.Generator) -> Array:
        """A random walk of the rate at ``_times``, zero in the middle of the test [rad/s]."""
        t = self._times().ravel()
        steps = np.sqrt(np.diff(np.append(t[0], t)))
        walk = self.drift * np.cumsum(steps * rng.standard_normal(t.size))
        return (walk - np.interp(0.0, t, walk)).reshape(self._times().shape)

    def _remembered(self, rng: np.random.Generator) -> Array:
        """Sum of first-order Markov processes of the rate at ``_times``, sampled every second [rad/s]."""
        t = self._times()
        grid = np.arange(t.min(), t.max() + 1.0)
        total, times = np.zeros(grid.size), 2.0 * 10.0 ** np.arange(0.0, 3.1, 0.5)
        for time, size in [(60.0, self.markov)] + [(time, self.flicker) for time in times]:
            kept = np.exp(-1.0 / time)
            noise = np.sqrt(1.0 - kept**2) * rng.standard_normal(grid.size)
            total += size * lfilter([1.0], [1.0, -kept], noise, zi=[kept * rng.standard_normal()])[0]
        return np.interp(t, grid, total)

    def calibrate(self, run: piga.Run) -> piga.Calibration:
        """The estimate that is put to the test."""
        return piga.calibrate(run, self.terms)

    def errors(self, calibration: piga.Calibration) -> Array:
        """Error of every coefficient in file units, in the order of the result; of phases to the nearest whole turn."""
        found = np.array([c.value for c in calibration.coefficients])
        return changes(calibration.coefficients, self.truths(calibration), found)

    def truths(self, calibration: piga.Calibration) -> Array:
        """True values in the order of the result, file units."""
        return np.array([self.true_value(c.name) for c in calibration.coefficients])

    def bound(self, run: piga.Run) -> Array:
        """Cramer-Rao covariance (file units) for the true noise levels, computed densely, white reading noise."""
        return np.asarray(np.linalg.inv(self.information(run)), dtype=np.float64)

    def information(self, run: piga.Run) -> Array:
        """Fisher information of the coefficients (file units).

        ``r = white^2 + count^2/12`` and ``q = walk^2``; the increments' full covariance is inverted. A scatter moves
        all increments of a segment alike. A drift is not in it.
        """
        steps, h = round(self.seconds * self.rate), 1.0 / self.rate
        r = self.white**2 + self.count**2 / 12.0
        V = np.diag(np.full(steps, self.walk**2 * h + 2.0 * r)) - r * (
            np.diag(np.ones(steps - 1), 1) + np.diag(np.ones(steps - 1), -1)
        )
        V += (self.scatter * h) ** 2
        angles = run.output + self.phi
        parts = [self._derivatives(angles[run.segment_index == s], s, h) for s in range(len(self.forces))]
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
        u_y, u_z = self.scale_factor * y - w[1], self.scale_factor * z - w[2]
        known = {
            "scale_factor": self.indicated(self.forces[segment]) + self.tan_beta * (y * sine - z * cosine),
            "tan_beta": u_y * sine - u_z * cosine,
            "phi": self.tan_beta * (u_y * cosine + u_z * sine),
        }
        rows = [
            known[n] if n in known else self.scale_factor * PRODUCTS[n](a, y, z) + 0.0 * sine
            for n in self.names
        ]
        return np.array([0.5 * h * (rate[1:] + rate[:-1]) for rate in rows]).T


@dataclass(frozen=True)
class Joint:
    """Several tests of one instrument calibrated together, each with its own noise and phase."""

    name: str
    runs: tuple[ConstantForce, ...]

    @property
    def terms(self) -> tuple[str, ...]:
        """Terms of the first test; all have the same."""
        return self.runs[0].terms

    def record(self, rng: np.random.Generator) -> list[piga.Run]:
        """One simulated test of each kind."""
        return [run.record(rng) for run in self.runs]

    def calibrate(self, runs: list[piga.Run]) -> piga.Calibration:
        """The estimate that is put to the test."""
        return piga.calibrate(runs, self.terms)

    def truths(self, calibration: piga.Calibration) -> Array:
        """True values in the order of the result, file units."""
        phases = {f"phi[run {i + 1}]": run.phi for i, run in enumerate(self.runs)}
        return np.array([phases.get(c.key, self.runs[0].true_value(c.name)) for c in calibration.coefficients])
