"""Large files: parts that a killed run continues from, sets in chunks, every kind of data file."""

from __future__ import annotations

import os

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

import piga
from piga.compensation.files import file_to_file as parts
from piga.compensation.result import Resampler
from piga.compensation.sets import set_files
from piga.compensation.sets.set_files import orthogonal_triad
from tests.compensation.run_files import CAL, KERNEL, command, small_chunks, write
from tests.compensation.sets.triads import orthogonal
from tests.compensation.twin_data import calibration_of
from tests.kills import kills


@pytest.fixture
def streamed(monkeypatch):
    """Chunks of 100 rows, parts of 300, whatever the size of the file."""
    small_chunks(monkeypatch, 100)
    monkeypatch.setattr(parts, "PART_ROWS", 300)


@pytest.mark.parametrize("options", [(), ("--rate", "40 Hz")])
@pytest.mark.parametrize("stop", [1, 4, 8, 11])
def test_a_stopped_run_goes_on_to_the_same_bytes(tmp_path, monkeypatch, capsys, streamed, stop, options):
    run = write(tmp_path, rows=1050)
    words = (run, "--calibration", tmp_path / "run.json", *options, "--out")
    assert command(monkeypatch, capsys, *words, tmp_path / "whole.parquet")[0] == 0
    step, calls = KERNEL.run_kernel, []

    def stop_at(*inputs):
        calls.append(1)
        if len(calls) == stop:
            raise KeyboardInterrupt
        step(*inputs)

    monkeypatch.setattr(KERNEL, "run_kernel", stop_at)
    assert command(monkeypatch, capsys, *words, tmp_path / "o.parquet", "--resume")[0] != 0
    assert not (tmp_path / "o.parquet").exists()
    calls.clear()
    stop = 0
    code, _, text = command(monkeypatch, capsys, *words, tmp_path / "o.parquet", "--resume")
    assert code == 0, text
    assert len(calls) < 11 or stop < 4
    assert (tmp_path / "o.parquet").read_bytes() == (tmp_path / "whole.parquet").read_bytes()
    assert not list(tmp_path.glob(".o*"))


def stopped(monkeypatch, capsys, at: int, *words) -> None:
    """Run the command up to so many pieces."""
    step, calls = KERNEL.run_kernel, []

    def stop(*inputs):
        calls.append(1)
        if len(calls) == at:
            raise KeyboardInterrupt
        step(*inputs)

    monkeypatch.setattr(KERNEL, "run_kernel", stop)
    assert command(monkeypatch, capsys, *words)[0] != 0
    monkeypatch.setattr(KERNEL, "run_kernel", step)


def on_a_profile(folder, turn: float):
    """A run without reference columns, on a stand whose motion is logged in a file of its own."""
    run = write(folder, rows=1050)
    lines = [line for line in run.read_text().splitlines() if not line.startswith("reference")]
    stand = 'kind = "profile"\nfile = "profile.csv"\ntime = { column = "t", unit = "s" }\n'
    stand += 'force = { columns = ["x", "y", "z"], unit = "g" }'
    run.write_text("\n".join([*lines, "[stand]", stand]))
    log = "".join(f"{k},1,{3.0 + turn * k},1\n" for k in range(12))
    (folder / "profile.csv").write_text("t,x,y,z\n" + log)
    return run


@pytest.mark.parametrize("what", ["calibration", "profile", "options"])
def test_parts_of_another_run_are_refused(tmp_path, monkeypatch, capsys, streamed, what):
    """By what was read: the file of the stand's motion is an input, too."""
    run = on_a_profile(tmp_path, 0.0)
    words = [run, "--calibration", tmp_path / "run.json", "--out", tmp_path / "o.parquet", "--resume"]
    stopped(monkeypatch, capsys, 8, *words)
    if what == "calibration":
        calibration_of({**CAL, "k0": 2e-3}, serial="A").to_json(tmp_path / "run.json")
    elif what == "profile":
        on_a_profile(tmp_path, 1e-4)
    else:
        words += ["--no-uncertainty"]
    code, _, text = command(monkeypatch, capsys, *words)
    assert code == 2
    assert "parts of another input, calibration or set of options" in text
    code, _, text = command(monkeypatch, capsys, *words, "--force")
    assert code == 0, text
    words[4] = tmp_path / "whole.parquet"
    assert command(monkeypatch, capsys, *words)[0] == 0
    assert (tmp_path / "o.parquet").read_bytes() == (tmp_path / "whole.parquet").read_bytes()


