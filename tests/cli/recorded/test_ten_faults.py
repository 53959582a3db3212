"""Ten faulty records: every line that ``--fix-suggestions`` prints is put into the run file, and the record is read."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

import piga
from piga.describe import suggestions
from piga.describe.draft import toml_text
from tests.records.containers import columns, write_xlsx
from tests.records.files import events, lines, write_log, write_run


def preamble(folder: Path) -> Path:
    write_log(folder, ["t,n,fx,fy,fz", *lines()], header="Test 12\nstarted at noon")
    return write_run(folder)


def time_stamps(folder: Path) -> Path:
    write_log(
        folder, [f"23.11.2026 12:00:{k / 20:06.3f},{row.split(',', 1)[1]}" for k, row in enumerate(lines())]
    )
    return write_run(folder)


def another_name(folder: Path) -> Path:
    write_log(folder, lines(), header="t,counts,fx,fy,fz")
    return write_run(folder)


def wrong_unit(folder: Path) -> Path:
    write_log(folder, [row.replace("1.0,0.1,0.0", "9.80665,0.1,0.0") for row in lines()])
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


def other_encoding(folder: Path) -> Path:
    text = "\n".join(["t,n,fx,fy,fz,备注", *(f"{row},好" for row in lines()), ""])
    (folder / "run.csv").write_bytes(text.encode("gb18030"))
    return write_run(folder)


RECORDS: dict[str, tuple[Callable[[Path], Path], set[str]]] = {
    "preamble": (preamble, {"header_row"}),
    "time-stamps": (time_stamps, {"time"}),
    "another-name": (another_name, {"output"}),
    "wrong-unit": (wrong_unit, {"reference"}),
    "counter-that-folds": (counter_that_folds, {"counter_bits"}),
    "words": (words, {"missing", "damaged_rows"}),
    "footer": (footer, {"damaged_rows"}),
    "sheets": (sheets, {"sheet"}),
    "decimal-or-thousands": (decimal_or_thousands, {"decimal"}),
    "other-encoding": (other_encoding, {"encoding"}),
}
"""Each record, and the keys that must be suggested."""


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=pytest.mark.only_compiled) if name == "sheets" else name for name in RECORDS
])  # fmt: skip
def test_every_line_that_is_printed_works(tmp_path: Path, name: str) -> None:
    make, keys = RECORDS[name]
    path = make(tmp_path)
    offered = suggestions(path)
    assert keys == {line.line.split(" = ")[0] for line in offered}
    document = tomllib.loads(path.read_text())
    first: dict[tuple[str, str], object] = {}
    for one in offered:
        key, value = next(iter(tomllib.loads(one.line).items()))
        alone = {**document, one.table: {**document.get(one.table, {}), key: value}}
        if len({line.line.split(" = ")[0] for line in offered}) > 1 and name != "words":
            first.setdefault((one.table, key), value)
            continue
        (tmp_path / "fixed.toml").write_text(toml_text(alone), encoding="utf-8")
        run = piga.read_run(tmp_path / "fixed.toml")
        assert run.size >= 38
        assert "implausible-unit" not in events(run)
    if first:
        whole = {table: dict(part) for table, part in document.items()}
        for (table, key), value in first.items():
            whole[table][key] = value
        (tmp_path / "fixed.toml").write_text(toml_text(whole), encoding="utf-8")
        assert piga.read_run(tmp_path / "fixed.toml").size >= 38
