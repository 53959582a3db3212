"""Ticks of every range: round, inside, in order, and labelled with what they are."""

from __future__ import annotations

import datetime as dt
import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from piga.reports.render.figure import Axis
from piga.reports.render.scales import Scale, Ticks, axis_label, axis_ticks, extent, fitting_ticks
from tests.reports.render.test_scene import value_of

PLAIN, LOG, DATE = Axis("angle", "rad"), Axis("angle", "rad", log=True), Axis("date", "", dates=True)


def checked(axis: Axis, low: float, high: float, ticks: Ticks) -> None:
    """Ticks lie inside and in order; each label, with what the axis label adds, is the value."""
    spread = high - low
    assert np.all(np.diff(ticks.at) > 0.0)
    assert np.all((ticks.at >= low - 1e-6 * spread) & (ticks.at <= high + 1e-6 * spread))
    assert len(set(ticks.words)) == len(ticks.words) == ticks.at.size
    for at, word in zip(ticks.at.tolist(), ticks.words, strict=True):
        value = value_of(word)
        assert value is not None, word
        stated = ticks.origin + value * 10.0**ticks.exponent
        # A label is exact but for the rounding of the floats that the range is made of.
        assert stated == pytest.approx(at, rel=1e-9, abs=1e-6 * spread if not axis.log else 0.0)


@example(10.0, 0.6021, 4)
@given(st.floats(-1e12, 1e12), st.floats(-9.0, 12.0), st.integers(2, 10))
def test_linear(middle: float, size: float, most: int) -> None:
    half = 10.0**size
    half = max(half, 1e-9 * abs(middle))
    low, high = middle - half, middle + half
    ticks = axis_ticks(PLAIN, Scale(low, high, 0.0, 1.0), most)
    checked(PLAIN, low, high, ticks)
    assert 1 <= ticks.at.size <= most + (most >= 4)
    if most >= 4:
        assert ticks.at.size >= 2
    assert max(map(len, ticks.words)) <= 12
    if ticks.at.size > 1:
        step = float(ticks.at[1] - ticks.at[0])
        assert f"{step:.2e}"[:4] in ("1.00", "2.00", "5.00")


@given(st.floats(-20.0, 20.0), st.floats(0.02, 30.0), st.integers(2, 10))
def test_logarithmic(low: float, decades: float, most: int) -> None:
    low, high = 10.0**low, 10.0 ** (low + decades)
    ticks = axis_ticks(LOG, Scale(low, high, 0.0, 1.0, log=True), most)
    checked(LOG, low, high, ticks)
    assert ticks.at.size <= most + 1
    if most >= 4:
        assert ticks.at.size >= 2
    assert np.all((ticks.minor >= low * 0.999) & (ticks.minor <= high * 1.001))


@given(st.floats(-10000.0, 60000.0), st.floats(-3.5, 4.5), st.integers(3, 10))
def test_dates(low: float, size: float, most: int) -> None:
    """Each is a whole date (a time of day for seconds) at the place of that moment, UTC."""
    high = low + 10.0**size
    ticks = axis_ticks(DATE, Scale(low, high, 0.0, 1.0), most)
    assert 1 <= ticks.at.size <= most
    assert np.all(np.diff(ticks.at) > 0.0)
    assert np.all((ticks.at >= low) & (ticks.at <= high))
    for at, word in zip(ticks.at.tolist(), ticks.words, strict=True):
        moment = dt.datetime(1970, 1, 1, tzinfo=dt.UTC) + dt.timedelta(seconds=round(at * 86400.0))
        if len(word) == len("12:00:00"):
            assert word == f"{moment:%H:%M:%S}"
        else:
            whole = word + "2000-01-01 00:00"[len(word) :] if len(word) < 16 else word
            assert f"{moment:%Y-%m-%d %H:%M}" == whole


