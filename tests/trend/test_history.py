"""Trends: what is shared, drift, forecasts, control chart, words; coverage by simulation (slow)."""

from __future__ import annotations

import datetime as dt
import math

import numpy as np
import pytest
from scipy import stats

from piga.errors import ArgumentError
from piga.records.calibration.coefficient import NO_REFERENCE
from piga.trend.history import YEAR, Forecast, find_trend
from piga.trend.trend_line import moving_average
from tests.chance import assert_variance
from tests.trend.campaign import COURSES, SCENARIOS, covered, simulate
from tests.trend.history import START, history, record


def test_drift_is_least_squares_with_student():
    rng = np.random.default_rng(1)
    t = np.arange(8) * 0.5
    y = 1.6e-3 + 2e-6 * t + rng.normal(0, 1e-6, 8)
    trend = find_trend(history(t, y, 4e-7))["k0"]
    fit = stats.linregress(t, y)
    assert trend.drift.value == pytest.approx(fit.slope, rel=1e-9)
    assert trend.drift.half_width() == pytest.approx(fit.stderr * stats.t.ppf(0.975, 6), rel=1e-9)
    assert trend.day_to_day == pytest.approx(
        math.sqrt(np.sum((y - fit.intercept - fit.slope * t) ** 2) / 6 - 1.6e-13)
    )
    assert math.isnan(trend.turn_on)


def test_prediction_interval_of_the_textbook():
    """A further record: ``s^2 (1 + 1/n + (t - mean)^2/S)`` with Student's t."""
    rng = np.random.default_rng(2)
    t = np.arange(10) * 0.3
    y = rng.normal(0, 1, 10)
    trend = find_trend(history(t, y, 0.3))["k0"]
    fit = stats.linregress(t, y)
    s2 = np.sum((y - fit.intercept - fit.slope * t) ** 2) / 8
    forecast = trend.line.record_at(4.0, 0.3, trend.last_shared)
    expected = s2 * (1 + 0.1 + (4.0 - t.mean()) ** 2 / np.sum((t - t.mean()) ** 2))
    assert forecast.std**2 == pytest.approx(expected, rel=1e-6)
    assert forecast.degrees_of_freedom == pytest.approx(8.0)
    assert forecast.value == pytest.approx(fit.intercept + 4 * fit.slope, rel=1e-6)


def test_shared_type_b_is_not_averaged_away_and_cancels_in_drift():
    rng = np.random.default_rng(3)
    t = np.arange(25) * 0.2
    y = rng.normal(0, 1e-6, 25)
    shared = {"reference_scale": {"k0": 5e-6}}
    std = math.hypot(1e-6, 5e-6)
    trend = find_trend(history(t, y, std, common=shared))["k0"]
    assert trend.points[0].own == pytest.approx(1e-6)
    assert trend.coefficient_at(2.4).std > 5e-6
    assert trend.next_record(2.4).std < 1.6e-6
    assert trend.drift.std < 5e-7
    own = find_trend(history(t, y, std, common=shared), common=0.0)["k0"]
    assert own.points[0].own == pytest.approx(std)
    assert own.coefficient_at(2.4).std < 3e-6
    part = find_trend(history(t, y, std, common=shared), common={"reference_scale": 0.25})["k0"]
    assert part.points[0].own == pytest.approx(math.sqrt(1e-12 + 0.75 * 25e-12))
    assert 2.5e-6 < part.coefficient_at(2.4).std < 3.5e-6


def test_what_is_set_anew_in_each_test_is_a_records_own():
    rng = np.random.default_rng(3)
    t = np.arange(25) * 0.2
    y = rng.normal(0, 5e-6, 25)
    std = math.hypot(1e-6, 5e-6)
    for source in ("angle_repeatability", "levelling_repeatability axis 1"):
        entries = history(t, y, std, common={source: {"k0": 5e-6}})
        trend = find_trend(entries)["k0"]
        assert trend.points[0].own == pytest.approx(std)
        assert not trend.last_shared.any()
        named = find_trend(entries, common={source: 1.0})["k0"]
        assert named.points[0].own == pytest.approx(1e-6)


def test_a_shared_error_that_grows_is_part_of_the_drift():
    entries = [
        (
            f"r{i}",
            START + dt.timedelta(days=100 * i),
            record({"k0": 1e-3}, {"k0": 2e-6}, {"arm": {"k0": 1e-6 * i}}),
        )
        for i in range(5)
    ]
    drift = find_trend(entries)["k0"].drift
    assert drift.std == pytest.approx(1e-6 * 365.25 / 100, rel=1e-6)


