"""What is read, found and refused does not depend on the size of the pieces, nor on where the columns lie."""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import piga
from piga.formats.text import source as text_source
from piga.records import arrays
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
