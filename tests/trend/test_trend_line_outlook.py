"""The averaged forecast: against formulas of one model, and what a walk and ageing do to it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from piga.errors import ArgumentError
from piga.trend.trend_line import CAUSES, outlook
from tests.trend.test_trend_line import of_days


def test_each_model_predicts_by_generalised_least_squares():
    """Each model alone, against the joint normal equations of days and forecast (Lagrange form of the best prediction)."""
    rng = np.random.default_rng(3)
    t = np.sort(rng.uniform(0, 4, 7))
    v, shared = rng.uniform(0.5, 2.0, 7), rng.normal(0, 1, (2, 7))
    days = of_days(t, rng.normal(0, 2, 7), v, shared=shared)
    whole = outlook(days)
    since, ahead = t - t[0], np.array([5.0 - t[0]])
    values, variances, weights, on_days = [], [], [], np.zeros(7)
    for model in whole.models:
        shape = CAUSES[model.cause]
        covariance = np.diag(v + model.still) + model.moving * shape(since, since)
        beside = model.moving * shape(since, ahead)[:, 0]
        X = np.stack([np.ones(7), t], axis=1)
        system = np.block([[covariance, X], [X.T, np.zeros((2, 2))]])
        solution = np.linalg.solve(system, np.concatenate([beside, [1.0, 5.0]]))
        own = model.still + model.moving * shape(ahead, ahead)[0, 0] + 0.3
        values.append(solution[:7] @ days.means)
        variances.append(own + solution[:7] @ covariance @ solution[:7] - 2 * solution[:7] @ beside)
        weights.append(model.weight)
        on_days += model.weight * solution[:7]
    mean = np.dot(weights, values)
    common = np.array([0.2, -0.4])
    known = np.sum((on_days @ shared.T - common) ** 2)
    spread = np.dot(weights, np.array(variances) + (np.array(values) - mean) ** 2)
    forecast = whole.at(5.0, 0.3, common)
    assert sum(weights) == pytest.approx(1.0)
    assert forecast.value == pytest.approx(mean, rel=1e-9)
    assert forecast.std == pytest.approx(math.sqrt(spread + known), rel=1e-9)


def chances(y, u=1.0):
    """Weights of the three causes for equal steps of a quarter of a year."""
    models = outlook(of_days(np.arange(len(y)) / 4, y, np.full(len(y), u**2))).models
    return [sum(model.weight for model in models if model.cause == cause) for cause in range(3)]


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
