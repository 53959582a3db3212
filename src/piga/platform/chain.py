"""The whole chain: simulate, identify, align, navigate with every model, compare with the theory; and the error budget by source.

The budget is that of the linear model, which tests hold against full perturbed runs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from piga.platform import analysis, navigator
from piga.platform.analysis import Lines, case_rates
from piga.platform.identify import Alignment, Identification, align, identify
from piga.platform.navigator import (
    Errors,
    Knowledge,
    Navigation,
    Perturbation,
    Start,
    true_knowledge,
    true_start,
)
from piga.platform.observation import MOVING_SOURCES, STATIC_SOURCES
from piga.platform.scenario import Gyro, Model, MotionPlan, PlatformScenario
from piga.platform.simulate import PlatformRun, number_table, simulate
from piga.progress import Progress, Steps
from piga.results import Array, Plotted, Result, finite
from piga.units import ARCMIN, ARCSEC, DAY, G0
from piga.upper import doors

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

    navigation: Navigation
    errors: Errors
    lines: Lines
    theory: Lines | None


def navigation_table(run: ModelRun) -> pa.Table:
    """Output of the navigator, and its errors."""
    t, e = run.navigation.table, run.errors
    return number_table(
        ("t", "s", run.navigation.times),
        ("latitude longitude", "rad", t[:, :2]),
        ("height", "m", t[:, 2]),
        ("v_north v_east v_down", "m/s", t[:, 3:6]),
        ("roll pitch heading", "rad", t[:, 6:]),
        ("error_north error_east error_up", "m", np.stack([e.north, e.east, e.up], axis=1)),
        ("error_v_north error_v_east error_v_down", "m/s", e.velocity),
        ("error_roll error_pitch error_heading", "rad", e.attitude),
    )


@dataclass(frozen=True, eq=False, repr=False)
class ModelComparisonRun(Result, Plotted):
    """All models over one run. The plot shows the lines of each model, day by day."""

    run: PlatformRun
    preparation: Preparation
    models: Mapping[Model, ModelRun]

    def figure(self) -> Figure:
        """Lines at the case-rotation period against the day."""
        return doors().platform_figures().lines_figure(self)

    def in_brief(self) -> list[tuple[str, str]]:
        """Duration, and what each model leaves on the last day."""
        rows = [("duration", f"{self.run.scenario.duration / 3600.0:.6g} h, step {self.run.scenario.step:g} s")]
        for model, ran in self.models.items():
            east = ran.lines.amplitude["east_velocity"][-1:]
            line = "" if not east.size else f"east velocity line {east[0]:.3g} m/s, "
            last = ran.lines.position[-1:]
            last_day = f"{line}position within {last[0]:.4g} m" if last.size else "less than a day"
            rows.append(("no model" if model == "none" else f"model {model}", f"last day: {last_day}"))
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


def prepare(run: PlatformRun, progress: Progress | None = None) -> Preparation:
    """Identify and align as the scenario asks, from readouts of its calibration stretch only."""
    s, c = run.scenario, run.scenario.compensation
    stretch, place = run.readouts.first(s.calibration_time), s.place
    identification, aligned, notes = None, None, [analysis.lines_note(s), analysis.theory_note(s)]
    if c.misalignment == "identified" and s.polar_rotation.rate > 0.0:
        identification = identify(stretch, place, sources=sources_of(run), orders=c.orders, progress=progress)
        notes = [*identification.notes, *notes]
    elif c.misalignment == "identified":
        notes.insert(0, "the cases are at rest: nothing can be identified; the true misalignments are used")
    knowledge = true_knowledge(s) if identification is None else identification.knowledge
    attitude = c.attitude or ("aligned" if run.truth.motion.at_rest else "true")
    if "aligned" in (attitude, c.drift):
        aligned = align(stretch, place, knowledge, orders=c.orders, progress=progress)
    start = aligned.start(with_drift=False) if aligned and attitude == "aligned" else true_start(run.truth)
    start = replace(start, drift=_drift(s, aligned))
    return Preparation(knowledge, start, identification, aligned, tuple(note for note in notes if note))


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
    made = navigator.compensator(
        model, preparation.knowledge, run.readouts, redundancy=s.compensation.redundancy
    )
    navigation = navigator.navigate(
        run.readouts, made, preparation.start, damping_time=s.damping_time, every=every
    )
    error = navigator.errors(navigation, run.truth, run.readouts)
    lines = analysis.daily_lines(error, case_rates(s), s.place.latitude)
    days = analysis.day_slices(error.times)
    theory = (
        analysis.theory_lines(s, model, preparation.knowledge, days, error.times)
        if analysis.has_theory(s)
        else None
    )
    return ModelRun(navigation, error, lines, theory)


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
    preparation, models, every = prepare(run), {}, max(1, round(1.0 / scenario.step))  # a row a second
    for m in named:
        steps(f"navigating, model {m}")
        models[m] = run_model(run, preparation, m, every=every)
    steps.finish()
    return ModelComparisonRun(run, preparation, models)


def last_east_lines(lines: Lines) -> list[float]:
    """East velocity lines [m/s] of the last day: at the polar case's rate and, at another speed, the equatorial one's."""
    return [float(amplitude["east_velocity"][-1]) for amplitude in lines.by_case.values()]


def _shown(label: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Amplitudes by channel as numbers of a document, in m/s or arcmin; a missing line is null."""
    document = {}
    for name, value in values.items():
        size, unit = (1.0, "m_s") if name.endswith("velocity") else (ARCMIN, "arcmin")
        numbers = np.asarray(value / size).tolist()
        document[f"{name}_{label}_{unit}"] = (
            [finite(number) for number in numbers] if isinstance(numbers, list) else finite(numbers)
        )
    return document


