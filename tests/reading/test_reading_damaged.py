"""Damaged files end as the fault catalogue says, alike in every command; no wrong number gets through."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pytest

import piga
from piga.reading import columns
from piga.units import G0
from tests.cli.runner import outcome
from tests.compensation.twin_data import K_G, calibration_of
from tests.reading.damaged_files import Case, cases, rows, text
from tests.records.files import events

CATALOGUE = cases()


def silently_wrong(run: piga.Run) -> int:
    """Used numbers that differ from the clean log; increments inside stretches tell the output."""
    wrong = int(np.count_nonzero(np.abs(run.f - G0 * np.array([1.0, 0.1, 0.0])) > 1e-12))
    step, h = np.diff(run.output) / run.resolution, np.diff(run.t)
    inside = ~run.begins[1:]
    wrong += int(np.count_nonzero(np.abs(step - 10179.0 * h)[inside] > 1.001))
    return wrong + int(np.count_nonzero(np.abs(run.t * 20.0 - np.round(run.t * 20.0)) > 1e-9))


@pytest.mark.parametrize("case", CATALOGUE, ids=lambda case: case.name)
def test_each_ends_as_the_catalogue_says(tmp_path: Path, case: Case) -> None:
    path = case.write(tmp_path)
    if case.outcome == "error":
        with pytest.raises(piga.DataError, match="(?s)" + case.message) as caught:
            piga.read_run(path)
        assert case.file in caught.value.message
        assert not case.place or re.search(r"row \d+", caught.value.message)
        assert caught.value.remedy
        return
    run = piga.read_run(path)
    result = events(run)
    assert {kind: result.get(kind, 0) for kind in case.events} == case.events
    assert set(result) - set(case.events) <= {"gap", "phase-lost", "encoding"}
    assert run.size == case.used
    assert silently_wrong(run) == 0


Capture = pytest.CaptureFixture[str]


def ends(capsys: Capture, run: Path) -> dict[str, object]:
    """How each command ends: the message of its refusal, or how often it met what."""
    out = run.parent / "results"
    out.mkdir(exist_ok=True)
    for stale in out.iterdir():
        stale.unlink()
    calibration_of({"scale_factor": K_G}, serial="T-1").to_json(run.parent / "cal.json")
    words: dict[str, tuple[object, ...]] = {
        "check": (run, "--json"),
        "calibrate": (run, "--terms", "scale_factor", "--json", "--no-report", "--out", out),
        "compensate": (run, "--calibration", run.parent / "cal.json", "--out", out / "c.parquet", "--json"),
        "convert": (run, "--out", out / "clean.parquet"),
    }
    ended: dict[str, object] = {}
    for name, more in words.items():
        code, said, complaint = outcome(capsys, name, *more)
        if code:
            ended[name] = complaint.removeprefix("piga: ")
        elif name == "compensate":
            ended[name] = json.loads(said)["repairs"]
        elif name == "convert":
            metadata = pa.parquet.read_schema(out / "clean.parquet").metadata
            ended[name] = counted(json.loads(metadata[b"quality"])["events"])
        else:
            ended[name] = counted(json.loads(said)["quality"]["events"])
    return ended


def counted(events: list[dict]) -> dict[str, int]:
    counts: dict[str, int] = {}
    for event in events:
        counts[event["kind"]] = counts.get(event["kind"], 0) + event["count"]
    return counts


@pytest.mark.parametrize("name", ["roll-over-undeclared", "reset-at-gap", "sidecar-differs"])
def test_every_command_ends_alike(tmp_path: Path, capsys: Capture, name: str) -> None:
    (case,) = (case for case in CATALOGUE if case.name == name)
    first, *others = ends(capsys, case.write(tmp_path)).values()
    assert all(end == first for end in others)
    if case.outcome == "error":
        assert "remedy" in str(first)
    else:
        assert isinstance(first, dict)
        assert {kind: first.get(kind, 0) for kind in case.events} == case.events


def test_a_growing_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    run, collect = Case("grows", text(rows()), "error").write(tmp_path), columns.collect

    def grow(path: Path, *more: object) -> columns.RawColumns:
        result = collect(path, *more)  # type: ignore[arg-type]
        with path.open("ab") as log:
            log.write(b"2.0,20358,1.0,0.1,0.0\n")
        return result

    monkeypatch.setattr(columns, "collect", grow)
    result = ends(capsys, run)
    assert all("changed while it was read" in str(end) for end in result.values()), result
