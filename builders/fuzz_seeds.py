"""Sound files of every kind that the mutations of :mod:`builders.fuzz_readers` start from."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import openpyxl
import pyarrow as pa
from nptdms import ChannelObject, TdmsWriter
from pyarrow import parquet
from scipy.io import savemat

import piga

NAMES = ("t", "n", "fx", "fy", "fz")
HEADS = (
    b"t,n,fx,fy,fz\n",
    b"t;n;fx;fy;fz\n",
    b"t [s],n,fx [g],fy [g],fz [g],seg\n",
    b"# log\nt\tn\tfx\tfy\tfz\n",
)
RUN = """\
[instrument]
serial = "T-1"
scale_factor = "0.8884 rad/s/g"
counts_per_revolution = 72000
counter_bits = 24
[data]
file = "run.csv"
time = { column = "t", unit = "s" }
output = { column = "n", kind = "counts" }
reference = { columns = ["fx", "fy", "fz"], unit = "g" }
range = { fx = [-2.0, 2.0] }
sequence = { column = "k", wraps_at = 65536 }
missing = ["ERR"]
[model]
terms = ["scale_factor", "k0", "tan_beta"]
[uncertainty]
reference_scale = "2 ppm"
[stand]
kind = "dividing-head"
"""


def columns(count: int = 8) -> dict[str, np.ndarray]:
    """A short log."""
    i = np.arange(count)
    return {
        "t": i / 20.0, "n": np.round(10179.0 * i / 20.0).astype(np.int64), "fx": np.ones(count),
        "fy": np.full(count, 0.1), "fz": np.zeros(count),
    }  # fmt: skip


def seeds(target: str) -> list[bytes]:
    """Sound files that the mutations start from."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "seed"
        return SEEDS[target](path) if target in SEEDS else []


def _text(_path: Path) -> list[bytes]:
    rows = b"".join(b"%.4f,%d,1.0,0.1,0.0\n" % (i / 20.0, round(10179.0 * i / 20.0)) for i in range(6))
    result = [
        HEADS[0] + rows,
        HEADS[1] + rows.replace(b",", b";").replace(b".", b","),
        HEADS[3] + rows.replace(b",", b"\t"),
    ]
    result.append(HEADS[2] + b"".join(line + b",A\n" for line in rows.splitlines()))
    result.append((HEADS[0] + rows).decode().encode("utf-16"))
    result.append((HEADS[0] + rows).replace(b"\n", b"\r\n"))
    return [
        *result,
        b'"t","n","fx","fy","fz"\n' + rows,
        HEADS[0] + b"s,1,g,g,g\n" + rows + b"NaN,OVER,,-,#N/A\n",
    ]


def _run_file(_path: Path) -> list[bytes]:
    return [RUN.encode()]


def _parquet(path: Path) -> list[bytes]:
    table = pa.table(columns())
    collected = []
    for packed in ("none", "snappy", "zstd"):
        parquet.write_table(table, path, compression=packed)
        collected.append(path.read_bytes())
    return collected


def _hdf5(path: Path) -> list[bytes]:
    collected = []
    for options, places in (({}, ["up", "下"] * 4), ({"compression": "gzip", "shuffle": True}, np.arange(8))):
        with h5py.File(path, "w") as out:
            for name, values in columns().items():
                out.create_dataset(name, data=values, **options).attrs["units"] = "s" if name == "t" else "1"
            out["pos"] = places
        collected.append(path.read_bytes())
    for write_places in (_matlab_text, _matlab_cells):
        with h5py.File(path, "w", userblock_size=512) as out:
            for name, values in columns().items():
                _matlab(out, name, np.atleast_2d(values), "int64" if name == "n" else "double")
            write_places(out)
        with path.open("r+b") as stream:
            stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
        collected.append(path.read_bytes())
    return collected


def _matlab(place: h5py.Group, name: str, values: np.ndarray, kind: str) -> h5py.Dataset:
    """A variable as MATLAB v7.3 lays it out: transposed, its class in an attribute."""
    item = place.create_dataset(name, data=values)
    item.attrs["MATLAB_class"] = np.bytes_(kind)
    if kind == "char":
        item.attrs["MATLAB_int_decode"] = np.int32(2)
    return item


def _characters(words: list[str]) -> np.ndarray:
    """UTF-16 units of words of one length, a column for each."""
    return np.array([[ord(letter) for letter in word] for word in words], "<u2").T


def _matlab_text(out: h5py.File) -> None:
    """Labels as the rows of a char array."""
    _matlab(out, "pos", _characters(["up ", "下  "] * 4), "char")


def _matlab_cells(out: h5py.File) -> None:
    """Labels as a cell array: references to texts, a number and an empty cell; a struct beside it."""
    held = out.create_group("#refs#")
    texts = [_matlab(held, name, _characters([word]), "char") for name, word in (("a", "up"), ("b", "下"))]
    number = _matlab(held, "c", np.array([[3.0]]), "double")
    empty = _matlab(held, "d", np.zeros(2, np.uint64), "char")
    empty.attrs["MATLAB_empty"] = np.uint8(1)
    cells = out.create_dataset("pos", (1, 8), h5py.ref_dtype)
    cells[0, :] = [item.ref for item in (*texts, number, empty)] * 2
    cells.attrs["MATLAB_class"] = np.bytes_("cell")
    log = out.create_group("log")
    log.attrs["MATLAB_class"] = np.bytes_("struct")
    _matlab(log, "temperature", np.atleast_2d(np.arange(8.0)), "double")


def _mat(path: Path) -> list[bytes]:
    collected = []
    for options in ({}, {"do_compression": True}, {"format": "4"}):
        savemat(path, columns(), appendmat=False, **options)
        collected.append(path.read_bytes())
    savemat(path, {"log": columns()} | columns(), appendmat=False)
    return [*collected, path.read_bytes()]


def _tdms(path: Path) -> list[bytes]:
    with TdmsWriter(path) as out:
        out.write_segment(
            [ChannelObject("log", name, values, {"unit_string": "1"}) for name, values in columns().items()]
        )
    return [path.read_bytes()]


def _xlsx(path: Path) -> list[bytes]:
    book = openpyxl.Workbook()
    data = columns()
    book.active.append(list(data))
    for row in zip(*(values.tolist() for values in data.values()), strict=True):
        book.active.append(list(row))
    book.save(path)
    return [path.read_bytes()]


def _calibration(path: Path) -> list[bytes]:
    t = np.arange(200) / 20.0
    angle = 0.45 * np.sin(0.1 * t)
    f = 9.8 * np.column_stack([np.cos(angle), np.sin(angle), 0.1 * t])
    run = piga.Run.from_arrays(
        t, np.cumsum(0.05 * 0.0906 * f[:, 0]) + 1e-6 * np.sin(9.0 * t), f, scale_factor="0.8884 rad/s/g"
    )
    piga.calibrate(run, ["scale_factor", "k0"]).to_json(path)
    return [path.read_bytes()]


SEEDS: dict[str, Callable[[Path], list[bytes]]] = {
    "csv": _text, "run-file": _run_file, "parquet": _parquet, "hdf5": _hdf5, "mat": _mat, "tdms": _tdms,
    "xlsx": _xlsx, "calibration": _calibration,
}  # fmt: skip
SUFFIX = {"csv": ".csv", "run-file": ".toml", "calibration": ".json", "hdf5": ".h5"}
