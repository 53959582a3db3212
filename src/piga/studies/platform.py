"""The platform [He2014]: redundancy angle, drift coupling, ten days, wobbling rotation axes; gyro accelerometers on it.

Why gyro accelerometers err on it although they are never locked for long: docs/theory/platform.md section 10.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Final, cast

import msgspec
import numpy as np

from piga.errors import ArgumentError
from piga.frames import matrix_to_rotation_vector, rotation_vector_to_matrix
from piga.platform.chain import (
    ModelComparisonRun,
    channels,
    compare,
    fitted_lines,
    prepare,
    run_model,
)
from piga.platform.geometry import nulled_attitude
from piga.platform.navigator import Errors
from piga.platform.scenario import (
    Compensation,
    Gyro,
    Harmonic,
    Model,
    Place,
    PlatformScenario,
)
from piga.platform.simulate import TRIPOD, locked, mounting_axes, simulate
from piga.progress import Progress, Steps
from piga.reports.platform import lines_figure, page, published_figure, schuler_peak, time_axis
from piga.reports.render.figure import Figure, Plot, Role
from piga.reports.render.numbers import short
from piga.reports.render.page import Page, Section, TableOf
from piga.results import Array, Result
from piga.studies.case import Chapter, chapter_of, published_chapters
from piga.units import ARCMIN, DAY

CASE_RATE = 2.0 * math.pi / 480.0
GRAVITY_OF_TABLE = 9.8
"""g of the publication's relations [m/s^2]."""
_HOUR_RATE = math.radians(1.0) / 3600.0


def table() -> Chapter:
    """Amplitude about the polar axis for 10' against redundancy angle, and the resulting east velocity.

    The amplitude is the first harmonic over a case turn, from the exact geometry of both nulled pick-offs, for m2 = 0.
    """
    case = np.arange(256) * (2.0 * np.pi / 256)
    values: dict[str, float] = {}
    for eta in range(1, 6):
        attitude, _ = nulled_attitude(Gyro(10.0 * ARCMIN), Gyro(), case, case, math.radians(eta))
        turn = matrix_to_rotation_vector(np.swapaxes(attitude, 1, 2))[:, 2]
        values[f"eta-{eta}"] = float(2.0 * np.abs(np.mean(turn * np.exp(-1j * case)))) / ARCMIN
    values |= {
        "velocity": GRAVITY_OF_TABLE * ARCMIN / CASE_RATE,
        "velocity-as-printed": 10.0 * ARCMIN / CASE_RATE,
    }
    return chapter_of("redundancy-angle", values)


def coupling() -> Chapter:
    """Drift of the triad from the drifts of two gyros: published relations against the geometry of two momenta.

    The geometry is our own derivation, by central difference over ten minutes each way.
    """
    half, eta = 600.0, math.radians(5.0)
    h1, h2 = np.array([0.0, 0.0, 1.0]), np.array([math.cos(eta), 0.0, -math.sin(eta)])
    z_G2 = np.array([math.sin(eta), 0.0, math.cos(eta)])
    first = _HOUR_RATE * np.array([0.013, -0.007, 0.0])
    second = _HOUR_RATE * (np.array([0.0, 0.01, 0.0]) + 0.02 * z_G2)
    (before, eta_before), (after, eta_after) = (
        _triad(rotation_vector_to_matrix(first * time) @ h1, rotation_vector_to_matrix(second * time) @ h2)
        for time in (-half, half)
    )
    rate = matrix_to_rotation_vector(after @ before.T) / (2.0 * half) / _HOUR_RATE
    values = dict(zip(("w_Gx", "w_Gy", "w_Gz"), rate.tolist(), strict=True)) | {
        "eta_rate": (eta_after - eta_before) / (2.0 * half) / _HOUR_RATE,
        "w_G2x": float(rate @ h2),
    }
    return chapter_of("drift-coupling", values)


def _triad(h1: Array, h2: Array) -> tuple[Array, float]:
    """Columns x_G, y_G, z_G on two momenta, and the redundancy angle [rad]."""
    y = np.cross(h1, h2)
    y /= np.linalg.norm(y)
    return np.stack([np.cross(y, h1), y, h1], axis=1), -math.asin(float(h1 @ h2))


LATITUDE: Final = math.radians(40.0)
STEP: Final = 2.0
"""Step of the ten-day runs [s]. A step of 1 s changes the lines by less than 0.5 %, and model B's by 5e-6 m/s."""
_DRIFT = math.radians(0.01) / 3600.0
_DAYS = 10.0
_LATE = 7200.0
CHANNELS: Final = {"east_velocity": 1.0, "heading": ARCMIN, "roll": ARCMIN}
"""Channels of the ten days, with the units of their published numbers (SI)."""


