"""A long record lies in files without a name: the same record, or a clear word about the room."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np
import pytest
from pyarrow import csv, parquet

import piga
from piga.records import arrays
from tests.records.files import lines, write_log, write_run


@pytest.fixture
def run_file(tmp_path: Path) -> Path:
    rows = lines(900)
    rows[300] = rows[300].replace("1.0", "NaN")
    write_log(tmp_path, rows)
    return write_run(tmp_path)


def is_mapped(values: np.ndarray) -> bool:
    owner = values
    while isinstance(owner, np.ndarray) and not isinstance(owner, np.memmap):
        owner = owner.base
    return isinstance(owner, np.memmap)


@pytest.mark.parametrize("kind", ["csv", "parquet"])
@pytest.mark.parametrize("fallocate", [True, False])
def test_the_same_record(run_file: Path, monkeypatch: pytest.MonkeyPatch, kind: str, fallocate: bool) -> None:
    """In memory, and with every array above some size in a file, of which nothing is left."""
    if kind == "parquet":
        data = run_file.with_name("run.csv")
        parquet.write_table(csv.read_csv(data), data.with_suffix(".parquet"), compression="zstd")
        run_file.write_text(run_file.read_text().replace("run.csv", "run.parquet"))
        data.unlink()
    plain = piga.read_run(run_file)
    if not fallocate:
        monkeypatch.delattr(os, "posix_fallocate")
    for most in (0, 7192):  # 899 numbers of 8 bytes are used
        monkeypatch.setattr(arrays, "LARGE_BYTES", most)
        run = piga.read_run(run_file)
        assert is_mapped(run.output) == (most < 7192)
        assert not is_mapped(plain.output)
        for name in ("t", "output", "f", "segment_index", "row", "begins"):
            np.testing.assert_array_equal(getattr(run, name), getattr(plain, name))
        assert run.quality == plain.quality
    assert sorted(path.name for path in run_file.parent.iterdir()) == [f"run.{kind}", "run.toml"]


def test_a_column_of_unknown_length(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.default_rng(1).standard_normal(1000)
    for most in (0, 8000):
        monkeypatch.setattr(arrays, "LARGE_BYTES", most)
        column = arrays.ColumnWriter()
        for start in range(0, 1000, 7):
            column.append(values[start : start + 7])
        made = column.finish()
        assert is_mapped(made) == (most < 8000)
        np.testing.assert_array_equal(made, values)
        made[3] = 1.0  # it can be written to
        assert arrays.taken(made, made == 1.0).tolist() == [1.0]
        np.testing.assert_array_equal(arrays.scaled(made, 2.0, 3.0), made * 2.0 + 3.0)


def test_files_lie_where_there_is_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TMPDIR", raising=False)
    usual = "/var/tmp"  # noqa: S108 - only its name
    assert arrays.folder() == (usual if os.access(usual, os.W_OK) else tempfile.gettempdir())
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    assert arrays.folder() == str(tmp_path)


def test_no_room_for_the_columns(run_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(arrays, "LARGE_BYTES", 0)
    for place, name in ((os, "posix_fallocate"), (tempfile, "TemporaryFile")):
        with monkeypatch.context() as patch:
            patch.setattr(place, name, full)
            with pytest.raises(piga.DataError, match=r"no room for the columns.*No space left(?s:.*)TMPDIR"):
                piga.read_run(run_file)
