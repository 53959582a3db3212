"""Three gyro accelerometers on the space-stable platform: the effect of the locked zone, and its compensation.

On a platform fixed in inertial space, gravity describes a cone once a sidereal day. Twice a day it crosses the plane
normal to an input axis and passes the locked zone ``|a_x| < a_t tan(beta)``. The same ten days are read in several
ways and navigated each time.

With the usual tan(beta) the zone is passed faster than the gimbal can lock (in ``1/(K a_t tan(beta))``). The error has
another cause: near the zone the gimbal turns so slowly that the cross-coupling keeps its phase. By stationary phase,
one passage leaves a velocity error of up to ``a_t tan(beta) sqrt(2 pi / (K |d a_x/dt|))`` (own derivation,
docs/platform.md section 10).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError
from piga.platform.model.models import compensator
from piga.platform.model.scenario import PigaSensors, PlatformScenario
from piga.platform.model.simulate import (
    TRIPOD,
    PlatformRun,
    base_motion,
    gimbal_angles,
    locked,
    mounting_axes,
    read_increments,
    simulate,
)
from piga.platform.navigation.navigator import Errors, errors, navigate
from piga.platform.runs.chain import Preparation, prepare
from piga.progress import Progress, Steps
from piga.results import Result, plotted
from piga.units import DAY

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TriadReading:
    """One way to mount and read the instruments: ``sensors`` None is the ideal accelerometer."""

    name: str
    sensors: PigaSensors | None
    sentence: str


@dataclass(frozen=True, eq=False, repr=False)
class CapstoneOutcome(Result):
    """Errors of one reading: largest horizontal position [m], velocity [m/s]; locked time [s/day]."""

    reading: TriadReading
    errors: Errors
    position: float
    velocity: float
    locked_per_day: Array
    noise_gain: float


@dataclass(frozen=True, eq=False, repr=False)
class Passage(Result):
    """One instrument through its locked zone.

    ``times`` [s]; ``true``, ``raw`` and ``triad`` reading of a_x [m/s^2]; ``half_width`` of the zone [m/s^2];
    ``lock_time``: time constant of locking [s]; ``velocity_error``: the most that stationary phase
    predicts for one passage [m/s].
    """

    instrument: int
    times: Array
    true: Array
    raw: Array
    triad: Array
    half_width: float
    locked: NDArray[np.bool_]
    lock_time: float
    velocity_error: float


@dataclass(frozen=True, eq=False, repr=False)
class Capstone(Result):
    """Outcomes by name, one passage in detail, and the day of input-axis forces (times [s], (n, 3) [m/s^2])."""

    scenario: PlatformScenario
    outcomes: Mapping[str, CapstoneOutcome]
    passage: Passage | None
    day: tuple[Array, Array]

    def in_brief(self) -> list[tuple[str, str]]:
        """Largest errors with each reading."""
        return [
            (name, f"position within {one.position:.4g} m, velocity within {one.velocity:.3g} m/s")
            for name, one in self.outcomes.items()
        ]

    def plot(self, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Position errors of each reading. See :class:`piga.results.Plots`."""
        return plotted(self, ax)


def readings(sensors: PigaSensors) -> tuple[TriadReading, ...]:
    """The readings compared: from the ideal instrument to the locked one, and back."""
    tripod = replace(sensors, mounting="skewed", cone=TRIPOD, tan_beta_error=0.0, phase_error=0.0)
    skewed = replace(sensors, mounting="skewed", tan_beta_error=0.0, phase_error=0.0)
    tan_beta_error, phase_error = 2e-3 * sensors.tan_beta, 2e-3
    if sensors.tan_beta_error or sensors.phase_error:
        tan_beta_error, phase_error = sensors.tan_beta_error, sensors.phase_error
    cone = np.degrees(sensors.cone)
    return (
        TriadReading("ideal", None, "ideal accelerometers: the platform and the navigator alone"),
        TriadReading(
            "raw tripod", replace(tripod, output="raw"), "three axes at right angles, output taken as alpha'/K"
        ),
        TriadReading(
            "raw skewed",
            replace(skewed, output="raw"),
            f"axes within {cone:.0f} deg of the pole: never locked, still pulled",
        ),
        TriadReading(
            "triad", replace(tripod, output="triad"), "right angles, effective axes solved per sample"
        ),
        TriadReading("triad skewed", replace(skewed, output="triad"), "skewed and solved per sample"),
        TriadReading(
            "triad, calibrated",
            replace(tripod, output="triad", tan_beta_error=tan_beta_error, phase_error=phase_error),
            "solved with tan(beta) and phase off by a calibration's error",
        ),
    )


