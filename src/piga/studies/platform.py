"""The platform [He2014]: redundancy angle, drift coupling, ten days, wobbling rotation axes; gyro accelerometers on it.

On a platform fixed in inertial space, gravity describes a cone once a sidereal day. Twice a day it crosses the plane
normal to an input axis of a gyro accelerometer and passes the locked zone ``|a_x| < a_t tan(beta)``. :func:`capstone`
reads the same days in several ways and navigates each time.

With the usual tan(beta) the zone is passed faster than the gimbal can lock. The error has another cause: near the zone the
gimbal turns so slowly that the cross-coupling keeps its phase (docs/theory/platform.md section 10).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Final

import msgspec
import numpy as np

from piga.errors import ArgumentError
from piga.frames import matrix_to_rotation_vector, rotation_vector_to_matrix
from piga.platform.chain import (
    ModelComparisonRun,
    Preparation,
    channels,
    compare,
    fitted_lines,
    prepare,
)
from piga.platform.geometry import nulled_attitude
from piga.platform.navigator import Errors, compensator, errors, navigate
from piga.platform.scenario import (
    Compensation,
    Gyro,
    Harmonic,
    Model,
    Place,
    PlatformScenario,
    Rotation,
)
from piga.platform.simulate import TRIPOD, PlatformRun, locked, mounting_axes, simulate
from piga.progress import Progress, Steps
from piga.reports.platform import lines_figure, page, published_figure, schuler_peak, time_axis
from piga.reports.render.figure import Figure, Plot, Role, Series
from piga.reports.render.numbers import short
from piga.reports.render.page import Page, Section, Table, TableOf, Tile
from piga.results import Array, Result
from piga.studies.case import Chapter, Value, chapter_of
from piga.units import ARCMIN, DAY

CASE_RATE = 2.0 * math.pi / 480.0
GRAVITY_OF_TABLE = 9.8
"""g of the publication's relations [m/s^2]."""
_MISALIGNMENT = 10.0 * ARCMIN
_HOUR_RATE = math.radians(1.0) / 3600.0
_CASE = np.arange(256) * (2.0 * np.pi / 256)


def pole_amplitude(misalignment: float, eta: float) -> float:
    """First-harmonic amplitude [rad] of the platform's rotation about the polar axis over a case turn, for m2 = 0.

    From the exact geometry of both nulled pick-offs.
    """
    attitude, _ = nulled_attitude(Gyro(misalignment), Gyro(), _CASE, _CASE, eta)
    turn = matrix_to_rotation_vector(np.swapaxes(attitude, 1, 2))[:, 2]
    return float(2.0 * np.abs(np.mean(turn * np.exp(-1j * _CASE))))


def table() -> Chapter:
    """Amplitude about the polar axis for 10' against redundancy angle, and the resulting east velocity."""
    values = {f"eta-{eta}": pole_amplitude(_MISALIGNMENT, math.radians(eta)) / ARCMIN for eta in range(1, 6)}
    values |= {
        "velocity": GRAVITY_OF_TABLE * ARCMIN / CASE_RATE,
        "velocity-as-printed": 10.0 * ARCMIN / CASE_RATE,
    }
    return chapter_of("redundancy-angle", values)


def coupling() -> Chapter:
    """Drift of the triad from the drifts of two gyros: published relations against the geometry of two momenta."""
    eta = math.radians(5.0)
    drift = {
        "w1x": 0.013 * _HOUR_RATE,
        "w1y": -0.007 * _HOUR_RATE,
        "w2y": 0.01 * _HOUR_RATE,
        "w2z": 0.02 * _HOUR_RATE,
    }
    relation, geometry = published_coupling(eta, **drift), momentum_coupling(eta, **drift)
    values = {
        name: Value(value / _HOUR_RATE, published=relation[name] / _HOUR_RATE)
        for name, value in geometry.items()
    }
    return chapter_of("drift-coupling", values)


def published_coupling(eta: float, *, w1x: float, w1y: float, w2y: float, w2z: float) -> dict[str, float]:
    """The published relations [rad/s]."""
    secant, tangent = 1.0 / math.cos(eta), math.tan(eta)
    return {
        "w_Gx": w1x,
        "w_Gy": w1y,
        "w_Gz": w2z * secant - w1x * tangent,
        "eta_rate": w2y - w1y,
        "w_G2x": w1x * secant - w2z * tangent,
    }


