"""What is left: what whole counts leave in the whitened residuals, told from what a model misses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.constant_force import tumble

import piga
from piga.records.calibration.diagnostics import COUNTED
from piga.units import G0
from tests.calibration.made.scenarios import SCENARIOS
from tests.calibration.made.synthetic import TERMS, record

COUNT = 2.0 * np.pi / 72000
compiled = pytest.mark.long


def counted(seed: int, **options: float) -> piga.Run:
    return record(np.random.default_rng(seed), white=1e-6, count_angle=COUNT, **options)


@compiled
def test_what_rounding_correlates_is_not_tested_and_no_doubt() -> None:
    calibration = piga.calibrate(counted(31), TERMS)
    tests = calibration.diagnostics
    assert tests.ljung_box_probability < 1e-9
    assert tests.verdict == COUNTED
    assert not tests.advice
    assert any("rounding to whole counts can correlate them" in said for said in calibration.verdict.not_tested)
    assert not any("correlate" in held for held in calibration.verdict.tested)
    assert not any("correlate" in doubt.what for doubt in calibration.verdict.doubts)


@compiled
@pytest.mark.parametrize("left_out", ["m_Y", "k2", "k0"])
def test_what_the_model_misses_is_seen_beside_the_counts(left_out: str) -> None:
    calibration = piga.calibrate(counted(31), [term for term in TERMS if term != left_out])
    assert any(f"missing term: {left_out} = " in said for said in (*calibration.notes, *calibration.remarks))


@compiled
@pytest.mark.parametrize("options", [{"white": 2.5e-5}, {"white": 0.8 * COUNT, "count_angle": COUNT}])
def test_noise_that_is_larger_than_a_count_is_no_excuse(options: dict[str, float]) -> None:
    run = record(np.random.default_rng(32), **options)
    calibration = piga.calibrate(run, [term for term in TERMS if term != "tan_beta"])
    assert any("not white" in said for said in (*calibration.verdict.tested, *calibration.notes))
    assert calibration.diagnostics.verdict != COUNTED


@compiled
def test_several_runs() -> None:
    """One count is stated, one is seen in the angles."""
    runs = [counted(33), replace(counted(34), resolution=0.0)]
    assert piga.calibrate(runs, TERMS).diagnostics.verdict == COUNTED
    both = [runs[0], record(np.random.default_rng(34), white=2.5e-5)]
    assert piga.calibrate(both, TERMS).diagnostics.verdict == COUNTED  # the counts of one are enough


def whole_counts(angles: tuple[float, ...], rate: float) -> piga.Run:
    """Positions of a minute on a head, each with an own zero of the counter (36 000 counts), without coupling."""
    inside, scale, rng = np.arange(0.0, 60.0, 1.0 / rate), 0.8884 / G0, np.random.default_rng(3)
    a_x = G0 * np.cos(np.radians(angles))
    angle = scale * a_x[:, None] * inside + rng.uniform(0.0, 1.0, a_x.size)[:, None]
    angle += np.cumsum(1e-6 * rng.standard_normal(angle.shape), axis=1)
    output = np.round(angle / (2.0 * np.pi) * 36000) * (2.0 * np.pi / 36000)
    f = np.zeros((output.size, 3))
    f[:, 0] = np.repeat(a_x, inside.size)
    segment = np.repeat(np.arange(a_x.size), inside.size)
    t = np.add.outer(65.0 * np.arange(a_x.size), inside).ravel()
    return piga.Run.from_arrays(
        t, output.ravel(), f, scale_factor="0.8884 rad/s/g", segment=segment, units="SI"
    )


@compiled
def test_nearly_whole_counts_in_each_sample_are_no_missing_term() -> None:
    """At 45 degrees the output turns by 179.96 counts of 36 000 in each twentieth of a second."""
    run = whole_counts((0.0, 45.0, 135.0, 180.0, 225.0, 315.0, 20.0, 160.0), 20.0)
    result = piga.calibrate(run, ["scale_factor", "k0"])
    assert result.diagnostics.verdict == COUNTED
    assert not result.diagnostics.missing_terms


@compiled
@pytest.mark.parametrize("seed", [1, 4, 7])
def test_scatter_that_counts_make_is_no_doubt(seed: int) -> None:
    """3600 counts at 10 Hz: in some positions the output turns by nearly whole counts in each sample."""
    test = replace(SCENARIOS["coarse"], forces=tumble(24), seconds=60.0)
    result = test.calibrate(test.record(np.random.default_rng(seed)))
    assert not any("scatter" in doubt.what for doubt in result.verdict.doubts)


@compiled
def test_swapped_axes_of_a_coarse_record_are_named() -> None:
    """Little tells them, less than a count: other readings are tried wherever residuals correlate."""
    run = record(np.random.default_rng(3), white=2e-6, count_angle=2.0 * np.pi / 10_000)
    result = piga.calibrate(replace(run, f=np.ascontiguousarray(run.f[:, [0, 2, 1]])), TERMS)
    assert any("swapped" in words for words in result.diagnostics.advice)
