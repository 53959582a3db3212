"""Simulate a scenario. The results are the readouts, which an engineer sees, and the truth, which is kept apart.

The base is at rest, turns, sways or follows a track. The platform may carry three gyro accelerometers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from piga import earth
from piga._kernels.platform import drift_series
from piga.compensation import Mounted, SetCompensator
from piga.errors import ArgumentError, DataError
from piga.frames import axis_turn, rotation_vector_to_matrix
from piga.instrument import Instrument, propagate
from piga.platform import geometry
from piga.platform.scenario import MotionPlan, PigaSensors, PlatformScenario
from piga.records import Calibration
from piga.results import Array, Plotted, Result
from piga.stand.profile import read_columns
from piga.tables import Column, arrow_table
from piga.units import G0
from piga.upper import doors

if TYPE_CHECKING:
    import pyarrow as pa

    from piga.reports.render.figure import Figure

_TRACK_COLUMNS = (
    "time_s", "latitude_deg", "longitude_deg", "height_m", "roll_deg", "pitch_deg", "heading_deg",
)  # fmt: skip
"""Columns of the file of a track."""
_BLOCK = 4096
"""Steps simulated at once. Their matrices then stay in the cache."""


@dataclass(frozen=True, eq=False, repr=False)
class BaseMotion(Result):
    """True motion of the base on the run's time grid. Arrays of constant quantities have one row.

    ``force`` (2n + 1, 3) or (1, 3): specific force in Earth axes at every half step [m/s^2];
    ``attitude`` (n + 1, 3) or (1, 3): roll, pitch, heading [rad]; ``place`` (.., 3): latitude,
    longitude [rad], height [m]; ``velocity`` (.., 3): north, east, down [m/s].
    """

    force: Array
    attitude: Array
    place: Array
    velocity: Array

    def part(self, nodes: slice) -> BaseMotion:
        """The motion from one node to another."""
        halves = slice(2 * nodes.start, 2 * nodes.stop - 1)
        rows = {"force": halves, "attitude": nodes, "place": nodes, "velocity": nodes}
        whole = {name: getattr(self, name) for name in rows}
        return BaseMotion(**{name: v[rows[name]] if len(v) > 1 else v for name, v in whole.items()})

    @property
    def to_earth(self) -> Array:
        """``C_b^e`` (n + 1, 3, 3) or (1, 3, 3)."""
        roll, pitch, heading = self.attitude.T
        to_body = axis_turn(0, roll) @ axis_turn(1, pitch) @ axis_turn(2, heading)
        return geometry.local_axes(*self.place[:, :2].T) @ np.swapaxes(to_body, 1, 2)

    @property
    def at_rest(self) -> bool:
        """True if neither place nor attitude changes."""
        return len(self.attitude) == 1 and len(self.place) == 1


def base_motion(scenario: PlatformScenario) -> BaseMotion:
    """Motion of the base for the scenario's time grid.

    Raises
    ------
    DataError
        If the track file cannot be read, lacks a column or is shorter than the run.
    """
    plan, at = scenario.motion, scenario.place
    half = 0.5 * scenario.step * np.arange(2 * scenario.steps + 1, dtype=np.float64)
    times = half[::2]
    if plan.kind == "track":
        return _track(plan, half)
    place, velocity = np.array([[at.latitude, at.longitude, at.height]]), np.zeros((1, 3))
    attitude, position = np.array([[plan.roll, plan.pitch, plan.heading]]), geometry.geodetic_to_earth(*place.T)
    force = geometry.specific_force_at_rest(position)
    if plan.kind == "turn":
        attitude = geometry.wrapped(attitude + np.outer(plan.turn_rate * times, [0.0, 0.0, 1.0]))
    if plan.kind == "sway":
        tilt, period = np.array([plan.roll_sway, plan.pitch_sway, plan.heading_sway]).T
        attitude = attitude + tilt * np.sin(2.0 * np.pi / period * times[:, None])
        amplitude, period = np.array([plan.north_sway, plan.east_sway, plan.down_sway]).T
        rate, axes = 2.0 * np.pi / period, geometry.local_axes(at.latitude, at.longitude)
        sine = amplitude * np.sin(rate * half[:, None])
        moving = (amplitude * rate * np.cos(rate * half[:, None])) @ axes.T
        place, force, velocity = _felt(position + sine @ axes.T, moving, (-(rate**2) * sine) @ axes.T)
    return BaseMotion(force, attitude, place, velocity)


def _felt(position: Array, velocity: Array, acceleration: Array) -> tuple[Array, Array, Array]:
    """Place and velocity at the nodes, specific force at the half steps, from Earth-axes motion (2n + 1, 3)."""
    spin = np.array([0.0, 0.0, earth.EARTH_RATE])
    coriolis = 2.0 * np.cross(spin, velocity) + np.cross(spin, np.cross(spin, position))
    lat, lon, height = geometry.earth_to_geodetic(position[::2])
    level = np.einsum("kji,kj->ki", geometry.local_axes(lat, lon), velocity[::2])
    return np.stack([lat, lon, height], axis=1), acceleration + coriolis - geometry.gravitation(position), level


def _track(plan: MotionPlan, half: Array) -> BaseMotion:
    """Motion along a track at the half steps [s] of a run."""
    from scipy.interpolate import CubicSpline

    assert plan.file is not None  # noqa: S101 - the reader of the scenario saw to it
    time, place, angles = _read_track(Path(plan.file))
    if time[0] > 0.0 or time[-1] < half[-1]:
        raise DataError(
            f"{plan.file}: the track covers {time[0]:g} s to {time[-1]:g} s, the run needs 0 to {half[-1]:g} s",
            remedy="shorten [run] duration or lengthen the track",
        )
    path = CubicSpline(time, geometry.geodetic_to_earth(*place.T))
    place, force, velocity = _felt(path(half), path(half, 1), path(half, 2))
    return BaseMotion(force, np.ascontiguousarray(CubicSpline(time, angles)(half[::2])), place, velocity)


def _read_track(path: Path) -> tuple[Array, Array, Array]:
    """Time (n,) [s], latitude, longitude [rad] and height [m] (n, 3), roll, pitch and heading (n, 3) [rad]."""
    try:
        rows, columns = read_columns(path, _TRACK_COLUMNS)
    except DataError as error:
        remedy = f"give these columns, a number in each row: {', '.join(_TRACK_COLUMNS)}"
        raise DataError(f"[motion] file {error.message}", remedy=remedy, where=error.where) from None
    time, *place, roll, pitch, heading = columns.values()
    if time.size < 4:
        raise DataError(f"[motion] file {path}: {time.size} rows", remedy="give a header and 4 rows or more")
    for row in rows[1:][np.diff(time) <= 0.0]:
        raise DataError(
            f"[motion] file {path}: row {row}: the time does not increase",
            remedy="sort the rows by time, and leave out repeated times",
        )
    angles = np.unwrap(np.radians([*place[:2], roll, pitch, heading]))
    return time, np.stack([*angles[:2], place[2]], axis=1), angles[2:].T


TRIPOD = float(np.arccos(1.0 / np.sqrt(3.0)))
"""Cone angle [rad] at which three skewed input axes are at right angles: 54.74 deg."""


def mounting_axes(sensors: PigaSensors) -> Array:
    """Axes (3, 3, 3) of the instruments in the platform frame: rows X0, Y0, Z0 of each.

    ``orthogonal``: input axes along the platform's x, y, z. ``skewed``: input axes evenly round the
    platform's polar axis at the cone angle to it. A force at the angle ``90 deg - latitude`` to the
    polar axis never lies across an input axis whose cone angle is below the latitude.
    """
    if sensors.mounting == "orthogonal":
        return np.stack([np.roll(np.eye(3), -k, axis=0) for k in range(3)])
    around, s, c = np.arange(3) * (2.0 * np.pi / 3.0), np.sin(sensors.cone), np.cos(sensors.cone)
    x = np.stack([s * np.cos(around), s * np.sin(around), np.full(3, c)], axis=1)
    y = np.stack([-np.sin(around), np.cos(around), np.zeros(3)], axis=1)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def gimbal_angles(sensors: PigaSensors, times: Array, force: Array, spin: Array) -> Array:
    """Outer-gimbal angles (3, n + 1) [rad] of the three instruments.

    ``force`` (n + 1, 3) specific force at ``times`` in platform axes [m/s^2]; ``spin`` (n, 3) turn of
    the platform over each step [rad].
    """
    step = times[1] - times[0]
    inner = np.concatenate([spin[:1], 0.5 * (spin[1:] + spin[:-1]), spin[-1:]]) / step
    angles = []
    for axes, alpha0 in zip(mounting_axes(sensors), sensors.alpha0, strict=True):
        instrument = Instrument(sensors.scale_factor, sensors.beta, alpha0)
        angles.append(propagate(instrument, times, force @ axes.T, inner @ axes.T, between="linear"))
    increments = np.stack(angles)
    if sensors.counts_per_revolution > 0.0:
        quantum = 2.0 * np.pi / sensors.counts_per_revolution
        increments = np.round(increments / quantum) * quantum
    return increments


def read_increments(sensors: PigaSensors, times: Array, alpha: Array) -> Array:
    """Velocity increments (n, 3) [m/s] in platform axes from gimbal angles (3, n + 1).

    ``raw``: ``d alpha / K`` along the input axes. ``triad``: the compensation of a set of instruments with the
    calibration ``tan_beta + tan_beta_error``, phase off by ``phase_error`` (:class:`piga.compensation.SetCompensator`).

    Raises
    ------
    ArgumentError
        If a gimbal turns by more than a third of a turn in one step (the angle between samples would be
        ambiguous).
    """
    axes, turned = mounting_axes(sensors), np.diff(alpha, axis=1)
    if sensors.output == "raw":
        return np.ascontiguousarray(np.linalg.solve(axes[:, 0, :], turned / sensors.scale_factor).T)
    fastest = float(np.abs(turned).max())
    if fastest > 2.0 * np.pi / 3.0:
        raise ArgumentError(
            f"the gyro accelerometers turn up to {fastest:.2f} rad in a step; at most a third of a "
            "turn can be solved",
            remedy=f"shorten [run] step below {(times[1] - times[0]) * 2.0 / fastest:.2g} s",
        )
    known = {
        "scale_factor": sensors.scale_factor * G0,
        "tan_beta": sensors.tan_beta + sensors.tan_beta_error,
        "phi": sensors.phase_error,
    }
    calibration = Calibration.from_coefficients(known)
    compensator = SetCompensator([Mounted(calibration, one) for one in axes], uncertainty=False)
    return compensator.push(times, alpha).dv[1:]


def locked(sensors: PigaSensors, force: Array) -> NDArray[np.bool_]:
    """Whether each instrument is inside its locked zone ``|a_x| < a_t tan(beta)``: (n, 3)."""
    along = force @ mounting_axes(sensors)[:, 0, :].T
    across = np.sqrt(np.maximum(np.sum(force**2, axis=1)[:, None] - along**2, 0.0))
    return np.abs(along) < across * abs(sensors.tan_beta)


@dataclass(frozen=True, eq=False, repr=False)
class Readouts(Result):
    """Readouts of the platform. Alignment, identification and navigation use nothing else.

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

    def first(self, duration: float) -> Readouts:
        """The readouts of the first ``duration`` seconds (the whole run when it is shorter)."""
        return self.between(0, max(2, min(len(self.increments), round(duration / self.step))))

    def between(self, first: int, last: int, every: int = 1) -> Readouts:
        """The readouts from node ``first`` to node ``last``, a whole number of times ``every`` nodes further on."""
        cut = ["times", "gimbals", "pickoff", "encoder1", "encoder2", *["altitude"] * (len(self.altitude) > 1)]
        nodes = {name: getattr(self, name)[first : last + 1 : every] for name in cut}
        increments = self.increments[first:last].reshape(-1, every, 3).sum(axis=1)
        return replace(self, increments=increments, **nodes)


