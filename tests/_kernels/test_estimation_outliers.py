"""The scan for samples off the path, on small arrays by hand."""

from __future__ import annotations

import numpy as np
import pytest

from piga._kernels.estimation import merge_rows, scan_samples

pytestmark = pytest.mark.interpreted


def flags_of(angle: np.ndarray, begins: tuple[int, ...] = (0,)) -> np.ndarray:
    d, h = np.diff(angle, prepend=angle[0]), np.full(angle.size, 0.1)
    d[list(begins)], h[list(begins)] = 0.0, 0.0
    flags = np.zeros(angle.size, dtype=np.int8)
    scan_samples(d, h, 1e-10, 1e-12, 5.0, 0.0, flags)
    return flags


def noise(size: int) -> np.ndarray:
    return 1e-5 * np.random.default_rng(7).standard_normal(size)


def test_jump_with_a_spike_inside() -> None:
    angle = noise(80)
    angle[30:] += 1e-2
    angle[33] -= 5e-2
    flags = flags_of(angle)
    assert flags[30] == 2
    assert np.flatnonzero(flags == 1).tolist() == [33]


def test_a_bad_first_sample_is_left_out_not_a_jump_of_the_rest() -> None:
    angle = noise(40)
    angle[0] += 1.0
    assert flags_of(angle)[:3].tolist() == [1, 2, 0]


def test_in_a_stretch_of_few_samples_the_majority_decides() -> None:
    angle = noise(12)
    angle[[0, 6]] += 1.0
    assert np.flatnonzero(flags_of(angle, (0, 6))).tolist() == [0, 6]


def test_merging_keeps_the_sums_and_stops_at_a_new_stretch() -> None:
    h = np.array([0.0, 1.0, 1.0, 1.0, 0.0, 1.0])
    columns = np.array([[0.0, 1.0, 2.0, 3.0, 0.0, 5.0]])
    left_out = np.array([False, True, True, False, False, True])
    merge_rows(columns, h, left_out)
    assert h.tolist() == [0.0, -1.0, -1.0, 3.0, 0.0, -1.0]
    assert columns[0].tolist() == [0.0, 0.0, 0.0, 6.0, 0.0, 0.0]
