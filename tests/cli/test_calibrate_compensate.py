from __future__ import annotations

import hashlib
import json
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest

from piga.units import G0
from tests.compensation.run_files import command, write
from tests.compensation.twin_data import TAN_BETA, calibration_of


@pytest.mark.parametrize("kind", ["parquet", "csv"])
def test_command_writes_columns_and_units(tmp_path, monkeypatch, capsys, kind):
    run, out = write(tmp_path), tmp_path / f"out.{kind}"
    code, text, _ = command(
        monkeypatch, capsys, run, "--calibration", tmp_path / "run.json", "--out", out, "--json"
    )
    assert code == 0
    assert json.loads(text)["rows"] == 500
    if kind == "parquet":
        table = pa.parquet.read_table(out)
        assert table.column_names == ["t", "ax", "dv", "u_ax", "flags"]
        assert table.schema.field("dv").metadata[b"unit"] == b"m/s"
        assert json.loads(table.schema.metadata[b"piga.flags"])["locked"] == 2
    else:
        table = pa.csv.read_csv(out)
        assert table.column_names == [
            "t [s]",
            "ax [m/s^2]",
            "dv [m/s]",
            "u_ax (reference not included) [m/s^2]",
            "flags",
        ]
    assert np.abs(table.column(1).to_numpy()[1:] - G0).max() < 1e-9 * G0


def test_another_rate_keeps_the_velocity(tmp_path, monkeypatch, capsys):
    run, fine, coarse = write(tmp_path, rows=501), tmp_path / "fine.parquet", tmp_path / "coarse.parquet"
    words = (run, "--calibration", tmp_path / "run.json", "--out")
    assert command(monkeypatch, capsys, *words, fine)[0] == 0
    assert command(monkeypatch, capsys, *words, coarse, "--rate", "10 Hz")[0] == 0
    rows, table = pa.parquet.read_table(fine), pa.parquet.read_table(coarse)
    assert table.column_names == ["t", "ax", "dv", "flags"]
    assert table.num_rows == 50
    assert abs(np.sum(table["dv"].to_numpy()) - np.sum(rows["dv"].to_numpy())) < 1e-12
    assert np.abs(table["ax"].to_numpy() - G0).max() < 1e-9 * G0


def test_wrong_serial_and_missing_phase_exit_2_with_remedy(tmp_path, monkeypatch, capsys):
    run = write(tmp_path, serial="B")
    code, _, text = command(
        monkeypatch, capsys, run, "--calibration", tmp_path / "run.json", "--out", tmp_path / "o.csv"
    )
    assert code == 2
    assert "--other-serial" in text
    assert not (tmp_path / "o.csv").exists()
    calibration_of({"tan_beta": TAN_BETA, "phi[7]": 0.1}, serial="A").to_json(tmp_path / "p.json")
    code, _, text = command(
        monkeypatch, capsys, run, "--calibration", tmp_path / "p.json", "--out", tmp_path / "o.csv"
    )
    assert code == 2
    assert "segment 'all'" in text


def test_triad_file(tmp_path, monkeypatch, capsys):
    lines = []
    for i, name in enumerate("xyz"):
        axes = np.roll(np.eye(3), -i, axis=0).tolist()
        write(tmp_path, f"{name}.parquet", axes=axes, phi=0.2 * i)
        lines.append(f'[[triad.instrument]]\nrun = "{name}.toml"\ncalibration = "{name}.json"\naxes = {axes}\n')
    (tmp_path / "triad.toml").write_text("\n".join(lines))
    code, _, text = command(monkeypatch, capsys, tmp_path / "triad.toml", "--out", tmp_path / "o.parquet")
    assert code == 0, text
    assert "no_increment: 1 row\n" in text
    assert text.count("piga: calibration of A: the reference's uncertainty was not given") == 3
    table = pa.parquet.read_table(tmp_path / "o.parquet")
    assert table.column_names == [
        "t", "fx", "fy", "fz", "dvx", "dvy", "dvz", "u_fx", "u_fy", "u_fz", "residual", "flags",
    ]  # fmt: skip
    for name, value in (("fx", 1.0), ("fy", 3.0), ("fz", 1.0)):
        assert np.abs(table.column(name).to_numpy()[1:] - value * G0).max() < 1e-9 * G0


def test_a_phase_of_another_record_is_named(tmp_path, monkeypatch, capsys):
    """A new power-up has another zero of the output, and nothing in the log shows it."""
    words = (write(tmp_path), "--calibration", tmp_path / "run.json", "--out", tmp_path / "o.csv", "--force")
    assert "the phase of the calibration is used" in command(monkeypatch, capsys, *words)[2]
    phase = calibration_of({"tan_beta": TAN_BETA, "phi": 0.1}, serial="A")
    digest = hashlib.sha256((tmp_path / "run.parquet").read_bytes()).hexdigest()
    known = replace(phase.provenance, input_sha256={"run.parquet": digest})
    replace(phase, provenance=known).to_json(tmp_path / "run.json")
    code, _, text = command(monkeypatch, capsys, *words)
    assert (code, "the phase of the calibration is used" in text) == (0, False)
