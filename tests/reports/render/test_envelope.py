import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from piga.reports.render.envelope import envelope_rows

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


def test_every_bucket_with_a_gap_keeps_a_gap():
    y = np.sin(np.linspace(0, 50, 100_000))
    holes = [20_000, 20_001, 71_234]
    y[holes] = np.nan
    rows = envelope_rows(y)
    assert np.isnan(y[rows]).sum() == 2
    between = rows[(rows > 20_001) & (rows < 71_234)]
    assert between.size > 500
