"""Three gyro accelerometers on the platform: what they turn, and the velocity increments read from them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from piga._kernels.platform.triad import solve_triad
from piga.errors import ArgumentError
from piga.instrument import Instrument, propagate
from piga.platform.model.scenario import PigaSensors

Array = NDArray[np.float64]

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
    around = np.arange(3) * (2.0 * np.pi / 3.0)
    s, c = np.sin(sensors.cone), np.cos(sensors.cone)
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
        instrument = Instrument(sensors.scale_factor, float(np.arctan(sensors.tan_beta)), alpha0)
        angles.append(propagate(instrument, times, force @ axes.T, inner @ axes.T))
    found = np.stack(angles)
    if sensors.counts_per_revolution > 0.0:
        quantum = 2.0 * np.pi / sensors.counts_per_revolution
        found = np.round(found / quantum) * quantum
    return found


def read_increments(sensors: PigaSensors, times: Array, alpha: Array) -> Array:
    """Velocity increments (n, 3) [m/s] in platform axes from gimbal angles (3, n + 1).

    ``raw``: ``d alpha / K`` along the input axes. ``triad``: the force that turns all three as measured,
    with the effective input axes and the calibration ``tan_beta + tan_beta_error``, phase off by
    ``phase_error``.

    Raises
    ------
    ArgumentError
        If a gimbal turns by more than a third of a turn in one step (the angle between samples would be
        ambiguous).
    """
    axes = mounting_axes(sensors)
    turned = np.diff(alpha, axis=1)
    if sensors.output == "raw":
        return np.ascontiguousarray(np.linalg.solve(axes[:, 0, :], turned / sensors.scale_factor).T)
    fastest = float(np.abs(turned).max())
    if fastest > 2.0 * np.pi / 3.0:
        raise ArgumentError(
            f"the gyro accelerometers turn up to {fastest:.2f} rad in a step; at most a third of a "
            "turn can be solved",
            remedy=f"shorten [run] step below {(times[1] - times[0]) * 2.0 / fastest:.2g} s",
        )
    increments = np.empty((turned.shape[1], 3))
    solve_triad(
        alpha + sensors.phase_error, axes, np.full(3, sensors.scale_factor),
        np.full(3, sensors.tan_beta + sensors.tan_beta_error), float(times[1] - times[0]), 4,
        np.empty((3, 4)), increments,
    )  # fmt: skip
    return increments


def through_pigas(sensors: PigaSensors, times: Array, force: Array, spin: Array) -> Array:
    """Velocity increments (n, 3) [m/s] that three gyro accelerometers give for the true force."""
    return read_increments(sensors, times, gimbal_angles(sensors, times, force, spin))


def locked(sensors: PigaSensors, force: Array) -> NDArray[np.bool_]:
    """Whether each instrument is inside its locked zone ``|a_x| < a_t tan(beta)``: (n, 3)."""
    along = force @ mounting_axes(sensors)[:, 0, :].T
    across = np.sqrt(np.maximum(np.sum(force**2, axis=1)[:, None] - along**2, 0.0))
    return np.abs(along) < across * abs(sensors.tan_beta)
