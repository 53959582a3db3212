"""Motion of the base: at rest, turning, swaying, or on a track; what the platform feels of it."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from piga import earth
from piga.errors import DataError
from piga.platform.model.geodesy import (
    earth_to_geodetic,
    geodetic_to_earth,
    gravitation,
    local_axes,
    specific_force_at_rest,
)
from piga.platform.model.scenario import MotionPlan, Oscillation, Place, Scenario
from piga.records.limits import read_whole

Array = NDArray[np.float64]

MAX_TRACK = 256 << 20
"""Largest file of a track [bytes]: some three million rows."""
_TRACK_COLUMNS = {
    "time": ("time_s", "t_s"),
    "latitude": ("latitude_deg", "lat_deg"),
    "longitude": ("longitude_deg", "lon_deg"),
    "height": ("height_m", "h_m"),
    "roll": ("roll_deg",),
    "pitch": ("pitch_deg",),
    "heading": ("heading_deg",),
}


@dataclass(frozen=True)
class BaseMotion:
    """True motion of the base on the run's time grid; arrays have one row when nothing changes.

    ``force`` (2n + 1, 3) or (1, 3): specific force in Earth axes at every half step [m/s^2];
    ``attitude`` (n + 1, 3) or (1, 3): roll, pitch, heading [rad]; ``place`` (.., 3): latitude,
    longitude [rad], height [m]; ``velocity`` (.., 3): north, east, down [m/s].
    """

    force: Array
    attitude: Array
    place: Array
    velocity: Array

    @property
    def at_rest(self) -> bool:
        """Whether neither place nor attitude changes."""
        return len(self.attitude) == 1 and len(self.place) == 1

    def start_inertial(self) -> tuple[Array, Array]:
        """Position [m] and velocity [m/s] in inertial axes at time zero."""
        lat, lon, height = self.place[0]
        position = geodetic_to_earth(lat, lon, height)
        spin = np.array([0.0, 0.0, earth.EARTH_RATE])
        return position, local_axes(lat, lon) @ self.velocity[0] + np.cross(spin, position)


def base_motion(scenario: Scenario) -> BaseMotion:
    """Motion of the base for the scenario's time grid.

    Raises
    ------
    DataError
        If the track file cannot be read, lacks a column or is shorter than the run.
    """
    plan, times = scenario.motion, scenario.step * np.arange(scenario.steps + 1, dtype=np.float64)
    if plan.kind == "track":
        return _track(plan, scenario)
    place, force, velocity = (
        _around(scenario.place, plan.sway[3:], scenario) if plan.kind == "sway" else _rest(scenario)
    )
    return BaseMotion(force, _attitude(plan, times), place, velocity)


def _rest(scenario: Scenario) -> tuple[Array, Array, Array]:
    at = scenario.place
    position = geodetic_to_earth(at.latitude, at.longitude, at.height)
    place = np.array([[at.latitude, at.longitude, at.height]])
    return place, specific_force_at_rest(position)[None, :], np.zeros((1, 3))


def _attitude(plan: MotionPlan, times: Array) -> Array:
    start = np.array([[plan.roll, plan.pitch, plan.heading]])
    if plan.kind == "turn":
        heading = np.arctan2(
            np.sin(plan.heading + plan.turn_rate * times), np.cos(plan.heading + plan.turn_rate * times)
        )
        return np.stack([np.full_like(times, plan.roll), np.full_like(times, plan.pitch), heading], axis=1)
    if plan.kind == "sway":
        return start + np.stack(
            [o.amplitude * np.sin(2.0 * np.pi / o.period * times) for o in plan.sway[:3]], axis=1
        )
    return start


def _around(at: Place, sway: tuple[Oscillation, ...], scenario: Scenario) -> tuple[Array, Array, Array]:
    """Place, force and velocity of a point that swings about a fixed one along north, east, down."""
    half = np.arange(2 * scenario.steps + 1) * (0.5 * scenario.step)
    rate = np.array([2.0 * np.pi / o.period for o in sway])
    amplitude = np.array([o.amplitude for o in sway])
    axes = local_axes(at.latitude, at.longitude)
    sine = amplitude * np.sin(rate * half[:, None])
    position = geodetic_to_earth(at.latitude, at.longitude, at.height) + sine @ axes.T
    velocity = (amplitude * rate * np.cos(rate * half[:, None])) @ axes.T
    return _felt(position, velocity, (-(rate**2) * sine) @ axes.T)


def _felt(position: Array, velocity: Array, acceleration: Array) -> tuple[Array, Array, Array]:
    """Place and velocity at the nodes, specific force at the half steps, from Earth-axes motion (2n + 1, 3)."""
    spin = np.array([0.0, 0.0, earth.EARTH_RATE])
    coriolis = 2.0 * np.cross(spin, velocity) + np.cross(spin, np.cross(spin, position))
    lat, lon, height = earth_to_geodetic(position[::2])
    level = np.einsum("kji,kj->ki", local_axes(lat, lon), velocity[::2])
    return np.stack([lat, lon, height], axis=1), acceleration + coriolis - gravitation(position), level


def _track(plan: MotionPlan, scenario: Scenario) -> BaseMotion:
    from scipy.interpolate import CubicSpline

    assert plan.file is not None  # noqa: S101 - the reader of the scenario saw to it
    table = _read_track(plan.file)
    half = np.arange(2 * scenario.steps + 1) * (0.5 * scenario.step)
    if table["time"][0] > 0.0 or table["time"][-1] < half[-1]:
        raise DataError(
            f"{plan.file}: the track covers {table['time'][0]:g} s to {table['time'][-1]:g} s, the "
            f"run needs 0 to {half[-1]:g} s",
            remedy="shorten [run] duration or lengthen the track",
        )
    earth_fixed = geodetic_to_earth(table["latitude"], np.unwrap(table["longitude"]), table["height"])
    path = CubicSpline(table["time"], earth_fixed)
    place, force, velocity = _felt(path(half), path(half, 1), path(half, 2))
    angles = np.stack([np.unwrap(table[k]) for k in ("roll", "pitch", "heading")], axis=1)
    return BaseMotion(
        force, np.ascontiguousarray(CubicSpline(table["time"], angles)(half[::2])), place, velocity
    )


def _read_track(path: Path) -> dict[str, Array]:
    try:
        text = read_whole(path, MAX_TRACK, "the file of the track").decode("utf-8-sig")
        rows = [row for row in csv.reader(text.splitlines()) if row]
    except (DataError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"[motion] file {path}: cannot be read ({error})", remedy="check the path") from None
    if len(rows) < 5:
        raise DataError(f"[motion] file {path}: a header and at least 4 rows are needed")
    header = [name.strip() for name in rows[0]]
    table = {}
    for key, names in _TRACK_COLUMNS.items():
        column = next((header.index(name) for name in names if name in header), None)
        if column is None:
            raise DataError(
                f"[motion] file {path}: column '{names[0]}' is missing", remedy=f"columns: {_columns()}"
            )
        table[key] = np.array([_number(path, line, row, column) for line, row in enumerate(rows[1:], start=2)])
        if key not in {"time", "height"}:
            table[key] = np.radians(table[key])
    if not np.all(np.diff(table["time"]) > 0.0):
        raise DataError(f"[motion] file {path}: the time does not increase at every row")
    return table


def _columns() -> str:
    return ", ".join(names[0] for names in _TRACK_COLUMNS.values())


def _number(path: Path, line: int, row: list[str], column: int) -> float:
    try:
        value = float(row[column])
    except (ValueError, IndexError):
        value = float("nan")
    if not np.isfinite(value):
        text = row[column] if column < len(row) else "nothing"
        raise DataError(f"[motion] file {path}: line {line}, column {column + 1}: '{text}' is not a number")
    return value