def test_turn_on_and_day_to_day_are_told_apart():
    rng = np.random.default_rng(4)
    days, per_day = 60, 4
    day_effect, t, y = rng.normal(0, 3.0, days), [], []
    for day in range(days):
        for run in range(per_day):
            t.append(day * 36 / 365.25 + run * 2e-4)
            y.append(10.0 + day_effect[day] + rng.normal(0, 1.5) + rng.normal(0, 0.5))
    trend = find_trend(history(t, y, 0.5))["k0"]
    within = trend.turn_on**2 + 0.5**2
    assert_variance(within / (1.5**2 + 0.5**2), days * (per_day - 1), "turn-on")
    between = trend.day_to_day**2 + within / per_day
    assert_variance(between / (3.0**2 + (1.5**2 + 0.5**2) / per_day), days - 2, "day to day")
    assert trend.line.degrees_of_freedom == days - 2
    line = between * (1.0 / days + (6.0 - np.mean(t)) ** 2 / (days * np.var(t)))
    own = trend.day_to_day**2 + trend.turn_on**2 + 0.5**2
    unclear = 0.5 * between * math.sqrt(2.0 / (days - 2))  # half the standard uncertainty of tau^2, at most
    forecast = trend.line.record_at(6.0, 0.5, trend.last_shared)
    assert own + line <= forecast.std**2 * (1.0 + 1e-9) <= own + line + unclear


def test_an_outlier_and_a_shift_raise_alarms_in_words():
    rng = np.random.default_rng(5)
    t = np.arange(24) / 12.0
    y = 1.6e-3 + rng.normal(0, 1e-6, 24)
    y[14] += 1.2e-5
    trend = find_trend(history(t, y, 1e-6))
    assert any("r14" in alarm and "standard deviations above" in alarm for alarm in trend.alarms)
    assert any(f"shows {1e6 * y[14]:.1f} ug," in alarm for alarm in trend.alarms)
    assert trend.judged == 21
    assert not any("r13" in alarm for alarm in trend.alarms)
    exact = find_trend(history(t[:6], [1.0, 1.0, 1.0, 1.0, 1.5, 1.0], 1e-9))
    assert any("record r4 of" in alarm and "shows 1.5000" in alarm for alarm in exact.alarms)
    assert exact["k0"].coefficient_at(1.0).std > 0.1
    t = np.arange(36) / 12.0
    shifted = 1.6e-3 + np.random.default_rng(3).normal(0, 1e-6, 36)
    shifted[26:] -= 4e-6
    alarms = find_trend(history(t, shifted, 1e-6)).alarms
    assert any("below" in alarm and "moving average" in alarm for alarm in alarms)


def test_a_step_early_in_a_history_alarms():
    """Record 4 of 12, ten standard uncertainties: the line of the first three days cannot say it, the whole history can."""
    rng = np.random.default_rng(5)
    y = 1.6e-3 + rng.normal(0, 1e-6, 12)
    y[3:] += 1e-5
    trend = find_trend(history(np.arange(12) / 4, y, 1e-6))
    step = trend["k0"].step
    assert any("(record r3) on the values are" in alarm and "higher" in alarm for alarm in trend.alarms)
    assert step.probability < 1e-3
    assert abs(step.size - 1e-5) < 3 * step.std < 1e-5
    assert trend["k0"].drift.value > trend["k0"].drift.half_width()
    assert not trend["k0"].drifts
    assert not any("drifts" in remark or "scatter" in remark for remark in trend.remarks)
    y[3:] -= 2e-5
    assert any("lower than a line" in alarm for alarm in find_trend(history(np.arange(12) / 4, y, 1e-6)).alarms)


def test_a_quiet_history_raises_none():
    rng = np.random.default_rng(6)
    trend = find_trend(history(np.arange(20) / 10, 1e-3 + rng.normal(0, 1e-6, 20), 1e-6))
    assert trend.alarms == ()
    assert trend.remarks == (f"20 of 20 records: {NO_REFERENCE}.",)


def test_remarks():
    trend = find_trend(history([0, 0.5], [1.0, 2.0], 0.1))
    assert any("need three days" in remark for remark in trend.remarks)
    assert any("shows 1.00e6 ug more than the first, 7.1 standard" in remark for remark in trend.remarks)
    assert not any("than the first" in r for r in find_trend(history([0, 0.5], [1.0, 1.3], 0.1)).remarks)
    assert trend["k0"].drift is None
    assert trend.judged == 0
    with pytest.raises(ArgumentError, match="at least three days"):
        trend["k0"].next_record(1.0)
    t = np.arange(12) / 4
    assert any("k0 drifts by 1" in r for r in find_trend(history(t, t, 0.01)).remarks)
    rng = np.random.default_rng(1)
    wild = find_trend(history(t, rng.normal(0, 1, 12), 0.01)).remarks
    assert any("times as much" in r for r in wild)
    calm = find_trend(history(t, rng.normal(0, 1, 12), 30.0)).remarks
    assert any("scatter less" in r for r in calm)
    assert any("extrapolation" in r for r in find_trend(history(t / 100, rng.normal(0, 1, 12), 1.0)).remarks)


