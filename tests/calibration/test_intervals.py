"""Intervals by the scatter of positions: against elementary formulas, numbers of the plan, and coverage."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.stats import binom, norm
from scipy.stats import t as student

from piga.calibration.intervals import LeverageError, Repetition, find_interval, scatter_of
from piga.calibration.model.reduction import Reduction, triangle
from piga.calibration.model.solution import Estimate, Layout, solve_parts
from tests.calibration.made.synthetic import layout_of


def triangles(x: np.ndarray, y: np.ndarray) -> list[np.ndarray]:
    """One position per row of (positions, columns) values, observed ``y``, less the common fit."""
    fitted = np.linalg.lstsq(x, y)[0]
    return [triangle(np.append(row, value - row @ fitted)[None, :]) for row, value in zip(x, y, strict=True)]


def test_a_mean_has_the_scatter_of_its_values() -> None:
    """Equal positions and one parameter: standard deviation over root of n, and n - 1 degrees of freedom."""
    y = np.random.default_rng(1).standard_normal(9)
    u, degrees, _ = scatter_of(triangles(np.ones((9, 1)), y))
    assert u[0] == pytest.approx(y.std(ddof=1) / 3.0, rel=1e-12)
    assert degrees[0] == pytest.approx(8.0, rel=1e-9)


@pytest.mark.parametrize("noise", ["equal", "unequal"])
def test_intervals_hold_for_noise_that_the_weights_do_not_know(noise: str) -> None:
    """Twelve positions, four columns of a tumble, 400 tests; Gauss's formula with 1.96 holds far less often."""
    rng, tests = np.random.default_rng(2), 400
    angle = 2.0 * np.pi * np.arange(12) / 12.0
    x = np.column_stack([np.cos(angle), np.ones(12), np.cos(angle) ** 2, -np.sin(angle)])
    size = np.where(np.arange(12) % 3 == 0, 3.0 if noise == "unequal" else 1.0, 1.0)
    held, plain = np.zeros(4), np.zeros(4)
    known = np.sqrt(np.diag(np.linalg.inv(x.T @ x)))
    for _ in range(tests):
        y = rng.permutation(size) * rng.standard_normal(12)
        error = np.linalg.lstsq(x, y)[0]
        u, degrees, _ = scatter_of(triangles(x, y))
        held += np.abs(error) <= student.ppf(0.975, degrees) * u
        spread = np.sqrt(((y - x @ error) ** 2).sum() / 8.0)
        plain += np.abs(error) <= norm.ppf(0.975) * spread * known
    low, high = binom.ppf([0.0005, 0.9995], tests, 0.95)
    assert (held >= low).all()
    assert (held <= high + 0.02 * tests).all()
    assert plain.min() < low


def plan(order: Sequence[int], excess: float, seed: int) -> tuple[Layout, Estimate, list[Repetition]]:
    """24 positions of 60 s of a tumble, five seconds apart; rates scatter by ``excess`` times what noise within positions gives."""
    rng = np.random.default_rng(seed)
    angle = 2.0 * np.pi * np.array(order) / 24.0
    names = ("scale_factor", "k0", "k2", "m_Y")
    columns = np.column_stack([np.cos(angle), np.ones(24), np.cos(angle) ** 2, -np.sin(angle)])
    repetitions, parts = [], []
    for index, row in enumerate(columns):
        rate = np.repeat(row[None, :], 50, axis=0)
        y = excess / np.sqrt(50.0) * rng.standard_normal() + rng.standard_normal(50)
        part = Reduction((*names, "rate"), triangle(np.column_stack([rate, np.ones(50), y])), 50)
        repetitions.append(Repetition(part, 0, 0.0, f"p{index}", 65.0 * index, 65.0 * index + 60.0))
        parts.append(part.select(names))
    layout = layout_of(False, (), names)
    return layout, solve_parts(layout, [Reduction.stacked(parts)]), repetitions


def test_positions_in_order_widen_a_slow_excess() -> None:
    """Numbers of the plan: with a large excess K grows by 2.1, k0 by 3.4, m_Y by 2.6 in order, and hardly if shuffled."""
    growth = find_interval(*plan(range(24), 100.0, 3)).growth
    assert growth[[0, 1, 3]] == pytest.approx([2.2, 2.7, 2.7], abs=0.5)
    order = np.random.default_rng(5).permutation(24).tolist()
    shuffled = find_interval(*plan(order, 100.0, 3)).growth
    assert (shuffled[[0, 2, 3]] < 1.5).all()


def test_without_an_excess_nothing_grows() -> None:
    interval = find_interval(*plan(range(24), 0.0, 4))
    assert interval.growth == pytest.approx(np.ones(4))
    assert interval.excess == pytest.approx(1.0, abs=0.8)
    assert np.sqrt(np.diag(interval.covariance)) == pytest.approx(
        np.sqrt(np.diag(plan(range(24), 0.0, 4)[1].covariance)), rel=0.5
    )


def test_a_position_that_alone_determines_a_coefficient_is_named() -> None:
    layout, _, repetitions = plan(range(24), 1.0, 6)
    names = (*layout.columns, "k0_T", "rate")
    layout = layout_of(False, (), names[:-1])
    wider = []
    for index, repetition in enumerate(repetitions):
        rows = np.insert(repetition.part.factor, 4, 0.0, axis=1)
        rows[:, 4] = repetition.part.factor[:, 4] if index == 7 else 0.0
        part = Reduction(names, triangle(rows), repetition.part.count)
        wider.append(Repetition(part, 0, 0.0, f"p{index}", repetition.begin, repetition.end))
    estimate = solve_parts(layout, [Reduction.stacked([one.part.select(names[:-1]) for one in wider])])
    with pytest.raises(LeverageError, match="position 'p7' alone determines k0_T") as caught:
        find_interval(layout, estimate, wider)
    assert (caught.value.position, caught.value.terms) == ("p7", ("k0_T",))


def test_runs_that_scatter_more_than_their_positions_widen() -> None:
    """Six runs whose bias differs by much more than their positions: u is that of six values, with five degrees."""
    rng = np.random.default_rng(8)
    layout = layout_of(False, (), ("k0",))
    repetitions, offsets = [], 10.0 * rng.standard_normal(6)
    for run, offset in enumerate(offsets):
        for index in range(8):
            rows = np.column_stack([np.ones((40, 2)), offset + rng.standard_normal(40)])
            part = Reduction(("k0", "rate"), triangle(rows), 40)
            repetitions.append(Repetition(part, 0, 0.0, f"p{index}", 60.0 * index, 60.0 * index + 50.0, run))
    estimate = solve_parts(layout, [Reduction.stacked([one.part.select(("k0",)) for one in repetitions])])
    interval = find_interval(layout, estimate, repetitions)
    assert np.sqrt(interval.covariance[0, 0]) == pytest.approx(offsets.std(ddof=1) / np.sqrt(6.0), rel=0.1)
    assert interval.degrees[0] == pytest.approx(5.0, abs=0.1)
