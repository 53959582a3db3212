"""Geometry that stands share: local axes, turns about a stand axis, smooth moves."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga.earth import EARTH_RATE, Site
from piga.errors import ArgumentError
from piga.frames import axis_turn, rotation_vector_to_matrix

Array = NDArray[np.float64]


def turned(vector: Array, angle: Array) -> Array:
    """Components of a constant ``vector`` (3,) in axes turned by ``angle`` (n,) [rad] about z, (n, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = vector
    return np.column_stack([c * x + s * y, c * y - s * x, np.full(angle.shape, z)])


def turned_back(vectors: Array, angle: Array) -> Array:
    """Components of ``vectors`` (n, 3), given in axes turned by ``angle`` about z, in the axes not turned."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = vectors.T
    return np.column_stack([c * x - s * y, c * y + s * x, z])


def in_axes(matrix: Array, vectors: Array) -> Array:
    """Each row of ``vectors`` (n, 3) multiplied by ``matrix`` (3, 3).

    Written out, because a matrix product may round a row differently with the number of rows: what a stand gives
    at a time must not depend on the other times it is asked for.
    """
    x, y, z = vectors.T
    return np.column_stack([row[0] * x + row[1] * y + row[2] * z for row in matrix])


def small_turn(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Array:
    """Matrix to axes turned by the small rotation vector ``(x, y, z)`` [rad], (3, 3)."""
    return rotation_vector_to_matrix(np.array([x, y, z])).T


def horizontal_axis_frame(site: Site, azimuth: float) -> tuple[Array, Array]:
    """Up and Earth rate [rad/s] in axes (up, z x up, z) with z horizontal at ``azimuth`` [rad] from north."""
    north, up = EARTH_RATE * math.cos(site.latitude), EARTH_RATE * math.sin(site.latitude)
    rate = np.array([up, -math.sin(azimuth) * north, math.cos(azimuth) * north])
    return np.array([1.0, 0.0, 0.0]), rate


def vertical_axis_frame(site: Site) -> tuple[Array, Array]:
    """Up and Earth rate [rad/s] in axes (north, west, up)."""
    rate = EARTH_RATE * np.array([math.cos(site.latitude), 0.0, math.sin(site.latitude)])
    return np.array([0.0, 0.0, 1.0]), rate


_ALONG_Z = {
    "Z0": np.eye(3),
    "X0": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "Y0": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
}


def mount(axis: str, what: str = "mount") -> Array:
    """Matrix from stand axes to base axes when base ``axis`` lies along the stand's z axis, (3, 3).

    ``axis`` is ``X0``, ``Y0`` or ``Z0``, with ``-`` for the opposite direction.

    Raises
    ------
    ArgumentError
        For another name.
    """
    name = axis.removeprefix("-")
    if name not in _ALONG_Z:
        raise ArgumentError(f"{what}: '{axis}' is no base axis", remedy="use X0, Y0, Z0, -X0, -Y0 or -Z0")
    flip = axis_turn(0, math.pi).round() if axis.startswith("-") else np.eye(3)
    return _ALONG_Z[name] @ flip


def smooth_step(u: Array) -> tuple[Array, Array, Array]:
    """Cycloid from 0 to 1 over ``u`` in [0, 1], with its first two derivatives with respect to ``u``."""
    w = 2.0 * math.pi * np.clip(u, 0.0, 1.0)
    return (w - np.sin(w)) / (2.0 * math.pi), 1.0 - np.cos(w), 2.0 * math.pi * np.sin(w)
