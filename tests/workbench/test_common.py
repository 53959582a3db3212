"""Typed numbers: the unit, the decimal comma, and what is refused."""

from __future__ import annotations

import pytest

from piga.errors import UnitError
from piga.units import to_si
from piga.workbench.common import Field, quantity


@pytest.mark.parametrize(
    ("written", "unit", "like", "value"),
    [
        ("0,8884", "rad/s/g", "rad/s/g", "0.8884 rad/s/g"),
        ("0.8884 rad/s/g", "", "rad/s/g", "0.8884 rad/s/g"),
        (" 52,3 ", "deg", "rad", "52.3 deg"),
        ("-1e-3", "rad", "rad", "-1e-3 rad"),
        ("\u22121", "deg", "rad", "-1 deg"),
        ("72000", "", "1", "72000"),
    ],
)
def test_a_number_with_its_unit(written: str, unit: str, like: str, value: str) -> None:
    assert quantity(written, unit, like, "x") == value
    to_si(value, like)


@pytest.mark.parametrize(
    ("written", "unit", "like", "words"),
    [
        ("0.8884", "", "rad/s/g", "the unit is missing"),
        ("52.3", "", "rad", "the unit is missing"),
        ("52.3", "s", "rad", "'s'"),
        ("1.234,5", "deg", "rad", "comma in the number"),
        ("1 deg", "rad", "rad", "the menu says"),
        ("five", "", "rad", "is not a number"),
        ("1 furlong", "", "m", "furlong"),
        ("<script>", "", "m", "is not a number"),
        ("1e999", "m", "m", "too large|larger|finite"),
    ],
)
def test_what_is_refused(written: str, unit: str, like: str, words: str) -> None:
    with pytest.raises(UnitError, match=words):
        quantity(written, unit, like, "x")


def test_a_field_keeps_what_was_typed_and_says_why_it_is_refused() -> None:
    field = Field("hours", like="s", units=("s", "h"))
    assert field.with_sent({"hours": "2,5", "u:hours": "h"}).value == "2.5 h"
    bare = field.with_sent({"hours": "2.5"})
    assert (bare.typed, bare.refusal.partition(".")[0]) == ("2.5", "The unit is missing")
    assert not Field("phase", like="rad").with_sent({}).refusal
