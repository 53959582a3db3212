"""Frames and rotations: direction cosine matrices from elementary turns and rotation vectors.

``C_ab`` takes components in frame ``b`` to components in frame ``a``: ``v_a = C_ab @ v_b``.
Single matrices have shape (3, 3); stacks have shape (n, 3, 3).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def skew(vector: ArrayLike) -> Array:
    """Matrix ``[v x]`` with ``[v x] w = v x w``; ``vector`` (..., 3), result (..., 3, 3)."""
    v = np.asarray(vector, dtype=float)
    result = np.zeros((*v.shape[:-1], 3, 3))
    result[..., 0, 1], result[..., 0, 2] = -v[..., 2], v[..., 1]
    result[..., 1, 0], result[..., 1, 2] = v[..., 2], -v[..., 0]
    result[..., 2, 0], result[..., 2, 1] = -v[..., 1], v[..., 0]
    return result


def axis_turn(axis: int, angle: ArrayLike) -> Array:
    """Components seen from a frame turned by ``angle`` [rad] about coordinate ``axis`` (0, 1, 2).

    ``C_ba`` of frame b obtained from a by the turn: for axis 2,
    ``[[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]``. Shape ``angle.shape + (3, 3)``.
    """
    a = np.asarray(angle, dtype=float)
    c, s = np.cos(a), np.sin(a)
    i, j, k = axis, (axis + 1) % 3, (axis + 2) % 3
    result = np.zeros((*a.shape, 3, 3))
    result[..., i, i] = 1.0
    result[..., j, j], result[..., j, k] = c, s
    result[..., k, j], result[..., k, k] = -s, c
    return result


def rotation_vector_to_matrix(vector: ArrayLike) -> Array:
    """Rotation matrix ``exp([v x])`` that turns vectors by ``|v|`` [rad] about ``v`` (Rodrigues).

    ``vector`` (..., 3), result (..., 3, 3). Accurate for small angles.
    """
    v = np.asarray(vector, dtype=float)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    cross = skew(v)
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    return np.eye(3) + first * cross + second * (cross @ cross)


def matrix_to_rotation_vector(matrix: ArrayLike) -> Array:
    """Rotation vector [rad] of a rotation matrix, ``|v| < pi``; (..., 3, 3) to (..., 3)."""
    c = np.asarray(matrix, dtype=float)
    axial = 0.5 * np.stack(
        [c[..., 2, 1] - c[..., 1, 2], c[..., 0, 2] - c[..., 2, 0], c[..., 1, 0] - c[..., 0, 1]], axis=-1
    )
    sine = np.linalg.norm(axial, axis=-1, keepdims=True)
    cosine = 0.5 * (np.trace(c, axis1=-2, axis2=-1)[..., None] - 1.0)
    angle = np.arctan2(sine, cosine)
    return axial * np.where(sine > 1e-12, angle / np.where(sine > 1e-12, sine, 1.0), 1.0)