def momentum_coupling(eta: float, *, w1x: float, w1y: float, w2y: float, w2z: float) -> dict[str, float]:
    """Coupled drift from the geometry of two momenta, by central difference [rad/s]; own derivation."""
    half = 600.0
    h1, h2 = np.array([0.0, 0.0, 1.0]), np.array([math.cos(eta), 0.0, -math.sin(eta)])
    z_G2 = np.array([math.sin(eta), 0.0, math.cos(eta)])
    first, second = np.array([w1x, w1y, 0.0]), np.array([0.0, w2y, 0.0]) + w2z * z_G2
    ends = []
    for time in (-half, half):
        p1 = rotation_vector_to_matrix(first * time) @ h1
        p2 = rotation_vector_to_matrix(second * time) @ h2
        ends.append(_triad(p1, p2))
    (before, eta_before), (after, eta_after) = ends
    rate = matrix_to_rotation_vector(after @ before.T) / (2.0 * half)
    return dict(zip(("w_Gx", "w_Gy", "w_Gz"), rate.tolist(), strict=True)) | {
        "eta_rate": (eta_after - eta_before) / (2.0 * half),
        "w_G2x": float(rate @ h2),
    }


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


@dataclass(frozen=True)
class Published:
    """One channel on day ten with model A: simulated and theoretical amplitude as printed, in units of ``scale`` (SI)."""

    channel: str
    scale: float
    simulated: float
    theory: float


CHANNELS = (
    Published("east_velocity", 1.0, 0.03, 0.03),
    Published("heading", ARCMIN, 0.13, 0.11),
    Published("roll", ARCMIN, 0.16, 0.13),
)


def scenario(*, wobble: bool) -> PlatformScenario:
    """L = 40 deg, m1 = m2 = 4', period 8 min, eta' = 0.01 deg/h; ten days.

    Case angles have no phases, as in the publication's sines and cosines. The size of the wobble is our choice: it
    is not published.
    """
    models: tuple[Model, ...] = ("A", "B", "C") if wobble else ("A", "B")
    return PlatformScenario(
        Place(LATITUDE, math.radians(116.0)),
        duration=_DAYS * DAY,
        step=STEP,
        polar_rotation=Rotation(CASE_RATE),
        equatorial_rotation=Rotation(CASE_RATE),
        polar=_gyro(20.0, (60.0, 130.0), wobble=wobble),
        equatorial=msgspec.structs.replace(_gyro(75.0, (100.0, 10.0), wobble=wobble), drift=(_DRIFT, 0.0)),
        compensation=Compensation(models=models),
    )


def _gyro(phase: float, waves: tuple[float, float], *, wobble: bool) -> Gyro:
    if not wobble:
        return Gyro(4.0 * ARCMIN)
    sizes = (0.25 * ARCMIN, 0.05 * ARCMIN)
    harmonics = tuple(
        Harmonic(k + 2, size, math.radians(angle))
        for k, (size, angle) in enumerate(zip(sizes, waves, strict=True))
    )
    return Gyro(4.0 * ARCMIN, math.radians(phase), harmonics)


@cache
def compared(*, wobble: bool) -> ModelComparisonRun:
    """The run with every model."""
    return compare(scenario(wobble=wobble))


def last_lines(comparison: ModelComparisonRun, model: Model) -> dict[str, float]:
    """Amplitude at the case-rotation period over the last two hours, by channel (SI)."""
    errors = comparison.models[model].errors
    named = channels(errors)
    late = errors.times > errors.times[-1] - _LATE
    table = np.stack([named[c.channel][late] for c in CHANNELS], axis=1)
    amplitude = fitted_lines(errors.times[late], table, (CASE_RATE,), LATITUDE)[0]
    return {c.channel: float(v) for c, v in zip(CHANNELS, amplitude, strict=True)}


