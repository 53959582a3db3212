import math
import re
from decimal import Decimal

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from piga.reports.render.numbers import (
    ascii_text,
    count,
    fixed,
    pretty_unit,
    printed,
    relative,
    rounded,
    short,
    signed,
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
        (-2e-6, 4.4e-5, "-0.2(4.4)e-5"),
    ],
)
def test_concise_form(value, uncertainty, concise):
    assert ascii_text(rounded(value, uncertainty).concise) == concise


@given(VALUES, SPREADS)
def test_rounding_keeps_two_digits_of_the_uncertainty_and_moves_nothing_by_more_than_a_twentieth(
    value, uncertainty
):
    text = rounded(value, uncertainty)
    value_part, spread_part = (Decimal(ascii_text(t)) for t in (text.value, text.uncertainty))
    assert value_part.as_tuple().exponent == spread_part.as_tuple().exponent
    assert len(spread_part.as_tuple().digits) == 2
    share = Decimal("1.000001") / 20
    assert abs(value_part - Decimal(repr(value))) <= spread_part * share
    assert abs(spread_part - Decimal(uncertainty)) <= Decimal(uncertainty) * share


@pytest.mark.parametrize("uncertainty", [0.0, -1.0, math.nan, math.inf])
def test_no_uncertainty_is_said_with_a_dash(uncertainty):
    assert rounded(1.5, uncertainty).uncertainty == "–"


@given(st.floats(-1e7, 1e7), st.integers(2, 7))
def test_significant_digits_are_right(value, digits):
    assume(value == 0 or abs(value) > 1e-12)
    assert float(ascii_text(significant(value, digits))) == pytest.approx(
        value, rel=0.51 * 10 ** (1 - digits), abs=0
    )


def test_forms_for_tables():
    assert [short(v) for v in (0.0, 2.8, 12, 999.9, 4711, 12345.6, 1.2e-7, math.nan)] == [
        "0", "2.80", "12.0", "1000", "4711", "12\u202f346", "1.20\u00a0×\u00a010⁻⁷", "–",
    ]  # fmt: skip
    assert count(-12345) == "−12\u202f345"
    assert fixed(-1e-9, 2) == "0.00"
    assert printed("-3.5876(12)e-4") == "−3.5876(12)\u00a0×\u00a010⁻⁴"
    assert printed("–") == "–"
    pairs = ((1.0, 0.5), (0.8885, 1.4e-6), (1.0, 6.4e-4), (1.0, 2e-9), (1.0, 2.0))
    assert [relative(value, uncertainty) for value, uncertainty in pairs] == [
        "50 %", "1.6 ppm", "640 ppm", "2.0 ppb", "> 100 %",
    ]  # fmt: skip
    assert relative(0.0, 1.0) == "–"


@given(VALUES, st.integers(0, 6), st.floats(1e-9, 1e3))
def test_what_rounds_to_zero_has_no_sign(value, decimals, uncertainty):
    """Never -0.0000 nor +0.0, in any formatter."""
    tiny = 0.49 * 10.0**-decimals * np.sign(value)
    for number in (value, tiny, -tiny, -0.0):
        texts = (fixed(number, decimals), signed(number, decimals), short(number), significant(number))
        for text in (*texts, rounded(number, uncertainty).value):
            assert text[:1] not in "−+" or re.search(r"[1-9]", ascii_text(text).partition("e")[0]), text
    assert signed(tiny, decimals) == fixed(0.0, decimals)


def test_a_power_of_ten_is_ascii_whatever_its_digits():
    assert ascii_text("(2.0 ± 0.3)\u00a0×\u00a010⁻¹²") == "(2.0 +/- 0.3)e-12"
    assert ascii_text("2.40\u00a0×\u00a010³ µg/g³, 12\u202f000") == "2.40e3 ug/g^3, 12000"
    assert ascii_text("–") == "-"
    assert ascii_text(pretty_unit("V/sqrt(Hz)")) == "V/sqrt(Hz)"