def _lines_document(lines: Lines) -> dict[str, Any]:
    document: dict[str, Any] = {"day": lines.day.tolist()}
    for label, amplitude in lines.by_case.items():
        document |= _shown(label, amplitude)
    return document | {"position_error_m": [finite(value) for value in lines.position.tolist()]}


# -- error budget --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class BudgetRow:
    """One source: largest horizontal errors over the run by the linear model."""

    source: str
    position_linear_m: float
    velocity_linear_m_s: float


def standard_sources(alignment: Alignment | None = None) -> dict[str, Perturbation]:
    """The usual sources, at the size of a good platform. With ``alignment``: the attitude errors have its uncertainties."""
    tilt = [ARCSEC] * 3 if alignment is None else alignment.std[:3].tolist()
    errors_of = (
        ("triad attitude {}", "attitude", tilt),
        ("drift {}, 1e-5 deg/h", "drift", [np.radians(1e-5) / 3600.0] * 3),
        ("accelerometer bias {}, 1 ug", "bias", [1e-6 * G0] * 3),
    )
    axes: dict[str, Perturbation] = {}
    for label, kind, sizes in errors_of:
        for k, size in enumerate(sizes):
            along: dict[str, Any] = {kind: tuple(size if i == k else 0.0 for i in range(3))}
            axes[label.format("xyz"[k])] = Perturbation(**along)
    return axes | {
        "reference height, 10 m": Perturbation(height=10.0),
        "start position north, 10 m": Perturbation(position=(10.0, 0.0, 0.0)),
        "start velocity east, 1 mm/s": Perturbation(velocity=(0.0, 1e-3, 0.0)),
    }


def error_budget(scenario: PlatformScenario, sources: Mapping[str, Perturbation]) -> tuple[BudgetRow, ...]:
    """Each source alone, then all together, over the length of the scenario, on a base at rest (:func:`linear_errors`)."""
    step, total, rows = max(1, round(10.0 / scenario.step)) * scenario.step, Perturbation(), []
    for perturbation in sources.values():
        total = total.plus(perturbation)
    for name, moved in {**sources, "all together": total}.items():
        at = navigator.linear_errors(
            scenario.place, moved, scenario.duration, step=step, damping_time=scenario.damping_time
        )
        rows.append(BudgetRow(name, *(float(np.hypot(at[:, k], at[:, k + 1]).max()) for k in (1, 4))))
    return tuple(rows)


@dataclass(frozen=True, eq=False, repr=False)
class LineRow(Result):
    """Lines of the last day that misalignments of known size leave, by channel in SI, in closed form.

    ``period`` [s] of the case at whose rate the lines stand.
    """

    source: str
    period: float
    lines: Mapping[str, float]


def line_budget(
    scenario: PlatformScenario, identification: Identification | None = None
) -> tuple[LineRow, ...]:
    """Lines that an error of each misalignment alone, then of both, leaves on a base at rest.

    The errors are the standard uncertainties of the identification, or one arc-second. The redundancy angle grows as
    the scenario says. None where a case rests or turns back and forth.
    """
    rotations = (scenario.polar_rotation, scenario.equatorial_rotation)
    if any(r.rate == 0.0 or r.turns > 0 for r in rotations):
        return ()
    sizes = [ARCSEC] * 2
    if identification is not None:
        sizes = [identification[f"{gyro}.misalignment"].std for gyro in ("polar", "equatorial")]
    growth, rates = true_knowledge(scenario).eta_rate, case_rates(scenario)
    end = scenario.duration
    day = np.array([(np.ceil(end / DAY) - 1.0) * DAY, end])
    rows: list[LineRow] = []
    labels = ("polar misalignment", "equatorial misalignment", "both misalignments")
    for label, used in zip(labels, ((1.0, 0.0), (0.0, 1.0), (1.0, 1.0)), strict=True):
        polar, equatorial = used[0] * sizes[0], used[1] * sizes[1]
        alone = replace(
            scenario,
            motion=MotionPlan(heading=scenario.motion.heading),
            polar=Gyro(polar, scenario.polar.phase),
            equatorial=Gyro(equatorial, scenario.equatorial.phase, drift=(growth, 0.0)),
        )
        theory = analysis.theory_lines(alone, "none", true_knowledge(alone), [slice(0, 2)], day)
        size = " and ".join(f"{value / ARCSEC:.2g}" for value in (polar, equatorial) if value > 0.0)
        for rate, amplitude in zip(rates, theory.by_case.values(), strict=True):
            lines = {name: float(value[0]) for name, value in amplitude.items()}
            if lines["heading"] > 0.0:
                rows.append(LineRow(f"{label}, {size} arcsec", 2.0 * np.pi / rate, lines))
    return tuple(rows)


def line_budget_document(rows: Sequence[LineRow]) -> list[dict[str, Any]]:
    """Lines of each misalignment alone and of both as JSON rows. A missing line is null."""
    return [{"source": row.source, "period_s": row.period} | _shown("line_linear", row.lines) for row in rows]
