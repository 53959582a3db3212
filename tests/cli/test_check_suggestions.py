"""Every line that ``piga check --fix-suggestions`` prints is taken into the run file, and settles what was open."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import piga
from piga.describe import suggestions
from piga.text_files import toml_text
from tests.cli.runner import invoked
from tests.records.containers import columns, write_xlsx
from tests.records.files import lines, psi_steps, write_log, write_run


def suggested(path: Path) -> list[tuple[str, str]]:
    """Table and line of each suggestion."""
    done = invoked("check", path, "--fix-suggestions")
    seen = [line.split("    # in [") for line in done.stdout.splitlines() if "    # in [" in line]
    return [(table.removesuffix("]"), line) for line, table in seen]


@pytest.mark.parametrize("kind", ["angle", "rate"])
def test_convert_keeps_base_rate_and_temperature(tmp_path: Path, kind: str) -> None:
    t = np.arange(200) / 20.0
    output = 0.8884 * t if kind == "angle" else np.full(200, 0.8884)
    unit = "rad" if kind == "angle" else "rad/s"
    rows = [
        f"{a:.4f},{b:.12g},1.0,0.0,0.0,0.001,0.002,0.003,{20.0 + 0.01 * a:.4f}"
        for a, b in zip(t, output, strict=True)
    ]
    write_log(tmp_path, rows, header="t,n,fx,fy,fz,wx,wy,wz,temp")
    columns = 'base_rate = { columns = ["wx", "wy", "wz"], unit = "deg/s" }\ntemperature = { column = "temp", unit = "degC" }'
    path = write_run(tmp_path, data=columns)
    text = path.read_text().replace('kind = "counts"', f'kind = "{kind}", unit = "{unit}"')
    path.write_text(text)
    done = invoked("convert", tmp_path / "run.toml", "--out", tmp_path / "clean.parquet")
    assert done.exit_code == 0, done.exception
    (tmp_path / "clean.toml").write_text(
        text.split("[data]")[0]
        + done.stdout[done.stdout.index("[data]") :]
        + "\n[model]"
        + text.split("[model]")[1]
    )
    before, after = piga.read_run(tmp_path / "run.toml"), piga.read_run(tmp_path / "clean.toml")
    assert before.kind == after.kind == kind
    assert before.base_rate is not None
    assert math.isclose(before.base_rate[0, 2], math.radians(0.003))
    for name in ("t", "output", "f", "begins", "base_rate", "temperature"):
        np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
    np.testing.assert_allclose(psi_steps(after), psi_steps(before), atol=0.0)


def test_two_problems_one_after_the_other(tmp_path: Path) -> None:
    """A decimal comma, and time stamps: the first line leads to the second problem; both lines together solve it."""
    rows = [f"12:00:{k / 20:06.3f};{10179 * k // 20};1,000;1,100;1,001" for k in range(40)]
    write_log(tmp_path, rows, header="t;n;fx;fy;fz")
    path = write_run(tmp_path)
    assert suggested(path) == [
        ("data", 'decimal = ","'),
        ("data", 'time = { column = "t", stamp = "hh:mm:ss.f" }'),
    ]


def test_nothing_is_suggested_that_does_not_help(tmp_path: Path) -> None:
    write_log(tmp_path, ["t,n,fx,fy,what", *lines()], header="Test 12,A")
    assert suggested(write_run(tmp_path)) == []


def time_stamps(folder: Path) -> Path:
    write_log(
        folder, [f"23.11.2026 12:00:{k / 20:06.3f},{row.split(',', 1)[1]}" for k, row in enumerate(lines())]
    )
    return write_run(folder)


def another_name(folder: Path) -> Path:
    write_log(folder, lines(), header="t,counts,fx,fy,fz")
    return write_run(folder)


def counter_that_folds(folder: Path) -> Path:
    cells = (row.split(",", maxsplit=2) for row in lines(60, rate=2.0))
    write_log(folder, [f"{t},{int(n) % 65536},{rest}" for t, n, rest in cells])
    return write_run(folder)


def words(folder: Path) -> Path:
    rows = lines()
    for k in (5, 17):
        cells = rows[k].split(",")
        rows[k] = ",".join([cells[0], "ERR", *cells[2:]])
    write_log(folder, rows)
    return write_run(folder)


def footer(folder: Path) -> Path:
    write_log(folder, [*lines(), "End of measurement"])
    return write_run(folder)


def sheets(folder: Path) -> Path:
    book = write_xlsx(folder / "run.xlsx", columns(), title="log 2")
    book.create_sheet("notes")
    book.save(folder / "run.xlsx")
    return write_run(folder, "run.xlsx")


def decimal_or_thousands(folder: Path) -> Path:
    rows = [f"{k},000;{10179 * k};1,000;1,100;1,001" for k in range(1, 41)]
    write_log(folder, rows, header="t;n;fx;fy;fz")
    return write_run(folder)


RECORDS: dict[str, tuple[Callable[[Path], Path], set[str]]] = {
    "time-stamps": (time_stamps, {"time"}),
    "another-name": (another_name, {"output"}),
    "counter-that-folds": (counter_that_folds, {"counter_bits"}),
    "words": (words, {"missing"}),
    "footer": (footer, {"damaged_rows"}),
    "sheets": (sheets, {"sheet"}),
    "decimal-or-thousands": (decimal_or_thousands, {"decimal"}),
}
"""Each record, and the keys that must be suggested."""


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=pytest.mark.long) if name == "sheets" else name for name in RECORDS
])  # fmt: skip
def test_every_line_that_is_printed_works(tmp_path: Path, name: str) -> None:
    make, keys = RECORDS[name]
    path = make(tmp_path)
    offered = suggestions(path)
    assert keys == {line.line.split(" = ")[0] for line in offered}
    document = tomllib.loads(path.read_text())
    for one in offered:
        key, value = next(iter(tomllib.loads(one.line).items()))
        fixed = {**document, one.table: {**document.get(one.table, {}), key: value}}
        (tmp_path / "fixed.toml").write_text(toml_text(fixed), encoding="utf-8")
        assert piga.read_run(tmp_path / "fixed.toml").size >= 38
