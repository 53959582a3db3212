"""The line with excess variance against certified and published values."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from piga.errors import ArgumentError
from piga.trend.trend_line import Line, clearest_step, line_through, merge_by_day, outlook

NORRIS = np.array([
    [0.1, 0.2], [338.8, 337.4], [118.1, 118.2], [888.0, 884.6], [9.2, 10.1], [228.1, 226.5], [668.5, 666.3],
    [998.5, 996.3], [449.1, 448.6], [778.9, 777.0], [559.2, 558.2], [0.3, 0.4], [0.1, 0.6], [778.1, 775.5],
    [668.8, 666.9], [339.3, 338.0], [448.9, 447.5], [10.8, 11.6], [557.7, 556.0], [228.3, 228.1], [998.0, 995.8],
    [888.8, 887.6], [119.6, 120.2], [0.3, 0.3], [0.6, 0.3], [557.6, 556.8], [339.3, 339.1], [888.0, 887.2],
    [998.5, 999.0], [778.9, 779.0], [10.2, 11.1], [117.6, 118.3], [228.9, 229.2], [668.4, 669.1], [449.2, 448.9],
    [0.2, 0.5],
])  # fmt: skip
"""NIST StRD data set Norris (y, x)."""


def of_days(t, y, v, days=None, shared=None):
    """The values merged by day; each value is a day of its own unless ``days`` says otherwise."""
    days = np.arange(len(y)) if days is None else days
    return merge_by_day(t, y, v, days, np.zeros((0, len(y))) if shared is None else shared)


def fit_line(t, y, v, shared=None) -> Line:
    """Line through values of as many days."""
    return line_through(of_days(t, y, v, shared=shared))


def about(line, origin):
    """Value at ``origin`` and slope, and their covariance."""
    moved = np.array([[1.0, origin - line.days.time.mean()], [0.0, 1.0]])
    return moved @ line.coefficients, moved @ line.covariance @ moved.T


@pytest.mark.parametrize("stated", [1e-3, 0.8, 0.9])
def test_certified_line_whatever_the_stated_size(stated):
    """NIST StRD Norris: certified estimates and standard deviations to 10 digits."""
    fit = fit_line(NORRIS[:, 1], NORRIS[:, 0], np.full(36, stated**2))
    coefficients, covariance = about(fit, 0.0)
    assert coefficients == pytest.approx([-0.262323073774029, 1.00211681802045], rel=1e-10)
    std = np.sqrt(np.diag(covariance))
    assert std == pytest.approx([0.232818234301152, 0.429796848199937e-3], rel=1e-10)
    residual_std = np.sqrt(fit.scale * (stated**2 + fit.excess))
    assert residual_std == pytest.approx(0.884796396144373, rel=1e-10)


def test_unequal_weights_are_those_of_a_weighted_line():
    rng = np.random.default_rng(5)
    t, v = np.sort(rng.uniform(0, 9, 12)), rng.uniform(0.2, 4.0, 12) ** 2
    y = 3.0 - 0.4 * t + rng.normal(0, np.sqrt(v + 4.0))
    fit = fit_line(t, y, v, shared=np.stack([y, v]))
    coefficients, stated = about(fit, 0.0)
    for excess, q in (
        (fit.excess, 10.0),
        (0.0, fit.chi2),
    ):  # Paule and Mandel's condition; the stated variances alone
        line, covariance = np.polyfit(t, y, 1, w=1.0 / np.sqrt(v + excess), cov="unscaled")
        assert np.sum((y - np.polyval(line, t)) ** 2 / (v + excess)) == pytest.approx(q, rel=1e-10)
        if excess > 0.2:
            assert coefficients == pytest.approx(line[::-1], rel=1e-10)
            assert stated == pytest.approx(covariance[::-1, ::-1], rel=1e-10)
    assert fit.scale == pytest.approx(1.0, rel=1e-10)
    assert fit.shared[:, 0] == pytest.approx(fit.coefficients, rel=1e-12)


def test_no_excess_when_the_stated_scatter_explains_it():
    rng = np.random.default_rng(2)
    t = np.arange(9.0)
    y = 1.0 + rng.normal(0, 0.1, 9)
    fit = fit_line(t, y, np.ones(9))
    assert fit.excess == 0.0
    assert fit.chi2 < 0.2
    assert fit.scale * 7 == pytest.approx(stats.chi2.ppf(0.2, 7), rel=1e-10)


def test_exact_values_are_a_line_without_excess():
    fit = fit_line(np.arange(5.0), 2.0 + 3.0 * np.arange(5.0), np.zeros(5))
    assert fit.coefficients[1] == pytest.approx(3.0, rel=1e-12)


def test_groups_are_one_way_analysis_of_variance():
    """Balanced groups: within and between as in the analysis of variance of JCGM 100, H.5."""
    rng = np.random.default_rng(8)
    labels = np.repeat(np.arange(10), 5)
    values = rng.normal(0, 3.0, 10)[labels] + rng.normal(0, 2.0, 50)
    v = np.linspace(0.005, 0.015, 50)
    own = 1.0 / (v + of_days(np.arange(50.0), values, v, labels, v[None]).within)
    weighted = np.bincount(labels, own * v) / np.bincount(labels, own)
    shared = of_days(np.arange(50.0), values, v, labels, v[None]).shared
    assert shared[:, 0] == pytest.approx(weighted, rel=1e-12)
    groups = of_days(np.arange(50.0), values, np.full(50, 0.01), labels)
    table = values.reshape(10, 5)
    inside = float(np.sum((table - table.mean(axis=1, keepdims=True)) ** 2) / 40)
    assert groups.within == pytest.approx(inside - 0.01, rel=1e-10)
    assert groups.means == pytest.approx(table.mean(axis=1), rel=1e-12)
    assert groups.variances == pytest.approx(np.full(10, inside / 5), rel=1e-10)
    line = line_through(groups)
    fit = stats.linregress(groups.time, groups.means)
    assert np.sqrt(line.covariance[1, 1]) == pytest.approx(fit.stderr, rel=1e-10)


@pytest.mark.parametrize("place", [2, 3, 6, 10])
def test_a_step_beside_a_line_is_found_with_its_size(place):
    """Equal uncertainties: the step is that of ordinary least squares with a line and a step."""
    rng = np.random.default_rng(place)
    t = np.arange(12) * 0.25
    y = 0.7 * t + rng.normal(0, 1.0, 12) + 10.0 * (np.arange(12) >= place)
    step = clearest_step(of_days(t, y, np.full(12, 0.01)))
    design = np.stack([np.ones(12), t, np.arange(12) >= place], axis=1)
    solution, squares, *_ = np.linalg.lstsq(design, y, rcond=None)
    std = np.sqrt(squares[0] / 9 * np.linalg.inv(design.T @ design)[2, 2])
    assert step.day == place
    assert step.size == pytest.approx(solution[2], rel=1e-9)
    assert step.std == pytest.approx(std, rel=1e-6)
    assert step.probability == pytest.approx(9 * 2 * stats.t.sf(step.size / std, 9), rel=1e-4)


def test_no_step_in_few_days():
    assert clearest_step(of_days(np.arange(4.0), np.array([0.0, 0.0, 9.0, 9.0]), np.ones(4))) is None


SHAPES = (
    lambda a, b: np.zeros((a.size, b.size)),
    np.minimum.outer,
    lambda a, b: np.array([[min(x, y) ** 2 * (3.0 * max(x, y) - min(x, y)) / 6.0 for y in b] for x in a]),
)
"""Covariance of the three causes: each day for itself, a walk, its integral."""


# -- forecast -----------------------------------------------------------------------------------------------


def test_each_model_predicts_by_generalised_least_squares():
    """Each model alone, by the textbook's formulas: weights from the restricted likelihood, best prediction, its variance."""
    rng = np.random.default_rng(3)
    t = np.sort(rng.uniform(0, 4, 7))
    v, shared = rng.uniform(0.5, 2.0, 7), rng.normal(0, 1, (2, 7))
    days = of_days(t, rng.normal(0, 2, 7), v, shared=shared)
    whole = outlook(days)
    since, ahead, X = t - t[0], np.array([5.0 - t[0]]), np.stack([np.ones(7), t], axis=1)
    values, variances, on_days, likely = [], [], [], []
    for cause, still, moving in zip(
        whole.cause, whole.size * whole.still, whole.size * whole.moving, strict=True
    ):
        shape = SHAPES[cause]
        covariance = np.diag(v + still) + moving * shape(since, since)
        beside = moving * shape(since, ahead)[:, 0]
        per = np.linalg.inv(covariance)
        line = np.linalg.inv(X.T @ per @ X) @ X.T @ per
        on_days.append([1.0, 5.0] @ line + beside @ per @ (np.eye(7) - X @ line))
        own = still + moving * shape(ahead, ahead)[0, 0] + 0.3
        values.append(on_days[-1] @ days.means)
        variances.append(own + on_days[-1] @ covariance @ on_days[-1] - 2 * on_days[-1] @ beside)
        left = days.means - X @ line @ days.means
        sizes = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(X.T @ per @ X)[1]
        likely.append(math.exp(-0.5 * (sizes + left @ per @ left)) / (3.0 if cause else 1.0))
    weights = np.array(likely) / np.sum(likely)
    mean = np.dot(weights, values)
    common = np.array([0.2, -0.4])
    known = np.sum((weights @ np.array(on_days) @ shared.T - common) ** 2)
    spread = np.dot(weights, np.array(variances) + (np.array(values) - mean) ** 2)
    forecast = whole.at(5.0, 0.3, common)
    assert whole.weight == pytest.approx(weights, rel=1e-9)
    assert forecast.value == pytest.approx(mean, rel=1e-9)
    assert forecast.std == pytest.approx(math.sqrt(spread + known), rel=1e-9)


