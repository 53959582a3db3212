"""Containers at the limits: lengths that cannot be, odd members; each ends in words or in the record."""

from __future__ import annotations

import struct
from pathlib import Path

import h5py
import numpy as np
import openpyxl
import pyarrow as pa
import pytest
from nptdms import ChannelObject, TdmsWriter
from pyarrow import parquet
from scipy.io import savemat

import piga
from piga.formats.container import CONTAINERS
from tests.records.containers import columns, whole, write_h5, write_tdms, write_xlsx
from tests.records.files import write_run


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
    assert whole(CONTAINERS[".tdms"](path, ("t",), "pos")).rows.size == 40
    path.write_bytes(raw.replace(index, struct.pack("<IIQ", 0x20, 1, 1 << 40)))
    with pytest.raises(piga.DataError, match="unpacks to more than 2048 MiB"):
        CONTAINERS[".tdms"](path, ("t",), "pos")


def test_parquet_that_does_not_fit(tmp_path: Path) -> None:
    with pytest.raises(piga.DataError, match=r"run\.parquet: cannot be read \(No such file"):
        piga.read_run(write_run(tmp_path, "run.parquet"))
    data = {name: pa.array(values) for name, values in columns().items()}
    parquet.write_table(pa.table(data | {"n": pa.array(["x"] * 40)}), tmp_path / "run.parquet")
    with pytest.raises(piga.DataError, match="column 'n' holds string, not numbers"):
        piga.read_run(write_run(tmp_path, "run.parquet"))
    parquet.write_table(pa.table(data)[:0], tmp_path / "run.parquet")
    with pytest.raises(piga.DataError, match="no data"):
        piga.read_run(write_run(tmp_path, "run.parquet"))
    twice = pa.Table.from_arrays([*data.values(), data["n"]], names=[*data, "n"])
    parquet.write_table(twice, tmp_path / "run.parquet")
    with pytest.raises(piga.DataError, match="duplicate column name 'n'"):
        piga.read_run(write_run(tmp_path, "run.parquet"))


NAMES = ("t", "n", "fx", "fy", "fz")


@pytest.mark.parametrize("name", ["run.h5", "run.tdms", "run.xlsx"])
def test_containers_without_a_row(tmp_path: Path, name: str) -> None:
    writer = {"run.h5": write_h5, "run.tdms": write_tdms, "run.xlsx": write_xlsx}[name]
    writer(tmp_path / name, columns(0))
    with pytest.raises(piga.DataError, match="no data"):
        CONTAINERS[Path(name).suffix](tmp_path / name, NAMES, None)


def test_a_counter_beyond_what_a_float_counts(tmp_path: Path) -> None:
    data = columns()
    data["n"] = data["n"].astype(np.uint64) + np.uint64(2**63)
    write_h5(tmp_path / "run.h5", data)
    with pytest.raises(piga.DataError, match=r"row 1, column 'n': 9\.2233\d+e\+18 is not a whole count"):
        piga.read_run(write_run(tmp_path, "run.h5"))


def test_hdf5_structs_and_units(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as out:
        table = np.zeros(4, dtype=[("t", "f8"), ("n", "i8")])
        table["n"] = [0, 3, 5, 9]
        out["log"] = table
        out["deep/fx"] = np.ones(4)
        out["deep/fx"].attrs["units"] = "g"
        out["deep/soft"] = h5py.SoftLink("/deep/fx")
    result = CONTAINERS[".h5"](path, ("log/n", "deep/fx"), None)
    np.testing.assert_array_equal(whole(result).numbers["log/n"], [0, 3, 5, 9])
    assert result.units == {"deep/fx": "g"}
    for wrong in ("log/speed", "log/n/more", "log", "deep"):
        with pytest.raises(piga.DataError, match=r"no column .*log/t, log/n") as caught:
            CONTAINERS[".h5"](path, (wrong,), None)
        assert "soft" not in str(caught.value).split("the columns are")[1]


def test_matlab_fields_and_labels(tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    cells = np.empty(3, dtype=object)
    cells[:] = ["up", "down", 7.0]
    words = np.array(["aa", "bb", "cc"])
    savemat(path, {"log": {"t": np.arange(3.0)}, "place": cells, "word": words, "z": 1j * np.arange(3.0)})
    with pytest.raises(piga.DataError, match="column 'z' holds complex128"):
        whole(CONTAINERS[".mat"](path, ("log.t", "z"), None))
    with pytest.raises(piga.DataError, match=r"no column 'log.speed'"):
        CONTAINERS[".mat"](path, ("log.speed",), None)
    with pytest.raises(piga.DataError, match=r"no column 'place.t.t'|no column 'log.t.t'"):
        CONTAINERS[".mat"](path, ("log.t.t",), None)
    codes, names = whole(CONTAINERS[".mat"](path, ("log.t",), "place")).label
    assert [names[code] for code in codes] == ["up", "down", "7"]
    codes, names = whole(CONTAINERS[".mat"](path, ("log.t",), "word")).label
    assert [names[code] for code in codes] == ["aa", "bb", "cc"]


def test_tdms_labels_and_channels_of_one_name(tmp_path: Path) -> None:
    path = tmp_path / "run.tdms"
    with TdmsWriter(path) as out:
        out.write_segment(
            [
                ChannelObject("a", "t", np.arange(3.0)),
                ChannelObject("b", "t", np.arange(3.0) + 1.0),
                ChannelObject("a", "place", ["up", "up", "down"]),
            ]
        )
    with pytest.raises(piga.DataError, match=r"(?s)several groups have a channel 't'.*'a/t', 'b/t'"):
        CONTAINERS[".tdms"](path, ("t",), None)
    result = whole(CONTAINERS[".tdms"](path, ("b/t",), "place"))
    np.testing.assert_array_equal(result.numbers["b/t"], [1.0, 2.0, 3.0])
    codes, names = result.label
    assert [names[code] for code in codes] == ["up", "up", "down"]


def test_sheets_without_names_or_rows(tmp_path: Path) -> None:
    path = tmp_path / "run.xlsx"
    for row, message in (((), "the sheet is empty"), ((0.0, 1, 1.0), "the first row holds numbers")):
        book = openpyxl.Workbook()
        book.active.append(row)
        book.save(path)
        with pytest.raises(piga.DataError, match=message):
            CONTAINERS[".xlsx"](path, NAMES, None)
