"""The whole reproduction, compiled: enough cases and figures, none failing, within a minute of one core, docs up to date."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from piga.studies import CHAPTERS, Reproduction, reproduce
from tests.studies.test_studies_chapters import check

DOCS = Path(__file__).parents[2] / "docs"

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def timed() -> tuple[Reproduction, float]:
    begin = time.process_time()
    reproduced = reproduce()
    return reproduced, time.process_time() - begin


def test_no_case_fails_and_everything_is_labelled(timed):
    result, seconds = timed
    assert [chapter.id for chapter in result.chapters] == list(CHAPTERS)
    assert len(result.cases) >= 25
    assert len(result.figures) >= 6
    assert len({case.id for case in result.cases}) == len(result.cases)
    assert len({figure.key for figure in result.figures}) == len(result.figures)
    for chapter in result.chapters:
        check(chapter)
    assert seconds < 60.0


def test_known_values(timed):
    """East-velocity line of model A as an independent integration at 1 Hz gave it; share that B removes."""
    value = {case.id: case.computed for case in timed[0].cases}
    assert value["ten-days.east-velocity-A"] == pytest.approx(0.0281, abs=1e-4)
    assert value["ten-days.east-velocity-B"] < 3.5e-5
    assert 30.0 < value["wobble.removed-B"] < 50.0
    assert value["wobble.removed-C"] > 90.0
    assert 0.03 < min(value[f"errata.sign-{k}"] for k in (2, 3, 4)) < 0.05
    assert (
        value["five-coefficients.successes"] >= 19.0
    )  # four standard uncertainties of some 14 degrees of freedom


def test_docs_hold_every_case_and_figure(timed):
    """The pages are made by builders/build_reproduction_docs.py: build them again when this fails."""
    pages = {name: (DOCS / name).read_text(encoding="utf-8") for name in ("reproduction.md", "errata.md")}
    for chapter in timed[0].chapters:
        text = pages["errata.md" if chapter.id == "errata" else "reproduction.md"]
        for case in chapter.cases.values():
            assert f"`{case.id.partition('.')[2]}`" in text, case.id
        for figure in chapter.figures:
            assert f"figures/reproduction/{figure.key}.svg" in text
            assert (DOCS / "figures" / "reproduction" / f"{figure.key}.svg").exists()
