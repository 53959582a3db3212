"""The square-root reduction against certified data, against high precision, and against itself in chunks."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from piga._kernels.estimation.sequential import absorb, absorb_rows
from piga.calibration.model.reduction import Reduction, solve_upper
from piga.errors import ArgumentError

pytestmark = pytest.mark.compiled

NIST = json.loads((Path(__file__).parents[2] / "data" / "nist-linear.json").read_text())


DIGITS = {"Filip": 7.5, "Wampler4": 7.5, "Longley": 10.0}


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
@pytest.mark.parametrize("chunk", [1, 3, 7, 20, 1000])
def test_certified_data_in_any_chunks(name: str, chunk: int) -> None:
    x, y = certified(name)
    total = Reduction.empty(tuple(f"b{i}" for i in range(x.shape[1])))
    for start in range(0, len(y), chunk):
        part = Reduction.empty(total.names)
        part.add(x[start : start + chunk], y[start : start + chunk])
        total.merge(part)
    estimate, covariance, rss = total.solve()
    std = np.sqrt(np.diag(covariance) * rss / (len(y) - x.shape[1]))
    assert digits(estimate, np.array(NIST[name]["estimate"])) >= DIGITS[name]
    assert digits(std, np.array(NIST[name]["std"])) >= 6.0
    assert rss == pytest.approx(NIST[name]["residual_sum_of_squares"], rel=1e-6)
    assert total.count == len(y)


def test_filip_is_as_good_as_its_rounded_columns_allow() -> None:
    """60-digit least squares of the same rounded powers agrees to 14 digits: nothing is lost in the reduction."""
    x, y = certified("Filip")
    with mpmath.workdps(60):
        a, b = mpmath.matrix(x.tolist()), mpmath.matrix(y.tolist())
        exact = np.array([float(v) for v in mpmath.lu_solve(a.T * a, a.T * b)])
    total = Reduction.empty(tuple(f"b{i}" for i in range(x.shape[1])))
    total.add(x, y)
    assert digits(total.solve()[0], exact) > 14.0


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.lists(st.integers(1, 400), min_size=1, max_size=6))
def test_split_and_order_do_not_matter(seed: int, sizes: list[int]) -> None:
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((sum(sizes) + 6, 4)) * [1.0, 1e-4, 1e3, 1.0]
    y = rng.standard_normal(len(x))
    whole = Reduction.empty(("a", "b", "c", "d"))
    whole.add(x, y)
    edges = np.cumsum([0, *sizes, 6])
    parts = []
    for left, right in pairwise(edges):
        part = Reduction.empty(whole.names)
        part.add(x[left:right], y[left:right])
        parts.append(part)
    merged = Reduction.empty(whole.names)
    for index in rng.permutation(len(parts)):
        merged.merge(parts[index])
    np.testing.assert_allclose(merged.solve()[0], whole.solve()[0], rtol=1e-11)
    np.testing.assert_allclose(merged.solve()[1], whole.solve()[1], rtol=1e-10, atol=1e-30)


def test_covariance_is_the_inverse_normal_matrix() -> None:
    rng = np.random.default_rng(3)
    x, y = rng.standard_normal((500, 3)), rng.standard_normal(500)
    total = Reduction.empty(("a", "b", "c"))
    total.add(x, y)
    estimate, covariance, rss = total.solve()
    np.testing.assert_allclose(covariance, np.linalg.inv(x.T @ x), rtol=1e-12)
    np.testing.assert_allclose(estimate, np.linalg.lstsq(x, y)[0], rtol=1e-12)
    assert rss == pytest.approx(float(np.sum((y - x @ estimate) ** 2)), rel=1e-12)


def test_wrong_columns_and_names_are_refused() -> None:
    total = Reduction.empty(("a",))
    with pytest.raises(ArgumentError, match="3 given, 2 needed"):
        total.absorb(np.zeros((3, 4)))
    with pytest.raises(ArgumentError, match="different columns"):
        total.merge(Reduction.empty(("b",)))
    with pytest.raises(np.linalg.LinAlgError):
        total.solve()


def test_back_substitution_refuses_a_singular_factor() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        solve_upper(np.array([[1.0, 2.0], [0.0, 0.0]]), np.ones(2))


def tumbled_rows(rng: np.random.Generator) -> np.ndarray:
    """Rows (position, row, column) of a dividing head: all columns but four are multiples of one in a position.

    The multiples are sums over samples, equal to rounding only; where a_x is 6e-17 g its powers go down to 1e-49.
    """
    parts = []
    t = 0.05 * np.arange(1200)
    for position in np.deg2rad(np.arange(0.0, 360.0, 30.0)):
        a, b = 9.80665 * np.cos(position), -9.80665 * np.sin(position)
        turned = a * (t + rng.uniform(0.0, 10.0))
        multiples = [np.full(1200, c) for c in (a, 1.0, a * a, a**3, a * abs(a), b, a * b, b * b)]
        rates = [b * np.sin(turned) - 0.1 * np.cos(turned), b * np.cos(turned), *multiples, t - 300.0]
        angle = np.vstack([0.05 * np.cumsum(rates, axis=1), rng.standard_normal(1200)])
        contrasts = rng.standard_normal((58, 1200))
        factor = np.linalg.cholesky(contrasts @ contrasts.T / 1200)
        parts.append(1e6 * np.linalg.solve(factor, contrasts @ angle.T))
    return np.array(parts)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_columns_that_nothing_separates_keep_what_the_others_tell(seed: int) -> None:
    """Merged by position, all columns have their norms, and a choice of them what their rows alone would give."""
    parts = tumbled_rows(np.random.default_rng(seed))
    names = tuple("pqacdefbghs")
    total = Reduction.empty(names)
    for rows in parts:
        part = Reduction.empty(names)
        part.add(rows[:, :-1], rows[:, -1])
        total.merge(part)
    flat = parts.reshape(-1, parts.shape[2])
    norms = np.linalg.norm(flat, axis=0)
    assert np.linalg.norm(total.factor, axis=0) == pytest.approx(norms, rel=1e-12)
    chosen = ("p", "q", "a", "c", "b", "s")
    result = total.select(chosen).solve()[1]
    x = flat[:, [names.index(name) for name in chosen]]
    scale = np.linalg.norm(x, axis=0)
    wanted = np.linalg.inv((x / scale).T @ (x / scale)) / np.outer(scale, scale)
    assert np.sqrt(np.diag(result)) == pytest.approx(np.sqrt(np.diag(wanted)), rel=1e-9)


def test_rounding_of_rounding_is_nothing() -> None:
    """Equal columns leave 1e-16 of each other, again and again: what is left at 1e-160 must not be divided by."""
    R = np.zeros((2, 2))
    absorb(R, np.array([[1e-160, -1e-160, 2e-160], [1.0, 2.0, -2.0]]))
    assert np.abs(R[1, 1]) == pytest.approx(3.0)
    assert np.isfinite(R).all()


def test_householder_and_rotations_give_one_factor() -> None:
    rng = np.random.default_rng(8)
    columns = rng.standard_normal((4, 300))
    block, rows = np.zeros((4, 4)), np.zeros((4, 4))
    absorb(block, columns.copy())
    snapshots = np.empty((2, 4, 4))
    absorb_rows(rows, columns, np.array([150, 300]), snapshots)
    np.testing.assert_allclose(np.abs(block), np.abs(rows), atol=1e-12)
    np.testing.assert_array_equal(snapshots[1], rows)
    np.testing.assert_allclose(snapshots[0].T @ snapshots[0], columns[:, :150] @ columns[:, :150].T, atol=1e-11)
