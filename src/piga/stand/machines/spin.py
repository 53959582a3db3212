"""A plan of angular rates with smooth ramps between them: centrifuges and rate tables turn by it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError
from piga.stand.imperfections import Imperfections
from piga.stand.profile import Segment, plan_holds

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Spin:
    """Angle [rad], rate [rad/s] and angular acceleration [rad/s^2] at some times, (n,) each."""

    angle: Array
    rate: Array
    acceleration: Array


@dataclass(frozen=True)
class SpinPlan:
    """Rates [rad/s] held for ``dwell`` [s], with cosine ramps of ``ramp`` [s] between them."""

    rates: tuple[float, ...]
    dwell: float
    ramp: float

    def __post_init__(self) -> None:
        if not self.rates:
            raise ArgumentError("rates: none given", remedy="give a list of angular rates")
        if self.dwell <= 0.0 or self.ramp <= 0.0:
            raise ArgumentError("dwell and ramp must be positive")

    @property
    def resolution(self) -> float:
        """Step [s] that resolves a ramp (a hundredth) and a revolution (a two-hundredth)."""
        fastest = max(abs(rate) for rate in self.rates)
        return min(self.ramp / 100.0, 2.0 * math.pi / max(fastest, 1e-9) / 200.0)

    def segments(self) -> tuple[Segment, ...]:
        """Levels ``0, 1, ...``, recorded, with ramps between them, not recorded."""
        return plan_holds(len(self.rates), self.dwell, "ramp", self.ramp)

    def nominal(self, t: Array) -> Spin:
        """The spin as set."""
        rates = np.array(self.rates)
        steps = np.diff(rates, append=rates[-1])
        cycle = self.dwell + self.ramp
        per_cycle = rates * cycle + 0.5 * steps * self.ramp
        before = np.concatenate([[0.0], np.cumsum(per_cycle)[:-1]])
        k = np.clip(np.floor(t / cycle).astype(int), 0, rates.size - 1)
        inside = t - k * cycle
        u = np.clip((inside - self.dwell) / self.ramp, 0.0, 1.0)
        ramped = steps[k] * self.ramp * (0.5 * u - np.sin(math.pi * u) / (2.0 * math.pi))
        angle = before[k] + rates[k] * inside + ramped
        rate = rates[k] + 0.5 * steps[k] * (1.0 - np.cos(math.pi * u))
        acceleration = 0.5 * steps[k] * np.sin(math.pi * u) * math.pi / self.ramp
        return Spin(angle, rate, acceleration)

    def true(self, t: Array, errors: Imperfections) -> Spin:
        """The spin with the imperfections ``rate_error`` and ``rate_ripple``."""
        spin, scale, ripple = self.nominal(t), 1.0 + errors.rate_error, errors.rate_ripple
        angle, rate = scale * spin.angle, scale * spin.rate
        swing = 1.0 + ripple * np.cos(angle)
        acceleration = scale * spin.acceleration * swing - ripple * rate**2 * np.sin(angle)
        return Spin(angle + ripple * np.sin(angle), rate * swing, acceleration)
