"""Large files: sets in chunks, every kind of data file."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

import piga
from piga.compensation.files import orthogonal_triad
from tests.compensation.run_files import CAL, command, set_to_file, small_chunks, write
from tests.compensation.triads import orthogonal
from tests.compensation.twin_data import calibration_of


@pytest.fixture
def streamed(monkeypatch):
    """Chunks of 100 rows, whatever the size of the file."""
    small_chunks(monkeypatch, 100)


def test_resume_is_answered_by_what_to_do(tmp_path, monkeypatch, capsys):
    words = (write(tmp_path, rows=50), "--calibration", tmp_path / "run.json", "--out", tmp_path / "o.parquet")
    code, _, text = command(monkeypatch, capsys, *words, "--resume")
    assert code == 2
    assert "run the same command again without it" in text


def test_set_of_files_in_chunks_is_the_set_read_whole(tmp_path, monkeypatch):
    runs = []
    for i, name in enumerate("xyz"):
        path = write(tmp_path, f"{name}.parquet", rows=400, axes=orthogonal()[i], phi=0.2 * i)
        path.write_text(path.read_text().replace('"angle", unit = "rad"', '"rate", unit = "rad/s"'))
        table = pa.parquet.read_table(tmp_path / f"{name}.parquet")
        rate = 0.9 + 0.1 * np.sin(0.3 * (i + 1) * table["t"].to_numpy())
        pa.parquet.write_table(table.set_column(1, "psi", pa.array(rate)), tmp_path / f"{name}.parquet")
        runs.append(path)
    mounted = orthogonal_triad([calibration_of(CAL, {"phi": 1e-4}, serial="A") for _ in runs])
    for name in ("whole", "parts"):
        set_to_file(runs, mounted, tmp_path / name)
        small_chunks(monkeypatch, 70)
    whole, pieces = (pa.parquet.read_table(tmp_path / name) for name in ("whole", "parts"))
    assert pieces.num_rows == 400
    for name in whole.column_names:
        assert pieces[name].to_numpy().tobytes() == whole[name].to_numpy().tobytes(), name


def test_set_of_files_of_rates_is_the_set_in_memory(tmp_path):
    """The times of its records differ by less than is refused: each angle is integrated over its own."""
    t, runs = np.arange(120) * 0.01, []
    for i, name in enumerate("xyz"):
        path = write(tmp_path, f"{name}.parquet", rows=120, phi=0.2 * i)
        path.write_text(path.read_text().replace('"angle", unit = "rad"', '"rate", unit = "rad/s"'))
        table = pa.parquet.read_table(tmp_path / f"{name}.parquet")
        rate, own = 0.9 + 0.1 * np.sin(0.3 * (i + 1) * t), t + 3e-9 * i * (np.arange(120) % 2)
        for column, values in (("t", own), ("psi", rate)):
            table = table.set_column(table.column_names.index(column), column, pa.array(values))
        pa.parquet.write_table(table, tmp_path / f"{name}.parquet")
        runs.append(path)
    mounted = orthogonal_triad([calibration_of(CAL, {"phi": 1e-4}, serial="A") for _ in runs])
    set_to_file(runs, mounted, tmp_path / "o.parquet")
    written = pa.parquet.read_table(tmp_path / "o.parquet")
    together = piga.compensate_set([piga.read_run(path) for path in runs], mounted)
    for name, values in together.columns().items():
        assert written[name].to_numpy().tobytes() == values.tobytes(), name


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


@pytest.mark.parametrize("name", ["run.h5", "run.mat", "run.xlsx"])
def test_other_kinds_of_files_are_streamed_too(tmp_path, monkeypatch, capsys, streamed, name):
    run = write(tmp_path, rows=350)
    table = {
        n: pa.parquet.read_table(tmp_path / "run.parquet")[n].to_numpy() for n in ("t", "psi", "fx", "fy", "fz")
    }
    if name.endswith("h5"):
        h5py = pytest.importorskip("h5py")
        with h5py.File(tmp_path / name, "w") as file:
            for column, values in table.items():
                file[column] = values
    elif name.endswith("mat"):
        pytest.importorskip("scipy.io").savemat(tmp_path / name, table)
    else:
        book = pytest.importorskip("openpyxl").Workbook()
        book.active.append(list(table))
        for row in zip(*(values.tolist() for values in table.values()), strict=True):
            book.active.append(row)
        book.save(tmp_path / name)
    words = ("--calibration", tmp_path / "run.json", "--out")
    assert command(monkeypatch, capsys, run, *words, tmp_path / "a.parquet")[0] == 0
    run.write_text(run.read_text().replace("run.parquet", name))
    code, _, text = command(monkeypatch, capsys, run, *words, tmp_path / "b.parquet")
    assert code == 0, text
    a, b = (pa.parquet.read_table(tmp_path / n)["ax"].to_numpy() for n in ("a.parquet", "b.parquet"))
    assert np.nanmax(np.abs(a - b)) < 1e-11  # a cell of XLSX holds 16 digits