def scenario(*, wobble: bool) -> PlatformScenario:
    """L = 40 deg, m1 = m2 = 4', period 8 min, eta' = 0.01 deg/h; ten days.

    Case angles have no phases, as in the publication's sines and cosines. The size of the wobble is our choice: it
    is not published.
    """
    models: tuple[Model, ...] = ("A", "B", "C") if wobble else ("A", "B")
    polar = equatorial = Gyro(4.0 * ARCMIN)
    if wobble:
        polar, equatorial = _wobbling(20.0, 60.0, 130.0), _wobbling(75.0, 100.0, 10.0)
    return PlatformScenario(
        Place(LATITUDE, math.radians(116.0)),
        duration=_DAYS * DAY,
        step=STEP,
        polar_rotation=CASE_RATE,
        equatorial_rotation=CASE_RATE,
        polar=polar,
        equatorial=msgspec.structs.replace(equatorial, drift=(_DRIFT, 0.0)),
        compensation=Compensation(models=models),
    )


def _wobbling(*phases: float) -> Gyro:
    """A gyro with harmonics of one, two and three cycles a turn at these phases [deg]."""
    first, second, third = np.radians(phases).tolist()
    harmonics = Harmonic(2, 0.25 * ARCMIN, second), Harmonic(3, 0.05 * ARCMIN, third)
    return Gyro(4.0 * ARCMIN, first, harmonics)


@cache
def compared(*, wobble: bool) -> ModelComparisonRun:
    """The run with every model."""
    return compare(scenario(wobble=wobble))


def last_lines(comparison: ModelComparisonRun, model: Model) -> dict[str, float]:
    """Amplitude at the case-rotation period over the last two hours, by channel (SI)."""
    errors = comparison.models[model].errors
    named = channels(errors)
    late = errors.times > errors.times[-1] - _LATE
    table = np.stack([named[channel][late] for channel in CHANNELS], axis=1)
    amplitude = fitted_lines(errors.times[late], table, (CASE_RATE,), LATITUDE)[0]
    return dict(zip(CHANNELS, amplitude.tolist(), strict=True))


def printed(channel: str, what: str) -> float:
    """A published number of the ten days: the ``formula``, the printed ``theory`` or the simulation of model ``A``."""
    case = published_chapters()["ten-days"].cases[f"{channel.replace('_', '-')}-{what}"]
    return cast("float", case.published)


def ten_days() -> Chapter:
    """Models A and B over ten days."""
    comparison = compared(wobble=False)
    lines = {m: last_lines(comparison, m) for m in comparison.models}
    values: dict[str, float] = {}
    for channel, unit in CHANNELS.items():
        name = channel.replace("_", "-")
        theory, followed = (lines[model][channel] / unit for model in ("A", "B"))
        values |= dict.fromkeys((f"{name}-theory", f"{name}-formula", f"{name}-A"), theory)
        values[f"{name}-B"] = followed
    first = [float(comparison.models[m].lines.amplitude["east_velocity"][0]) for m in ("A", "B")]
    values["first-day"] = first[0] - first[1]
    title = "Errors around the end of day ten, models A and B"
    end = replace(published_figure(comparison), key="ten-days-end", title=title)
    return chapter_of("ten-days", values, (replace(lines_figure(comparison), key="ten-days-lines"), end))


def wobble() -> Chapter:
    """Wobbling rotation axes: model B removes only a part of the error of model A; model C removes the wobble, too."""
    comparison = compared(wobble=True)
    amplitude = {m: float(r.lines.amplitude["east_velocity"][-1]) for m, r in comparison.models.items()}
    values = {f"removed-{m}": 100.0 * (1.0 - amplitude[m] / amplitude["A"]) for m in ("B", "C")}
    figure = replace(lines_figure(comparison), key="wobble-lines")
    return chapter_of("wobble", values | {"left-B": amplitude["B"]}, (figure,))


# -- gyro accelerometers on the platform ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False, repr=False)
class CapstoneOutcome(Result):
    """One way to mount and read the instruments: errors, locked time [s/day] of each, noise against three axes at right angles."""

    errors: Errors
    locked_per_day: Array
    noise_gain: float

    @property
    def position(self) -> float:
        """Largest horizontal position error [m]."""
        return float(self.errors.horizontal.max())

    @property
    def velocity(self) -> float:
        """Largest horizontal velocity error [m/s]."""
        return float(np.hypot(*self.errors.velocity[:, :2].T).max())


@dataclass(frozen=True, eq=False, repr=False)
class Capstone(Result):
    """Outcomes by name."""

    scenario: PlatformScenario
    outcomes: Mapping[str, CapstoneOutcome]


