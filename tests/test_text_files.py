"""Whatever is named as an input: only a regular file of a size that its kind may have is read."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

import piga
from piga.calibration import RunSummary
from piga.certificate.certificate_file import read_certificate_file
from piga.certificate.dcc import load_certificate, read_xml
from piga.errors import PigaError
from piga.formats.text.reader import TextStream
from piga.records.run_file import read_run_file
from piga.text_files import open_regular, read_whole
from tests.records.files import lines, write_run

READERS: dict[str, Callable[[Path], object]] = {
    "json": piga.Calibration.from_json,
    "summary": RunSummary.from_json,
    "toml": read_run_file,
    "certificate": read_certificate_file,
    "xml": read_xml,
    "pem": load_certificate,
    "text": lambda path: list(TextStream(path, ("t",), None).chunks()),
}


@pytest.fixture(params=["fifo", "device", "folder"])
def odd(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """What is no file: a pipe that nobody writes to, a device that never ends, a folder."""
    path = tmp_path / "odd.csv"
    if request.param == "fifo":
        os.mkfifo(path)
    elif request.param == "device":
        path.symlink_to("/dev/zero")
    else:
        path.mkdir()
    return path


def within(seconds: float, work: Callable[[], object]) -> Exception:
    """The error of ``work``, which must not wait for bytes that never come."""
    caught: list[Exception] = []

    def run() -> None:
        try:
            work()
        except Exception as error:
            caught.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(seconds)
    assert not thread.is_alive(), "still reading"
    assert caught, "nothing was refused"
    return caught[0]


@pytest.mark.skipif(sys.platform == "win32", reason="no pipes and devices among the files there")
@pytest.mark.parametrize("kind", list(READERS))
def test_what_is_no_file_is_refused_at_once(odd: Path, kind: str) -> None:
    error = within(5.0, lambda: READERS[kind](odd))
    assert isinstance(error, PigaError)
    assert "is not a regular file" in str(error)


@pytest.mark.skipif(sys.platform == "win32", reason="no pipes and devices among the files there")
@pytest.mark.parametrize("ending", ["csv", "csv.gz", "parquet", "h5", "mat", "tdms", "xlsx"])
@pytest.mark.parametrize("kind", ["fifo", "device"])
def test_data_files(tmp_path: Path, ending: str, kind: str) -> None:
    path = tmp_path / f"run.{ending}"
    os.mkfifo(path) if kind == "fifo" else path.symlink_to("/dev/zero")
    run = write_run(tmp_path, path.name)
    error = within(5.0, lambda: piga.read_run(run))
    assert isinstance(error, PigaError)


RACE = """
import sys, threading, types
from pathlib import Path
from piga.records import run_file
from piga.text_files import convert_toml

sys.setswitchinterval(1e-6)
source = Path(run_file.__file__).read_text()
table = {"instrument": {"serial": "a", "scale_factor": "1 rad/s/g"}, "data": {"file": "x", "output": {"column": "a"}}}
table["data"]["output"]["kind"] = "counts"
for turn in range(10):
    module = sys.modules[f"m{turn}"] = types.ModuleType(f"m{turn}")
    exec(source, vars(module))
    start = threading.Barrier(8)
    work = lambda: (start.wait(), convert_toml(Path("x"), table, module.RunFile))
    threads = [threading.Thread(target=work) for _ in range(8)]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
"""
"""Threads that use the tables of a run file for the first time, all at the same time."""


def test_threads_that_meet_a_type_for_the_first_time() -> None:
    """Outside this process: where msgspec is called without a lock, the interpreter crashes."""
    subprocess.run([sys.executable, "-c", RACE], check=True, timeout=60.0)


def test_the_limit_holds_for_a_file_that_grows(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"x" * 10)
    assert read_whole(path, 10, "a smaller one") == b"x" * 10
    with pytest.raises(piga.DataError, match="larger than 9 bytes"):
        read_whole(path, 9, "a smaller one")
    path.write_bytes(b"0.0,1.0\n" * 200_000)
    with pytest.raises(piga.RunFileError, match="larger than 1048576 bytes"):
        read_run_file(path)
    with pytest.raises(piga.DataError, match="is not a file name"):
        read_whole(Path("a\0b"), 9, "a smaller one")
    with pytest.raises(piga.DataError, match="No such file"):
        open_regular(tmp_path / "none")


def test_labels_of_parquet_in_their_order(tmp_path: Path) -> None:
    """Names in order of appearance, through row groups, nulls and dictionaries with words that are not used."""
    labels = ["b"] * 20 + ["a"] * 10 + ["c"] * 10
    rows = [[float(cell) for cell in line.split(",")] for line in lines()]
    numbers = {name: [row[i] for row in rows] for i, name in enumerate(("t", "n", "fx", "fy", "fz"))}
    coded = pa.DictionaryArray.from_arrays(
        [2 if w == "b" else 1 if w == "a" else 3 for w in labels], ["x", "a", "b", "c"]
    )
    for column in (pa.array(labels), coded):
        parquet.write_table(pa.table(numbers | {"seg": column}), tmp_path / "run.parquet", row_group_size=15)
        run = piga.read_run(write_run(tmp_path, "run.parquet", data='segment = "seg"'))
        assert run.labels == ("b", "a", "c")
        assert np.bincount(run.segment_index).tolist() == [20, 10, 10]
