"""Geometry of the platform: positions on the Earth, the nulled triad and rings, case-rotation schedules.

Positions and gravitation are those of the WGS-84 Earth in the field (J2) that simulator and navigator use, so a run without
errors stays at its place. Earth-fixed axes ``e``: z along the polar axis, x through the Greenwich meridian. Inertial axes
``i`` coincide with ``e`` at time zero. Triad and rings: the exact nulled geometry, and the literature's small-angle matrices.
"""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from piga import earth
from piga.frames import axis_turn
from piga.platform.scenario import Gyro
from piga.results import Array

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
    lat, lon = (np.asarray(v, dtype=float) for v in np.broadcast_arrays(latitude, longitude))
    sl, cl, so, co = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    rows = (-sl * co, -so, -cl * co, -sl * so, co, -cl * so, cl, np.zeros_like(sl), -sl)
    return np.stack(rows, axis=-1).reshape(*sl.shape, 3, 3)


def gravitation(position: ArrayLike) -> Array:
    """Gravitation of the J2 field [m/s^2] at positions (..., 3) [m] with z along the polar axis.

    ``g = -GM r / r^3 (1 + 1.5 J2 (a/r)^2 (1 - 5 s^2))`` in x and y, with 3 in place of 1 in z,
    ``s = z/r``. It lacks the J4 term of the closed normal-gravity formula; docs/theory/platform.md section 7 gives the
    difference.
    """
    r = np.asarray(position, dtype=float)
    inverse2 = 1.0 / np.sum(r * r, axis=-1, keepdims=True)
    s2 = r[..., 2:3] ** 2 * inverse2
    q = 1.5 * earth.J2 * earth.SEMI_MAJOR_AXIS**2 * inverse2
    return -earth.GM * inverse2**1.5 * r * (1.0 + q * (np.array([1.0, 1.0, 3.0]) - 5.0 * s2))


def specific_force_at_rest(position: ArrayLike) -> Array:
    """Specific force [m/s^2] in Earth axes of a body at rest on the turning Earth, (..., 3)."""
    r = np.asarray(position, dtype=float)
    return -gravitation(r) - earth.EARTH_RATE**2 * r * np.array([1.0, 1.0, 0.0])


def gravity(latitude: float, height: float = 0.0) -> float:
    """Magnitude of gravity [m/s^2] of this field (J2 and rotation) at a geodetic place."""
    return float(np.linalg.norm(specific_force_at_rest(geodetic_to_earth(latitude, 0.0, height))))


def misalignment(gyro: Gyro, angle: ArrayLike) -> Array:
    """``m(c) = m + sum_k a_k cos(k c + p_k)`` [rad] at case angles ``c`` [rad], phase included."""
    c = np.asarray(angle, dtype=float)
    return gyro.misalignment + sum(
        (h.amplitude * np.cos(h.order * c + h.phase) for h in gyro.harmonics), np.zeros_like(c)
    )


def nulled_attitude(
    polar: Gyro, equatorial: Gyro, c1: ArrayLike, c2: ArrayLike, eta: ArrayLike
) -> tuple[Array, Array]:
    """Exact ``C_G^P`` (n, 3, 3) and ring angle Y (n,) [rad] with both pick-offs nulled.

    ``c1, c2`` case angles with their phase and ``eta`` redundancy angle [rad], each (n,) or a scalar.
    The tip of the polar momentum is ``n1 = (-sin m1 sin c1, sin m1 cos c1, cos m1)`` in P, that of the equatorial one
    ``n2 = (cos m2, -sin m2 sin c2, sin m2 cos c2)`` in the ring. Y solves ``n1 . R_y(Y) n2 = -sin(eta)``. The attitude is
    the triad of the two momenta. No small-angle step. Own derivation, docs/theory/platform.md section 2.
    """
    a, b, e = (np.asarray(v, dtype=float) for v in np.broadcast_arrays(*np.atleast_1d(c1, c2, eta)))
    m1, m2 = misalignment(polar, a), misalignment(equatorial, b)
    x1, y1, z1 = -np.sin(m1) * np.sin(a), np.sin(m1) * np.cos(a), np.cos(m1)
    x2, y2, z2 = np.cos(m2), -np.sin(m2) * np.sin(b), np.sin(m2) * np.cos(b)
    along, across = x1 * x2 + z1 * z2, z1 * x2 - x1 * z2
    ring = np.arctan2(along, across) + np.arcsin((np.sin(e) + y1 * y2) / np.hypot(along, across))
    c, s = np.cos(ring), np.sin(ring)
    x2, z2 = x2 * c + z2 * s, z2 * c - x2 * s  # the equatorial momentum in P
    y = np.stack([y1 * z2 - z1 * y2, z1 * x2 - x1 * z2, x1 * y2 - y1 * x2], axis=-1)
    y /= np.linalg.norm(y, axis=-1, keepdims=True)
    z = np.stack([x1, y1, z1], axis=-1)
    return np.stack([np.cross(y, z), y, z], axis=-1), ring


