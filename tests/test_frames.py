"""Rotations against SciPy's, and by what they must do."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from piga.frames import axis_turn, matrix_to_rotation_vector, rotation_vector_to_matrix, skew

VECTORS = st.lists(st.floats(-1.7, 1.7), min_size=3, max_size=3).map(np.array)


@given(VECTORS, VECTORS)
def test_skew_is_the_vector_product(v: np.ndarray, w: np.ndarray) -> None:
    assert skew(v) @ w == pytest.approx(np.cross(v, w), abs=1e-15)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_turned_frame_sees_the_opposite_rotation(axis: int) -> None:
    angles = np.array([-2.0, 0.0, 1e-9, 0.7, 3.0])
    expected = Rotation.from_euler("xyz"[axis], angles[:, None]).as_matrix().transpose(0, 2, 1)
    assert axis_turn(axis, angles) == pytest.approx(expected, abs=1e-15)
    assert axis_turn(axis, 0.7) == pytest.approx(expected[3], abs=1e-15)


@given(VECTORS)
def test_rotation_vectors(v: np.ndarray) -> None:
    matrix = rotation_vector_to_matrix(v)
    assert matrix == pytest.approx(Rotation.from_rotvec(v).as_matrix(), abs=3e-15)
    assert matrix_to_rotation_vector(matrix) == pytest.approx(v, abs=2e-14)


@pytest.mark.parametrize("size", [0.0, 1e-15, 1e-12, 3e-12, 1e-8, 1e-3, 3.0, 3.14])
def test_any_size_of_turn_comes_back(size: float) -> None:
    """Small turns keep their relative digits; near half a turn the matrix itself holds the axis badly."""
    v = size * np.array([0.36, -0.48, 0.8])
    back = matrix_to_rotation_vector(rotation_vector_to_matrix(v))
    assert back == pytest.approx(v, rel=1e-14, abs=1e-30 if size < 3.0 else 1e-12)
