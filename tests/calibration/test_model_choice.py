"""Term sets compared: against refits, truth found again."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace

import msgspec
import numpy as np
import pytest

import piga
from piga.calibration import term_prospects
from piga.calibration.model.design import Design
from piga.calibration.model.request import make_request
from piga.calibration.weights import Noise, Whitener
from piga.records.terms import UNITS
from piga.reports.check import check_document, prospects_table
from tests.calibration.made.scenarios import COUPLED
from tests.calibration.made.synthetic import TERMS, record

TRUE = tuple(TERMS)
SMALLER = ("scale_factor", "tan_beta", "k0", "m_Y")
LARGER = (*TRUE, "k3")
SETS = [("scale_factor", "tan_beta"), SMALLER, TRUE, LARGER, (*TRUE, "s2", "c2")]


def small(seed: int, **options: float) -> piga.Run:
    return record(np.random.default_rng(seed), seconds=20.0, rate=5.0, walk=4e-6, **options)


@pytest.fixture(scope="module")
def run() -> piga.Run:
    return small(1)


@pytest.fixture(scope="module")
def compared(run: piga.Run):
    return piga.compare_models(run, SETS)


def weighted_rows(run: piga.Run, terms, noise: Noise):
    """Whitened rows of a set by its own design: (n, m), (n,)."""
    design = Design(run, make_request(run, terms, "information", "shared"), run.scale_factor)
    whitener = Whitener("increments", noise, len(design.names) + 1)
    x = np.hstack([whitener.apply(b.columns, b.h)[:, b.h > 0.0] for b in design.blocks()])
    return x[:-1].T, x[-1]


def fitted(x, y):
    size = np.linalg.norm(x, axis=0)
    return np.linalg.lstsq(x / size, y, rcond=None)[0] / size


@pytest.mark.long
def test_figures_as_brute_force(run, compared):
    """BIC by a dense covariance matrix and a refit of each set alone; differences to 1e-6."""
    noise = Noise(compared.angle_rms**2, compared.angle_random_walk**2)
    logarithm, count = 0.0, 0
    for segment in range(len(run.labels)):
        h = np.diff(run.t[run.segment_index == segment])
        covariance = np.diag(noise.walk * h + 2.0 * noise.white)
        covariance -= noise.white * (np.eye(h.size, k=1) + np.eye(h.size, k=-1))
        logarithm += float(np.linalg.slogdet(covariance)[1])
        count += h.size
    for terms, one in zip(SETS, compared.sets, strict=True):
        x, y = weighted_rows(run, terms, noise)
        chi_square = float(np.sum((y - x @ fitted(x, y)) ** 2))
        likelihood = -0.5 * (count * np.log(2.0 * np.pi) + logarithm + chi_square)
        assert one.parameters == x.shape[1]
        assert one.chi_square == pytest.approx(chi_square, rel=1e-9)
        assert one.log_likelihood == pytest.approx(likelihood, rel=1e-9)
        assert one.bic == pytest.approx(x.shape[1] * np.log(count) - 2.0 * likelihood, rel=1e-9)
    assert compared.observations == count


@pytest.mark.long
def test_estimates_are_those_of_a_calibration_with_this_noise(run, compared):
    estimation = msgspec.structs.replace(
        run.estimation,
        angle_rms=f"{compared.angle_rms!r} rad",
        angle_random_walk=f"{compared.angle_random_walk!r} rad/sqrt(s)",
    )
    for one in compared.sets[1:4]:
        alone = piga.calibrate(replace(run, estimation=estimation), list(one.terms))
        for mine, other in zip(one.coefficients, alone.coefficients, strict=True):
            assert mine.key == other.key
            assert abs(mine.value - other.value) < 1e-6 * other.std
            assert other.std > 0.3 * mine.std, "the scatter of the positions also shows what the terms miss"


@pytest.mark.long
def test_truth_is_best(compared):
    assert compared.sets[compared.best].terms == TRUE
    changes = dict(compared.sets[1].changes)
    assert abs(changes["k0"]) > 5.0  # without k2 the bias takes it up
    assert dict(compared.sets[2].changes)["k0"] == 0.0


@pytest.mark.long
def test_confounded_set_stays_with_its_reason(run):
    still = ("scale_factor", "tan_beta", "k0", "k0_T")
    with pytest.raises(piga.CalibrationError, match="temperature"):
        piga.compare_models(run, [still])
    turned = replace(run, f=run.f * np.array([1.0, 1.0, 0.0]))
    comparison = piga.compare_models(turned, [SMALLER, (*SMALLER, "m_Z")])
    assert "m_Z" in comparison.sets[1].reason
    assert comparison.sets[1].bic is None
    assert comparison.best == 0


@pytest.mark.long
def test_own_phases_are_parameters_of_each_set():
    comparison = piga.compare_models(small(4), [SMALLER, TRUE], phases="per-segment")
    assert comparison.sets[comparison.best].terms == TRUE
    assert comparison.sets[1].parameters == len(TRUE) + 24


@pytest.mark.long
def test_asked_for_by_the_run_file(run, compared):
    wish = msgspec.structs.replace(run.model, terms=SMALLER, compare=tuple(SETS))
    calibration = piga.calibrate(replace(run, model=wish))
    document = calibration.diagnostics.model_comparison
    assert document == compared.document()
    json.dumps(document, allow_nan=False)
    assert calibration.terms == SMALLER


def test_wrong_requests(run):
    with pytest.raises(piga.ArgumentError, match="no term sets"):
        piga.compare_models(run)
    with pytest.raises(piga.ArgumentError, match="set 2 is empty"):
        piga.compare_models(run, [["k0"], []])
    with pytest.raises(piga.RunFileError, match="set 1: unknown term 'K0'"):
        piga.compare_models(run, [["K0"]])


# --- what a record can say about each term before a fit


ASKED = ("scale_factor", "tan_beta", "k0", "k2", "m_Y")


@pytest.mark.long
@pytest.mark.parametrize(("levels", "expected"), [((1.0,), {True, False}), ((0.5, 1.0), {True})])
def test_every_verdict_is_that_of_the_fit(levels, expected):
    run = record(np.random.default_rng(3), seconds=20.0, rate=5.0, walk=4e-6, levels=levels)
    told = term_prospects(run, ASKED)
    assert [row.term for row in told[:5]] == list(ASKED)
    assert {row.term for row in told} == set(UNITS) - {"phi", "k1", "k0_T", "k1_T", "k2v"}
    assert {row.determined for row in told} == expected
    for row in told:
        terms = ASKED if row.asked else (*ASKED, row.term)
        refusal, fit = "", None
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                budget = piga.calibrate(run, terms=terms).budget
            fit = next(abs(entry.contributions[row.term]) for entry in budget if entry.type == "A")
        except piga.IdentifiabilityError as error:
            refusal = error.message
        assert row.determined == (fit is not None), row
        assert bool(row.remedy) == bool(refusal)
        assert refusal.startswith(row.reason[:30])
        if fit is not None:
            assert 0.4 < row.std / fit < 2.5, row


@pytest.fixture(scope="module")
def one_level() -> piga.Run:
    return record(np.random.default_rng(4), seconds=20.0, rate=5.0, levels=(1.0,), count=8)


@pytest.mark.long
def test_a_term_that_one_level_cannot_tell_leaves_the_others_their_verdict(one_level):
    """a_Z never changes."""
    told = {row.term: row for row in term_prospects(one_level, (*COUPLED, "m_Z", "s2", "c2"))}
    asked = {name: told[name].determined for name in ("scale_factor", "k0", "m_Z", "s2", "c2")}
    assert asked == {"scale_factor": True, "k0": True, "m_Z": False, "s2": True, "c2": True}
    assert told["m_Z"].remedy
    assert told["m_Z"].words() == told["m_Z"].reason
    assert told["k2"].determined
    rows = {row[0].text: row for row in prospects_table(tuple(told.values())).cells}
    assert rows["k0"][1].text == "asked"
    assert "determined, u = " in rows["k0"][2].text


@pytest.mark.long
def test_a_lost_phase_is_no_obstacle(one_level):
    lost = replace(one_level, phase_group=tuple(range(len(one_level.labels))))
    rows = term_prospects(lost, COUPLED)
    assert rows[0].determined
    assert json.loads(json.dumps(check_document(lost, rows)["terms"]))[0]["term"] == "scale_factor"
    assert "terms" not in check_document(lost)
