"""Positions and gravitation on the WGS-84 Earth in the field the navigator uses (J2).

The simulator and the navigator share this field, so that a run without errors stays where it is.
Earth-fixed axes ``e``: z along the polar axis, x through the Greenwich meridian. Inertial axes ``i``
coincide with ``e`` at time zero.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga import earth

Array = NDArray[np.float64]

KERNEL_EARTH = np.array(
    [
        earth.GM,
        1.5 * earth.J2 * earth.SEMI_MAJOR_AXIS**2,
        earth.SEMI_MAJOR_AXIS * (1.0 - earth.FLATTENING),
        earth.ECCENTRICITY_SQUARED,
        1.0 / (1.0 - earth.ECCENTRICITY_SQUARED),
    ]
)
"""GM, 1.5 J2 a^2, semi-minor axis, e^2 and 1/(1 - e^2), in the order the navigation kernel takes."""


def geodetic_to_earth(latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike) -> Array:
    """Earth-fixed position [m], shape (..., 3), of geodetic latitude, longitude [rad] and height [m]."""
    lat, lon, h = np.broadcast_arrays(*(np.asarray(v, dtype=float) for v in (latitude, longitude, height)))
    normal = earth.SEMI_MAJOR_AXIS / np.sqrt(1.0 - earth.ECCENTRICITY_SQUARED * np.sin(lat) ** 2)
    out = (normal + h) * np.cos(lat)
    up = (normal * (1.0 - earth.ECCENTRICITY_SQUARED) + h) * np.sin(lat)
    return np.stack([out * np.cos(lon), out * np.sin(lon), up], axis=-1)


def earth_to_geodetic(position: ArrayLike) -> tuple[Array, Array, Array]:
    """Latitude, longitude [rad] and height [m] of Earth-fixed positions (..., 3) [m] (Bowring, two steps)."""
    r = np.asarray(position, dtype=float)
    e2, a = earth.ECCENTRICITY_SQUARED, earth.SEMI_MAJOR_AXIS
    flat = np.sqrt(1.0 - e2)
    axis = np.hypot(r[..., 0], r[..., 1])
    tangent = r[..., 2] / (flat * axis)
    for _ in range(2):
        beta = np.arctan(tangent)
        up = r[..., 2] + e2 / flat * a * np.sin(beta) ** 3
        out = axis - e2 * a * np.cos(beta) ** 3
        tangent = flat * up / out
    latitude = np.arctan2(up, out)
    root = np.sqrt(1.0 - e2 * np.sin(latitude) ** 2)
    height = axis * np.cos(latitude) + r[..., 2] * np.sin(latitude) - a * root
    return latitude, np.arctan2(r[..., 1], r[..., 0]), height


def local_axes(latitude: ArrayLike, longitude: ArrayLike) -> Array:
    """``C_n^e`` (..., 3, 3): columns north, east, down in Earth-fixed axes."""
    lat, lon = np.broadcast_arrays(np.asarray(latitude, dtype=float), np.asarray(longitude, dtype=float))
    sl, cl, so, co = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    zero = np.zeros_like(sl)
    return np.stack(
        [
            np.stack([-sl * co, -so, -cl * co], axis=-1),
            np.stack([-sl * so, co, -cl * so], axis=-1),
            np.stack([cl, zero, -sl], axis=-1),
        ],
        axis=-2,
    )


def gravitation(position: ArrayLike) -> Array:
    """Gravitation of the J2 field [m/s^2] at positions (..., 3) [m] with z along the polar axis.

    ``g = -GM r / r^3 (1 + 1.5 J2 (a/r)^2 (1 - 5 s^2))`` in x and y, with 3 in place of 1 in z,
    ``s = z/r``. Against the closed normal-gravity formula it is short of the J4 term; docs/platform.md
    section 7 gives the difference.
    """
    r = np.asarray(position, dtype=float)
    inverse2 = 1.0 / np.sum(r * r, axis=-1, keepdims=True)
    s2 = r[..., 2:3] ** 2 * inverse2
    q = 1.5 * earth.J2 * earth.SEMI_MAJOR_AXIS**2 * inverse2
    factor = np.concatenate([1.0 - 5.0 * s2, 1.0 - 5.0 * s2, 3.0 - 5.0 * s2], axis=-1)
    return -earth.GM * inverse2**1.5 * r * (1.0 + q * factor)


def specific_force_at_rest(position: ArrayLike) -> Array:
    """Specific force [m/s^2] in Earth axes of a body at rest on the turning Earth, (..., 3)."""
    r = np.asarray(position, dtype=float)
    return -gravitation(r) - earth.EARTH_RATE**2 * r * np.array([1.0, 1.0, 0.0])


def gravity(latitude: float, height: float = 0.0) -> float:
    """Magnitude of gravity [m/s^2] of this field (J2 and rotation) at a geodetic place."""
    return float(np.linalg.norm(specific_force_at_rest(geodetic_to_earth(latitude, 0.0, height))))
