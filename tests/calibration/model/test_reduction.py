"""Triangles of rows against certified data, and against themselves in chunks."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from piga.calibration.model.reduction import Reduction
from piga.errors import ArgumentError

NIST = json.loads((Path(__file__).parents[2] / "data" / "nist-linear.json").read_text())
DIGITS = {"Filip": 6.5, "Wampler4": 7.5, "Longley": 10.0}


def certified(name: str) -> tuple[np.ndarray, np.ndarray]:
    data = np.array(NIST[name]["data"])
    if name == "Longley":
        return np.column_stack([np.ones(len(data)), data[:, 1:]]), data[:, 0]
    degree = 10 if name == "Filip" else 5
    return np.column_stack([data[:, 1] ** k for k in range(degree + 1)]), data[:, 0]


def digits(result: np.ndarray, wanted: np.ndarray) -> float:
    error = np.maximum(np.abs(result - wanted) / np.abs(wanted), 1e-17)
    return float(-np.log10(error).min())


@pytest.mark.parametrize("name", list(DIGITS))
def test_certified_data(name: str) -> None:
    """Rows come in parts of seven, which are merged."""
    x, y = certified(name)
    total = Reduction.empty(tuple(f"b{i}" for i in range(x.shape[1])))
    for start in range(0, len(y), 7):
        part = Reduction.empty(total.names)
        part.absorb(np.column_stack([x, y])[start : start + 7].T)
        total = Reduction.stacked([total, part])
    estimate, covariance, rss = total.solve()
    std = np.sqrt(np.diag(covariance) * rss / (len(y) - x.shape[1]))
    assert digits(estimate, np.array(NIST[name]["estimate"])) >= DIGITS[name]
    assert digits(std, np.array(NIST[name]["std"])) >= 5.5
    assert rss == pytest.approx(NIST[name]["residual_sum_of_squares"], rel=1e-6)
    assert total.count == len(y)


def rows_of(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, Reduction]:
    x = rng.standard_normal((40, 3))
    y = x @ [1.0, 2.0, 3.0] + rng.standard_normal(40)
    part = Reduction.empty(("a", "b", "c"))
    part.absorb(np.column_stack([x, y]).T)
    return x, y, part


@pytest.mark.parametrize("variance", [np.inf, 0.7, 0.0])
def test_a_column_with_a_random_coefficient_is_integrated_out(variance: float) -> None:
    """Generalised least squares of the other columns with the covariance ``I + variance b b'``."""
    x, y, part = rows_of(np.random.default_rng(4))
    b = x[:, 1]
    weight = np.eye(40) - np.outer(b, b) / ((1.0 / variance if variance else np.inf) + b @ b)
    estimate, covariance, rss = part.without(("b",), variance).solve()
    rest = x[:, [0, 2]]
    np.testing.assert_allclose(covariance, np.linalg.inv(rest.T @ weight @ rest), rtol=1e-10)
    np.testing.assert_allclose(estimate, covariance @ rest.T @ weight @ y, rtol=1e-10)
    missed = y - rest @ estimate
    assert rss == pytest.approx(float(missed @ weight @ missed), rel=1e-10)


def test_selected_and_subtracted() -> None:
    x, y, part = rows_of(np.random.default_rng(5))
    np.testing.assert_allclose(
        part.select(("c", "a")).solve()[0], np.linalg.lstsq(x[:, [2, 0]], y)[0], rtol=1e-10
    )
    moved = part.less("b", 0.5)
    np.testing.assert_allclose(moved.solve()[0], part.solve()[0] - [0.0, 0.5, 0.0], rtol=1e-10, atol=1e-12)


def test_wrong_columns_and_names_are_refused() -> None:
    total = Reduction.empty(("a",))
    with pytest.raises(ArgumentError, match="3 given, 2 needed"):
        total.absorb(np.zeros((3, 4)))
    with pytest.raises(ArgumentError, match="different columns"):
        Reduction.stacked([total, Reduction.empty(("b",))])
    with pytest.raises(np.linalg.LinAlgError):
        total.solve()
