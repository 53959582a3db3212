"""Columns of MATLAB files of level 5: those that were written, of every kind, order of bytes and packing."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from piga.errors import DataError
from piga.formats.container import CONTAINERS
from tests.records.containers import whole

ROWS = 300
KINDS = {"u1": 2, "i2": 3, "i4": 5, "f4": 7, "f8": 9, "i8": 12}
VALUES = np.round(100.0 * np.random.default_rng(1).random(ROWS))


def read(path: Path, numeric: tuple[str, ...], label: str | None = None) -> dict[str, np.ndarray]:
    return whole(CONTAINERS[".mat"](path, numeric, label)).numbers


def element(order: str, kind: int, data: bytes) -> bytes:
    if 0 < len(data) <= 4:
        return struct.pack(order + "I", len(data) << 16 | kind) + data.ljust(4, b"\0")
    return struct.pack(order + "II", kind, len(data)) + data + b"\0" * (-len(data) % 8)


def matrix(order: str, name: str, values: np.ndarray, kind: int = 6) -> bytes:
    """An array of class double, stored as narrow as its values are."""
    stored = values.T.astype(values.dtype.newbyteorder(order)).tobytes()
    body = element(order, 6, struct.pack(order + "II", kind, 0))
    body += element(order, 5, struct.pack(f"{order}{values.ndim}i", *values.shape))
    body += element(order, 1, name.encode()) + element(order, KINDS[values.dtype.str[1:]], stored)
    return struct.pack(order + "II", 14, len(body)) + body


def written(path: Path, order: str, packed: bool, *arrays: bytes) -> Path:
    """A file of level 5 by the published format."""
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack(order + "HH", 0x0100, 0x4D49)
    if packed:
        arrays = tuple(struct.pack(order + "II", 15, len(data)) + data for data in map(zlib.compress, arrays))
    path.write_bytes(head + b"".join(arrays))
    return path


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", [(ROWS, 1), (1, ROWS), (ROWS // 3, 3), (1, 1)])
def test_columns_are_those_that_were_written(
    tmp_path: Path, order: str, packed: bool, kind: str, shape: tuple[int, int]
) -> None:
    values = VALUES.astype(kind)[: shape[0] * shape[1]].reshape(shape)
    other = matrix(order, "other", VALUES.reshape(-1, 1))
    path = written(tmp_path / "a.mat", order, packed, other, matrix(order, "x", values))
    columns = {"x(:,1)": values[:, 0], f"x(:,{shape[1]})": values[:, -1]}
    if 1 in shape:
        columns["x"] = values.reshape(-1)
    for name, values_of in columns.items():
        column = read(path, (name,))[name]
        np.testing.assert_array_equal(column, values_of.astype(float))
    if 1 not in shape:
        with pytest.raises(DataError, match="a column is needed"):
            read(path, ("x",))


@pytest.mark.parametrize("packed", [False, True])
def test_fields_of_structs(tmp_path: Path, packed: bool) -> None:
    log = {"t": VALUES, "inner": {"n": np.arange(ROWS), "words": "text"}, "f": np.outer(VALUES, [1.0, 2.0])}
    savemat(tmp_path / "a.mat", {"first": VALUES, "log": log}, do_compression=packed)
    columns = read(tmp_path / "a.mat", ("log.t", "log.inner.n", "log.f(:,2)"))
    np.testing.assert_array_equal(columns["log.t"], VALUES)
    np.testing.assert_array_equal(columns["log.inner.n"], np.arange(ROWS))
    np.testing.assert_array_equal(columns["log.f(:,2)"], 2.0 * VALUES)
    for name in ("log", "log.speed", "log.inner.words", "log.t.n", "first.t", "log.f(:,3)", "log.f(:,0)"):
        with pytest.raises(DataError):
            read(tmp_path / "a.mat", (name,))


def test_declared_sizes_beyond_the_file(tmp_path: Path) -> None:
    whole = written(tmp_path / "a.mat", "<", False, matrix("<", "x", VALUES.reshape(-1, 1))).read_bytes()
    at = whole.index(struct.pack("<II", 9, 8 * ROWS))
    for rows in (1 << 28, ROWS + 1):
        longer = whole[:at] + struct.pack("<II", 9, 8 * rows & 0xFFFFFFFF) + whole[at + 8 :]
        longer = longer.replace(struct.pack("<ii", ROWS, 1), struct.pack("<ii", rows, 1))
        (tmp_path / "a.mat").write_bytes(longer)
        with pytest.raises(DataError):
            CONTAINERS[".mat"](tmp_path / "a.mat", ("x",), None)
