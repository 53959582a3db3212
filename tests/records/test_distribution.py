"""What a run file says about uncertainties and stands is refused where it could be read in two ways."""

from __future__ import annotations

from pathlib import Path

import pytest

import piga
from piga.records import read_run_file
from tests.records.files import lines, write_log, write_run


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ('{ standard = "1 ppm", half_width = "2 ppm" }', "give either standard or half_width"),
        ("{ degrees_of_freedom = 8 }", "give either standard or half_width"),
        ('{ value = "1 ppm", distribution = "rectangular" }', "'value' of a rectangular distribution could be"),
        ('{ value = "1 ppm", distribution = "arcsine" }', "'value' of a arcsine distribution could be"),
        ('{ half_width = "1 ppm" }', "a normal distribution has no half-width"),
        (
            '{ half_width = "1 ppm", distribution = "t", degrees_of_freedom = 9 }',
            "a t distribution has no half-width",
        ),
        ('{ standard = "1 ppm", distribution = "t" }', "'t' needs more than two degrees_of_freedom"),
        ('{ standard = "1 ppm", distribution = "t", degrees_of_freedom = 2 }', "needs more than two"),
        ('{ standard = "1 ppm", degrees_of_freedom = 0 }', "degrees_of_freedom must be positive"),
        ('{ half_width = "-1 ppm", distribution = "triangular" }', "'-1 ppm' is negative"),
        ('"-1 ppm"', "'-1 ppm' is negative"),
        ('"1 arcsec"', "arcsec"),
    ],
)
def test_a_spread_that_says_too_little_or_too_much(tmp_path: Path, entry: str, message: str) -> None:
    path = write_run(tmp_path, model=f"[uncertainty]\nreference_scale = {entry}")
    with pytest.raises(piga.RunFileError, match=message) as caught:
        read_run_file(path)
    assert "[uncertainty] reference_scale" in str(caught.value)
    assert "run.toml" in str(caught.value)
    assert caught.value.remedy


def test_more_segments_than_a_record_may_have(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("piga.reading.columns.MAX_SEGMENTS", 12)
    rows = [f"{row},{index // 2}" for index, row in enumerate(lines(40))]
    write_log(tmp_path, rows, header="t,n,fx,fy,fz,seg")
    with pytest.raises(piga.DataError, match="column 'seg' has more than 12 different segments"):
        piga.read_run(write_run(tmp_path, data='segment = "seg"'))
    assert piga.read_run(write_run(tmp_path)).size == 40


def test_an_extreme_between_missing_values_is_no_saturation(tmp_path: Path) -> None:
    """Nothing beside the plateau tells how far the reading would have gone on."""
    rows = []
    for i, row in enumerate(lines(200)):
        t, n, fx, _, fz = row.split(",")
        fy = "0.9" if 100 <= i < 110 else "" if 80 <= i < 130 else f"{0.1 + 0.001 * (i % 7):.4f}"
        rows.append(f"{t},{n},{fx},{fy},{fz}")
    write_log(tmp_path, rows)
    run = piga.read_run(write_run(tmp_path))
    assert {event.kind for event in run.quality.events} == {"missing-value", "gap"}


def test_an_output_that_stands_where_nothing_is_felt(tmp_path: Path) -> None:
    """At rest across the gravity vector the output has no reason to turn: not a finding, whatever stands beside it."""
    rows = []
    for i, row in enumerate(lines(120)):
        t, n, _, _, fz = row.split(",")
        rows.append(f"{t},{n},1.0,0.0,{fz}" if i < 60 else f"{t},{round(10179.0 * 59 / 20.0)},0.0,1.0,{fz}")
    write_log(tmp_path, rows)
    run = piga.read_run(write_run(tmp_path))
    assert "stopped-output" not in {event.kind for event in run.quality.events}
    held = [
        row if i < 60 else ",".join([row.split(",")[0], rows[59].split(",")[1], "1.0,0.0,0.0"])
        for i, row in enumerate(rows)
    ]
    write_log(tmp_path, held)
    assert "stopped-output" in {event.kind for event in piga.read_run(write_run(tmp_path)).quality.events}
