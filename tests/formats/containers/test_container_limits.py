"""Containers at the limits: memory, time, lengths that cannot be, odd members; each ends in words or in the record."""

from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pytest
from nptdms import ChannelObject, TdmsWriter
from pyarrow import parquet

import piga
from piga.formats.containers.container import READERS
from tests.records.containers import columns, write_h5
from tests.records.files import write_run

SCARCE = """
import resource, sys
from pathlib import Path
from piga.errors import DataError
from piga.formats.containers.container import read_container
resource.setrlimit(resource.RLIMIT_AS, (1300 << 20, 1300 << 20))
try:
    read_container(Path(sys.argv[1]), ".h5", ("t",), None)
except DataError as error:
    print(error)
"""


@pytest.mark.only_compiled
@pytest.mark.skipif(sys.platform != "linux", reason="address space is limited there only")
def test_more_memory_than_there_is(tmp_path: Path) -> None:
    """A dataset of 1.5 GiB in a file with a hole of that size, read where the system gives 1.3 GiB to a process."""
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as out:
        plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plan.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
        plan.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
        space = h5py.h5s.create_simple((192 << 20,))
        h5py.h5d.create(out.id, b"t", h5py.h5t.IEEE_F64LE, space, plan)
    assert path.stat().st_size > 1 << 30
    done = subprocess.run(
        [sys.executable, "-c", SCARCE, str(path)], capture_output=True, text=True, check=False
    )
    assert "run.h5: reading it needs more than 6 GiB of memory" in done.stdout, done.stderr
    assert "remedy: the file is damaged, or export it as Parquet" in done.stdout


def matlab_cells(path: Path, cells: list[object]) -> None:
    """A v7.3 file whose cell array ``pos`` refers to texts, numbers and whatever else is given."""
    with h5py.File(path, "w", userblock_size=512) as out:
        held = out.create_group("#refs#")
        references = []
        for index, cell in enumerate(cells):
            if isinstance(cell, str):
                item = held.create_dataset(f"c{index}", data=np.array([[ord(c)] for c in cell], "<u2"))
                item.attrs["MATLAB_class"] = np.bytes_("char")
            elif isinstance(cell, float):
                item = held.create_dataset(f"c{index}", data=np.array([[cell]]))
                item.attrs["MATLAB_class"] = np.bytes_("double")
            else:
                item = held.create_group(f"c{index}")
                item.attrs["MATLAB_class"] = np.bytes_("struct")
            references.append(item.ref)
        item = out.create_dataset("pos", (1, len(cells)), h5py.ref_dtype)
        item[0, :] = references
        item.attrs["MATLAB_class"] = np.bytes_("cell")
        item = out.create_dataset("t", data=np.arange(float(len(cells)))[None, :])
        item.attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")


def test_cells_of_texts_and_numbers(tmp_path: Path) -> None:
    matlab_cells(tmp_path / "a.mat", ["up", "下", 3.0, 2.5, "up"])
    codes, names = READERS[".mat"](tmp_path / "a.mat", ("t",), "pos").labels["pos"]
    assert [names[code] for code in codes] == ["up", "下", "3", "2.5", "up"]
    matlab_cells(tmp_path / "b.mat", ["up", None])
    with pytest.raises(piga.DataError, match="'pos', cell 2 holds no text and no number"):
        READERS[".mat"](tmp_path / "b.mat", ("t",), "pos")


def test_only_what_can_be_named_is_listed(tmp_path: Path) -> None:
    """Committed types, links, and groups too deep are no columns."""
    with h5py.File(tmp_path / "a.h5", "w") as out:
        out["kind"] = np.dtype("f8")
        out["elsewhere"] = h5py.SoftLink("/deep")
        out["deep/a/b/c/d/e/f/g/h/i/j/t"] = np.arange(3.0)
        out["group/t"] = np.arange(3.0)
    with pytest.raises(piga.DataError, match=r"no column 'n'; the columns are: group/t\n"):
        READERS[".h5"](tmp_path / "a.h5", ("n",), None)


def test_a_channel_longer_than_its_file(tmp_path: Path) -> None:
    """Texts say how many they are and, apart from that, how many bytes: damage can make the two differ by anything."""
    path = tmp_path / "run.tdms"
    with TdmsWriter(path) as out:
        out.write_segment(
            [ChannelObject("log", "t", np.arange(40.0)), ChannelObject("log", "pos", ["up"] * 40)]
        )
    raw = path.read_bytes()
    index = struct.pack("<IIQ", 0x20, 1, 40)  # texts, one dimension, forty of them
    assert raw.count(index) == 1
    assert READERS[".tdms"](path, ("t",), "pos").rows == 40
    path.write_bytes(raw.replace(index, struct.pack("<IIQ", 0x20, 1, 1 << 40)))
    with pytest.raises(
        piga.DataError, match=r"declares 1099511627816 values, more than its \d+ bytes can hold"
    ):
        READERS[".tdms"](path, ("t",), "pos")


def test_parquet_that_does_not_fit(tmp_path: Path) -> None:
    with pytest.raises(piga.DataError, match=r"run\.parquet: cannot be read \(No such file"):
        piga.read_run(write_run(tmp_path, "run.parquet"))
    data = {name: pa.array(values) for name, values in columns().items()}
    parquet.write_table(pa.table(data | {"n": pa.array(["x"] * 40)}), tmp_path / "run.parquet")
    with pytest.raises(piga.DataError, match="column 'n' holds string, not numbers"):
        piga.read_run(write_run(tmp_path, "run.parquet"))
    twice = pa.Table.from_arrays([*data.values(), data["n"]], names=[*data, "n"])
    parquet.write_table(twice, tmp_path / "run.parquet")
    with pytest.raises(piga.DataError, match="duplicate column name 'n'"):
        piga.read_run(write_run(tmp_path, "run.parquet"))


def test_a_reader_that_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the system, when memory is short or the limit on computing time is reached."""
    folder = tmp_path / "fake" / "piga"
    room = folder / "formats" / "containers"
    room.mkdir(parents=True)
    for package in (folder, room.parent, room):
        (package / "__init__.py").write_text("")
    write_h5(tmp_path / "run.h5", columns())
    monkeypatch.setattr(sys, "path", [str(tmp_path / "fake"), *sys.path])
    for name in ("SIGKILL", "SIGXCPU"):
        (room / "container.py").write_text(f"import os, signal\nos.kill(os.getpid(), signal.{name})\n")
        with pytest.raises(piga.DataError, match=r"took more than \d+ s of computing time"):
            piga.read_run(write_run(tmp_path, "run.h5"))
