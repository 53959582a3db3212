"""Columns of MATLAB files of level 5: structs, matrices, and sizes that cannot be."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from piga.errors import DataError
from piga.formats.container import CONTAINERS
from tests.records.containers import whole

ROWS = 300
VALUES = np.round(100.0 * np.random.default_rng(1).random(ROWS)) + 0.5


def read(path: Path, numeric: tuple[str, ...], label: str | None = None) -> dict[str, np.ndarray]:
    return whole(CONTAINERS[".mat"](path, numeric, label)).numbers


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("shape", [(ROWS, 1), (1, ROWS), (ROWS // 3, 3), (1, 1)])
def test_columns_are_those_that_were_written(tmp_path: Path, packed: bool, shape: tuple[int, int]) -> None:
    values = VALUES[: shape[0] * shape[1]].reshape(shape)
    savemat(tmp_path / "a.mat", {"other": VALUES, "x": values}, do_compression=packed)
    columns = {"x(:,1)": values[:, 0], f"x(:,{shape[1]})": values[:, -1]}
    columns |= {"x": values.reshape(-1)} if 1 in shape else {}
    for name, values_of in columns.items():
        np.testing.assert_array_equal(read(tmp_path / "a.mat", (name,))[name], values_of)
    if 1 not in shape:
        with pytest.raises(DataError, match="a column is needed"):
            read(tmp_path / "a.mat", ("x",))


def test_fields_of_structs(tmp_path: Path) -> None:
    log = {"t": VALUES, "inner": {"n": np.arange(ROWS), "words": "text"}, "f": np.outer(VALUES, [1.0, 2.0])}
    savemat(tmp_path / "a.mat", {"first": VALUES, "log": log})
    columns = read(tmp_path / "a.mat", ("log.t", "log.inner.n", "log.f(:,2)"))
    np.testing.assert_array_equal(columns["log.t"], VALUES)
    np.testing.assert_array_equal(columns["log.inner.n"], np.arange(ROWS))
    np.testing.assert_array_equal(columns["log.f(:,2)"], 2.0 * VALUES)
    for name in ("log", "log.speed", "log.inner.words", "log.t.n", "first.t", "log.f(:,3)", "log.f(:,0)"):
        with pytest.raises(DataError):
            read(tmp_path / "a.mat", (name,))


def test_declared_sizes_beyond_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    savemat(path, {"x": VALUES.reshape(-1, 1)})
    written = path.read_bytes()
    at = written.index(struct.pack("<II", 9, 8 * ROWS))
    for rows in (1 << 28, ROWS + 1):
        longer = written[:at] + struct.pack("<II", 9, 8 * rows & 0xFFFFFFFF) + written[at + 8 :]
        path.write_bytes(longer.replace(struct.pack("<ii", ROWS, 1), struct.pack("<ii", rows, 1)))
        with pytest.raises(DataError):
            CONTAINERS[".mat"](path, ("x",), None)