def test_refusals():
    one = history([0.0], [1.0], 0.1)
    with pytest.raises(ArgumentError, match="at least two records"):
        find_trend(one)
    other = [("x", START, record({"k0": 1.0}, {"k0": 0.1}, serial="Z"))]
    with pytest.raises(ArgumentError, match="different instruments: G-0417, Z"):
        find_trend(one + other)
    with pytest.raises(ArgumentError, match="given twice"):
        find_trend(one + one)
    with pytest.raises(ArgumentError, match="no time zone"):
        find_trend([*one, ("y", dt.datetime(2024, 1, 1), record({"k0": 1.0}, {"k0": 0.1}))])
    with pytest.raises(ArgumentError, match="not between 0 and 1"):
        find_trend(history([0, 1], [1.0, 1.0], 0.1), common=1.5)


def test_phases_are_left_out_and_order_does_not_matter():
    rng = np.random.default_rng(7)
    values = [{"tan_beta": 3e-4 + rng.normal(0, 1e-7), "phi": rng.uniform(-3, 3), "k0": 1e-3} for _ in range(5)]
    entries = [
        (f"r{i}", START + dt.timedelta(days=30 * i), record(v, {"tan_beta": 1e-7, "phi": 1e-3, "k0": 1e-6}))
        for i, v in enumerate(values)
    ]
    result = find_trend(entries)
    assert [trend.key for trend in result.coefficients] == ["tan_beta", "k0"]
    again = find_trend(entries[::-1])
    assert again.records == result.records
    assert again["tan_beta"].drift == result["tan_beta"].drift
    assert result.years(START + dt.timedelta(seconds=YEAR)) == pytest.approx(1.0)


def test_moving_average_limits_by_simulation():
    """Standard deviation of the average of independent scores is its limit over three."""
    scores = np.random.default_rng(9).standard_normal((4000, 12)).clip(-3, 3)
    ends = np.array([moving_average(row)[0][-1] for row in scores])
    assert ends.std() == pytest.approx(moving_average(scores[0])[1][-1] / 3, rel=0.04)
    average, limit = moving_average(np.array([math.nan, 1.0]))
    assert math.isnan(average[0])
    assert average[1] == pytest.approx(0.2)
    assert limit[1] == pytest.approx(0.6)


@pytest.mark.slow
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_coverage(scenario):
    drift, coefficient, further = covered(scenario, 300, 11)
    assert math.isnan(drift) or 0.92 < drift < 0.975
    assert coefficient > 0.9 if scenario in COURSES else coefficient > 0.93
    assert further > 0.9 if scenario in COURSES else further > 0.93


@pytest.mark.slow
def test_false_alarms():
    """In control, at most one value in 370 is beyond three standard deviations; the average alarms as rarely."""
    rng = np.random.default_rng(12)
    outside = scored = shifted = 0
    stepped = 0
    for _ in range(300):
        entries, *_ = simulate(rng, 20, 1, 1.0, 0.0, 1.0, 0.0, drift=0.3)
        trend = find_trend(entries)["k0"]
        outside += sum(point.outside for point in trend.points)
        scored += sum(point.forecast is not None for point in trend.points)
        shifted += int((np.abs(trend.average) > trend.limit).sum())
        stepped += trend.stepped
    assert 0.0003 < outside / scored < 0.0035
    assert shifted / scored < 0.008
    assert stepped <= 5  # 0.27 % of 300, Poisson


def test_the_score_of_a_value_is_the_normal_number_of_its_probability() -> None:
    forecast = Forecast(0.0, 10.0, 2.0, math.inf)
    assert forecast.score(14.0) == 2.0
    few = Forecast(0.0, 10.0, 2.0, 4.0)
    # Student, 4 degrees: 2.776 at 97.5 %; normal: 1.960
    assert few.score(10.0 + 2.0 * 2.776445) == pytest.approx(1.959964, abs=1e-5)
    assert few.score(10.0 - 2.0 * 2.776445) == pytest.approx(-1.959964, abs=1e-5)
    assert few.half_width() == pytest.approx(2.0 * 2.776445, rel=1e-6)
