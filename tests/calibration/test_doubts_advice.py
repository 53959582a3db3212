"""Swapped axes, wrong signs and wrong units are named; good records are not judged."""

from __future__ import annotations

import math
from dataclasses import replace

import numba
import numpy as np
import pytest

import piga
from piga.calibration.doubts import advise
from piga.calibration.model.request import make_request
from piga.errors import PigaError
from tests.calibration.made.scenarios import COUPLED, SCENARIOS, Scenario, around

SMALL = bool(numba.config.DISABLE_JIT)
UNCOUPLED = ("scale_factor", "k0")
DEGREES = math.degrees(1.0)

STRONG = Scenario(
    "strong", around(6 if SMALL else 18), seconds=6.0 if SMALL else 20.0, white=2.5e-5, walk=2e-6, tan_beta=4e-3,
    terms=COUPLED,
)  # fmt: skip


def advised(run, terms=COUPLED):
    """The advice itself, whether or not a calibration would ask for it."""
    run = replace(run, source="run.csv")
    return " | ".join(advise(run, make_request(run, terms)))


@pytest.fixture(scope="module")
def good():
    return STRONG.record(np.random.default_rng(1))


def columns(run, order, signs=(1, 1, 1)):
    return replace(run, f=np.ascontiguousarray(run.f[:, order] * np.array(signs, dtype=float)))


@pytest.mark.interpreted
def test_swapped_transverse_axes_are_named_with_what_is_equivalent(good):
    words = advised(columns(good, [0, 2, 1]))
    for part in ("times better with", "Y0 and Z0 swapped", "Y0 negative", "Z0 negative"):
        assert part in words
    assert advised(columns(good, [0, 2, 1], (1, 1, -1))) == "", "a turn about X0, which the phase takes up"


@pytest.mark.parametrize(
    ("order", "signs", "words"),
    [
        ([1, 0, 2], (1, 1, 1), "X0 and Y0 swapped: in [data] reference list the columns in the order second, first, third"),
        ([2, 1, 0], (1, 1, 1), "X0 and Z0 swapped: in [data] reference list the columns in the order third, second, first"),
        ([0, 1, 2], (-1, 1, 1), "the scale factor comes out negative: X0 of the reference has"),
    ],
)  # fmt: skip
def test_a_wrong_input_axis_is_named_with_its_remedy(good, order, signs, words):
    said = advised(columns(good, order, signs))
    assert all(part in said for part in words.split(": ", 1))


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (9.80665, "0.102 times the nominal one"),
        (9.80665, "[data] reference unit = 'm/s^2' where it says 'g'"),
        (1 / 9.80665, "[data] reference unit = 'g' where it says 'm/s^2'"),
        (1000.0, "[data] reference unit = 'mg' where it says 'g'"),
        (1e-3, "[data] reference unit = 'g' where it says 'mg'"),
    ],
)
def test_a_wrong_unit_of_the_reference_is_named_with_the_right_one(good, factor, words):
    result = advised(replace(good, f=good.f * factor))
    assert words in result
    assert "[data] output" not in result, "the coupling tells that the output is right"


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (-1.0, "with the output negative"),
        (-1.0, "direction = -1 in [data] output"),
        (DEGREES, "the output divided by 57.2958: in [data] output unit = 'deg' where it says 'rad'"),
        (1 / DEGREES, "the output multiplied by 57.2958: in [data] output unit = 'rad' where it says 'deg'"),
        (3600.0, "the output divided by 3600: in [data] output unit = 'arcsec' where it says 'deg'"),
        (4.0, "the output divided by 4: in [data] output a unit 4 times smaller"),
    ],
)
def test_a_wrong_sign_or_unit_of_the_output_is_named_with_the_right_one(good, factor, words):
    assert words in advised(replace(good, output=good.output * factor))


@pytest.mark.parametrize(
    ("factor", "words"),
    [(4.0, "multiplied by 4"), (0.1, "divided by 10"), (2.0 * math.pi, "multiplied by 6.28319"), (1e-3, "divided by 1000")],
)  # fmt: skip
def test_of_counts_it_is_the_counts_per_revolution(good, factor, words):
    run = replace(good, output=good.output * factor, resolution=1e-5)
    assert f"[instrument] counts_per_revolution {words}" in advised(run)


def test_what_the_coupling_cannot_tell_names_all_that_it_may_be(good):
    """Without coupling input and output cannot be told apart."""
    result = advised(replace(good, f=good.f * 1e-3), UNCOUPLED)
    assert "[data] reference unit = 'g' where it says 'mg'" in result
    assert "[data] time unit = 's' where it says 'ms'" in result
    assert "[data] output unit = 'mrad' where it says 'rad'" in result
    assert "[instrument] scale_factor multiplied by 1000" in result


def test_a_log_of_rates_is_judged_too(good):
    """Rates between the samples, the force at their middle."""
    inside = ~good.begins[1:]
    step = np.diff(good.t)[inside]
    f = 0.5 * (good.f[1:] + good.f[:-1])[inside]
    run = piga.Run.from_arrays(
        0.5 * (good.t[1:] + good.t[:-1])[inside], np.diff(good.output)[inside] / step, f,
        scale_factor=good.scale_factor, kind="rate", segment=good.segment_index[1:][inside], units="SI",
    )  # fmt: skip
    assert advised(run, UNCOUPLED) == ""
    assert "unit = 'deg/s' where it says 'rad/s'" in advised(
        replace(run, output=run.output * DEGREES), UNCOUPLED
    )
    assert "comes out negative" in advised(replace(run, output=-run.output), UNCOUPLED)


@pytest.mark.long
def test_a_calibration_gives_the_advice_and_no_other_remark_on_the_same_cause(good):
    calibration = piga.calibrate(columns(good, [0, 2, 1]), COUPLED)
    assert "not applied" in calibration.diagnostics.advice[0]
    assert not calibration.diagnostics.missing_terms
    assert not any("without segment" in note or "missing term" in note for note in calibration.notes)
    assert calibration.notes[0] == calibration.diagnostics.advice[0]
    with pytest.raises(PigaError, match="not applied"):
        piga.calibrate(columns(good, [1, 0, 2]), COUPLED)


@pytest.mark.parametrize("name", ["static", "centrifuge", "near-critical"])
def test_a_good_record_gets_no_advice_when_it_is_tried(name):
    scenario = SCENARIOS[name]
    assert advised(scenario.record(np.random.default_rng(2)), scenario.terms) == ""


@pytest.mark.parametrize("terms", [("scale_factor", "tan_beta"), UNCOUPLED])
def test_a_missing_term_is_no_wrong_axis(good, terms):
    assert advised(good, terms) == ""
