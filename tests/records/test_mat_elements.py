"""Columns of MATLAB files in pieces are those that SciPy reads whole; what it does not read here is left to SciPy."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from piga.errors import DataError
from piga.formats.containers import array_columns, mat_elements, mat_reader
from piga.formats.containers.mat_elements import MatColumns, OtherKindError
from piga.records.spool import arrays_like

ROWS = 300
KINDS = {"u1": 2, "i2": 3, "i4": 5, "f4": 7, "f8": 9, "i8": 12}
VALUES = np.round(100.0 * np.random.default_rng(1).random(ROWS))


@pytest.fixture(autouse=True)
def _small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(array_columns, "PIECE_ROWS", 64)
    monkeypatch.setattr(mat_elements, "PIECE_ROWS", 64)
    monkeypatch.setattr(mat_elements, "PACKED", 50)


def read(path: Path, numeric: tuple[str, ...], label: str | None = None) -> dict[str, np.ndarray]:
    return mat_reader.read_mat(path, numeric, label).numbers


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
def test_columns_are_those_of_scipy(
    tmp_path: Path, order: str, packed: bool, kind: str, shape: tuple[int, int]
) -> None:
    values = VALUES.astype(kind)[: shape[0] * shape[1]].reshape(shape)
    other = matrix(order, "other", VALUES.reshape(-1, 1))
    path = written(tmp_path / "a.mat", order, packed, other, matrix(order, "x", values))
    theirs = loadmat(path)["x"]
    np.testing.assert_array_equal(theirs, values)
    source = MatColumns(path, order)
    for name, column in (("x(:,1)", theirs[:, 0]), (f"x(:,{shape[1]})", theirs[:, -1]), ("x", theirs)):
        if name == "x" and 1 not in shape:
            with pytest.raises(OtherKindError):
                source.column(name)
            continue
        found = source.column(name)
        assert found.dtype == ("f8" if kind.startswith("f") else "i8")
        np.testing.assert_array_equal(found, column.reshape(-1).astype(found.dtype))
        assert (arrays_like(found).folder is not None) == (found.size > 64)


@pytest.mark.parametrize("packed", [False, True])
def test_fields_of_structs(tmp_path: Path, packed: bool) -> None:
    log = {"t": VALUES, "inner": {"n": np.arange(ROWS), "words": "text"}, "f": np.outer(VALUES, [1.0, 2.0])}
    savemat(tmp_path / "a.mat", {"first": VALUES, "log": log}, do_compression=packed)
    source = MatColumns(tmp_path / "a.mat", "<")
    np.testing.assert_array_equal(source.column("log.t"), VALUES)
    np.testing.assert_array_equal(source.column("log.inner.n"), np.arange(ROWS))
    np.testing.assert_array_equal(source.column("log.f(:,2)"), 2.0 * VALUES)
    assert source.plain == {"first"}
    for name in ("log", "log.speed", "log.inner.words", "log.t.n", "first.t", "log.f(:,3)", "log.f(:,0)"):
        with pytest.raises(OtherKindError):
            source.column(name)


def test_scipy_is_not_asked_for_plain_columns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = np.array(["up", "down"], object)[np.arange(ROWS) % 2]
    savemat(tmp_path / "a.mat", {"t": VALUES, "n": VALUES.astype("i2"), "pos": words, "z": 1j * VALUES})
    asked, real = [], mat_reader._load
    monkeypatch.setattr(mat_reader, "_load", lambda path, names: asked.append(names) or real(path, names))
    assert set(read(tmp_path / "a.mat", ("t", "n"))) == {"t", "n"}
    assert mat_reader.read_mat(tmp_path / "a.mat", ("t", "n"), "pos").labels["pos"][1] == ("up", "down")
    with pytest.raises(DataError, match="column 'z' holds complex128"):
        read(tmp_path / "a.mat", ("t", "z"))
    assert asked == [[], ["pos"], ["t", "z"]]


def arrays_of(raw: bytes) -> list[bytes]:
    at, found = 128, []
    while at < len(raw):
        found.append(raw[at : at + 8 + struct.unpack_from("<II", raw, at)[1]])
        at += len(found[-1])
    return found


@pytest.mark.parametrize("packed", [False, True])
def test_of_damaged_files_only_what_scipy_reads_is_read(tmp_path: Path, packed: bool) -> None:
    """Changed bytes, mostly of heads, and cut files."""
    path, chance, read_in_pieces = tmp_path / "a.mat", np.random.default_rng(3), 0
    savemat(path, {"t": VALUES, "log": {"n": np.arange(ROWS, dtype="u2")}, "f": np.outer(VALUES, [1.0, 2.0])})
    head, parts = path.read_bytes()[:128], arrays_of(path.read_bytes())
    for _ in range(300):
        changed = [bytearray(part) for part in parts]
        for _ in range(chance.integers(1, 3)):
            part = changed[chance.integers(3)]
            part[chance.choice((chance.integers(90), chance.integers(len(part))))] = chance.integers(256)
        if chance.random() < 0.2:
            del changed[-1][chance.integers(len(changed[-1])) :]
        if packed:
            changed = [
                bytearray(struct.pack("<II", 15, len(data)) + data) for data in map(zlib.compress, changed)
            ]
        path.write_bytes(head + b"".join(changed))
        try:
            source = MatColumns(path, "<")
            found = [source.column(name) for name in ("t", "log.n", "f(:,2)")]
        except (OtherKindError, zlib.error):
            continue
        whole = loadmat(path)
        theirs = (whole["t"], whole["log"]["n"][0, 0], whole["f"][:, 1])
        for mine, other in zip(found, theirs, strict=True):
            np.testing.assert_array_equal(mine, other.reshape(-1))
        read_in_pieces += 1
    assert 100 < read_in_pieces < 300


def test_declared_sizes_beyond_the_file(tmp_path: Path) -> None:
    whole = written(tmp_path / "a.mat", "<", False, matrix("<", "x", VALUES.reshape(-1, 1))).read_bytes()
    at = whole.index(struct.pack("<II", 9, 8 * ROWS))
    for rows in (1 << 28, ROWS + 1):
        longer = whole[:at] + struct.pack("<II", 9, 8 * rows & 0xFFFFFFFF) + whole[at + 8 :]
        longer = longer.replace(struct.pack("<ii", ROWS, 1), struct.pack("<ii", rows, 1))
        (tmp_path / "a.mat").write_bytes(longer)
        with pytest.raises(OtherKindError):
            MatColumns(tmp_path / "a.mat", "<").column("x")
