"""Runs and sets by their files: refusals, another rate, an output that folds."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

import piga
from piga.compensation.sets import orthogonal_triad
from tests.compensation.run_files import CAL, REFERENCE, command, run_text, set_to_file, write
from tests.compensation.triads import orthogonal
from tests.compensation.twin_data import calibration_of


def test_resume_is_answered_by_what_to_do(tmp_path, monkeypatch, capsys):
    words = (write(tmp_path, rows=50), "--calibration", tmp_path / "run.json", "--out", tmp_path / "o.parquet")
    code, _, text = command(monkeypatch, capsys, *words, "--resume")
    assert code == 2
    assert "run the same command again without it" in text


def test_set_whose_times_differ_is_refused_by_name(tmp_path):
    runs = [write(tmp_path, f"{name}.parquet", rows=200) for name in "xyz"]
    table = pa.parquet.read_table(tmp_path / "z.parquet")
    late = table["t"].to_numpy() + np.where(np.arange(200) > 150, 1e-4, 0.0)
    pa.parquet.write_table(table.set_column(0, "t", pa.array(late)), tmp_path / "z.parquet")
    mounted = orthogonal_triad([calibration_of(CAL, serial="A") for _ in runs])
    with pytest.raises(
        piga.DataError, match=r"z\.toml: row 152, t = 1\.51\d* s: the times are not those of .*x\.toml"
    ):
        set_to_file(runs, mounted, tmp_path / "o.parquet")


def test_set_at_another_rate_keeps_the_velocity(tmp_path, monkeypatch, capsys):
    words = []
    for i, name in enumerate("xyz"):
        words.append(write(tmp_path, f"{name}.parquet", axes=orthogonal()[i]))
    for name in "xyz":
        words += ["--calibration", tmp_path / f"{name}.json"]
    for name, more in (("a", ()), ("b", ("--rate", "10 Hz"))):
        code, _, text = command(monkeypatch, capsys, *words, "--out", tmp_path / f"{name}.parquet", *more)
        assert code == 0, text
    fine, slow = (pa.parquet.read_table(tmp_path / f"{name}.parquet") for name in "ab")
    assert slow.column_names == ["t", "fx", "fy", "fz", "dvx", "dvy", "dvz", "flags"]
    last = np.searchsorted(fine["t"].to_numpy(), slow["t"].to_numpy()[-1] - 1e-9)
    for axis in ("dvx", "dvy", "dvz"):
        total = np.cumsum(fine[axis].to_numpy())[last]
        assert abs(np.cumsum(slow[axis].to_numpy())[-1] - total) < 1e-12


@pytest.mark.parametrize(("turn", "kept"), [(2.0 * np.pi, True), (5.0, False)])
def test_a_gap_loses_the_phase_of_a_range_that_is_no_whole_turn(tmp_path, turn, kept):
    path, data = write(tmp_path, rows=400), tmp_path / "run.parquet"
    table = pa.parquet.read_table(data).to_pydict()
    table["t"] = np.array(table["t"]) + np.where(np.arange(400) < 300, 0.0, 7.0)
    table["psi"] = np.mod(np.array(table["psi"]) + 1.0, turn)
    pa.parquet.write_table(pa.table(table), data)
    folded = f'kind = "angle", unit = "rad", wraps_at = "{turn!r} rad"'
    path.write_text(run_text(data.name, REFERENCE, output=folded))
    run, cal = piga.read_run(path), calibration_of(CAL, serial="A")
    if kept:
        assert np.count_nonzero(piga.compensate(run, cal).flagged("no_increment")) == 2
        return
    with pytest.raises(piga.CalibrationError, match="the zero of the output angle was lost before segment"):
        piga.compensate(run, cal)
