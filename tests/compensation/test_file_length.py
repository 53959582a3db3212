"""Rows decide whether a file is streamed: counted or known before it is read, packed as it may be."""

from __future__ import annotations

import gzip

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

import piga
from piga.compensation import identify_phase
from piga.compensation.compensate import compensate_in_pieces
from piga.compensation.file_length import holds_more
from piga.compensation.phase import identify_phase_of_file
from piga.compensation.writers import TableWriter
from piga.records.run_file import read_run_file
from piga.records.stream import nulls_of, numbers_of

from .test_command import CAL, command, small_chunks, write
from .twin_data import K_G, TAN_BETA, calibration_of, constant_force, run_of


def data_of(folder, name: str):
    run = write(folder, rows=10)
    run.write_text(run.read_text().replace("run.parquet", name))
    return read_run_file(run).data


def columns(rows: int) -> dict[str, np.ndarray]:
    return {name: np.arange(float(rows)) for name in ("t", "psi", "fx", "fy", "fz", "part")}


@pytest.mark.parametrize("packing", ["none", "zstd"])
def test_parquet_knows_its_rows_however_packed(tmp_path, packing):
    data = data_of(tmp_path, "p.parquet")
    pa.parquet.write_table(pa.table(columns(5000)), tmp_path / "p.parquet", compression=packing)
    assert holds_more(tmp_path, data, 4999)
    assert not holds_more(tmp_path, data, 5000)


@pytest.mark.parametrize("end", [b"\n", b"\r\n", b"\r"])
@pytest.mark.parametrize("name", ["a.csv", "a.csv.gz"])
def test_lines_of_text_are_counted(tmp_path, end, name):
    data = data_of(tmp_path, name)
    text = b"t,psi,fx,fy,fz" + end + (b"0,0,0,0,0" + end) * 5000
    (tmp_path / name).write_bytes(gzip.compress(text) if name.endswith("gz") else text)
    assert holds_more(tmp_path, data, 5000)
    assert not holds_more(tmp_path, data, 5001)


def test_a_packed_container_is_asked(tmp_path):
    h5py = pytest.importorskip("h5py")
    data = data_of(tmp_path, "a.h5")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in columns(1):
            file.create_dataset(name, data=np.zeros(100_000), compression="gzip")
    assert (tmp_path / "a.h5").stat().st_size < 100_000
    assert holds_more(tmp_path, data, 20_000)
    assert not holds_more(tmp_path, data, 200_000)


def test_what_cannot_be_read_is_left_to_the_reader(tmp_path):
    data = data_of(tmp_path, "a.csv.gz")
    assert not holds_more(tmp_path, data, 0)
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(b"t\n" * 100)[:20])
    assert not holds_more(tmp_path, data, 1000)


@pytest.mark.parametrize("kind", ["angle", "rate"])
def test_phase_of_a_file_is_that_of_the_record(tmp_path, monkeypatch, capsys, kind):
    """The first 20 s of 30, in chunks of 100 rows: no row behind them is read."""
    t = np.arange(0.0, 30.0, 0.02)
    f = constant_force(t, 0.7, 0.7, 0.1)
    record = run_of(t, f, phi=0.8, kind=kind)
    path = write(tmp_path, rows=10)
    output = record.output + 1e-5 * np.random.default_rng(1).standard_normal(t.size)
    table = {"t": t, "psi": output, "fx": f[:, 0], "fy": f[:, 1], "fz": f[:, 2]}
    pa.parquet.write_table(pa.table(table), tmp_path / "run.parquet")
    text = path.read_text()
    path.write_text(
        text if kind == "angle" else text.replace('"angle" , unit = "rad"', '"rate", unit = "rad/s"')
    )
    cal = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.0}, serial="A", angle_rms=1e-5)
    small_chunks(monkeypatch, 100)
    whole, streamed = (
        identify_phase(piga.read_run(path), cal, 20.0),
        identify_phase_of_file(path, cal, 20.0),
    )
    assert abs(whole.value - 0.8) < 2e-3
    assert abs(streamed.value - whole.value) < 1e-9
    assert abs(streamed.std / whole.std - 1.0) < 1e-6
    cal.to_json(tmp_path / "run.json")
    monkeypatch.setattr("piga.cli.compensate.STREAM_ROWS", 0)
    words = (
        path,
        "--calibration",
        tmp_path / "run.json",
        "--identify-phase",
        "20 s",
        "--out",
        tmp_path / "o.parquet",
    )
    code, _, said = command(monkeypatch, capsys, *words)
    assert code == 0, said
    assert f"phase {streamed.value:.6g} rad" in said
    expected = piga.compensate(piga.read_run(path), cal, phase=streamed)
    assert pa.parquet.read_table(tmp_path / "o.parquet")["ax"].to_numpy().tobytes() == expected.ax.tobytes()


