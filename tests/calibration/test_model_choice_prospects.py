"""What a record can say about each term before a fit, against the fit itself."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest

import piga
from piga.calibration import term_prospects
from piga.records.terms import UNITS
from piga.reports.check import check_document, prospects_table
from tests.calibration.made.synthetic import record

pytestmark = pytest.mark.long
ASKED = ("scale_factor", "tan_beta", "k0", "k2", "m_Y")


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


def test_one_level_cannot_tell_powers_apart():
    one = record(np.random.default_rng(4), seconds=4.0, rate=5.0, levels=(1.0,), count=8)
    by_term = {row.term: row for row in term_prospects(one, ("scale_factor", "tan_beta", "k0"))}
    assert by_term["k0"].determined
    assert not by_term["m_Z"].determined  # a_Z never changes
    assert by_term["m_Z"].words() == by_term["m_Z"].reason
    rows = {row[0].text: row for row in prospects_table(tuple(by_term.values())).cells}
    assert rows["k0"][1].text == "asked"
    assert "determined, u = " in rows["k0"][2].text


def test_an_asked_term_that_fails_leaves_the_others_their_verdict():
    one = record(np.random.default_rng(4), seconds=4.0, rate=5.0, levels=(1.0,), count=8)
    told = {row.term: row for row in term_prospects(one, ("scale_factor", "tan_beta", "k0", "m_Z", "s2", "c2"))}
    assert [told[name].determined for name in ("scale_factor", "k0", "m_Z", "s2", "c2")] == [
        True,
        True,
        False,
        True,
        True,
    ]
    assert told["m_Z"].remedy
    assert told["k2"].determined


def test_a_lost_phase_is_no_obstacle():
    one = record(np.random.default_rng(4), seconds=4.0, rate=5.0, levels=(1.0,), count=8, per_segment=True)
    lost = replace(one, phase_group=tuple(range(len(one.labels))))
    rows = term_prospects(lost, ("scale_factor", "tan_beta", "k0"))
    assert rows[0].determined
    document = check_document(lost, rows)
    assert json.loads(json.dumps(document["terms"]))[0]["term"] == "scale_factor"
    assert "terms" not in check_document(lost)