_READINGS: dict[str, tuple[dict[str, Any], str, Role]] = {
    "ideal": ({}, "ideal accelerometers: the platform and the navigator alone", "reference"),
    "raw tripod": ({"cone": TRIPOD, "output": "raw"}, "three axes at right angles, output taken as alpha'/K", "before"),
    "raw skewed": ({"output": "raw"}, "axes near the pole: never locked, still pulled", "warning"),
    "triad": ({"cone": TRIPOD}, "right angles, compensated as a set", "after"),
    "triad skewed": ({}, "axes near the pole, compensated as a set", "model"),
    "triad, calibrated": ({"cone": TRIPOD}, "the same with tan(beta) and phase off by a calibration's error", "z"),
}  # fmt: skip
"""Readings compared, from the ideal instrument to the locked one, and back: what they change, a sentence, their colour."""


def capstone(scenario: PlatformScenario, *, progress: Progress | None = None) -> Capstone:
    """Navigate the scenario with every reading of its gyro accelerometers (model B).

    ``progress`` is called as ``progress(done, total, what)`` before each reading; it returns False to stop
    (:mod:`piga.progress`).

    Raises
    ------
    ArgumentError
        If the scenario has no gyro accelerometers.
    """
    sensors = scenario.sensors.pigas
    if sensors is None:
        raise ArgumentError(
            f"{scenario.source or 'the scenario'}: there are no gyro accelerometers",
            remedy="set [sensors] accelerometers = 'piga'",
        )
    off = {"tan_beta_error": sensors.tan_beta_error, "phase_error": sensors.phase_error}
    if not any(off.values()):
        off = {"tan_beta_error": 2e-3 * sensors.tan_beta, "phase_error": 2e-3}
    steps = Steps(progress, 2 + len(_READINGS))
    steps("simulating")
    ideal = simulate(
        replace(scenario, sensors=msgspec.structs.replace(scenario.sensors, accelerometers="ideal"))
    )
    steps("identifying and aligning")
    preparation = prepare(ideal)
    outcomes = {}
    for name, (changes, *_) in _READINGS.items():
        steps(f"navigating, {name}")
        run, axes, inside = ideal, np.eye(3), np.zeros(3)
        if name != "ideal":
            wrong = off if name.endswith("calibrated") else dict.fromkeys(off, 0.0)
            given = {"mounting": "skewed", "output": "triad"} | wrong | changes
            used = msgspec.structs.replace(sensors, **given)
            read = replace(scenario, sensors=msgspec.structs.replace(scenario.sensors, piga=used))
            run = simulate(read, motion=ideal.truth.motion)
            axes, inside = mounting_axes(used)[:, 0, :], locked(used, run.truth.force).mean(axis=0) * DAY
        gain = float(np.sqrt(np.trace(np.linalg.inv(axes.T @ axes)) / 3.0))
        left = run_model(run, preparation, "B", every=max(1, round(10.0 / scenario.step))).errors
        outcomes[name] = CapstoneOutcome(left, inside, gain)
    steps.finish()
    return Capstone(scenario, outcomes)


def capstone_figure(capstone: Capstone) -> Figure:
    """Horizontal position error over the run for every reading."""
    axis, unit = time_axis(float(capstone.scenario.duration))
    title = "Ten days with three gyro accelerometers"
    plot = Plot("fig-capstone", title, axis, "log horizontal position error [m]", height=3.6)
    for name, o in capstone.outcomes.items():
        peak = np.maximum(schuler_peak(o.errors.times, o.errors.horizontal), 1e-4)
        plot.line(o.errors.times / unit, peak, name, _READINGS[name][2], dashed="," in name or name == "ideal")
    return plot.caption("Largest error within each 84 minutes.")


def capstone_page(capstone: Capstone) -> Page:
    """Page on the effect of the locked zone on the platform, and its compensation."""
    o = capstone.outcomes
    story = (
        "The platform stands still in inertial space and the Earth turns under it. Each input axis crosses the "
        "horizontal twice a sidereal day and is inside its locked zone for "
        f"{short(float(o['raw tripod'].locked_per_day.max()))} s a day: too short to lock, but about it the gimbal turns so "
        "slowly that its cross-coupling does not average out.\n\n"
        "Mounted within the latitude of the pole the axes never come to the horizontal, with "
        f"{short(o['raw skewed'].noise_gain)} times the noise. Compensated as a set, the three instruments give the force "
        "back in any mounting."
    )
    table = (
        TableOf(o.items())
        .text("reading", lambda row: row[0])
        .number("position error", lambda row: short(row[1].position), "m")
        .number("velocity error", lambda row: short(1e3 * row[1].velocity), "mm/s")
        .number("locked", lambda row: short(float(row[1].locked_per_day.max())), "s/day")
        .number("noise gain", lambda row: short(row[1].noise_gain))
        .text("what it is", lambda row: _READINGS[row[0]][1])
        .table(notes=("Locked: longest of the three. Noise gain: against three axes at right angles.",))
    )
    sections = (Section("What happens", "story", (story, capstone_figure(capstone), table)),)
    return page("Gyro accelerometers on the space-stable platform", capstone.scenario, (), sections)