def formula(channel: str) -> float:
    """The published formula at the end of day ten (SI): g d cos(L)/w_c, d sin(L), d cos(L), d = m1 tan(eta)."""
    turn = 4.0 * ARCMIN * math.tan(_DRIFT * _DAYS * DAY)
    return {
        "east_velocity": GRAVITY_OF_TABLE * turn * math.cos(LATITUDE) / CASE_RATE,
        "heading": turn * math.sin(LATITUDE),
        "roll": turn * math.cos(LATITUDE),
    }[channel]


def ten_days() -> Chapter:
    """Models A and B over ten days."""
    comparison = compared(wobble=False)
    lines = {m: last_lines(comparison, m) for m in comparison.models}
    values: dict[str, float | Value] = {}
    for c in CHANNELS:
        name = c.channel.replace("_", "-")
        theory, followed = (lines[model][c.channel] / c.scale for model in ("A", "B"))
        values |= dict.fromkeys((f"{name}-theory", f"{name}-formula", f"{name}-A"), theory)
        values[f"{name}-B"] = followed
    first = [float(comparison.models[m].lines.amplitude["east_velocity"][0]) for m in ("A", "B")]
    values["first-day"] = first[0] - first[1]
    title = "Errors around the end of day ten, models A and B"
    end = replace(published_figure(comparison), key="ten-days-end", title=title)
    figures = (_with_published(lines_figure(comparison)), end)
    return chapter_of("ten-days", values, figures)


def wobble() -> Chapter:
    """Wobbling rotation axes: model B removes only a part of the error of model A; model C removes the wobble, too."""
    comparison = compared(wobble=True)
    amplitude = {m: float(r.lines.amplitude["east_velocity"][-1]) for m, r in comparison.models.items()}
    values = {f"removed-{m}": 100.0 * (1.0 - amplitude[m] / amplitude["A"]) for m in ("B", "C")}
    title = "Errors around the end of day ten with wobble"
    figures = (
        replace(lines_figure(comparison), key="wobble-lines"),
        replace(published_figure(comparison), key="wobble-end", title=title),
    )
    return chapter_of("wobble", values | {"left-B": amplitude["B"]}, figures)


def _with_published(figure: Figure) -> Figure:
    """The lines per day on linear axes, with the published amplitudes of day ten."""
    panels = [replace(panel, y=replace(panel.y, log=False)) for panel in figure.panels]
    for k, channel in enumerate(CHANNELS):
        added = (
            Series([_DAYS], [channel.simulated], "published simulation, model A", "points", "warning"),
            Series([_DAYS], [channel.theory], "published theory, model A", "points", "model"),
        )
        panels[k] = replace(panels[k], series=(*panels[k].series, *added))
    caption = (
        "Amplitude fitted over each day, so that a day's point stands for its middle; the published amplitudes belong to the end "
        "of day ten. Model A grows with the redundancy angle as the theory says; model B follows it."
    )
    return replace(figure, key="ten-days-lines", panels=tuple(panels), caption=caption)


# -- gyro accelerometers on the platform ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False, repr=False)
class CapstoneOutcome(Result):
    """Errors of one way to mount and read the instruments, and how they are drawn.

    Locked time [s/day] of each instrument; noise against that of three axes at right angles.
    """

    sentence: str
    role: Role
    dashed: bool
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


