"""Containers at the limits: lengths that cannot be, odd members; each ends in words or in the record."""

from __future__ import annotations

import struct
from pathlib import Path

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


ROWS = 300
VALUES = np.round(100.0 * np.random.default_rng(1).random(ROWS)) + 0.5


def read_mat(path: Path, numeric: tuple[str, ...], label: str | None = None) -> dict[str, np.ndarray]:
    return whole(CONTAINERS[".mat"](path, numeric, label)).numbers


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("shape", [(ROWS, 1), (1, ROWS), (ROWS // 3, 3), (1, 1)])
def test_columns_are_those_that_were_written(tmp_path: Path, packed: bool, shape: tuple[int, int]) -> None:
    values = VALUES[: shape[0] * shape[1]].reshape(shape)
    savemat(tmp_path / "a.mat", {"other": VALUES, "x": values}, do_compression=packed)
    columns = {"x(:,1)": values[:, 0], f"x(:,{shape[1]})": values[:, -1]}
    columns |= {"x": values.reshape(-1)} if 1 in shape else {}
    for name, values_of in columns.items():
        np.testing.assert_array_equal(read_mat(tmp_path / "a.mat", (name,))[name], values_of)
    if 1 not in shape:
        with pytest.raises(piga.DataError, match="a column is needed"):
            read_mat(tmp_path / "a.mat", ("x",))


def test_fields_of_structs(tmp_path: Path) -> None:
    log = {"t": VALUES, "inner": {"n": np.arange(ROWS), "words": "text"}, "f": np.outer(VALUES, [1.0, 2.0])}
    savemat(tmp_path / "a.mat", {"first": VALUES, "log": log})
    columns = read_mat(tmp_path / "a.mat", ("log.t", "log.inner.n", "log.f(:,2)"))
    np.testing.assert_array_equal(columns["log.t"], VALUES)
    np.testing.assert_array_equal(columns["log.inner.n"], np.arange(ROWS))
    np.testing.assert_array_equal(columns["log.f(:,2)"], 2.0 * VALUES)
    for name in ("log", "log.speed", "log.inner.words", "log.t.n", "first.t", "log.f(:,3)", "log.f(:,0)"):
        with pytest.raises(piga.DataError):
            read_mat(tmp_path / "a.mat", (name,))
