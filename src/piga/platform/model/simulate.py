"""The simulator: a scenario becomes readouts (what an engineer gets) and truth (kept apart)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from piga import earth
from piga._kernels.platform.motion import simulate_platform
from piga.frames import rotation_vector_to_matrix
from piga.platform.model.case_rotation import encoder_angle
from piga.platform.model.geometry import harmonic_arrays
from piga.platform.model.motion import BaseMotion, base_motion
from piga.platform.model.scenario import Gyro, Scenario, Sensors

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Readouts:
    """What is read from the platform; all that alignment, identification and navigation may see.

    ``times`` (n + 1,) [s]; ``increments`` (n, 3) velocity increments along platform axes [m/s], row k
    over times k to k + 1; ``gimbals`` (n + 1, 3) outer, middle, inner [rad]; ``pickoff`` (n + 1,)
    redundancy-axis angle Y [rad]; ``encoder1, encoder2`` (n + 1,) case angles from their own zero [rad];
    ``altitude`` (n + 1,) or (1,) reference height [m]; ``turn_sensitivity`` 1/K [(m/s)/rad] of gyro
    accelerometers, which read the platform's own turn as ``-turn/K``; 0 for ideal ones.
    """

    times: Array
    increments: Array
    gimbals: Array
    pickoff: Array
    encoder1: Array
    encoder2: Array
    altitude: Array
    turn_sensitivity: float = 0.0

    @property
    def step(self) -> float:
        """Step [s]."""
        return float(self.times[1] - self.times[0])

    @cached_property
    def case_nodes(self) -> tuple[Array, Array]:
        """Cosine and sine of both case encoders at the nodes, (n + 1, 2) each."""
        return _phasor(self.encoder1), _phasor(self.encoder2)

    @cached_property
    def case_middles(self) -> tuple[Array, Array]:
        """Cosine and sine of both case encoders in the middle of every step, (n, 2) each."""
        return _phasor(0.5 * (self.encoder1[1:] + self.encoder1[:-1])), _phasor(
            0.5 * (self.encoder2[1:] + self.encoder2[:-1])
        )

    def first(self, duration: float) -> Readouts:
        """The readouts of the first ``duration`` seconds (the whole run when it is shorter)."""
        return self.between(0, max(2, min(len(self.increments), round(duration / self.step))))

    def between(self, first: int, last: int) -> Readouts:
        """The readouts from node ``first`` to node ``last``."""
        node = slice(first, last + 1)
        return replace(
            self,
            times=self.times[node],
            increments=self.increments[first:last],
            gimbals=self.gimbals[node],
            pickoff=self.pickoff[node],
            encoder1=self.encoder1[node],
            encoder2=self.encoder2[node],
            altitude=self.altitude[node] if len(self.altitude) > 1 else self.altitude,
        )


def _phasor(angle: Array) -> Array:
    out = np.empty((len(angle), 2))
    np.cos(angle, out=out[:, 0])
    np.sin(angle, out=out[:, 1])
    return out


@dataclass(frozen=True)
class Truth:
    """What really happened: base motion, redundancy angle (n + 1,) [rad], triad ``C_i^G`` at start and end.

    ``force`` (n + 1, 3): specific force in platform axes at the nodes [m/s^2].
    """

    motion: BaseMotion
    force: Array
    eta: Array
    triad_start: Array
    triad_end: Array


@dataclass(frozen=True)
class Run:
    """A simulated run: its scenario, what the sensors show, and the truth."""

    scenario: Scenario
    readouts: Readouts
    truth: Truth


def simulate(scenario: Scenario, *, motion: BaseMotion | None = None) -> Run:
    """Simulate the platform of ``scenario``: exact geometry, drift, base motion, readout errors.

    ``motion`` may be handed in to share it between runs. The noise depends on ``scenario.seed`` only.

    Raises
    ------
    DataError
        If the track of a moving base cannot be used.
    """
    motion = base_motion(scenario) if motion is None else motion
    n, h = scenario.steps, scenario.step
    increments, force = np.empty((n, 3)), np.empty((n + 1, 3))
    gimbals, ring, eta = np.empty((n + 1, 3)), np.empty(n + 1), np.empty(n + 1)
    spin = np.empty((n if scenario.sensors.piga else 0, 3))
    start = rotation_vector_to_matrix(np.array(scenario.triad)).T
    triad = start.copy()
    simulate_platform(
        _gyro_constants(scenario.polar, scenario.equatorial),
        *harmonic_arrays(scenario.polar),
        *harmonic_arrays(scenario.equatorial),
        np.array([*scenario.polar.drift, *scenario.equatorial.drift, *scenario.polar.case_drift,
                  *scenario.equatorial.case_drift]),
        np.array([scenario.polar_rotation.rate, float(scenario.polar_rotation.turns),
                  scenario.equatorial_rotation.rate, float(scenario.equatorial_rotation.turns)]),
        motion.force, motion.attitude, np.ascontiguousarray(motion.place[:, :2]),
        earth.EARTH_RATE, 0.0, h, triad, scenario.redundancy, np.zeros((6, 3, 3)),
        increments, force, gimbals, ring, eta, spin,
    )  # fmt: skip
    times = h * np.arange(n + 1, dtype=np.float64)
    if scenario.sensors.piga is not None:
        from piga.platform.model.triad import through_pigas

        increments = through_pigas(scenario.sensors.piga, times, force, spin)
    readouts = _read(scenario, times, increments, gimbals, ring, motion.place[:, 2])
    return Run(scenario, readouts, Truth(motion, force, eta, start, triad))


def _gyro_constants(polar: Gyro, equatorial: Gyro) -> Array:
    return np.array([polar.misalignment, polar.phase, equatorial.misalignment, equatorial.phase])


def _read(s: Scenario, times: Array, increments: Array, gimbals: Array, ring: Array, height: Array) -> Readouts:
    """Add noise and quantisation to the true readings, each channel from its own random stream."""
    sensors, h = s.sensors, s.step
    streams = [np.random.default_rng(child) for child in np.random.SeedSequence(s.seed).spawn(4)]
    walk = sensors.velocity_random_walk * np.sqrt(h)
    increments = _noisy(increments, walk, 0.0, streams[0]) + h * np.array(sensors.accelerometer_bias)
    increments = _pulses(increments, sensors.increment_quantisation)
    return Readouts(
        times=times,
        increments=increments,
        gimbals=_noisy(gimbals, sensors.gimbal_noise, sensors.gimbal_quantisation, streams[1]),
        pickoff=_noisy(ring, sensors.pickoff_noise, sensors.pickoff_quantisation, streams[2]),
        encoder1=encoder_angle(s.polar_rotation, times),
        encoder2=encoder_angle(s.equatorial_rotation, times),
        altitude=_altitude(sensors, height, len(times), streams[3]),
        turn_sensitivity=1.0 / sensors.piga.scale_factor if sensors.piga else 0.0,
    )


def _altitude(sensors: Sensors, height: Array, rows: int, stream: np.random.Generator) -> Array:
    if sensors.altitude_noise == 0.0:
        return height
    return height + sensors.altitude_noise * stream.standard_normal(rows)


def _noisy(values: Array, sigma: float, quantum: float, stream: np.random.Generator) -> Array:
    """Values with white noise, then rounded to the quantum; zero leaves them as they are."""
    if sigma > 0.0:
        values = values + sigma * stream.standard_normal(values.shape)
    return np.round(values / quantum) * quantum if quantum > 0.0 else values


def _pulses(increments: Array, quantum: float) -> Array:
    """Increments read as whole pulses: the running sum is rounded, so that no velocity is lost."""
    if quantum <= 0.0:
        return increments
    total = np.round(np.cumsum(increments, axis=0) / quantum) * quantum
    return np.diff(total, axis=0, prepend=0.0)
