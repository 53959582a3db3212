"""What is read, found and refused does not depend on the size of the pieces, nor on where the columns lie."""

from __future__ import annotations

import dataclasses
import gzip
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pyarrow import parquet

import piga
from piga.formats.text import source as text_source
from piga.reading.columns import open_stream
from piga.records import arrays
from piga.records.run_file import read_run_file
from tests.formats.test_formats_fuzz import NAMES
from tests.reading.damaged_files import cases
from tests.records.files import lines, write_log, write_run

QUICK = settings(deadline=None, database=None, suppress_health_check=list(HealthCheck))


def outcome(path: Path) -> dict[str, Any] | str:
    """Everything about a run, or the error."""
    try:
        run = piga.read_run(path)
    except piga.PigaError as error:
        return str(error)
    return {field.name: getattr(run, field.name) for field in dataclasses.fields(run)}


def assert_same(first: dict[str, Any] | str, second: dict[str, Any] | str) -> None:
    if isinstance(first, str) or isinstance(second, str):
        assert first == second
        return
    for name, value in first.items():
        if isinstance(value, np.ndarray):
            assert value.dtype == second[name].dtype, name
            np.testing.assert_array_equal(value, second[name], err_msg=name)
        else:
            assert value == second[name], name


@pytest.mark.long
@pytest.mark.parametrize("case", [c for c in cases() if c.name != "gzip-bomb"], ids=lambda case: case.name)
def test_damaged_files_in_small_pieces(tmp_path: Path, case: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    path = case.write(tmp_path)
    whole = outcome(path)
    for piece in (37, 200, 1000):
        monkeypatch.setattr(text_source, "PIECE_BYTES", piece)
        assert_same(whole, outcome(path))
    monkeypatch.setattr(arrays, "LARGE_BYTES", 0)
    assert_same(whole, outcome(path))


@settings(QUICK, max_examples=25)
@given(seed=st.integers(0, 2**32), piece=st.integers(20, 500), disk=st.booleans())
def test_any_size_of_pieces(
    tmp_path_factory: pytest.TempPathFactory, seed: int, piece: int, disk: bool
) -> None:
    folder = tmp_path_factory.getbasetemp() / "pieces"
    folder.mkdir(exist_ok=True)
    draw = random.Random(seed)
    rows = [line + f",{'AB'[i // 12 % 2]}" for i, line in enumerate(lines(60))]
    for _ in range(draw.randint(0, 4)):
        edit(rows, draw)
    write_log(folder, rows, header="t,n,fx,fy,fz,s")
    data = 'segment = "s"\nrange = { fx = [-2.0, 2.0] }' + (
        '\ndamaged_rows = "mask"' if draw.random() < 0.5 else ""
    )
    bits = "counter_bits = 16" if draw.random() < 0.3 else ""
    path = write_run(folder, data=data, instrument=bits)
    whole = outcome(path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(text_source, "PIECE_BYTES", piece)
        if disk:
            patch.setattr(arrays, "LARGE_BYTES", 0)
        assert_same(whole, outcome(path))


def edit(rows: list[str], draw: random.Random) -> None:
    """One thing that a log may have wrong."""
    at = draw.randrange(2, len(rows) - 2)
    cells = rows[at].split(",")
    kinds: list[Callable[[], object]] = [
        lambda: rows.insert(at, ""),
        lambda: rows.insert(at, rows[at]),
        lambda: rows.__setitem__(at, ",".join([cells[0], "x", *cells[2:]])),
        lambda: rows.__setitem__(at, ",".join([cells[0], "NaN", *cells[2:]])),
        lambda: rows.__setitem__(at, ",".join([rows[at - 1].split(",")[0], *cells[1:]])),
        lambda: rows.__setitem__(at, ",".join([*cells[:2], "5.0", *cells[3:]])),
        lambda: rows.__delitem__(slice(at, at + draw.randint(1, 5))),
        lambda: rows.__setitem__(slice(at, at + 2), rows[at : at + 2][::-1]),
        lambda: rows.__setitem__(at, ",".join(cells[:3])),
        lambda: rows.__setitem__(at, ",".join([cells[0], "0", *cells[2:]])),
        lambda: rows.__setitem__(at, rows[at] + "\0"),
        lambda: rows.__setitem__(at, rows[at] + "\r"),
        lambda: rows.__setitem__(at, rows[at].replace(",A", ',"A').replace(",B", ',"B"')),
    ]
    draw.choice(kinds)()


def test_containers_and_parquet_give_the_same_chunks(tmp_path: Path) -> None:
    rows = lines(50)
    table = np.array([[float(cell) for cell in row.split(",")] for row in rows])
    write_log(tmp_path, rows)
    (tmp_path / "run.csv.gz").write_bytes(gzip.compress((tmp_path / "run.csv").read_bytes()))
    parquet.write_table(
        pa.table(dict(zip(NAMES, table.T, strict=True))), tmp_path / "run.parquet", row_group_size=7
    )
    for file in ("run.csv", "run.csv.gz", "run.parquet"):
        path = write_run(tmp_path, file)
        stream = open_stream(tmp_path, read_run_file(path).data)
        result = list(stream.chunks())
        for name, column in zip(NAMES, table.T, strict=True):
            np.testing.assert_array_equal(np.concatenate([chunk.numbers[name] for chunk in result]), column)