def test_two_processes_do_not_share_parts(tmp_path, monkeypatch, capsys, streamed):
    run, out = write(tmp_path, rows=500), tmp_path / "o.parquet"
    other = parts.Parts(out, "another process")
    words = (run, "--calibration", tmp_path / "run.json", "--out", out, "--resume", "--force")
    code, _, text = command(monkeypatch, capsys, *words)
    assert code == 2
    assert f"another process writes {out}" in text
    other.close()
    assert command(monkeypatch, capsys, *words)[0] == 0


def test_a_stop_while_parts_are_deleted_does_not_matter(tmp_path, monkeypatch, capsys, streamed):
    """Before any is deleted, and when some are."""
    words = (
        write(tmp_path, rows=1050),
        "--calibration",
        tmp_path / "run.json",
        "--out",
        tmp_path / "o.parquet",
    )
    for delete in (lambda path, **_: None, lambda path, **_: (path / "1.parquet").unlink()):
        with monkeypatch.context() as patch:
            patch.setattr(parts.shutil, "rmtree", delete)
            assert command(monkeypatch, capsys, *words, "--resume")[0] == 0
        assert list(tmp_path.glob(".o*"))
        whole = (tmp_path / "o.parquet").read_bytes()
        code, _, text = command(monkeypatch, capsys, *words, "--resume")
        assert code == 0, text
        assert (tmp_path / "o.parquet").read_bytes() == whole
        assert not list(tmp_path.glob(".o*"))
        (tmp_path / "o.parquet").unlink()


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="kill -9 is POSIX")
def test_killed_at_any_moment_the_result_is_the_same(tmp_path):
    run, out = write(tmp_path, rows=200_000), tmp_path / "o.parquet"
    small = (
        "from piga.compensation.files import file_to_file as parts; from piga.records import spool; "
        "parts.PART_ROWS = 20_000; spool.BLOCK = 5000"
    )
    words = ["compensate", str(run), "--calibration", str(tmp_path / "run.json"), "--out", str(out)]
    whole, killed, resumed = None, 0, 0
    for fate in kills(50, [*words, "--resume", "--force"], small):
        whole = whole or out.read_bytes()
        assert out.read_bytes() == whole
        killed += fate == "killed"
        resumed += bool(list(tmp_path.glob(".o*")))
    assert killed > 25
    assert resumed > 10
    assert out.read_bytes() == whole
    assert not list(tmp_path.glob(".o*"))


@pytest.mark.parametrize("kind", ["angle", "rate"])
def test_set_of_files_in_chunks_is_the_set_read_whole(tmp_path, monkeypatch, kind):
    runs = []
    for i, name in enumerate("xyz"):
        path = write(tmp_path, f"{name}.parquet", rows=400, axes=orthogonal()[i], phi=0.2 * i)
        if kind == "rate":
            path.write_text(path.read_text().replace('"angle", unit = "rad"', '"rate", unit = "rad/s"'))
            table = pa.parquet.read_table(tmp_path / f"{name}.parquet")
            rate = 0.9 + 0.1 * np.sin(0.3 * (i + 1) * table["t"].to_numpy())
            pa.parquet.write_table(table.set_column(1, "psi", pa.array(rate)), tmp_path / f"{name}.parquet")
        runs.append(path)
    mounted = orthogonal_triad([calibration_of(CAL, {"phi": 1e-4}, serial="A") for _ in runs])
    for name in ("whole", "parts"):
        set_files.compensate_set_files(runs, mounted, tmp_path / name, "parquet")
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
    set_files.compensate_set_files(runs, mounted, tmp_path / "o.parquet", "parquet")
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
        set_files.compensate_set_files(runs, mounted, tmp_path / "o.parquet", "parquet")


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


def test_state_of_a_resampler_moves_to_another_one():
    t, dv = 0.01 * np.arange(100.0), np.sin(np.arange(100.0))
    one, two = Resampler(0.03), Resampler(0.03)
    one.push(t[:40], dv[:40])
    two.go_on(one.carried())
    assert one.push(t[40:], dv[40:])[1].tobytes() == two.push(t[40:], dv[40:])[1].tobytes()


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