@pytest.mark.parametrize(
    ("axis", "low", "high", "words"),
    [
        (PLAIN, 0.0, 1.0, ("0.0", "0.2", "0.4", "0.6", "0.8", "1.0")),
        (PLAIN, -14000.0, 21000.0, ("−10\u202f000", "0", "10\u202f000", "20\u202f000")),
        (Axis("angle", "deg"), 0.0, 360.0, ("0", "90", "180", "270", "360")),
        (LOG, 0.02, 700.0, ("0.1", "1", "10", "100")),
        (LOG, 0.3, 4.0, ("0.5", "1", "2")),
        (LOG, 1.01e-9, 1.01e-5, ("10⁻⁸", "10⁻⁷", "10⁻⁶", "10⁻⁵")),
        (LOG, 1.2e-7, 3e-7, ("150", "200", "250", "300")),
        (LOG, 1.2e-7, 8e-7, ("2\u00a0×\u00a010⁻⁷", "5\u00a0×\u00a010⁻⁷")),
        (DATE, 19000.0, 19800.0, ("2022-07", "2023-01", "2023-07", "2024-01")),
        (DATE, 19000.6, 19001.4, ("2022-01-08 18:00", "2022-01-09 00:00", "2022-01-09 06:00")),
    ],
)
def test_examples(axis: Axis, low: float, high: float, words: tuple[str, ...]) -> None:
    ticks = axis_ticks(axis, Scale(low, high, 0.0, 1.0, axis.log), 6)
    assert ticks.words == words


def test_labels_have_room() -> None:
    """The wider the labels, the fewer there are; two never touch."""
    scale, counts = Scale(0.0, 10.0, 0.0, 300.0), []
    for letter in (2.0, 8.0, 25.0, 60.0):
        ticks = fitting_ticks(PLAIN, scale, lambda word, letter=letter: letter * len(word), 8.0)  # type: ignore[misc]
        widths = np.array([letter * len(word) for word in ticks.words])
        counts.append(ticks.at.size)
        if counts[-1] > 2:
            assert np.all(np.diff(scale.place(ticks.at)) >= 0.5 * (widths[1:] + widths[:-1]) + 8.0)
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > counts[-1]


def test_whole_numbers_have_no_ticks_between() -> None:
    for high in (1.2, 2.5, 7.0, 40.0):
        ticks = axis_ticks(Axis("set", "1"), Scale(0.5, high, 0.0, 1.0), 8, whole=True)
        assert np.array_equal(ticks.at, np.round(ticks.at))
        assert ticks.at.size


@pytest.mark.parametrize(
    ("axis", "values", "expected"),
    [
        (PLAIN, [np.array([1.0, 3.0])], (0.92, 3.08)),
        (PLAIN, [np.array([5.0, np.nan, 5.0])], (4.75, 5.25)),
        (PLAIN, [np.array([0.0])], (-1.0, 1.0)),
        (PLAIN, [np.array([np.inf, np.nan])], (0.0, 1.0)),
        (PLAIN, [], (0.0, 1.0)),
        (LOG, [np.array([-1.0, 0.0])], (1.0, 10.0)),
        (LOG, [np.array([-5.0, 1.0, 100.0])], (10.0**-0.08, 10.0**2.08)),
        (Axis("a", "1", limits=(2.0, 3.0)), [np.array([9.0])], (2.0, 3.0)),
        (Axis("a", "1", limits=(math.nan, 3.0)), [np.array([1.0, 3.0])], (0.92, 3.08)),
        (Axis("a", "1", log=True, limits=(0.0, 3.0)), [np.array([1.0, 100.0])], (10.0**-0.08, 10.0**2.08)),
        (Axis("a", "1", limits=(3.0, 3.0)), [np.array([1.0, 3.0])], (0.92, 3.08)),
    ],
)
def test_range_that_is_shown(axis: Axis, values: list[np.ndarray], expected: tuple[float, float]) -> None:
    assert extent(axis, values) == pytest.approx(expected)


def test_the_ends_of_the_range_lie_at_the_ends_of_the_axis() -> None:
    for log in (False, True):
        scale = Scale(0.5, 80.0, 300.0, 20.0, log)
        assert scale.place([0.5, 80.0]) == pytest.approx([300.0, 20.0])
        assert np.isnan(scale.place([np.nan, np.inf])).all()


def test_bars_begin_at_zero() -> None:
    assert extent(PLAIN, [np.array([1.0, 3.0])], from_zero=True)[0] == 0.0
    assert extent(PLAIN, [np.array([-1.0, 3.0])], from_zero=True)[0] < -1.0


def test_an_axis_label_without_power_is_as_it_was() -> None:
    ticks = axis_ticks(PLAIN, Scale(0.0, 1.0, 0.0, 1.0), 5)
    assert axis_label(PLAIN, ticks) == "angle [rad]"
