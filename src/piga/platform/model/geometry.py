"""Platform, triad and rings: the exact nulled geometry and the small-angle matrices of the literature."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga._kernels.platform.geometry import exact_geometry_series
from piga.frames import axis_turn, skew
from piga.platform.model.scenario import Gyro

Array = NDArray[np.float64]


def harmonic_arrays(gyro: Gyro) -> tuple[Array, Array]:
    """Cosine and sine coefficients [rad] of the misalignment over the case angle, order 1 upwards."""
    orders = max((h.order for h in gyro.harmonics), default=0)
    cosines, sines = np.zeros(orders), np.zeros(orders)
    for h in gyro.harmonics:
        cosines[h.order - 1] += h.amplitude * np.cos(h.phase)
        sines[h.order - 1] -= h.amplitude * np.sin(h.phase)
    return cosines, sines


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
    No small-angle step. Own derivation, docs/platform.md section 2.
    """
    a, b, e = (np.ascontiguousarray(v, dtype=float) for v in np.broadcast_arrays(*np.atleast_1d(c1, c2, eta)))
    attitude, ring = np.empty((a.size, 3, 3)), np.empty(a.size)
    exact_geometry_series(
        polar.misalignment, *harmonic_arrays(polar), a,
        equatorial.misalignment, *harmonic_arrays(equatorial), b, e,
        attitude, ring,
    )  # fmt: skip
    return attitude, ring


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


def small_angle_attitude(e: ArrayLike) -> Array:
    """``C_G^P = I - [e x]`` for small angles ``e`` (..., 3) [rad]."""
    return np.eye(3) - skew(e)


def gimbal_attitude(gimbals: ArrayLike) -> Array:
    """``C_b^P = R3(sigma) R2(theta) R3(psi)`` (..., 3, 3) of gimbal angles (..., 3) outer, middle, inner [rad].

    The outer axis is the base's vertical, the inner one the platform's polar axis; the set locks only
    where these two are parallel (at the poles), so that no fourth gimbal is needed below 85 degrees.
    """
    g = np.asarray(gimbals, dtype=float)
    return axis_turn(2, g[..., 2]) @ axis_turn(1, g[..., 1]) @ axis_turn(2, g[..., 0])


def turns_to_gimbals(gimbals: ArrayLike, turn: Array) -> Array:
    """Changes of the gimbal angles (n, 3, p) [rad] that turn P by ``turn`` (n, 3, p) [rad] about its own axes.

    ``d theta`` is the turn about the middle axis, ``d psi`` that about the outer one, ``d sigma`` the rest.
    """
    g = np.asarray(gimbals, dtype=float)[..., None]
    st, ct, ss, cs = np.sin(g[:, 1]), np.cos(g[:, 1]), np.sin(g[:, 2]), np.cos(g[:, 2])
    out = np.empty_like(turn)
    out[:, 0] = (ss * turn[:, 1] - cs * turn[:, 0]) / st
    out[:, 1] = ss * turn[:, 0] + cs * turn[:, 1]
    out[:, 2] = turn[:, 2] - ct * out[:, 0]
    return out