@dataclass(frozen=True, eq=False, repr=False)
class Truth(Result):
    """Truth of a run: base motion, redundancy angle (n + 1,) [rad], triad ``C_i^G`` at start and end.

    ``force`` (n + 1, 3): specific force in platform axes at the nodes [m/s^2].
    """

    motion: BaseMotion
    force: Array
    eta: Array
    triad_start: Array
    triad_end: Array


@dataclass(frozen=True, eq=False, repr=False)
class PlatformRun(Result, Plotted):
    """A simulated run: scenario, readouts and truth.

    The plot shows the readouts against time.
    """

    scenario: PlatformScenario
    readouts: Readouts
    truth: Truth

    def figure(self) -> Figure:
        """What is read on the platform."""
        return doors().platform_figures().readouts_figure(self)

    def in_brief(self) -> list[tuple[str, str]]:
        """Place, time and motion."""
        s = self.scenario
        return [
            ("place", f"latitude {np.degrees(s.place.latitude):.6g} deg, height {s.place.height:g} m"),
            ("duration", f"{s.duration / 3600.0:.6g} h, step {s.step:g} s"),
            ("motion", s.motion.kind),
        ]


def simulate(scenario: PlatformScenario, *, motion: BaseMotion | None = None) -> PlatformRun:
    """Simulate the platform of ``scenario``: exact geometry, drift, base motion, readout errors.

    ``motion`` may be given, to share it between runs. The noise of each channel depends only on ``scenario.seed``.

    Raises
    ------
    DataError
        If the track of a moving base cannot be used.
    """
    motion = base_motion(scenario) if motion is None else motion
    s, sensors, n, h = scenario, scenario.sensors, scenario.steps, scenario.step
    times, start = h * np.arange(n + 1, dtype=np.float64), rotation_vector_to_matrix(np.array(s.triad)).T
    increments, force, spin = np.empty((n, 3)), np.empty((n + 1, 3)), np.empty((n if sensors.pigas else 0, 3))
    gimbals, ring, eta = np.empty((n + 1, 3)), np.empty(n + 1), np.full(n + 1, s.redundancy)
    end = start
    for first in range(0, n, _BLOCK):
        part, nodes = slice(first, first + _BLOCK), slice(first, first + _BLOCK + 1)
        half = 0.5 * h * np.arange(2 * first, 2 * min(first + _BLOCK, n) + 1, dtype=np.float64)
        triad, angle = _drifted(s, half, end, eta[first])
        attitude, rings = geometry.nulled_attitude(s.polar, s.equatorial, *_case_angles(s, half), angle)
        attitude, turned = attitude @ triad, geometry.earth_to_inertial(half)
        base = motion.part(nodes)
        felt = np.squeeze(attitude @ (turned @ base.force[:, :, None]), axis=2)
        increments[part], force[nodes] = h * geometry.step_means(felt), felt[::2]
        gimbals[nodes] = geometry.gimbals_of(attitude[::2] @ turned[::2] @ base.to_earth)
        ring[nodes], eta[nodes], end = rings[::2], angle[::2], triad[-1].copy()
        if sensors.pigas:
            spin[part] = geometry.turns_between(attitude[::2])
    if sensors.pigas is not None:
        increments = read_increments(sensors.pigas, times, gimbal_angles(sensors.pigas, times, force, spin))
    streams = [np.random.default_rng(child) for child in np.random.SeedSequence(s.seed).spawn(4)]
    walk = sensors.velocity_random_walk * np.sqrt(h)
    increments = _noisy(increments, walk, 0.0, streams[0]) + h * np.array(sensors.accelerometer_bias)
    if (pulse := sensors.increment_quantisation) > 0.0:  # the running sum is rounded, so no velocity is lost
        increments = np.diff(np.round(np.cumsum(increments, axis=0) / pulse) * pulse, axis=0, prepend=0.0)
    readouts = Readouts(
        times=times,
        increments=increments,
        gimbals=_noisy(gimbals, sensors.gimbal_noise, sensors.gimbal_quantisation, streams[1]),
        pickoff=_noisy(ring, sensors.pickoff_noise, sensors.pickoff_quantisation, streams[2]),
        encoder1=geometry.encoder_angle(s.polar_rotation, s.reversal, times),
        encoder2=geometry.encoder_angle(s.equatorial_rotation, s.reversal, times),
        altitude=_noisy(motion.place[:, 2], sensors.altitude_noise, 0.0, streams[3], len(times)),
        turn_sensitivity=1.0 / sensors.piga.scale_factor if sensors.pigas else 0.0,
    )
    return PlatformRun(s, readouts, Truth(motion, force, eta, start, end))


