"""The corpus of damaged files: each ends as the fault catalogue says, and no wrong number gets through."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from builders.build_damaged_files import Case, cases, count

import piga
from piga.units import G0
from tests.records.files import events

CASES = cases()


def silently_wrong(run: piga.Run) -> int:
    """Used numbers that differ from the clean log; increments inside stretches tell the output."""
    wrong = int(np.count_nonzero(np.abs(run.f - G0 * np.array([1.0, 0.1, 0.0])) > 1e-12))
    step, h = np.diff(run.output) / run.resolution, np.diff(run.t)
    inside = ~run.begins[1:]
    wrong += int(np.count_nonzero(np.abs(step - 10179.0 * h)[inside] > 1.001))
    return wrong + int(np.count_nonzero(np.abs(run.t * 20.0 - np.round(run.t * 20.0)) > 1e-9))


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_each_ends_as_the_catalogue_says(tmp_path: Path, case: Case) -> None:
    path = case.write(tmp_path)
    if case.outcome == "error":
        with pytest.raises(piga.DataError, match="(?s)" + case.message) as caught:
            piga.read_run(path)
        assert case.file in caught.value.message
        assert caught.value.remedy
        return
    run = piga.read_run(path)
    result = events(run)
    assert {kind: result.get(kind, 0) for kind in case.events} == case.events
    assert set(result) - set(case.events) <= {"gap", "phase-lost", "encoding"}
    assert run.size == case.used
    assert silently_wrong(run) == 0


def test_the_corpus_is_large_and_names_places(tmp_path: Path) -> None:
    assert len(CASES) >= 60
    assert len({case.name for case in CASES}) == len(CASES)
    assert count(1.0) == 10179
    placed = [case for case in CASES if case.outcome == "error" and case.place]
    named = 0
    for case in placed:
        with pytest.raises(piga.DataError) as caught:
            piga.read_run(case.write(tmp_path / case.name))
        named += bool(re.search(r"row \d+", caught.value.message))
    assert named >= 0.95 * len(placed)
    print(f"{len(CASES)} files; {named} of {len(placed)} errors with a place name it")  # noqa: T201
