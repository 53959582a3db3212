"""Error budget by source: linear model against full perturbed runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np

from piga import earth
from piga.frames import rotation_vector_to_matrix
from piga.platform.alignment import Alignment
from piga.platform.analysis import case_rates, daily_lines, day_slices, theory_lines
from piga.platform.geometry import local_axes
from piga.platform.identify import Identification
from piga.platform.navigator import (
    Errors,
    Perturbation,
    Start,
    compensator,
    errors,
    linear_errors,
    navigate,
    true_knowledge,
    true_start,
)
from piga.platform.scenario import Gyro, MotionPlan, PlatformScenario
from piga.platform.simulate import PlatformRun, simulate
from piga.progress import Progress, Steps
from piga.results import Result, finite
from piga.units import ARCMIN, ARCSEC


class BudgetRow(
    msgspec.Struct,
    frozen=True,
    rename={
        "position_linear": "position_linear_m",
        "position_full": "position_full_m",
        "velocity_linear": "velocity_linear_m_s",
        "velocity_full": "velocity_full_m_s",
        "difference": "largest_difference_m",
    },
):
    """One source: largest errors over the run from the linear model and from a full perturbed run.

    ``position`` horizontal [m], ``velocity`` horizontal [m/s]; ``difference`` [m]: largest distance between
    the two position histories. In JSON the keys end with the unit.
    """

    source: str
    position_linear: float
    position_full: float
    velocity_linear: float
    velocity_full: float
    difference: float


def standard_sources(alignment: Alignment | None = None) -> dict[str, Perturbation]:
    """The usual sources, at the size of a good platform. With ``alignment``: the attitude errors have its uncertainties."""
    tilt = (ARCSEC, ARCSEC, ARCSEC)
    if alignment is not None:
        std = alignment.std
        tilt = (float(std[0]), float(std[1]), float(std[2]))
    drift = np.radians(1e-5) / 3600.0
    micro_g = 9.80665e-6
    return {
        "triad attitude x": Perturbation(attitude=(tilt[0], 0.0, 0.0)),
        "triad attitude y": Perturbation(attitude=(0.0, tilt[1], 0.0)),
        "triad attitude z": Perturbation(attitude=(0.0, 0.0, tilt[2])),
        "drift x, 1e-5 deg/h": Perturbation(drift=(drift, 0.0, 0.0)),
        "drift y, 1e-5 deg/h": Perturbation(drift=(0.0, drift, 0.0)),
        "drift z, 1e-5 deg/h": Perturbation(drift=(0.0, 0.0, drift)),
        "accelerometer bias x, 1 ug": Perturbation(bias=(micro_g, 0.0, 0.0)),
        "accelerometer bias y, 1 ug": Perturbation(bias=(0.0, micro_g, 0.0)),
        "accelerometer bias z, 1 ug": Perturbation(bias=(0.0, 0.0, micro_g)),
        "reference height, 10 m": Perturbation(height=10.0),
        "start position north, 10 m": Perturbation(position=(10.0, 0.0, 0.0)),
        "start velocity east, 1 mm/s": Perturbation(velocity=(0.0, 1e-3, 0.0)),
    }


def error_budget(
    scenario: PlatformScenario, sources: Mapping[str, Perturbation], *, progress: Progress | None = None
) -> tuple[BudgetRow, ...]:
    """Each source alone, then all together, over the scenario's run at rest with perfect gyros and sensors.

    ``progress`` is called as ``progress(done, total, what)`` before each result; it returns False to stop
    (:mod:`piga.progress`).
    """
    steps = Steps(progress, 3 + len(sources))
    steps("simulating")
    run = simulate(scenario.without_errors())
    steps("navigating without errors")
    quiet = perturbed_errors(run, Perturbation())
    total = Perturbation()
    for perturbation in sources.values():
        total = total.plus(perturbation)
    rows = []
    for name, moved in {**sources, "all together": total}.items():
        steps(f"navigating with {name}")
        rows.append(_row(run, quiet, name, moved))
    steps.finish()
    return tuple(rows)


def perturbed_errors(run: PlatformRun, perturbation: Perturbation) -> Errors:
    """Errors of a full navigation run whose navigator or sensors have the error ``perturbation``."""
    readouts, place = run.readouts, run.scenario.place
    start = true_start(run.truth)
    axes = local_axes(place.latitude, place.longitude)
    position = start.position + axes @ np.array(perturbation.position)
    velocity = start.velocity + axes @ np.array(perturbation.velocity)
    velocity = velocity + np.cross([0.0, 0.0, earth.EARTH_RATE], axes @ np.array(perturbation.position))
    triad = rotation_vector_to_matrix(np.array(perturbation.attitude)) @ start.triad
    biased = replace(
        readouts,
        increments=readouts.increments + readouts.step * np.array(perturbation.bias),
        altitude=readouts.altitude + perturbation.height,
    )
    made = compensator("none", true_knowledge(run.scenario), biased)
    moved = Start(position, velocity, triad, np.array(perturbation.drift))
    every = max(1, round(10.0 / readouts.step))
    navigation = navigate(biased, made, moved, damping_time=run.scenario.damping_time, every=every)
    return errors(navigation, run.truth, readouts)


def _row(run: PlatformRun, quiet: Errors, source: str, perturbation: Perturbation) -> BudgetRow:
    full = perturbed_errors(run, perturbation)
    step = float(full.times[1] - full.times[0])
    linear = linear_errors(
        run.scenario.place,
        perturbation,
        float(full.times[-1]),
        step=step,
        damping_time=run.scenario.damping_time,
    )[1:]
    north, east = full.north - quiet.north, full.east - quiet.east
    velocity = full.velocity - quiet.velocity
    return BudgetRow(
        source,
        float(np.hypot(linear[:, 1], linear[:, 2]).max()),
        float(np.hypot(north, east).max()),
        float(np.hypot(linear[:, 4], linear[:, 5]).max()),
        float(np.hypot(velocity[:, 0], velocity[:, 1]).max()),
        float(np.hypot(north - linear[:, 1], east - linear[:, 2]).max()),
    )


@dataclass(frozen=True, eq=False, repr=False)
class LineRow(Result):
    """Lines of the last day that misalignments of known size leave, by channel in SI: closed form and full run.

    ``period`` [s] of the case at whose rate the lines stand.
    """

    source: str
    period: float
    theory: Mapping[str, float]
    full: Mapping[str, float]


def line_budget(
    scenario: PlatformScenario, identification: Identification | None = None
) -> tuple[LineRow, ...]:
    """Lines that an error of each misalignment alone, then of both, leaves on a base at rest; perfect sensors.

    The errors are the standard uncertainties of the identification, or one arc-second. The redundancy angle grows as
    the scenario says. None where a case rests or turns back and forth.
    """
    rotations = (scenario.polar_rotation, scenario.equatorial_rotation)
    if any(r.rate == 0.0 or r.turns > 0 for r in rotations):
        return ()
    sizes = [
        ARCSEC if identification is None else identification[f"{gyro}.misalignment"].std
        for gyro in ("polar", "equatorial")
    ]
    growth = scenario.equatorial.drift[0] - scenario.polar.drift[1]
    still = replace(scenario.without_errors(), motion=MotionPlan(heading=scenario.motion.heading))
    rows: list[LineRow] = []
    labels = ("polar misalignment", "equatorial misalignment", "both misalignments")
    for label, used in zip(labels, ((1.0, 0.0), (0.0, 1.0), (1.0, 1.0)), strict=True):
        polar, equatorial = used[0] * sizes[0], used[1] * sizes[1]
        alone = replace(
            still,
            polar=Gyro(polar, scenario.polar.phase),
            equatorial=Gyro(equatorial, scenario.equatorial.phase, drift=(growth, 0.0)),
        )
        size = " and ".join(f"{value / ARCSEC:.2g}" for value in (polar, equatorial) if value > 0.0)
        rows += _line_rows(alone, f"{label}, {size} arcsec")
    return tuple(rows)


def _line_rows(scenario: PlatformScenario, source: str) -> Iterator[LineRow]:
    run, known = simulate(scenario), true_knowledge(scenario)
    made = compensator("none", known, run.readouts)
    every = max(1, round(min(10.0, 0.05 * 2.0 * np.pi / max(case_rates(scenario))) / scenario.step))
    shown = navigate(run.readouts, made, true_start(run.truth), damping_time=scenario.damping_time, every=every)
    error, rates = errors(shown, run.truth, run.readouts), case_rates(scenario)
    full = daily_lines(error, rates, scenario.place.latitude)
    theory = theory_lines(scenario, made, known, day_slices(error.times), error.times)
    pairs = ((theory.amplitude, full.amplitude), (theory.equatorial, full.equatorial))
    for rate, (expected, seen) in zip(rates, pairs, strict=False):
        if max(expected["heading"]) > 0.0:
            yield LineRow(
                source, 2.0 * np.pi / rate, {name: float(v[-1]) for name, v in expected.items()},
                {name: float(v[-1]) for name, v in seen.items()},
            )  # fmt: skip


def line_budget_document(rows: Sequence[LineRow]) -> list[dict[str, Any]]:
    """Lines of each misalignment alone and of both as JSON rows. A missing line is null."""
    document = []
    for row in rows:
        entry: dict[str, Any] = {"source": row.source, "period_s": row.period}
        for name, theory in row.theory.items():
            scale, unit = (1.0, "m_s") if name.endswith("velocity") else (ARCMIN, "arcmin")
            linear, full = finite(theory / scale), finite(row.full[name] / scale)
            entry |= {f"{name}_line_linear_{unit}": linear, f"{name}_line_full_{unit}": full}
        document.append(entry)
    return document
