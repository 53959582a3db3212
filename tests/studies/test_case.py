"""Verdicts: a wrong number fails, an upper limit holds, a number without a counterpart is for information."""

from __future__ import annotations

import math

import pytest
from msgspec.structs import replace

from piga.studies import CHAPTERS, Case
from piga.studies.case import Value, chapter_of, published_chapters

CASE = Case(
    id="part.one", source="[Wei2024]", quantity="error", unit="g", published=0.05, computed=0.0492, tolerance=0.005,
    note="printed to one digit",
)  # fmt: skip


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


def test_a_chapter_has_the_published_cases_and_no_others():
    values = {"least-skew": 1000.0, "moves": Value(999.0, published=999.5, tolerance=0.6), "shortfall": 0.01}
    chapter = chapter_of("mounting", values, ())
    assert [case.id for case in chapter.cases.values()] == [
        "mounting.least-skew",
        "mounting.moves",
        "mounting.shortfall",
    ]
    assert [case.published for case in chapter.cases.values()] == [1000.0, 999.5, None]
    assert [case.verdict for case in chapter.cases.values()] == ["pass", "pass", "info"]
    with pytest.raises(ValueError, match="moves"):
        chapter_of("mounting", {"least-skew": 1000.0, "shortfall": 0.01}, ())


def test_the_file_of_published_numbers_is_that_of_the_chapters():
    chapters = published_chapters()
    assert list(chapters) == list(CHAPTERS)
    for chapter in chapters.values():
        for case in chapter.cases.values():
            assert case.tolerance is None or case.tolerance >= 0.0
            assert not case.limit or "upper limit" in case.note