def small_angles(
    polar: Gyro, equatorial: Gyro, c1: ArrayLike, c2: ArrayLike, eta: ArrayLike
) -> tuple[Array, Array]:
    """Small angles ``e`` (n, 3) of P against G and pick-off ``Y`` (n,) [rad], second order dropped [He2014].

    ``e_x = m1 cos c1, e_y = m1 sin c1, e_z = m2 sin c2 sec(eta) - m1 cos c1 tan(eta)``,
    ``Y = eta + m2 cos c2 - m1 sin c1``, ``C_G^P = I - [e x]``.
    """
    a, b, angle = (np.asarray(v, dtype=float) for v in np.broadcast_arrays(c1, c2, eta))
    m1, m2 = misalignment(polar, a), misalignment(equatorial, b)
    ex, ey = m1 * np.cos(a), m1 * np.sin(a)
    ez = m2 * np.sin(b) / np.cos(angle) - ex * np.tan(angle)
    return np.stack([ex, ey, ez], axis=-1), angle + m2 * np.cos(b) - ey


def gimbal_attitude(gimbals: ArrayLike) -> Array:
    """``C_b^P = R3(sigma) R2(theta) R3(psi)`` (..., 3, 3) of gimbal angles (..., 3) outer, middle, inner [rad].

    The outer axis is the base's vertical. The inner axis is the platform's polar axis. Gimbal lock occurs only
    if the two are parallel (at the poles), so no fourth gimbal is needed below 85 degrees.
    """
    g = np.asarray(gimbals, dtype=float)
    return axis_turn(2, g[..., 2]) @ axis_turn(1, g[..., 1]) @ axis_turn(2, g[..., 0])


def gimbals_of(body_to_platform: Array) -> Array:
    """Gimbal angles (n, 3) outer, middle, inner [rad] of ``C_b^P`` (n, 3, 3)."""
    c = body_to_platform
    middle = np.arctan2(np.hypot(c[:, 2, 0], c[:, 2, 1]), c[:, 2, 2])
    outer, inner = np.arctan2(c[:, 2, 1], c[:, 2, 0]), np.arctan2(c[:, 1, 2], -c[:, 0, 2])
    return np.stack([outer, middle, inner], axis=1)


def earth_to_inertial(times: Array) -> Array:
    """``C_e^i`` (n, 3, 3) at ``times`` [s]."""
    return axis_turn(2, -earth.EARTH_RATE * times)


def turns_between(attitude: Array) -> Array:
    """Turn (n, 3) [rad] of a frame from one attitude (n + 1, 3, 3) to the next, in its own axes; first order."""
    turn = np.einsum("nij,nkj->nik", attitude[1:], attitude[:-1])
    return 0.5 * np.stack([turn[:, j - 2, j - 1] - turn[:, j - 1, j - 2] for j in range(3)], axis=1)


def step_means(values: Array) -> Array:
    """Means over steps (n, ...) by Simpson's rule, from values at the nodes and between them (2n + 1, ...)."""
    return (values[:-2:2] + 4.0 * values[1::2] + values[2::2]) / 6.0


def halved(nodes: Array) -> Array:
    """Values at nodes (n, ...) and, between them, in the middle of every step: (2n - 1, ...)."""
    out = np.empty((2 * len(nodes) - 1, *nodes.shape[1:]))
    out[::2], out[1::2] = nodes, 0.5 * (nodes[1:] + nodes[:-1])
    return out


def wrapped(angle: ArrayLike) -> Array:
    """Angles [rad] brought to one turn about zero, -pi to pi."""
    return np.remainder(np.asarray(angle) + np.pi, 2.0 * np.pi) - np.pi


def encoder_angle(rate: float, reversal: int, times: ArrayLike) -> Array:
    """Angle of a case encoder [rad] at ``times`` [s]: ``rate t``, folded back every ``reversal`` turns (0: never)."""
    angle, span = rate * np.asarray(times, dtype=float), 2.0 * np.pi * reversal
    return span - np.abs(np.mod(angle, 2.0 * span) - span) if reversal else angle


def apparent_gyro(gyro: Gyro, rate: float, reversal: int = 0) -> Gyro:
    """The gyro as identification sees it: under steady rotation a case-fixed drift looks like misalignment.

    Drift ``w`` in case axes [rad/s] moves the momentum on a circle, ``w exp(ic) / (i rate)``. The circle turns with the
    case, as the misalignment ``m exp(ic)`` does. Only ``m - i w / rate`` is observable, and only this must be
    compensated; a reversal separates the two. Own derivation, docs/theory/platform.md section 4.
    """
    if rate == 0.0 or reversal or not any(gyro.case_drift):
        return gyro
    seen = complex(gyro.misalignment, 0.0) - 1j * complex(*gyro.case_drift) / rate
    return msgspec.structs.replace(gyro, misalignment=abs(seen), phase=gyro.phase + float(np.angle(seen)))
