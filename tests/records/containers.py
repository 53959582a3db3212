"""The log of :mod:`tests.records.files` in every container that is read."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
import openpyxl
from nptdms import ChannelObject, TdmsWriter
from scipy.io import savemat

from piga.formats.columns import RecordStream


def columns(count: int = 40, rate: float = 20.0) -> dict[str, np.ndarray]:
    i = np.arange(count)
    return {
        "t": np.round(i / rate, 4),
        "n": np.round(10179.0 * i / rate).astype(np.int64),
        "fx": np.ones(count),
        "fy": np.full(count, 0.1),
        "fz": np.zeros(count),
    }


def write_h5(path: Path, data: dict[str, np.ndarray], units: dict[str, object] | None = None) -> None:
    with h5py.File(path, "w") as out:
        for name, values in data.items():
            packed = {"compression": "gzip", "shuffle": True} if values.dtype.kind in "fi" else {}
            item = out.create_dataset(name, data=values, **packed)
            if units and name in units:
                item.attrs["units"] = units[name]


def write_mat73(path: Path, data: dict[str, np.ndarray]) -> None:
    """As MATLAB lays v7.3 out: a 512-byte user block, row vectors, the class as an attribute."""
    with h5py.File(path, "w", userblock_size=512) as out:
        for name, values in data.items():
            item = out.create_dataset(name, data=np.atleast_2d(values))
            item.attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")


def write_mat(path: Path, data: dict[str, np.ndarray]) -> None:
    savemat(path, data, do_compression=True)


def write_tdms(path: Path, data: dict[str, np.ndarray], units: dict[str, str] | None = None) -> None:
    units = units or {}
    with TdmsWriter(path) as out:
        out.write_segment(
            [
                ChannelObject("log", name, values, {"unit_string": units[name]} if name in units else {})
                for name, values in data.items()
            ]
        )


def write_xlsx(path: Path, data: dict[str, np.ndarray], title: str = "log") -> openpyxl.Workbook:
    book = openpyxl.Workbook()
    sheet = book.active
    sheet.title = title
    sheet.append(list(data))
    for row in zip(*(values.tolist() for values in data.values()), strict=True):
        sheet.append(list(row))
    book.save(path)
    return book


WRITERS = {
    "run.h5": write_h5,
    "run.mat": write_mat,
    "v73.mat": write_mat73,
    "run.tdms": write_tdms,
    "run.xlsx": write_xlsx,
}


class Whole(NamedTuple):
    """A record stream read to its end: numbers by column, codes and names of the segments, and the file rows."""

    numbers: dict[str, np.ndarray]
    label: tuple[np.ndarray, tuple[str, ...]]
    rows: np.ndarray


def whole(stream: RecordStream) -> Whole:
    chunks = list(stream.chunks())
    numbers = {name: np.concatenate([chunk.numbers[name] for chunk in chunks]) for name in stream.numeric}
    codes = [chunk.codes for chunk in chunks if chunk.codes is not None]
    label = np.concatenate(codes) if codes else np.zeros(0), tuple(stream.label_names)
    return Whole(numbers, label, np.concatenate([chunk.rows for chunk in chunks]))
