"""Simulated tests whose positions and levels are set anew, each with an error of its own that the lab states.

The instrument feels the forces as they were set, the reference tells what was asked for. Motion, forces and errors are
written here and in :mod:`tests.calibration.made.scenarios`; the product's stands and kernels take no part in the truth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import piga
from piga.units import G0
from tests.calibration.made.scenarios import SCENARIOS, Array, Scenario
from tests.calibration.made.synthetic import at_rest

ARCSEC = np.pi / 648000.0
TRUTH = {"k0": 1.6e-3, "k2": 2.0e-4, "m_Y": 2.4e-4}
TERMS = ("scale_factor", "tan_beta", "k0", "k2", "m_Y")
CENTRIFUGE = SCENARIOS["centrifuge"]
assert isinstance(CENTRIFUGE, Scenario)


def in_plane(angle: Array) -> Array:
    """Forces [g] of a dividing head at its positions [rad]."""
    return np.stack([np.cos(angle), -np.sin(angle), np.zeros(angle.size)], axis=1)


@dataclass(frozen=True)
class Repeated:
    """A test: its forces as asked for, the forces as set, what is stated of it, and its stand."""

    scenario: Scenario
    set_forces: Callable[[np.random.Generator], Array]
    stated: dict[str, Any]
    stand: dict[str, Any] | None = None

    def record(self, rng: np.random.Generator) -> piga.Run:
        """One simulated test; the lab states what repeats."""
        run = replace(self.scenario, forces=self.set_forces(rng)).record(rng)
        asked = (self.scenario.forces * G0)[run.segment_index]
        return replace(run, f=asked, uncertainty=at_rest(**self.stated), stand=self.stand)


def head(
    arcsec: float, positions: int = 24, told: Any = None, mounting: float = 0.0, **noise: float
) -> Repeated:
    """A dividing head that sets each position with a normal error [arcsec]; mounted anew with another, about Z0."""
    angle = 2.0 * np.pi * np.arange(positions) / positions
    levels = {"white": 2.5e-5, "walk": 2e-5} | noise
    scenario = Scenario("head", in_plane(angle), truth=TRUTH, terms=TERMS, **levels)  # type: ignore[arg-type]

    def forces(rng: np.random.Generator) -> Array:
        off = arcsec * rng.standard_normal(positions) + mounting * rng.standard_normal()
        return in_plane(angle + ARCSEC * off)

    written = tuple(f"{value!r} rad" for value in angle.tolist())
    stand = {"kind": "dividing-head", "latitude": "40 deg", "gravity": f"{G0} m/s^2", "positions": written}
    stated: dict[str, Any] = {"angle_repeatability": told or f"{arcsec} arcsec"}
    if mounting:
        stated["mounting_repeatability"] = f"{mounting} arcsec"
    return Repeated(scenario, forces, stated, stand)


def centrifuge(ppm: float) -> Repeated:
    """A centrifuge whose reference is off by another share at each level."""
    asked = CENTRIFUGE.forces

    def forces(rng: np.random.Generator) -> Array:
        return asked * (1.0 + 1e-6 * ppm * rng.standard_normal((len(asked), 1)))

    return Repeated(CENTRIFUGE, forces, {"reference_repeatability": f"{ppm} ppm"})


CASES: dict[str, Callable[[], Repeated]] = {
    "head": lambda: head(1.0),
    "head-8": lambda: head(1.0, positions=8),
    "head-quiet": lambda: head(1.0, walk=0.0),
    "head-unclear-walk": lambda: head(1.0, walk=1e-6),
    "head-coarse-setting": lambda: head(10.0),
    "head-fine-setting": lambda: head(0.2),
    "centrifuge": lambda: centrifuge(20.0),
}


def coverage(case: Repeated, tests: int) -> Array:
    """Share of the 95 % intervals that hold, per coefficient."""
    held = []
    for seed in range(tests):
        calibration = case.scenario.calibrate(case.record(np.random.default_rng([seed, 1906])))
        half = np.array([c.expanded for c in calibration.coefficients])
        held.append(np.abs(case.scenario.errors(calibration)) <= half)
    return np.mean(held, axis=0)