def test_a_record_in_pieces_is_the_record(monkeypatch):
    """Pieces of 64 rows: rows, labels and samples to the bit."""
    t = 0.01 * np.arange(1000)
    run = run_of(t, constant_force(t, 1.0, 3.0, 1.0), phi=0.3)
    cal = calibration_of(CAL, {"phi": 1e-4})
    whole = piga.compensate(run, cal)
    monkeypatch.setattr("piga.records.spool.BLOCK", 64)
    found = list(compensate_in_pieces(run, cal))
    assert len(found) == 16
    assert {label for label, _, _ in found} == set(run.labels)
    for name in ("t", "ax", "dv", "u_ax", "flags"):
        assert (
            np.concatenate([getattr(part, name) for _, _, part in found]).tobytes()
            == getattr(whole, name).tobytes()
        )
    assert np.concatenate([chunk.a_Y for _, chunk, _ in found]).tobytes() == run.f[:, 1].tobytes()


def test_a_long_record_with_a_stand_is_written_in_pieces(tmp_path, monkeypatch, capsys):
    """No reference columns: the stand computes it; the file and the page are those of the short record."""
    run = write(tmp_path, rows=1000)
    lines = [line for line in run.read_text().splitlines() if not line.startswith("reference")]
    stand = [
        'segment = "part"',
        "[stand]",
        'kind = "dividing-head"',
        'latitude = "40 deg"',
        'gravity = "9.80166 m/s^2"',
    ]
    run.write_text("\n".join([*lines, *stand, 'positions = ["0 deg", "30 deg"]']))
    words = (run, "--calibration", tmp_path / "run.json", "--report", tmp_path / "r.html", "--out")
    assert command(monkeypatch, capsys, *words, tmp_path / "a.parquet")[0] == 0
    monkeypatch.setattr("piga.cli.compensate.STREAM_ROWS", 0)
    monkeypatch.setattr("piga.records.spool.BLOCK", 64)
    code, _, said = command(monkeypatch, capsys, *words, tmp_path / "b.parquet")
    assert code == 0, said
    a, b = (pa.parquet.read_table(tmp_path / f"{name}.parquet") for name in "ab")
    assert all(a[c].to_numpy().tobytes() == b[c].to_numpy().tobytes() for c in a.column_names)
    assert b.num_rows == 1000


def test_columns_without_nulls_in_parquet(tmp_path, monkeypatch, capsys):
    run = write(tmp_path)
    words = (run, "--calibration", tmp_path / "run.json", "--out", tmp_path / "o.parquet")
    assert command(monkeypatch, capsys, *words)[0] == 0
    schema = pa.parquet.read_table(tmp_path / "o.parquet").schema
    assert not any(field.nullable for field in schema)


def test_numbers_of_every_kind_of_column():
    """Whole and broken numbers, nulls, parts of a column: as Arrow's own conversion gives them."""
    for column in (
        pa.array([1.0, None, -0.0, np.nan, np.inf]), pa.array([1, None, 2**60 + 1], pa.int64()),
        pa.array([2**63 + 5, 1], pa.uint64()), pa.array([1.5, None, 2.5], pa.float32()),
        pa.array([1.0, 2.0, None, 4.0]).slice(1, 3), pa.array([], pa.float64()), pa.array([None], pa.int8()),
    ):  # fmt: skip
        expected = column.to_numpy(zero_copy_only=False).astype(float)
        assert numbers_of(column).tobytes() == expected.tobytes() or np.array_equal(
            numbers_of(column), expected, equal_nan=True
        )
        assert nulls_of(column).tolist() == [value is None for value in column.to_pylist()]
        assert numbers_of(column).flags.writeable


@pytest.mark.parametrize("sizes", [(250,), (99, 1, 150), (37,) * 6 + (28,), (100, 100, 50)])
def test_row_groups_do_not_depend_on_the_pieces(tmp_path, monkeypatch, sizes):
    """250 rows in groups of 100: the same bytes however they come."""
    monkeypatch.setattr("piga.compensation.writers.GROUP_ROWS", 100)
    whole = {"t": np.arange(250.0), "flags": np.arange(250, dtype=np.int32)}
    with TableWriter(tmp_path / "whole.parquet") as writer:
        writer.write(whole)
    start = 0
    with TableWriter(tmp_path / "pieces.parquet") as writer:
        for size in sizes:
            writer.write({name: values[start : start + size] for name, values in whole.items()})
            start += size
        assert writer.rows == 250
    found = pa.parquet.ParquetFile(tmp_path / "pieces.parquet").metadata
    assert [found.row_group(i).num_rows for i in range(found.num_row_groups)] == [100, 100, 50]
    assert (tmp_path / "pieces.parquet").read_bytes() == (tmp_path / "whole.parquet").read_bytes()
