"""The whole chain: simulate, identify, align, navigate with every model, compare with the theory.

On a platform fixed in inertial space, gravity describes a cone once a sidereal day. Twice a day it crosses the plane
normal to an input axis of a gyro accelerometer and passes the locked zone ``|a_x| < a_t tan(beta)``. :func:`capstone`
reads the same days in several ways and navigates each time.

With the usual tan(beta) the zone is passed faster than the gimbal can lock (in ``1/(K a_t tan(beta))``). The error has
another cause: near the zone the gimbal turns so slowly that the cross-coupling keeps its phase. By stationary phase,
one passage leaves a velocity error of up to ``a_t tan(beta) sqrt(2 pi / (K |d a_x/dt|))`` (own derivation,
docs/platform.md section 10).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError
from piga.platform.alignment import Alignment, align
from piga.platform.analysis import (
    Lines,
    case_rates,
    daily_lines,
    day_slices,
    lines_note,
    theory_lines,
)
from piga.platform.identify import Identification, identify
from piga.platform.navigator import (
    CaseCompensator,
    Errors,
    Knowledge,
    Navigation,
    Start,
    compensator,
    errors,
    navigate,
    true_knowledge,
    true_start,
)
from piga.platform.observation import MOVING_SOURCES, STATIC_SOURCES
from piga.platform.scenario import Model, PigaSensors, PlatformScenario
from piga.platform.simulate import (
    TRIPOD,
    PlatformRun,
    gimbal_angles,
    locked,
    mounting_axes,
    read_increments,
    simulate,
)
from piga.progress import Progress, Steps
from piga.results import Array, Plotted, Result, finite
from piga.units import ARCMIN, DAY


@dataclass(frozen=True)
class Preparation:
    """Knowledge before navigation: misalignments, start, and the results that gave them (None: from truth)."""

    knowledge: Knowledge
    start: Start
    identification: Identification | None
    alignment: Alignment | None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class ModelRun:
    """One compensation model over the run: navigation, errors, lines per day, and theory."""

    compensator: CaseCompensator
    navigation: Navigation
    errors: Errors
    lines: Lines
    theory: Lines | None


@dataclass(frozen=True, eq=False, repr=False)
class ModelComparisonRun(Result, Plotted):
    """All models over one run. The plot shows the lines of each model, day by day."""

    run: PlatformRun
    preparation: Preparation
    models: Mapping[Model, ModelRun]

    def in_brief(self) -> list[tuple[str, str]]:
        """Duration, and what each model leaves on the last day."""
        rows = [("duration", f"{self.run.scenario.duration / 3600.0:.6g} h, step {self.run.scenario.step:g} s")]
        for model, ran in self.models.items():
            east = ran.lines.amplitude["east_velocity"][-1:]
            line = "" if not east.size else f"east velocity line {east[0]:.3g} m/s, "
            last = ran.lines.position[-1:]
            said = f"{line}position within {last[0]:.4g} m" if last.size else "less than a day"
            rows.append(("no model" if model == "none" else f"model {model}", f"last day: {said}"))
        return [*rows, *(("note", note) for note in self.preparation.notes)]

    def document(self) -> dict[str, Any]:
        """The JSON document of ``piga platform compare``."""
        theory = {m: _lines_document(r.theory) for m, r in self.models.items() if r.theory is not None}
        return {
            "models": {m: _lines_document(r.lines) for m, r in self.models.items()},
            "theory": theory,
            "notes": list(self.preparation.notes),
        }


def sources_of(run: PlatformRun) -> tuple[str, ...]:
    """Sources of identification that the base of a run allows."""
    return STATIC_SOURCES if run.truth.motion.at_rest else MOVING_SOURCES


def identified(run: PlatformRun, progress: Progress | None = None) -> Identification:
    """Identification from the calibration stretch of a run."""
    s = run.scenario
    stretch, orders = run.readouts.first(s.calibration_time), s.compensation.orders
    return identify(stretch, s.place, sources=sources_of(run), orders=orders, progress=progress)


def prepare(run: PlatformRun, progress: Progress | None = None) -> Preparation:
    """Identify and align as the scenario asks, from readouts of its calibration stretch only."""
    s, c = run.scenario, run.scenario.compensation
    identification = None
    notes: list[str] = []
    if c.misalignment == "identified" and s.polar_rotation.rate > 0.0:
        identification = identified(run, progress)
        notes += identification.notes
    elif c.misalignment == "identified":
        notes.append("the cases are at rest: nothing can be identified; the true misalignments are used")
    if indistinct := lines_note(s):
        notes.append(indistinct)
    known = true_knowledge(s) if identification is None else identification.knowledge
    aligned = None
    start = true_start(run.truth)
    if "aligned" in (c.attitude, c.drift):
        aligned = align(
            run.readouts.first(s.calibration_time), s.place, known, orders=c.orders, progress=progress
        )
        if c.attitude == "aligned":
            start = aligned.start(with_drift=False)
    drift = _drift(s, aligned)
    return Preparation(
        known, Start(start.position, start.velocity, start.triad, drift), identification, aligned, tuple(notes)
    )


def _drift(s: PlatformScenario, aligned: Alignment | None) -> Array:
    if s.compensation.drift == "aligned" and aligned is not None:
        return aligned.drift
    if s.compensation.drift == "true":
        w1x, w1y = s.polar.drift
        w2z = s.equatorial.drift[1]
        return np.array([w1x, w1y, w2z / np.cos(s.redundancy) - w1x * np.tan(s.redundancy)])
    return np.zeros(3)


def run_model(run: PlatformRun, preparation: Preparation, model: Model, *, every: int = 1) -> ModelRun:
    """Navigate the run with one model; lines per day, and theory where the base is at rest."""
    s = run.scenario
    made = compensator(model, preparation.knowledge, run.readouts, redundancy=s.compensation.redundancy)
    navigation = navigate(run.readouts, made, preparation.start, damping_time=s.damping_time, every=every)
    error = errors(navigation, run.truth, run.readouts)
    lines = daily_lines(error, case_rates(s), s.place.latitude)
    theory = None
    turning = max(s.polar_rotation.rate, s.equatorial_rotation.rate) > 0.0
    if run.truth.motion.at_rest and turning and s.polar_rotation.turns == 0:
        theory = theory_lines(s, made, preparation.knowledge, day_slices(error.times), error.times)
    return ModelRun(made, navigation, error, lines, theory)


def _every(scenario: PlatformScenario) -> int:
    """Steps per row of the navigation: one row a second."""
    return max(1, round(1.0 / scenario.step))


def navigated_rows(scenario: PlatformScenario) -> int:
    """Rows that the navigation of each model has."""
    return scenario.steps // _every(scenario)


def compare(scenario: PlatformScenario, *, progress: Progress | None = None) -> ModelComparisonRun:
    """Simulate the scenario and navigate it with every model it names.

    ``progress`` is called as ``progress(done, total, what)`` before each step; it returns False to stop
    (:mod:`piga.progress`).

    Raises
    ------
    PigaError
        If the scenario cannot be simulated, or its misalignments cannot be identified.
    """
    named = scenario.compensation.models
    steps = Steps(progress, 2 + len(named))
    steps("simulating")
    run = simulate(scenario)
    steps("identifying and aligning")
    preparation = prepare(run)
    every = _every(scenario)
    models = {}
    for m in named:
        steps(f"navigating, model {m}")
        models[m] = run_model(run, preparation, m, every=every)
    steps.finish()
    return ModelComparisonRun(run, preparation, models)


def last_east_lines(lines: Lines) -> list[float]:
    """East velocity lines [m/s] of the last day: at the polar case's rate and, at another speed, the equatorial one's."""
    each = (lines.amplitude, lines.equatorial)
    return [float(amplitude["east_velocity"][-1]) for amplitude in each if amplitude]


def _lines_document(lines: Lines) -> dict[str, Any]:
    document: dict[str, Any] = {"day": [int(day) for day in lines.day]}
    for amplitude, label in ((lines.amplitude, "line"), (lines.equatorial, "equatorial_line")):
        for name, values in amplitude.items():
            scale, unit = (1.0, "m_s") if name.endswith("velocity") else (ARCMIN, "arcmin")
            document[f"{name}_{label}_{unit}"] = [finite(value) for value in (values / scale).tolist()]
    document["position_error_m"] = [finite(value) for value in lines.position.tolist()]
    return document


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
class Capstone(Result, Plotted):
    """Outcomes by name, one passage in detail, and the day of input-axis forces (times [s], (n, 3) [m/s^2]).

    The plot shows the position errors of each reading.
    """

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
        read = replace(scenario, sensors=replace(scenario.sensors, piga=reading.sensors))
        run = ideal if reading.sensors is None else simulate(read, motion=ideal.truth.motion)
        outcomes[reading.name] = _outcome(run, reading, preparation)
    tripod = next(way.sensors for way in ways if way.name == "raw tripod")
    assert tripod is not None  # noqa: S101 - named above
    times, force = ideal.readouts.times, ideal.truth.force
    one_day = slice(0, min(len(times), round(86164.1 / scenario.step) + 1), max(1, round(60.0 / scenario.step)))
    along = force[one_day] @ mounting_axes(tripod)[:, 0, :].T
    steps.finish()
    return Capstone(scenario, outcomes, _passage(ideal, tripod), (times[one_day], along))


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