def capstone(scenario: PlatformScenario, *, progress: Progress | None = None) -> Capstone:
    """Navigate the scenario with every reading of its gyro accelerometers (model B).

    ``progress`` is called as ``progress(done, total, what)`` before each reading; it returns False to stop
    (:mod:`piga.progress`).

    Raises
    ------
    ArgumentError
        If the scenario has no gyro accelerometers.
    CancelledError
        If ``progress`` returns False.
    """
    sensors = scenario.sensors.piga
    if sensors is None:
        raise ArgumentError(
            f"{scenario.source or 'the scenario'}: there are no gyro accelerometers",
            remedy="set [sensors] accelerometers = 'piga'",
        )
    ways = readings(sensors)
    steps = Steps(progress, 2 + len(ways))
    steps("simulating")
    ideal = simulate(replace(scenario, sensors=replace(scenario.sensors, piga=None)))
    steps("identifying and aligning")
    preparation = prepare(ideal)
    outcomes = {}
    for reading in ways:
        steps(f"navigating, {reading.name}")
        run = ideal if reading.sensors is None else _reread(scenario, reading.sensors)
        outcomes[reading.name] = _outcome(run, reading, preparation)
    tripod = next(r.sensors for r in readings(sensors) if r.name == "raw tripod")
    assert tripod is not None  # noqa: S101 - named above
    times, force = ideal.readouts.times, ideal.truth.force
    one_day = slice(0, min(len(times), round(86164.1 / scenario.step) + 1), max(1, round(60.0 / scenario.step)))
    along = force[one_day] @ mounting_axes(tripod)[:, 0, :].T
    steps.finish()
    return Capstone(scenario, outcomes, _passage(ideal, tripod), (times[one_day], along))


def _reread(scenario: PlatformScenario, sensors: PigaSensors) -> PlatformRun:
    return simulate(
        replace(scenario, sensors=replace(scenario.sensors, piga=sensors)), motion=base_motion(scenario)
    )


def _outcome(run: PlatformRun, reading: TriadReading, preparation: Preparation) -> CapstoneOutcome:
    s = run.scenario
    made = compensator("B", preparation.knowledge, run.readouts, redundancy=s.compensation.redundancy)
    every = max(1, round(10.0 / s.step))
    error = errors(
        navigate(run.readouts, made, preparation.start, damping_time=s.damping_time, every=every),
        run.truth,
        run.readouts,
    )
    axes = np.eye(3) if reading.sensors is None else mounting_axes(reading.sensors)[:, 0, :]
    inside = (
        np.zeros(3) if reading.sensors is None else locked(reading.sensors, run.truth.force).mean(axis=0) * DAY
    )
    return CapstoneOutcome(
        reading,
        error,
        float(error.horizontal.max()),
        float(np.hypot(error.velocity[:, 0], error.velocity[:, 1]).max()),
        inside,
        float(np.sqrt(np.trace(np.linalg.inv(axes.T @ axes)) / 3.0)),
    )


def passage_velocity(half_width: float, scale_factor: float, slope: float) -> float:
    """Largest velocity error of one passage [m/s], by stationary phase: ``a_t tan(beta) sqrt(2 pi/(K s))``.

    ``half_width`` of the locked zone and ``slope`` of the force [m/s^2, m/s^3]. Own derivation, docs/platform.md
    section 10.
    """
    return half_width * math.sqrt(2.0 * math.pi / (scale_factor * slope))


def _passage(run: PlatformRun, sensors: PigaSensors) -> Passage | None:
    """The first passage of any instrument through its locked zone, with half an hour before and after."""
    inside = locked(sensors, run.truth.force)
    if not inside.any():
        return None
    first = int(np.argmax(inside.any(axis=1)))
    instrument = int(np.argmax(inside[first]))
    step = run.readouts.step
    margin = round(1800.0 / step)
    part = slice(max(0, first - margin), min(len(inside) - 1, first + margin) + 1)
    times, force = run.readouts.times[part], run.truth.force[part]
    whole = slice(0, part.stop)
    still = np.zeros((part.stop - 1, 3))
    alpha = gimbal_angles(sensors, run.readouts.times[whole], run.truth.force[whole], still)[:, part]
    axis = mounting_axes(sensors)[instrument, 0]
    read = {
        output: read_increments(replace(sensors, output=output), times, alpha) @ axis / step
        for output in ("raw", "triad")
    }
    along = force @ axis
    width = float(np.sqrt(np.sum(force**2, axis=1) - along**2).mean() * abs(sensors.tan_beta))
    slope = abs(float(along[-1] - along[0])) / float(times[-1] - times[0])
    return Passage(
        instrument=instrument,
        times=times[1:],
        true=0.5 * (along[1:] + along[:-1]),
        raw=read["raw"],
        triad=read["triad"],
        half_width=width,
        locked=inside[part][1:, instrument],
        lock_time=1.0 / (sensors.scale_factor * width),
        velocity_error=passage_velocity(width, sensors.scale_factor, slope),
    )