def _case_angles(s: PlatformScenario, times: Array) -> tuple[Array, Array]:
    """Case angles [rad] of the polar and the equatorial gyro, phases included."""
    first = geometry.encoder_angle(s.polar_rotation, s.reversal, times) + s.polar.phase
    return first, geometry.encoder_angle(s.equatorial_rotation, s.reversal, times) + s.equatorial.phase


def _drifted(s: PlatformScenario, half: Array, triad: Array, eta: float) -> tuple[Array, Array]:
    """``C_i^G`` (n, 3, 3) and the redundancy angle (n,) [rad] at ``half`` steps, from those at the first of them."""
    triads, etas = np.empty((len(half), 3, 3)), np.empty(len(half))
    triads[0], etas[0] = triad, eta
    first, second = (np.stack([np.sin(c), np.cos(c)], axis=1) for c in _case_angles(s, half))
    rates = np.array([*s.polar.drift, *s.equatorial.drift, *s.polar.case_drift, *s.equatorial.case_drift])
    drift_series(first, second, rates, 0.5 * s.step, triads, etas)
    return triads, etas


def _noisy(
    values: Array, sigma: float, quantum: float, stream: np.random.Generator, rows: int | None = None
) -> Array:
    """Values with white noise, then rounded to the quantum; zero leaves them as they are. ``rows`` of a single value."""
    if sigma > 0.0:
        values = values + sigma * stream.standard_normal(rows or values.shape)
    return np.round(values / quantum) * quantum if quantum > 0.0 else values


