"""The whole chain: simulate, identify, align, navigate with every model, compare with the theory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from piga import doors
from piga.platform.alignment import Alignment, align
from piga.platform.analysis import (
    Lines,
    case_rates,
    daily_lines,
    day_slices,
    has_theory,
    lines_note,
    theory_lines,
    theory_note,
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
from piga.platform.scenario import Model, PlatformScenario
from piga.platform.simulate import PlatformRun, number_table, simulate
from piga.progress import Progress, Steps
from piga.results import Array, Plotted, Result, finite
from piga.units import ARCMIN

if TYPE_CHECKING:
    import pyarrow as pa

    from piga.reports.render.figure import Figure


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


NAVIGATION_COLUMNS = 19
"""Columns of the table of a navigation, so that its size can be told before it."""


def navigation_table(run: ModelRun) -> pa.Table:
    """Output of the navigator, and its errors."""
    t, e = run.navigation.table, run.errors
    names = ("latitude", "longitude", "height", "v_north", "v_east", "v_down", "roll", "pitch", "heading")
    units = ("rad", "rad", "m", "m/s", "m/s", "m/s", "rad", "rad", "rad")
    columns = {"t": (run.navigation.times, "s")}
    columns |= {name: (t[:, k], unit) for k, (name, unit) in enumerate(zip(names, units, strict=True))}
    columns |= {"error_north": (e.north, "m"), "error_east": (e.east, "m"), "error_up": (e.up, "m")}
    columns |= {
        f"error_v_{name}": (e.velocity[:, k], "m/s") for k, name in enumerate(("north", "east", "down"))
    }
    columns |= {
        f"error_{name}": (e.attitude[:, k], "rad") for k, name in enumerate(("roll", "pitch", "heading"))
    }
    return number_table(columns)


@dataclass(frozen=True, eq=False, repr=False)
class ModelComparisonRun(Result, Plotted):
    """All models over one run. The plot shows the lines of each model, day by day."""

    run: PlatformRun
    preparation: Preparation
    models: Mapping[Model, ModelRun]

    def figure(self) -> Figure:
        """Lines at the case-rotation period against the day."""
        return doors.platform_figures().lines_figure(self)

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
    notes += [note for note in (lines_note(s), theory_note(s)) if note]
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
    """Navigate the run with one model; lines per day, and theory where the base stays at its place."""
    s = run.scenario
    made = compensator(model, preparation.knowledge, run.readouts, redundancy=s.compensation.redundancy)
    navigation = navigate(run.readouts, made, preparation.start, damping_time=s.damping_time, every=every)
    error = errors(navigation, run.truth, run.readouts)
    lines = daily_lines(error, case_rates(s), s.place.latitude)
    theory = None
    if has_theory(s):
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