_READINGS: dict[str, tuple[dict[str, Any] | None, str, Role, bool]] = {
    "ideal": (None, "ideal accelerometers: the platform and the navigator alone", "reference", True),
    "raw tripod": ({"cone": TRIPOD, "output": "raw"}, "three axes at right angles, output taken as alpha'/K", "before", False),
    "raw skewed": ({"output": "raw"}, "axes within {:.0f} deg of the pole: never locked, still pulled", "warning", False),
    "triad": ({"cone": TRIPOD}, "right angles, effective axes solved per sample", "after", False),
    "triad skewed": ({}, "skewed and solved per sample", "model", True),
    "triad, calibrated": ({"cone": TRIPOD}, "solved with tan(beta) and phase off by a calibration's error", "z", True),
}  # fmt: skip
"""Readings compared, from the ideal instrument to the locked one, and back: what they change, a sentence, how they are drawn."""


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
    ideal = simulate(replace(scenario, sensors=msgspec.structs.replace(scenario.sensors, piga=None)))
    steps("identifying and aligning")
    preparation = prepare(ideal)
    outcomes = {}
    for name, (changes, sentence, role, dashed) in _READINGS.items():
        steps(f"navigating, {name}")
        run, axes, inside = ideal, np.eye(3), np.zeros(3)
        if changes is not None:
            wrong = off if name.endswith("calibrated") else dict.fromkeys(off, 0.0)
            given = {"mounting": "skewed", "output": "triad"} | wrong | changes
            used = msgspec.structs.replace(sensors, **given)
            read = replace(scenario, sensors=msgspec.structs.replace(scenario.sensors, piga=used))
            run = simulate(read, motion=ideal.truth.motion)
            axes, inside = mounting_axes(used)[:, 0, :], locked(used, run.truth.force).mean(axis=0) * DAY
        gain = float(np.sqrt(np.trace(np.linalg.inv(axes.T @ axes)) / 3.0))
        words = sentence.format(np.degrees(sensors.cone))
        left = _navigated(run, preparation)
        outcomes[name] = CapstoneOutcome(words, role, dashed, left, inside, gain)
    steps.finish()
    return Capstone(scenario, outcomes)


def _navigated(run: PlatformRun, preparation: Preparation) -> Errors:
    """Navigation errors of a run with model B."""
    s, readouts = run.scenario, run.readouts
    made = compensator("B", preparation.knowledge, readouts, redundancy=s.compensation.redundancy)
    every = max(1, round(10.0 / s.step))
    navigation = navigate(readouts, made, preparation.start, damping_time=s.damping_time, every=every)
    return errors(navigation, run.truth, readouts)


def capstone_figure(capstone: Capstone) -> Figure:
    """Horizontal position error over the run for every reading."""
    axis, unit = time_axis(float(capstone.scenario.duration))
    title = "Ten days with three gyro accelerometers"
    plot = Plot("fig-capstone", title, axis, "log horizontal position error [m]", height=3.6)
    for name, o in capstone.outcomes.items():
        peak = np.maximum(schuler_peak(o.errors.times, o.errors.horizontal), 1e-4)
        plot.line(o.errors.times / unit, peak, name, o.role, dashed=o.dashed)
    return plot.caption("Largest error within each 84 minutes.")


def capstone_page(capstone: Capstone) -> Page:
    """Page on the effect of the locked zone on the platform, and its compensation."""
    o = capstone.outcomes
    position = {name: short(one.position) for name, one in o.items()}
    tiles = (
        Tile(
            "raw output", position["raw tripod"], "m", "largest horizontal error, axes at right angles", "bad"
        ),
        Tile("skewed mounting", position["raw skewed"], "m", "raw output, axes near the pole", "doubtful"),
        Tile("triad solved", position["triad"], "m", "effective axes, per sample", "good"),
    )
    story = (
        "The platform stands still in inertial space and the Earth turns under it. Each input axis crosses the "
        "horizontal twice a sidereal day and is inside its locked zone for "
        f"{short(float(o['raw tripod'].locked_per_day.max()))} s a day: too short to lock, but about it the gimbal turns so "
        "slowly that its cross-coupling does not average out.\n\n"
        "Mounted within the latitude of the pole the axes never come to the horizontal, with "
        f"{short(o['raw skewed'].noise_gain)} times the noise. Solved together with their effective axes the three "
        f"instruments give the force back in any mounting, against {position['ideal']} m with ideal ones."
    )
    blocks = (story, capstone_figure(capstone), _capstone_table(capstone))
    sections = (Section("What happens", "story", blocks),)
    return page("Gyro accelerometers on the space-stable platform", capstone.scenario, tiles, sections)


def _capstone_table(capstone: Capstone) -> Table:
    return (
        TableOf(capstone.outcomes.items())
        .text("reading", lambda row: row[0])
        .number("position error", lambda row: short(row[1].position), "m")
        .number("velocity error", lambda row: short(1e3 * row[1].velocity), "mm/s")
        .number("locked", lambda row: short(float(row[1].locked_per_day.max())), "s/day")
        .number("noise gain", lambda row: short(row[1].noise_gain))
        .text("what it is", lambda row: row[1].sentence)
        .table(notes=("Locked: longest of the three. Noise gain: against three axes at right angles.",))
    )
