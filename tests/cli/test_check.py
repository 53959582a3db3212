"""``piga check`` shows everything and suggests lines that work; ``piga convert`` gives back the same record."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import piga
from piga.errors import PigaError
from tests.cli.runner import invoked
from tests.records.files import lines, write_log, write_run


def run_command(*arguments: object) -> str:
    done = invoked(*arguments)
    if isinstance(done.exception, PigaError):
        raise done.exception
    assert done.exit_code == 0, done.output
    return done.stdout


def dirty(folder: Path) -> Path:
    rows = lines(60)
    del rows[20:23]
    rows[5] = rows[5].replace("1.0", "NaN")
    rows.insert(31, rows[30])
    write_log(folder, rows)
    return write_run(folder)


def test_everything_in_one_pass_with_a_page(tmp_path: Path) -> None:
    text = " ".join(run_command("check", dirty(tmp_path), "--out", tmp_path / "page").split())
    for words in ("missing-value 1 7", "gap", "repeated-row 1", "Calibration: information, 2 terms"):
        assert words in text
    page = (tmp_path / "page" / "check.html").read_text(encoding="utf-8")
    for words in ("missing-value", "interval [s]", "specific force [g]", "output [rev]", "SHA-256"):
        assert words in page


def test_convert_gives_the_same_record(tmp_path: Path) -> None:
    path = dirty(tmp_path)
    text = run_command("convert", path, "--out", tmp_path / "clean.parquet")
    table = text[text.index("[data]") :]
    assert tomllib.loads(table)["data"]["file"] == "clean.parquet"
    head, tail = path.read_text().split("[data]")[0], "[model]" + path.read_text().split("[model]")[1]
    path.with_name("clean.toml").write_text(head + table + tail)
    before, after = piga.read_run(path), piga.read_run(path.with_name("clean.toml"))
    for name in ("t", "output", "f", "begins"):
        np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
    schema = pq.read_schema(tmp_path / "clean.parquet")
    assert schema.field("fx").metadata == {b"unit": b"m/s^2"}
    assert b"missing-value" in schema.metadata[b"quality"]
    with pytest.raises(PigaError, match=r"must end in \.parquet"):
        run_command("convert", path, "--out", tmp_path / "clean.csv")
