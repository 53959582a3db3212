"""What is read, found and refused does not depend on the size of the pieces, nor on where the columns lie."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import piga
from piga.formats.text import source as text_source
from piga.records import arrays
from tests.records.files import lines, write_log, write_run


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


@pytest.mark.parametrize("data", ['segment = "s"', 'segment = "s"\ndamaged_rows = "mask"'])
def test_any_size_of_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, data: str) -> None:
    """A log with everything that a log may have wrong."""
    rows = [f"{line},{'AB'[i // 12 % 2]}" for i, line in enumerate(lines(60))]
    rows[5] = rows[5].replace(",A", ',"A"')
    rows[9] = rows[9].replace(",1.0,", ",NaN,")
    rows[20:22] = rows[21:19:-1]
    del rows[30:33]
    rows[40:40] = ["", rows[40]]
    for at, damaged in ((10, "x,1,1.0,0.1,0.0,A"), (15, "1,2"), (44, rows[44] + "\0"), (45, rows[45] + "\r,")):
        rows[at] = damaged
    write_log(tmp_path, rows, header="t,n,fx,fy,fz,s")
    path = write_run(tmp_path, data=data)
    whole = outcome(path)
    assert isinstance(whole, str) == ("mask" not in data)
    for piece, large in ((20, 0), (77, 1 << 30), (500, 0)):
        monkeypatch.setattr(text_source, "PIECE_BYTES", piece)
        monkeypatch.setattr(arrays, "LARGE_BYTES", large)
        assert_same(whole, outcome(path))