def number_table(*columns: tuple[str, str, Array]) -> pa.Table:
    """A table of numbers: names of the columns, their unit (kept in the metadata), values (n,), (n, k) or a single row."""
    rows = len(columns[0][2])
    table: dict[str, Column] = {}
    for names, unit, values in columns:
        wide = np.broadcast_to(values.reshape(len(values), -1), (rows, len(names.split())))
        table |= {name: Column(column, unit) for name, column in zip(names.split(), wide.T, strict=True)}
    return arrow_table(table)


def readouts_table(r: Readouts) -> pa.Table:
    """Readouts as a table. The increment of a row is that since the previous row; the first row has none."""
    return number_table(
        ("t", "s", r.times),
        ("dvx dvy dvz", "m/s", np.concatenate([np.full((1, 3), np.nan), r.increments])),
        ("gimbal_outer gimbal_middle gimbal_inner", "rad", r.gimbals),
        ("pickoff", "rad", r.pickoff),
        ("case_polar", "rad", r.encoder1),
        ("case_equatorial", "rad", r.encoder2),
        ("height", "m", r.altitude),
    )


def truth_table(run: PlatformRun) -> pa.Table:
    """True specific force in platform axes, redundancy angle, place, velocity and attitude."""
    motion = run.truth.motion
    return number_table(
        ("t", "s", run.readouts.times),
        ("eta", "rad", run.truth.eta),
        ("fx fy fz", "m/s^2", run.truth.force),
        ("latitude longitude", "rad", motion.place[:, :2]),
        ("height", "m", motion.place[:, 2]),
        ("v_north v_east v_down", "m/s", motion.velocity),
        ("roll pitch heading", "rad", motion.attitude),
    )
