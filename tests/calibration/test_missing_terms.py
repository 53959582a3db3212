"""Missing terms are found by their signature, errors of single positions and right models are left alone."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.constant_force import tumble

import piga
from piga.records.run_file import UncertaintyTable
from piga.units import G0
from tests.calibration.made.independent import Bench, head
from tests.calibration.made.scenarios import COUPLED, EVERYWHERE, SCENARIOS, Scenario, with_term
from tests.calibration.made.synthetic import record

pytestmark = pytest.mark.long

SIZES = {
    "k2": 2e-4, "k3": 2e-4, "k2o": 2e-4, "m_Y": 2e-4, "m_Z": 2e-4, "k_XY": 2e-4, "k_XZ": 2e-4, "k_YY": 2e-4,
    "k_ZZ": -2e-4, "k_YZ": 2e-4, "k0_t": 3e-7, "s1": 4e-4, "c2": 4e-4,
}  # fmt: skip


def assert_first_is(calibration, name):
    """The first suggestion is the term, of its true size."""
    first = calibration.diagnostics.missing_terms[0]
    assert name in first.terms
    at = first.terms.index(name)
    miss = abs(first.estimate[at] - SIZES[name]) / first.standard_uncertainty[at]
    assert miss < 5.0
    assert first.standard_uncertainty[at] < 0.1 * abs(SIZES[name])


@pytest.mark.parametrize("name", SIZES)
def test_every_signature_is_recognised(name):
    run = with_term(EVERYWHERE.record(np.random.default_rng(4)), name, SIZES[name])
    calibration = piga.calibrate(run, COUPLED)
    assert_first_is(calibration, name)
    moves = max(missing.largest_shift for missing in calibration.diagnostics.missing_terms)
    said = calibration.notes if moves > 1.0 else calibration.remarks
    assert any("signature of a missing term" in note and name in note for note in said)
    assert name not in [c.name for c in calibration.coefficients]


def test_of_terms_that_explain_the_same_the_first_of_the_table_is_named():
    """With a bias, ``k2`` and ``k_YY`` of a tumble in one plane are one column: rounding does not choose."""
    for seed in range(12):
        run = with_term(record(np.random.default_rng(seed), levels=(1.0,), rate=4.0), "k2", SIZES["k2"])
        first = piga.calibrate(run, ["scale_factor", "tan_beta", "k0", "m_Y"]).diagnostics.missing_terms[0]
        assert (first.terms, first.alike[0]) == (("k2",), "k_YY")


@pytest.mark.parametrize("name", ["k2", "m_Y", "k_XY", "c2"])
def test_several_runs_name_a_signature_too(name):
    runs = [
        with_term(EVERYWHERE.record(np.random.default_rng(seed)), name, size)
        for seed, size in ((4, SIZES[name]), (5, SIZES[name]), (6, 0.0), (7, 0.0))
    ]
    other = piga.RunSummary.of(runs[1], COUPLED)
    for pair in (runs[:2], [runs[0], other] if name != "c2" else runs[:2]):
        together = piga.calibrate(pair, COUPLED)
        assert_first_is(together, name)
        assert any("missing term" in words and name in words for words in (*together.notes, *together.remarks))
    sound = piga.calibrate(runs[2:], COUPLED)
    assert sound.diagnostics.missing_terms == ()


def test_a_term_that_moves_nothing_by_more_than_u_is_no_doubt():
    run = with_term(EVERYWHERE.record(np.random.default_rng(4)), "k2", 2e-4)
    wide = replace(run, uncertainty=UncertaintyTable(reference_scale="0.1 %", reference_bias="1 mg"))
    for one, doubts in ((run, 1), (wide, 0)):
        verdict = (result := piga.calibrate(one, COUPLED)).verdict
        found = [doubt for doubt in verdict.doubts if "signature of a missing term" in doubt.what]
        assert len(found) == doubts
        assert doubts or "signature of a missing term" in " ".join(result.remarks)


def test_the_bias_is_missed_too():
    run = EVERYWHERE.record(np.random.default_rng(5))
    calibration = piga.calibrate(run, ("scale_factor", "tan_beta"))
    first = calibration.diagnostics.missing_terms[0]
    assert first.terms == ("k0",)
    assert first.estimate[0] == pytest.approx(1.6e-3, abs=5.0 * first.standard_uncertainty[0])


def test_two_missing_terms_are_both_found():
    run = with_term(EVERYWHERE.record(np.random.default_rng(4)), "k2", 2e-4)
    calibration = piga.calibrate(with_term(run, "k_YZ", 1e-4), COUPLED)
    assert [m.terms for m in calibration.diagnostics.missing_terms] == [("k2",), ("k_YZ",)]


def test_what_the_model_cannot_tell_apart_is_not_suggested():
    """On a tumble at one level k_YY is k0 and k2 again."""
    run = SCENARIOS["static"].record(np.random.default_rng(3))
    one = Scenario("one", tumble(12, side=0.0), white=2.5e-5, walk=2e-5, terms=(*COUPLED, "k2"))
    calibration = piga.calibrate(with_term(one.record(np.random.default_rng(3)), "k_YY", 3e-4), one.terms)
    assert not any("k_YY" in m.terms for m in calibration.diagnostics.missing_terms)
    assert not piga.calibrate(run, SCENARIOS["static"].terms).diagnostics.missing_terms


def test_errors_of_single_positions_are_not_taken_for_a_term():
    """Random errors of the head, far above the noise, look like any term; the scatter test knows."""
    alarms = 0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        run = EVERYWHERE.record(rng)
        off = 2e-5 * G0 * rng.standard_normal((len(run.labels), 3))
        alarms += bool(
            piga.calibrate(replace(run, f=run.f + off[run.segment_index]), COUPLED).diagnostics.missing_terms
        )
    assert alarms == 0


WARMING = Bench(
    forces=head(16), seconds=20.0, rate=10.0, warmth=lambda t: 3.0 * (1.0 - np.exp(-t / 160.0)), k0_T=8e-6
)
"""A bench that warms up by 3 K, and a bias that follows it."""


def test_a_bias_that_follows_the_temperature_is_suggested():
    """Of temperature and time, which explain much the same here, the one that was recorded for it comes first."""
    for warmth in (WARMING.warmth, lambda t: 3.0 * t / 400.0):
        run = replace(WARMING, warmth=warmth, k0_T=2e-5).record(1)
        first = piga.calibrate(run, COUPLED).diagnostics.missing_terms[0]
        assert first.terms == ("k0_T",)
        assert first.estimate[0] == pytest.approx(2e-5, abs=5.0 * first.standard_uncertainty[0])


@pytest.mark.slow
def test_a_temperature_that_does_nothing_is_not_suggested():
    """200 sound records with a temperature: at most 1 %; 40 in which the bias follows it: at least 95 %."""

    def suggested(bench, seed):
        missing = piga.calibrate(bench.record(seed), COUPLED).diagnostics.missing_terms
        return any("k0_T" in (*entry.terms, *entry.alike) for entry in missing)

    assert sum(suggested(replace(WARMING, k0_T=0.0), seed) for seed in range(200)) <= 2
    assert sum(suggested(WARMING, seed) for seed in range(40)) >= 38
