"""A long record lies in files without a name: the same record, whatever the platform has, or a clear word about the room."""

from __future__ import annotations

import mmap
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyarrow import csv, parquet

import piga
from piga.formats.text import source as text_source
from piga.reading import raw_columns
from piga.records import spool
from tests.records.files import lines, write_log, write_run


@pytest.fixture
def run_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(raw_columns, "LARGE_ROWS", 100)
    monkeypatch.setattr(spool, "BLOCK", 64)
    rows = lines(900)
    rows[300] = rows[300].replace("1.0", "NaN")
    write_log(tmp_path, rows)
    return write_run(tmp_path)


def without_fallocate(patch: pytest.MonkeyPatch) -> None:
    patch.delattr(os, "posix_fallocate")


def without_advice(patch: pytest.MonkeyPatch) -> None:
    patch.delattr(mmap, "MADV_DONTNEED")
    patch.setattr(spool, "_watch", spool._Watch())


def nothing_resident(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(spool, "RESIDENT_BYTES", 0)


def everything_resident(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(spool, "RESIDENT_BYTES", 1 << 60)


def folder_not_writable(patch: pytest.MonkeyPatch) -> None:
    there = tempfile.TemporaryFile

    def refuse(*arguments: Any, **options: Any) -> Any:
        if options.get("dir") is not None:
            raise PermissionError(13, "Permission denied")
        return there(*arguments, **options)

    patch.setattr(tempfile, "TemporaryFile", refuse)


@pytest.mark.parametrize(
    "change", [without_fallocate, without_advice, nothing_resident, everything_resident, folder_not_writable]
)
def test_the_same_record(
    run_file: Path, monkeypatch: pytest.MonkeyPatch, change: Callable[[pytest.MonkeyPatch], None]
) -> None:
    with pytest.MonkeyPatch.context() as whole:
        whole.setattr(raw_columns, "LARGE_ROWS", 1 << 40)
        plain = piga.read_run(run_file)
    change(monkeypatch)
    run = piga.read_run(run_file)
    assert spool.arrays_like(run.t).folder is not None
    assert spool.arrays_like(plain.t).folder is None
    for name in ("t", "output", "f", "segment_index", "row", "begins"):
        np.testing.assert_array_equal(getattr(run, name), getattr(plain, name))
    assert run.quality == plain.quality
    assert sorted(path.name for path in run_file.parent.iterdir()) == ["run.csv", "run.toml"]


@pytest.mark.parametrize(("most", "on_disk"), [(0, True), (450, True), (899, True), (900, False)])
@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_rows_decide_what_is_on_disk(
    run_file: Path, monkeypatch: pytest.MonkeyPatch, most: int, on_disk: bool, kind: str
) -> None:
    """Not bytes; wherever in the file the row is met that is one too many, and whatever was expected."""
    if kind == "parquet":
        data = run_file.with_name("run.csv")
        parquet.write_table(csv.read_csv(data), data.with_suffix(".parquet"), compression="zstd")
        run_file.write_text(run_file.read_text().replace("run.csv", "run.parquet"))
    monkeypatch.setattr(raw_columns, "LARGE_ROWS", 1 << 40)
    plain = piga.read_run(run_file)
    monkeypatch.setattr(raw_columns, "LARGE_ROWS", most)
    for piece in (500, 1 << 20):
        monkeypatch.setattr(text_source, "PIECE_BYTES", piece)
        run = piga.read_run(run_file)
        assert (spool.arrays_like(run.t).folder is not None) == on_disk
        for name in ("t", "output", "f", "segment_index", "row", "begins"):
            np.testing.assert_array_equal(getattr(run, name), getattr(plain, name))


def test_no_room_for_the_columns(run_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(
        piga.DataError, match=r"no room for the columns.*No space left(?s:.*)free about three times"
    ):
        piga.read_run(run_file)


class Full:
    """A file on a disk without room."""

    def write(self, _data: object) -> int:
        raise OSError(28, "No space left on device")

    def close(self) -> None:
        """Nothing to close."""


def test_no_room_while_reading(run_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda **_: Full())
    with pytest.raises(piga.DataError, match=r"no room for the columns of a long record \(No space left"):
        piga.read_run(run_file)
