"""Swapped axes, wrong signs and wrong units are named; good records are not judged."""

from dataclasses import replace

import numpy as np
import pytest

import piga
from piga.calibration import advice
from piga.errors import PigaError
from tests.calibration.scenarios import SCENARIOS, Scenario
from tests.calibration.test_missing_terms import EVERYWHERE, TERMS

STRONG = Scenario("strong", EVERYWHERE.forces, white=2.5e-5, walk=2e-6, tan_beta=4e-3, terms=TERMS)


def told(run, terms=TERMS):
    """All that is advised: by the result, or by the remedy of a refusal."""
    try:
        return " | ".join(piga.calibrate(run, terms).diagnostics.get("advice", ()))
    except PigaError as error:
        return str(error)


@pytest.fixture(scope="module")
def good():
    return STRONG.record(np.random.default_rng(1))


def columns(run, order, signs=(1, 1, 1)):
    return replace(run, f=np.ascontiguousarray(run.f[:, order] * np.array(signs, dtype=float)))


def test_swapped_transverse_axes_are_named_with_what_is_equivalent(good):
    words = told(columns(good, [0, 2, 1]))
    assert "times better with" in words
    assert "Y0 and Z0 swapped" in words
    assert "Y0 negative" in words
    assert "Z0 negative" in words


def test_a_turn_about_the_input_axis_is_no_error_the_phase_takes_it_up(good):
    assert told(columns(good, [0, 2, 1], (1, 1, -1))) == ""


@pytest.mark.parametrize(
    ("order", "words"), [([1, 0, 2], "X0 and Y0 swapped"), ([2, 1, 0], "X0 and Z0 swapped")]
)
def test_a_swapped_input_axis_is_named(good, order, words):
    assert words in told(columns(good, order))


def test_a_wrong_sign_of_the_input_axis_shows_in_the_scale_factor(good):
    assert "scale factor comes out negative" in told(columns(good, [0, 1, 2], (-1, 1, 1)))


def test_a_wrong_sign_of_the_output_is_told_from_it_by_the_coupling(good):
    assert "with the output negative" in told(replace(good, output=-good.output))


@pytest.mark.parametrize("factor", [9.80665, 1 / 9.80665, 1000.0, 1e-3])
def test_a_wrong_unit_of_the_reference_is_named(good, factor):
    words = told(replace(good, f=good.f * factor))
    assert "check the units in [data]" in words
    assert f"{max(factor, 1 / factor):.6g}" in words


@pytest.mark.parametrize("factor", [57.29578, 1 / 57.29578, 3600.0, 4.0])
def test_a_wrong_unit_of_the_output_is_named(good, factor):
    words = told(replace(good, output=good.output * factor))
    assert f"{max(factor, 1 / factor):.6g}"[:4] in words


def test_a_good_record_is_not_even_tried(good, monkeypatch):
    monkeypatch.setattr("piga.calibration.advice._trials", None)
    assert "advice" not in piga.calibrate(good, TERMS).diagnostics
    scenario = SCENARIOS["static"]
    assert "advice" not in scenario.calibrate(scenario.record(np.random.default_rng(1))).diagnostics


@pytest.mark.parametrize("name", ["static", "centrifuge", "near-critical"])
def test_a_good_record_gets_no_advice_when_it_is_tried(name):
    scenario = SCENARIOS[name]
    run = scenario.record(np.random.default_rng(2))
    assert (
        advice.advise(run, piga.calibration.request.make_request(run, scenario.terms, None, None, None)) == ()
    )


def test_a_missing_term_is_no_wrong_axis(good):
    assert told(good, ("scale_factor", "tan_beta")) == ""
