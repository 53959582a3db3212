import math
from decimal import Decimal

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from piga.reports.numbers import (
    count,
    fixed,
    friendly,
    pretty_unit,
    printed,
    relative,
    rounded,
    short,
    significant,
)

VALUES = st.floats(-1e9, 1e9, allow_nan=False).filter(lambda v: v == 0 or abs(v) > 1e-9)
SPREADS = st.floats(1e-12, 1e8)


# JCGM 100, 7.2.2 writes 100,021 47(35) g for y = 100,021 47 g, u = 0,35 mg.
@pytest.mark.parametrize(
    ("value", "uncertainty", "concise"),
    [
        (100.02147, 0.00035, "100.02147(35)"),
        (3.587621e-4, 1.2e-7, "3.5876(12)e-4"),
        (0.888506608, 1.6e-6, "0.8885066(16)"),
        (1600.04, 5.21, "1600.0(5.2)"),
        (0.3, 1.24, "0.3(1.2)"),
        (9.96, 0.0996, "9.96(10)"),
        (12.0, 34.0, "12(34)"),
        (123456.0, 1234.0, "1.235(12)e5"),
        (0.0, 0.012, "0.000(12)"),
        (-2.37e-3, 1e-5, "-0.002370(10)"),
    ],
)
def test_concise_form(value, uncertainty, concise):
    assert rounded(value, uncertainty).concise == concise


@given(VALUES, SPREADS)
def test_rounding_moves_value_by_less_than_a_twentieth_of_its_uncertainty(value, uncertainty):
    text = rounded(value, uncertainty)
    margin = Decimal(text.uncertainty) / 20 * Decimal("1.000001")
    assert abs(Decimal(text.value) - Decimal(repr(value))) <= margin
    assert abs(Decimal(text.uncertainty) - Decimal(uncertainty)) <= Decimal(uncertainty) / 20 * Decimal(
        "1.000001"
    )


@given(VALUES, SPREADS)
def test_value_and_uncertainty_end_at_the_same_place_with_two_digits(value, uncertainty):
    text = rounded(value, uncertainty)
    value_part, spread_part = (Decimal(t) for t in (text.value, text.uncertainty))
    assert value_part.as_tuple().exponent == spread_part.as_tuple().exponent
    assert len(spread_part.as_tuple().digits) == 2


@given(VALUES, st.sampled_from([0.0, -1.0, math.nan, math.inf]))
def test_no_uncertainty_is_said_with_a_dash(value, uncertainty):
    assert rounded(value, uncertainty).uncertainty == "–"


@given(st.floats(-1e7, 1e7), st.integers(2, 7))
def test_significant_digits_are_right(value, digits):
    assume(value == 0 or abs(value) > 1e-12)
    assert float(significant(value, digits)) == pytest.approx(value, rel=0.51 * 10 ** (1 - digits), abs=0)


def test_forms_for_tables():
    assert [short(v) for v in (0.0, 2.8, 12, 999.9, 4711, 12345.6, 1.2e-7, math.nan)] == [
        "0", "2.80", "12.0", "1000", "4711", "12\u202f346", "1.20e-7", "–",
    ]  # fmt: skip
    assert count(-12345) == "-12\u202f345"
    assert fixed(-1e-9, 2) == "0.00"
    assert printed("-3.5876(12)e-4") == "−3.5876(12)\u00a0×\u00a010⁻⁴"
    assert printed("–") == "–"
    pairs = ((1.0, 0.5), (0.8885, 1.4e-6), (1.0, 6.4e-4), (1.0, 2e-9), (1.0, 2.0))
    assert [relative(value, uncertainty) for value, uncertainty in pairs] == [
        "50 %", "1.6 ppm", "640 ppm", "2.0 ppb", "> 100 %",
    ]  # fmt: skip
    assert relative(0.0, 1.0) == "–"


def test_units_are_friendly_and_printed():
    value, std, unit = friendly(1.6e-3, 5e-6, "g/g^2")
    assert (value, std, unit) == (pytest.approx(1600.0), pytest.approx(5.0), "ug/g^2")
    assert friendly(0.8885, 1e-6, "rad/s/g")[2] == "rad/s/g"
    assert friendly(0.48, 1e-3, "rad")[2] == "rad"
    assert friendly(3.6e-4, 1e-7, "1")[2] == "1"
    assert [pretty_unit(u) for u in ("ug/g^2", "1", "urad", "rad/sqrt(s)", "rad/s/g")] == [
        "µg/g²", "", "µrad", "rad/√s", "rad/s/g",
    ]  # fmt: skip


def test_numbers_are_plain_below_a_million():
    assert rounded(999999.4, 12.0).concise == "999999(12)"
    assert rounded(1234567.0, 1.2).concise == "1.2345670(12)e6"
