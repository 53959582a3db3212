"""HDF5, MATLAB, TDMS and XLSX give the same record as CSV; damaged and hostile ones are refused."""

from __future__ import annotations

import struct
from datetime import datetime
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
from piga.errors import Where
from piga.formats.container import columns_stream
from piga.formats.text.convention import TextOptions
from tests.records.containers import (
    WRITERS,
    Whole,
    columns,
    whole,
    write_h5,
    write_mat,
    write_mat73,
    write_tdms,
    write_xlsx,
)
from tests.records.files import lines, read, write_run

NAMES = ("t", "n", "fx", "fy", "fz")


def direct(path: Path, numeric: tuple[str, ...] = NAMES, label: str | None = None) -> Whole:
    return whole(columns_stream(path, numeric, label))


@pytest.mark.parametrize("name", list(WRITERS))
def test_every_container_gives_the_record_of_the_csv(tmp_path: Path, name: str) -> None:
    plain = read(tmp_path, lines())
    WRITERS[name](tmp_path / name, columns())
    run = piga.read_run(write_run(tmp_path, name))
    for mine, theirs in ((run.t, plain.t), (run.output, plain.output), (run.f, plain.f)):
        np.testing.assert_array_equal(mine, theirs)
    assert run.quality.events == ()


@pytest.mark.parametrize("name", list(WRITERS))
def test_a_missing_column_lists_those_that_are_there(tmp_path: Path, name: str) -> None:
    WRITERS[name](tmp_path / name, columns())
    with pytest.raises(piga.DataError, match=r"no column 'speed'; the columns are: .*fx") as caught:
        direct(tmp_path / name, ("t", "speed"))
    error = caught.value
    assert {one.rpartition("/")[2] for one in error.columns} == {*NAMES}
    assert error.where == Where(tmp_path / name, 1 if name == "run.xlsx" else None, ("speed",))


