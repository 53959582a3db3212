"""Linear vibration table: sine dwells, sweeps and random vibration along one axis."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from piga.earth import Site
from piga.errors import ArgumentError
from piga.results import Array
from piga.stand.imperfections import Imperfections
from piga.stand.machines.turning import horizontal_axis_frame, mount, small_turn
from piga.stand.profile import Segment, plan

_UP_FIRST = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
_LINES = 256


@dataclass(frozen=True)
class Drive:
    """One stretch of vibration.

    Parameters
    ----------
    shape:
        ``rest``, ``sine`` (at ``frequency``), ``sweep`` (``frequency`` to ``last_frequency``, logarithmic),
        or ``random`` (flat between the two frequencies: a sum of 256 lines with phases from ``seed``).
    duration:
        [s].
    frequency, last_frequency:
        [Hz].
    amplitude:
        Peak acceleration [m/s^2] of sine and sweep; root mean square of random vibration.
    taper:
        Time [s] in which the drive rises at the start and falls at the end.
    seed:
        Seed of the phases of random vibration.
    """

    shape: Literal["rest", "sine", "sweep", "random"]
    duration: float
    frequency: float = 1.0
    last_frequency: float = 1.0
    amplitude: float = 0.0
    taper: float = 0.5
    seed: int = 1

    def __post_init__(self) -> None:
        if self.duration <= 0.0 or self.frequency <= 0.0 or self.last_frequency <= 0.0 or self.taper < 0.0:
            raise ArgumentError(
                "vibration drive: duration, frequency or last_frequency is not positive, or taper is negative",
                remedy='e.g. duration = "20 s", frequency = "8 Hz", taper = "0.5 s"',
            )
        if 2.0 * self.taper > self.duration and self.shape != "rest":
            raise ArgumentError(
                f"vibration drive: taper {self.taper:g} s does not fit twice into {self.duration:g} s",
                remedy="use a shorter taper or a longer duration",
            )
        if self.shape == "random" and self.last_frequency <= self.frequency:
            raise ArgumentError(
                f"vibration drive: random from {self.frequency:g} Hz to {self.last_frequency:g} Hz",
                remedy="give a last_frequency above frequency",
            )

    @property
    def highest(self) -> float:
        """Highest frequency [Hz]."""
        return self.frequency if self.shape in ("rest", "sine") else max(self.frequency, self.last_frequency)

    @cached_property
    def _lines(self) -> tuple[Array, Array]:
        edges = np.linspace(self.frequency, self.last_frequency, _LINES + 1)
        phases = np.random.default_rng(self.seed).uniform(0.0, 2.0 * math.pi, _LINES)
        return math.pi * (edges[1:] + edges[:-1]), phases

    def acceleration(self, t: Array) -> tuple[Array, Array]:
        """Acceleration [m/s^2] and its rate of change [m/s^3] at ``t`` [s] since the start of the drive."""
        if self.shape == "rest":
            return np.zeros(t.size), np.zeros(t.size)
        wave, wave_rate = self._random(t) if self.shape == "random" else self._sine(t)
        ease, ease_rate = self._envelope(t)
        return self.amplitude * ease * wave, self.amplitude * (ease * wave_rate + ease_rate * wave)

    def _sine(self, t: Array) -> tuple[Array, Array]:
        if self.shape == "sine" or self.last_frequency == self.frequency:
            w = 2.0 * math.pi * self.frequency
            return np.sin(w * t), w * np.cos(w * t)
        growth = math.log(self.last_frequency / self.frequency) / self.duration
        rate = 2.0 * math.pi * self.frequency * np.exp(growth * t)
        phase = (rate - 2.0 * math.pi * self.frequency) / growth
        return np.sin(phase), rate * np.cos(phase)

    def _random(self, t: Array) -> tuple[Array, Array]:
        wave, rate = np.zeros(t.size), np.zeros(t.size)
        scale = math.sqrt(2.0 / _LINES)
        for w, phase in zip(*self._lines, strict=True):
            wave += scale * np.sin(w * t + phase)
            rate += scale * w * np.cos(w * t + phase)
        return wave, rate

    def _envelope(self, t: Array) -> tuple[Array, Array]:
        if self.taper == 0.0:
            return np.ones(t.size), np.zeros(t.size)
        up = np.clip(t / self.taper, 0.0, 1.0)
        down = np.clip((self.duration - t) / self.taper, 0.0, 1.0)
        u = np.minimum(up, down)
        sign = np.where(up < down, 1.0, -1.0)
        ease = 0.5 * (1.0 - np.cos(math.pi * u))
        return ease, sign * 0.5 * math.pi / self.taper * np.sin(math.pi * u)


@dataclass(frozen=True)
class VibrationTable:
    """A table that vibrates along a base axis in the gravity field.

    Parameters
    ----------
    site:
        Place and local gravity.
    drives:
        Stretches of vibration in order. Each is a recorded segment.
    axis:
        Base axis along which the table moves.
    up:
        Base axis that points up.
    """

    site: Site
    drives: tuple[Drive, ...]
    axis: str = "X0"
    up: str = "X0"

    kind = "vibration-table"
    accepted = ("gravity", "levelling", "transverse_motion", "rocking")

    def __post_init__(self) -> None:
        mount(self.axis, "vibration-table axis")
        mount(self.up, "vibration-table up")
        if not self.drives:
            raise ArgumentError("vibration-table drives: none given", remedy="add a [[stand.drives]] table")

    @property
    def fastest(self) -> float:
        """Step [s]: 40 samples per period of the highest frequency."""
        return 1.0 / (40.0 * max(drive.highest for drive in self.drives))

    def segments(self) -> tuple[Segment, ...]:
        """Drives ``0, 1, ...``."""
        return plan([(str(k), drive.duration, True) for k, drive in enumerate(self.drives)])

    def _drive(self, t: Array) -> tuple[Array, Array, Array]:
        """Acceleration, its rate of change, and both divided by the drive's amplitude, at ``t``."""
        starts = np.array([s.start for s in self.segments()])
        index = np.clip(np.searchsorted(starts, t, side="right") - 1, 0, starts.size - 1)
        wave, wave_rate, peak = np.zeros(t.size), np.zeros(t.size), np.ones(t.size)
        for k, drive in enumerate(self.drives):
            rows = index == k
            wave[rows], wave_rate[rows] = drive.acceleration(np.clip(t[rows] - starts[k], 0.0, drive.duration))
            peak[rows] = drive.amplitude or 1.0
        return wave, wave_rate, peak

    def motion(self, t: Array, errors: Imperfections) -> tuple[Array, Array]:
        """Specific force and base rate in base axes, (n, 3) each."""
        wave, wave_rate, peak = self._drive(t)
        local_up, local_rate = horizontal_axis_frame(self.site, 0.0)
        to_base = mount(self.up) @ _UP_FIRST @ small_turn(0.0, *errors.levelling)
        up, earth = to_base @ local_up, to_base @ local_rate
        along, across = mount(self.axis)[:, 2], mount(self.axis)[:, 0]
        gravity = (self.site.local_gravity + errors.gravity) * up
        force = gravity + np.outer(wave, along + errors.transverse_motion * across)
        pivot = np.cross(along, mount(self.up)[:, 2])
        pivot = pivot if np.any(pivot) else across
        force -= np.outer(errors.rocking * wave / peak, np.cross(pivot, gravity))
        rate = earth + np.outer(errors.rocking * wave_rate / peak, pivot)
        return force, rate
