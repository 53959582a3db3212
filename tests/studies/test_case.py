"""Verdicts: a wrong number fails, an upper limit holds, a number without a counterpart is for information."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from piga.studies import Case, Chapter

CASE = Case("part.one", "[Wei2024]", "error", "g", 0.05, 0.0492, 0.005, "printed to one digit")


@pytest.mark.parametrize(
    ("computed", "verdict"),
    [(0.0492, "pass"), (0.055, "pass"), (0.0551, "fail"), (0.044, "fail"), (math.nan, "fail")],
)
def test_verdict_follows_the_difference(computed, verdict):
    assert replace(CASE, computed=computed).verdict == verdict


@pytest.mark.parametrize(
    ("computed", "verdict"),
    [(0.0, "pass"), (0.05, "pass"), (0.0501, "fail"), (-0.06, "fail"), (math.nan, "fail")],
)
def test_limit_admits_anything_from_zero_up_to_it(computed, verdict):
    assert replace(CASE, computed=computed, limit=True, tolerance=0.05).verdict == verdict


def test_without_number_or_tolerance_it_is_for_information():
    nothing = replace(CASE, published=None, tolerance=None)
    assert (nothing.verdict, nothing.difference) == ("info", None)
    contradicted = replace(CASE, tolerance=None)
    assert contradicted.verdict == "info"
    assert contradicted.difference == pytest.approx(-0.0008)


def test_document_has_the_keys_of_the_interface():
    document = CASE.document()
    assert list(document) == [
        "id", "source", "quantity", "unit", "published", "computed", "difference", "tolerance", "verdict", "note",
    ]  # fmt: skip
    assert document["difference"] == document["computed"] - document["published"]
    assert replace(CASE, computed=math.inf).document()["computed"] is None


def test_case_must_belong_to_its_chapter():
    with pytest.raises(ValueError, match="does not belong"):
        Chapter("other", "t", "s", "", (CASE,), ())