@pytest.mark.parametrize("name", list(WRITERS))
def test_cut_and_foreign_files_are_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    WRITERS[name](path, columns())
    whole = path.read_bytes()
    for content in (whole[: len(whole) // 2], b"", b"not a container", whole[:600]):
        path.write_bytes(content)
        with pytest.raises(piga.DataError, match="remedy") as caught:
            direct(path)
        assert name in str(caught.value)


@pytest.mark.parametrize("name", list(WRITERS))
def test_columns_of_different_length_are_refused(tmp_path: Path, name: str) -> None:
    data = columns()
    data["fz"] = data["fz"][:-1]
    if name == "run.xlsx":
        pytest.skip("a short column of a sheet has empty cells, which are counted")
    WRITERS[name](tmp_path / name, data)
    with pytest.raises(piga.DataError, match=r"'fz' has 39 rows, column 't' has 40"):
        direct(tmp_path / name)


def test_units_in_the_container_are_checked(tmp_path: Path) -> None:
    write_h5(tmp_path / "run.h5", columns(), {"fx": np.array([b"m/s^2"])})
    with pytest.raises(piga.DataError, match=r"column 'fx' has the unit 'm/s\^2' in the file, but 'g'"):
        piga.read_run(write_run(tmp_path, "run.h5"))
    write_tdms(tmp_path / "run.tdms", columns(), {"t": "ms"})
    assert columns_stream(tmp_path / "run.tdms", NAMES, None).units == {"t": "ms"}


def test_a_date_above_the_table_of_a_sheet_is_not_its_zero(tmp_path: Path) -> None:
    book = openpyxl.Workbook()
    book.active.append(["made", datetime(2019, 3, 1)])
    book.active.append(["t", "n"])
    for k in range(3):
        book.active.append([datetime(2024, 5, 1, 12, 0, k), k])
    book.save(tmp_path / "log.xlsx")
    found = direct(tmp_path / "log.xlsx", ("t", "n"))
    np.testing.assert_array_equal(found.numbers["t"], 43200.0 + np.arange(3.0))


def test_matrices_structs_groups_and_labels(tmp_path: Path) -> None:
    data = columns()
    f = np.column_stack([data.pop(name) for name in ("fx", "fy", "fz")])
    log = data | {"inner": {"n": data["n"]}, "words": "text"}
    write_mat(tmp_path / "a.mat", {"log": log, "f": f, "pos": np.array(["one", "two"], object)[[0] * 40]})
    wanted = ("log.t", "log.n", "f(:,1)", "f(:,2)", "f(:,3)")
    table = direct(tmp_path / "a.mat", wanted, "pos")
    np.testing.assert_array_equal(table.numbers["f(:,2)"], 0.1)
    assert table.label[1] == ("one",)
    with pytest.raises(piga.DataError, match="the matrix has 3 columns"):
        direct(tmp_path / "a.mat", ("f(:,4)",))
    for name in ("log", "log.speed", "log.words", "log.t.n", "f.t", "f(:,0)"):
        with pytest.raises(piga.DataError):
            direct(tmp_path / "a.mat", (name,))
    np.testing.assert_array_equal(
        direct(tmp_path / "a.mat", ("log.inner.n",)).numbers["log.inner.n"], data["n"]
    )
    with pytest.raises(piga.DataError, match=r"shape \(40, 3\).*needed(?s:.*)f\(:,1\)"):
        direct(tmp_path / "a.mat", ("f",))
    with h5py.File(tmp_path / "b.h5", "w") as out:
        out["run/f"] = f
        out["run/pos"] = ["a"] * 20 + ["b"] * 20
        out["run/log"] = np.rec.fromarrays([data["t"], data["n"]], names="t,n")
    table = direct(tmp_path / "b.h5", ("run/log/t", "run/f(:,1)"), "run/pos")
    assert table.label[1] == ("a", "b")
    with pytest.raises(piga.DataError, match=r"the columns are: .*run/log/t"):
        direct(tmp_path / "b.h5", ("t",))


def test_hdf5_never_leaves_the_file(tmp_path: Path) -> None:
    write_h5(tmp_path / "other.h5", columns())
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as out:
        out["t"] = h5py.ExternalLink("other.h5", "/t")
        out["soft"] = h5py.SoftLink("/t")
        layout = h5py.VirtualLayout((40,), "f8")
        layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "n", (40,))
        out.create_virtual_dataset("v", layout)
        out.create_dataset("e", (4,), "f8", external=[("raw.bin", 0, 32)])
        out.create_dataset("huge", (1 << 45,), "f8", chunks=(1 << 16,), compression="gzip")
        out.create_dataset("obj", (2,), h5py.ref_dtype)
        out["c"] = np.ones(4, complex)
    for name, message in (
        ("t", "no column 't'"), ("soft", "no column 'soft'"), ("v", "lie in other files"),
        ("e", "lie in other files"), ("huge", "unpacks to more than"),
        ("obj", "holds objects"), ("c", "holds complex128"),
    ):  # fmt: skip
        with pytest.raises(piga.DataError, match=message):
            direct(path, (name,))


def test_sheets_formulas_and_text(tmp_path: Path) -> None:
    path = tmp_path / "run.xlsx"
    book = write_xlsx(path, columns())
    book.create_sheet("notes")
    book.save(path)
    with pytest.raises(piga.DataError, match="2 sheets: 'log', 'notes'") as caught:
        columns_stream(path, NAMES, None)
    assert [(fix.key, fix.value) for fix in caught.value.fixes] == [("sheet", "log"), ("sheet", "notes")]
    with pytest.raises(piga.DataError, match="no sheet 'data'"):
        columns_stream(path, NAMES, None, TextOptions(sheet="data"))
    assert whole(columns_stream(path, NAMES, None, TextOptions(sheet="log"))).rows.size == 40
    run = piga.read_run(write_run(tmp_path, "run.xlsx", data='sheet = "log"'))
    assert run.size == 40
    sheet = book["log"]
    sheet["B9"] = "=B8+1"
    sheet["C10"] = "OVER"
    book.save(path)
    table = columns_stream(path, NAMES, None, TextOptions(sheet="log"))
    whole(table)
    assert {(e.kind, e.count, e.first_row) for e in table.events()} == {
        ("missing-value", 1, 9), ("missing-value", 1, 10),
    }  # fmt: skip
    sheet["B12"], sheet["C13"] = "x5", True
    book.save(path)
    with pytest.raises(
        piga.DataError, match=r"row 12, column 'n' \(B\): 'x5' is not a number.*row 13, column 'fx' \(C\)"
    ):
        whole(columns_stream(path, NAMES, None, TextOptions(sheet="log")))


@pytest.mark.parametrize(("shape", "matlab"), [((700, 1), False), ((1, 700), False), ((1, 700), True)])
def test_a_column_standing_or_lying(tmp_path: Path, shape: tuple[int, ...], matlab: bool) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as out:
        out.create_dataset("n", data=np.arange(700).reshape(shape), chunks=True, compression=4)
        if matlab:
            out["n"].attrs["MATLAB_class"] = np.bytes_("double")
    np.testing.assert_array_equal(direct(tmp_path / "a.h5", ("n",)).numbers["n"], np.arange(700.0))


def test_cells_of_a_sheet(tmp_path: Path) -> None:
    """What is read is what was in the cells: numbers, labels, missing ones and where they stood."""
    book = openpyxl.Workbook()
    book.active.append(["t", "n", "part"])
    for i in range(40):
        book.active.append([i / 4.0, None if i in (9, 30) else i, (None, 1.0, "up", "down")[i // 10]])
        if i == 20:
            book.active.append([])
    book.save(tmp_path / "a.xlsx")
    stream = columns_stream(tmp_path / "a.xlsx", ("t", "n"), "part")
    table = whole(stream)
    i = np.arange(40.0)
    np.testing.assert_array_equal(table.numbers["t"], i / 4.0)
    np.testing.assert_array_equal(table.numbers["n"], np.where(np.isin(i, (9, 30)), np.nan, i))
    assert table.label[1] == ("1", "up", "down")
    np.testing.assert_array_equal(table.label[0], i // 10 - 1)
    np.testing.assert_array_equal(table.rows, i + 2 + (i > 20))
    assert [(e.kind, e.count, e.first_row) for e in stream.events()] == [
        ("blank-line", 1, None),
        ("missing-value", 2, 11),
    ]


def test_old_spreadsheets_and_open_ones(tmp_path: Path) -> None:
    (tmp_path / "run.xls").write_bytes(b"x")
    with pytest.raises(piga.DataError, match=r"of kind '\.xls'(?s:.*)save it as \.xlsx"):
        piga.read_run(write_run(tmp_path, "run.xls"))
    write_xlsx(tmp_path / "run.xlsx", columns())
    (tmp_path / "~$run.xlsx").write_bytes(b"x")
    with pytest.raises(piga.DataError, match="open in a spreadsheet"):
        piga.read_run(write_run(tmp_path, "run.xlsx"))


def test_text_of_matlab_v73_is_refused(tmp_path: Path) -> None:
    """Char arrays and cell arrays: UTF-16 units, references into #refs#."""
    path = tmp_path / "v73.mat"
    write_mat73(path, columns(6))
    with h5py.File(path, "r+") as out:
        cells = np.empty((1, 6), dtype=h5py.ref_dtype)
        out.create_dataset("position", data=cells, dtype=h5py.ref_dtype).attrs["MATLAB_class"] = np.bytes_(
            "cell"
        )
        out.create_dataset("code", data=np.full((3, 6), 97, np.uint16)).attrs["MATLAB_class"] = np.bytes_(
            "char"
        )
    for name in ("position", "code"):
        with pytest.raises(piga.DataError, match=r"text of MATLAB v7\.3"):
            direct(path, NAMES, name)


# --- at the limits: lengths that cannot be, odd members


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
    assert whole(columns_stream(path, ("t",), "pos")).rows.size == 40
    path.write_bytes(raw.replace(index, struct.pack("<IIQ", 0x20, 1, 1 << 40)))
    with pytest.raises(piga.DataError, match="unpacks to more than 2048 MiB"):
        columns_stream(path, ("t",), "pos")


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


@pytest.mark.parametrize("name", ["run.h5", "run.tdms", "run.xlsx"])
def test_containers_without_a_row(tmp_path: Path, name: str) -> None:
    writer = {"run.h5": write_h5, "run.tdms": write_tdms, "run.xlsx": write_xlsx}[name]
    writer(tmp_path / name, columns(0))
    with pytest.raises(piga.DataError, match="no data"):
        columns_stream(tmp_path / name, NAMES, None)


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
        columns_stream(path, ("t",), None)
    result = whole(columns_stream(path, ("b/t",), "place"))
    np.testing.assert_array_equal(result.numbers["b/t"], [1.0, 2.0, 3.0])
    codes, names = result.label
    assert [names[code] for code in codes] == ["up", "up", "down"]


def test_sheets_without_names_or_rows(tmp_path: Path) -> None:
    path = tmp_path / "run.xlsx"
    for row, message in (((), "is empty"), ((0.0, 1, 1.0), "the first row holds numbers")):
        book = openpyxl.Workbook()
        book.active.append(row)
        book.save(path)
        with pytest.raises(piga.DataError, match=message):
            columns_stream(path, NAMES, None)


ROWS = 300
VALUES = np.round(100.0 * np.random.default_rng(1).random(ROWS)) + 0.5


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("shape", [(ROWS, 1), (1, ROWS), (ROWS // 3, 3), (1, 1)])
def test_columns_are_those_that_were_written(tmp_path: Path, packed: bool, shape: tuple[int, int]) -> None:
    values = VALUES[: shape[0] * shape[1]].reshape(shape)
    savemat(tmp_path / "a.mat", {"other": VALUES, "x": values}, do_compression=packed)
    wanted = {"x(:,1)": values[:, 0], f"x(:,{shape[1]})": values[:, -1]}
    wanted |= {"x": values.reshape(-1)} if 1 in shape else {}
    for name, values_of in wanted.items():
        np.testing.assert_array_equal(direct(tmp_path / "a.mat", (name,)).numbers[name], values_of)
    if 1 not in shape:
        with pytest.raises(piga.DataError, match="a column is needed"):
            direct(tmp_path / "a.mat", ("x",))
