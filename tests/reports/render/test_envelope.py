import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from piga.reports.render.envelope import envelope_rows
from piga.reports.render.figure import Plot

CURVES = arrays(
    float, st.integers(1, 400), elements=st.one_of(st.floats(-1e6, 1e6), st.sampled_from([np.nan, np.inf]))
)


@given(CURVES, st.integers(8, 60))
def test_extremes_and_ends_stay_and_the_limit_holds(y, limit):
    rows = envelope_rows(y, limit)
    assert rows.size <= max(limit, min(y.size, limit))
    assert np.all(np.diff(rows) > 0)
    assert rows[0] == 0
    assert rows[-1] == y.size - 1
    finite = y[np.isfinite(y)]
    kept = y[rows][np.isfinite(y[rows])]
    if finite.size:
        assert kept.min() == finite.min()
        assert kept.max() == finite.max()


def test_one_spike_in_a_million_rows_is_kept():
    y = np.zeros(1_000_000)
    y[654_321], y[123_456] = 7.0, -5.0
    plot = Plot("spike", "A spike.", "row", "value").line(
        np.arange(y.size), y, "rows", rows=np.arange(y.size) + 1
    )
    series = plot.caption("").panels[0].series[0]
    x, shown = series.arrays()
    assert x.size <= 2000
    assert np.asarray(series.rows).tolist() == (x + 1).tolist()
    assert x[shown == 7.0] == 654_321
    assert x[shown == -5.0] == 123_456


def test_every_bucket_with_a_gap_keeps_a_gap():
    y = np.sin(np.linspace(0, 50, 100_000))
    holes = [20_000, 20_001, 71_234]
    y[holes] = np.nan
    rows = envelope_rows(y)
    assert np.isnan(y[rows]).sum() == 2
    between = rows[(rows > 20_001) & (rows < 71_234)]
    assert between.size > 500


@pytest.mark.parametrize("size", [1, 7, 2000])
def test_short_curves_stay_whole(size):
    assert envelope_rows(np.arange(size)).tolist() == list(range(size))
