"""What is left: lagged products, and what whole counts leave in the whitened residuals, told from what a model misses."""

from __future__ import annotations

import numpy as np
import pytest

import piga
from piga.calibration.fit.residuals import LAG_PART, WHITENESS, add_lagged_products, counting_probability
from piga.records.calibration.verdict import COUNTED
from tests.calibration.made.synthetic import TERMS, record

COUNT = 2.0 * np.pi / 72000


compiled = pytest.mark.only_compiled


def counted(seed: int, **options: float) -> piga.Run:
    return record(np.random.default_rng(seed), white=1e-6, count_angle=COUNT, **options)


@compiled
def test_the_lines_of_whole_counts_are_no_doubt() -> None:
    calibration = piga.calibrate(counted(31), TERMS)
    tests = calibration.diagnostics
    assert tests.ljung_box_probability < 1e-9
    assert tests.verdict == COUNTED
    assert tests.counting_probability > 1e-3
    words = "correlate as whole counts make them"
    assert any(words in held for held in calibration.verdict.tested)
    assert not any("not white" in doubt.words for doubt in calibration.verdict.doubts)


@compiled
@pytest.mark.parametrize("left_out", ["m_Y", "k2", "k0"])
def test_what_the_model_misses_is_seen_beside_the_counts(left_out: str) -> None:
    calibration = piga.calibrate(counted(31), [term for term in TERMS if term != left_out])
    assert calibration.diagnostics.counting_probability < 1e-6
    assert any("not white" in doubt.words for doubt in calibration.verdict.doubts)


@compiled
def test_a_record_without_counts_has_no_such_excuse() -> None:
    run = record(np.random.default_rng(32), white=2.5e-5)
    calibration = piga.calibrate(run, [term for term in TERMS if term != "m_Y"])
    assert calibration.diagnostics.counting_probability is None
    assert any("not white" in doubt.words for doubt in calibration.verdict.doubts)


@compiled
def test_several_runs() -> None:
    runs = [counted(seed) for seed in (33, 34)]
    tests = piga.calibrate(runs, TERMS).diagnostics
    assert tests.verdict == COUNTED
    alone = [run if run is runs[0] else record(np.random.default_rng(34), white=2.5e-5) for run in runs]
    assert piga.calibrate(alone, TERMS).diagnostics.verdict != COUNTED


def test_the_probability_is_even_where_counting_is_all() -> None:
    """Correlations of one kind, with means of their own: the data are one of them."""
    rng = np.random.default_rng(35)
    middle = 0.1 * rng.standard_normal(WHITENESS.lags)

    def products(shift: float) -> np.ndarray:
        correlation = middle + 0.006 * rng.standard_normal((1 + WHITENESS.draws, WHITENESS.lags))
        correlation[0] += shift
        return 28_800 * np.hstack([np.ones((1 + WHITENESS.draws, 1)), correlation])

    result = np.array([counting_probability((lambda: products(0.0),)) for _ in range(400)])
    assert np.mean(result < 0.05) == pytest.approx(0.05, abs=0.035)
    assert np.mean(result < 0.5) == pytest.approx(0.5, abs=0.08)
    assert counting_probability((lambda: products(0.02),)) < 1e-6
    assert np.isnan(counting_probability((lambda: products(0.0), lambda: None)))


@pytest.mark.compiled
def test_lagged_products() -> None:
    x = np.random.default_rng(9).standard_normal(2 * LAG_PART + 2)
    out = np.zeros(4)
    add_lagged_products(x, out)
    np.testing.assert_allclose(out, [x[k:] @ x[: x.size - k] for k in range(4)], rtol=1e-12, atol=1e-10)
