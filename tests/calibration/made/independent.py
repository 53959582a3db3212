"""Records from the equation of motion itself, integrated by SciPy: nothing of the product makes them.

``alpha' = K (a + k0 + ... + tan_beta (a_Y sin(alpha) - a_Z cos(alpha)))`` (``piga``, the model) is solved by an explicit
method of eighth order for all positions at once. Noise is added to the angle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

import piga
from piga.units import G0

Array = NDArray[np.float64]

K = 0.8884
"""Scale factor [(rad/s)/g]."""


def head(count: int, start: float = 0.13, side: float = 0.02) -> Array:
    """Forces of a dividing head [g], (count, 3)."""
    angle = start + 2.0 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), -np.sin(angle), np.full(count, side)], axis=1)


@dataclass(frozen=True)
class Bench:
    """A test of positions at rest: forces [g], sampling, noise [rad, rad/sqrt(s)], truth in file units.

    ``warmth`` gives the temperature [K from 20 degC] at a time of the test [s].
    """

    forces: Array = field(default_factory=lambda: head(8))
    seconds: float = 40.0
    rate: float = 20.0
    pause: float = 5.0
    white: float = 2.5e-5
    walk: float = 1e-5
    tan_beta: float = 3.6e-4
    phi: float = 0.48
    k0: float = 1.6e-3
    k2: float = 0.0
    k0_T: float = 0.0
    warmth: Callable[[Array], Array] | None = None

    def times(self) -> Array:
        """Time of every sample, (positions, samples) [s]."""
        inside = np.arange(round(self.seconds * self.rate) + 1) / self.rate
        starts = (self.seconds + self.pause) * np.arange(len(self.forces))
        return np.add.outer(starts, inside)

    def angles(self, rng: np.random.Generator) -> Array:
        """Gimbal angle at every sample, from any start in every position, (positions, samples) [rad]."""
        t = self.times()
        a, y, z = self.forces.T
        start = rng.uniform(-np.pi, np.pi, a.size)
        rest = a + self.k0 + self.k2 * a**2

        def rate(inside: float, alpha: Array) -> Array:
            bias = 0.0 if self.warmth is None else self.k0_T * self.warmth(t[:, 0] + inside)
            return K * (rest + bias + self.tan_beta * (y * np.sin(alpha) - z * np.cos(alpha)))

        inside = t[0]
        solved = solve_ivp(
            rate, (0.0, inside[-1]), start, method="DOP853", t_eval=inside, rtol=1e-11, atol=1e-11
        )
        angle = np.asarray(solved.y)
        steps = self.walk * np.sqrt(1.0 / self.rate) * rng.standard_normal(angle.shape)
        return angle + np.cumsum(steps, axis=1) + self.white * rng.standard_normal(angle.shape)

    def run(self, angle: Array) -> piga.Run:
        """The record of gimbal angles: read from a zero of its own, ``phi`` before that of alpha."""
        t, size = self.times(), angle.shape[1]
        return piga.Run.from_arrays(
            t.ravel(),
            (angle - self.phi).ravel(),
            np.repeat(self.forces * G0, size, axis=0),
            uncertainty={"waived": {"earth_rate": "simulated at rest", "servo": "simulated without"}},
            scale_factor=f"{K} rad/s/g",
            segment=np.repeat(np.arange(len(self.forces), dtype=np.int32), size),
            temperature=None if self.warmth is None else 293.15 + self.warmth(t.ravel()),
            serial="independent",
            units="SI",
        )

    def record(self, seed: int) -> piga.Run:
        """One test."""
        return self.run(self.angles(np.random.default_rng([seed, 19])))

    def truth(self, name: str) -> float:
        """True value in file units."""
        return K if name == "scale_factor" else float(getattr(self, name))

    def miss(self, result: piga.Calibration, name: str) -> float:
        """Error of a coefficient, a phase to the nearest turn (file units)."""
        error = result[name].value - self.truth(name)
        return float(np.angle(np.exp(1j * error))) if name == "phi" else error