def chances(y, u=1.0):
    """Weights of the three causes for equal steps of a quarter of a year."""
    found = outlook(of_days(np.arange(len(y)) / 4, y, np.full(len(y), u**2)))
    return [found.weight[found.cause == cause].sum() for cause in range(3)]


def test_what_the_scatter_shows_decides():
    rng = np.random.default_rng(7)
    t = np.arange(40) / 4
    assert chances(rng.normal(0, 5, 40))[0] > 0.5
    assert chances(5 * np.cumsum(rng.normal(0, 1, 40)))[1] > 0.6
    assert chances(50 * (1 - np.exp(-t / 3)) + rng.normal(0, 0.5, 40), 0.5)[2] > 0.9


def test_a_history_that_shows_nothing_decides_nothing():
    assert chances(np.random.default_rng(1).normal(0, 1, 8)) == pytest.approx([1 / 3] * 3, abs=0.1)


def test_the_interval_grows_with_the_horizon_and_needs_three_days():
    whole = outlook(of_days(np.arange(12) / 4, np.random.default_rng(2).normal(0, 1, 12), np.ones(12)))
    widths = [whole.at(2.75 + ahead).std for ahead in (0.1, 0.5, 1.0, 3.0)]
    assert np.all(np.diff(widths) > 0)
    with pytest.raises(ArgumentError, match="three days"):
        outlook(of_days(np.arange(2.0), np.arange(2.0), np.ones(2)))
