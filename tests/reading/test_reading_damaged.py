"""Damaged data files with the outcome each must have: no wrong number gets through.

The clean log rests along X0: counts ``round(10179 t)`` of a counter with 72000 counts per revolution, 20 Hz,
reference (1, 0.1, 0) g. Each case damages it in one way of the fault catalogue and says what is to happen:
``error`` (with row and column where ``place`` is set), ``mask`` or ``repair`` (with events and their counts).
"""

from __future__ import annotations

import gzip
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

import piga
from piga.reading import columns
from piga.units import G0
from tests.records.files import events, write_run

HEADER = "t,n,fx,fy,fz"
ROWS = 40


@dataclass(frozen=True)
class Case:
    """One damaged file. ``place``: the error names row (and column) where one exists; ``n`` used rows else."""

    name: str
    content: bytes
    outcome: str
    message: str = ""
    events: dict[str, int] = field(default_factory=dict)
    used: int = ROWS
    place: bool = False
    file: str = "run.csv"
    data: str = ""
    instrument: str = ""
    t: str = "t"
    n: str = "n"

    def write(self, folder: Path) -> Path:
        """Write data and run file; returns the run file."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / self.file).write_bytes(self.content)
        run = write_run(folder, self.file, instrument=self.instrument, data=self.data)
        text = run.read_text(encoding="utf-8").replace('"t"', f'"{self.t}"').replace('"n"', f'"{self.n}"')
        run.write_text(text, encoding="utf-8")
        return run


def count(t: float) -> int:
    return round(10179.0 * t)


def rows(number: int = ROWS) -> list[list[str]]:
    return [[f"{i / 20.0:.4f}", str(count(i / 20.0)), "1.0", "0.1", "0.0"] for i in range(number)]


def text(body: list[list[str]], header: str = HEADER, separator: str = ",") -> bytes:
    lines = [header.replace(",", separator), *(separator.join(row) for row in body)]
    return ("\n".join(lines) + "\n").encode()


def cell(at: int, column: int, value: str) -> bytes:
    body = rows()
    body[at][column] = value
    return text(body)


def changed(change: Callable[[list[list[str]]], object]) -> bytes:
    body = rows()
    change(body)
    return text(body)


def error(name: str, content: bytes, message: str, *, place: bool = False, **more: str) -> Case:
    return Case(name, content, "error", message, place=place, **more)  # type: ignore[arg-type]


def mask(name: str, content: bytes, used: int, events: dict[str, int], **more: str) -> Case:
    return Case(name, content, "mask", events=events, used=used, **more)  # type: ignore[arg-type]


def repair(name: str, content: bytes, events: dict[str, int], used: int = ROWS, **more: str) -> Case:
    return Case(name, content, "repair", events=events, used=used, **more)  # type: ignore[arg-type]


def encodings() -> list[Case]:
    plain = text(rows()).decode()
    chinese = plain.replace("t,n,", "时间,计数,", 1)
    named = {"t": "时间", "n": "计数"}
    return [
        repair("bom-utf8", plain.encode("utf-8-sig"), {"encoding": 1}),
        repair("utf16-bom", plain.encode("utf-16"), {"encoding": 1}),
        repair("gb18030-header", chinese.encode("gb18030"), {"encoding": 1}, **named),
        repair("utf8-chinese-header", chinese.encode(), {}, **named),
        repair("utf16-declared", plain.encode("utf-16-le"), {"encoding": 1}, data='encoding = "utf-16-le"'),
        error("utf16-no-bom", plain.encode("utf-16-le"), "UTF-16 without a byte-order mark"),
        error("unknown-encoding", plain.encode(), "encoding 'klingon'", data='encoding = "klingon"'),
        error("not-text", plain[:60].encode() + b"\xff\xff\xff\xff" + plain[60:].encode(), "neither UTF-8 nor GB18030"),
        error("wrong-declared", plain.replace("0.1", "0.1é", 1).encode("latin-1"), r"row 2: byte \d+ of the row is not UTF-8 text",
              place=True, data='encoding = "utf-8"'),
        error("chinese-column-missing", chinese.encode(), "no column 'n', 't'; the columns are: 时间, 计数"),
        repair("mac-line-ends", plain.replace("\n", "\r").encode(), {}),
        repair("windows-line-ends", plain.replace("\n", "\r\n").encode(), {}),
    ]  # fmt: skip


def numbers() -> list[Case]:
    comma = text(rows(), separator=";").replace(b".", b",")
    mixed = text(rows(), separator=";").replace(b"0,1", b"0.1")
    thousands = [[r[0], f"{count(i / 20.0):,}", *r[2:]] for i, r in enumerate(rows())]
    ambiguous = "t;n;fx;fy;fz\n" + "".join(f"{i + 1};{i + 1},509;1;1;1\n" for i in range(20))
    return [
        repair("decimal-comma", comma, {}),
        repair("decimal-comma-declared", comma, {}, data="decimal = ','\ndelimiter = ';'"),
        repair("tabs", text(rows(), separator="\t"), {}),
        repair("pipes", text(rows(), separator="|"), {}),
        error("decimal-mix", mixed.replace(b";1.0;", b";1,0;"), "ambiguous", place=False),
        error("decimal-comma-in-commas", text(rows()).replace(b".", b","), "cells, the header has 5", place=True),
        error("thousands-comma", text(thousands, separator=";"), "decimal mark|thousands", place=True),
        error("thousands-or-decimal", ambiguous.encode(), "decimal comma or a thousands separator", place=True),
        error("thousands-space", cell(5, 1, "2 545"), r"row 7, column 'n' \(B\).*thousands", place=True),
        error("thousands-quote", cell(5, 1, "2'545"), r"row 7, column 'n' \(B\).*thousands", place=True),
        error("full-width-digits", cell(5, 1, "２５４５"), "full-width", place=True),
        error("full-width-point", cell(5, 3, "０．１"), "full-width", place=True),
        error("underscore", cell(5, 1, "2_545"), r"row 7, column 'n' \(B\): '2_545'", place=True),
        error("hex", cell(5, 1, "0x9f1"), r"row 7, column 'n' \(B\): '0x9f1'", place=True),
        error("word", cell(5, 1, "abc"), r"row 7, column 'n' \(B\): 'abc'", place=True),
        error("control-character", cell(5, 1, "\x1f2545"), r"row 7, column 'n' \(B\)", place=True),
        mask("stray-quote-masked", cell(5, 1, '2545"'), 39, {"not-a-number": 1}, data="damaged_rows = 'mask'"),
        error("fraction-of-a-count", cell(5, 1, "2545.5"), r"row 7, column 'n'", place=True),
        error("too-large", cell(5, 3, "1e35"), r"row 7, column 'fy': 1e\+35 is too large to compute with", place=True),
        error("more-than-64-bits", cell(5, 1, "9" * 21), r"row 7, column 'n'", place=True),
        error("many-faults", changed(lambda b: [r.__setitem__(1, "x") for r in b[3:33]]), r"row 5,.*row 34,", place=True),
        mask("nan", cell(5, 1, "NaN"), 39, {"missing-value": 1}),
        mask("empty-cell", cell(5, 1, ""), 39, {"missing-value": 1}),
        mask("dashes", cell(5, 1, "---"), 39, {"missing-value": 1}),
        mask("infinite", cell(5, 1, "inf"), 39, {"missing-value": 1}),
        mask("overflow-word", cell(5, 1, "OVER"), 39, {"missing-value": 1}),
        mask("own-token", cell(5, 1, "ERR"), 39, {"missing-value": 1}, data='missing = ["ERR"]'),
        mask("own-number", cell(5, 3, "-999.0"), 39, {"missing-value": 1}, data='missing = ["ERR", "-999"]'),
        error("utf16-without-mark", text(rows()), "is not utf-16 text", data='encoding = "utf-16"'),
        mask("declared-range", cell(5, 3, "9.9"), 39, {"saturated": 1}, data="range = { fy = [-2, 2] }"),
    ]  # fmt: skip


def shape() -> list[Case]:
    whole = text(rows())
    units = text([["s", "", "g", "g", "g"], *rows()])
    nul = whole.replace(b"0.2500,", b"\0" * 7, 1)
    short = changed(lambda b: b.__setitem__(5, b[5][:3]))
    masked = "damaged_rows = 'mask'"
    return [
        error("empty", b"", "is empty"),
        error("blank", b"\n \n\n", "is empty"),
        error("comments-only", b"# made by a logger\n# that stopped\n\n", "is empty"),
        error("half-a-character", b"\xff\xfe\xff", "utf-16|NUL|empty"),
        error("header-only", (HEADER + "\n").encode(), "no data"),
        error("names-in-an-empty-row", b"\n" + whole, "header_row names an empty row", data="header_row = 1"),
        error("all-rows-skipped", whole, "no row of column names after the 60 rows", data="skip_rows = 60"),
        error("no-header", text(rows()).split(b"\n", 1)[1], "row 1: the first row holds numbers"),
        error("column-twice", text(rows(), "t,n,fx,fx,fz"), "row 1: .*duplicate column name 'fx'", place=True),
        error("column-missing", text(rows(), "t,n,fx,fy,up"), "no column 'fz'"),
        error("short-row", short, "row 7 has 3 cells, the header has 5", place=True),
        error("long-row", cell(5, 4, "0.0,7"), "row 7 has 6 cells", place=True),
        mask("short-row-masked", short, 39, {"short-row": 1}, data=masked),
        mask("long-row-masked", cell(5, 4, "0.0,7"), 39, {"long-row": 1}, data=masked),
        mask("word-masked", cell(5, 1, "abc"), 39, {"not-a-number": 1}, data=masked),
        error("nul-block", nul, "row 7: 7 NUL bytes from byte", place=True),
        mask("nul-block-masked", nul, 39, {"nul-bytes": 1}, data=masked),
        mask("nul-tail", whole + b"\0" * 4096, 40, {"truncated-last-line": 1}),
        mask("cut-last-line", whole[:-3], 39, {"truncated-last-line": 1}),
        mask("no-final-line-end", whole[:-1], 39, {"truncated-last-line": 1}),
        repair("units-row", units, {}),
        repair("units-in-header", text(rows(), "t [s],n,fx [g],fy (g),fz [g]"), {}),
        error("unit-differs", text(rows(), "t,n,fx [m/s^2],fy,fz"), "column 'fx' has the unit 'm/s"),
        repair("comment-lines", b"# logger 7\n# site\n" + whole, {}),
        repair("blank-lines", whole.replace(b"\n", b"\n\n", 3), {"blank-line": 3}),
        repair("gzip", gzip.compress(whole), {}, file="run.csv.gz"),
        error("gzip-cut", gzip.compress(whole)[:-20], "cannot be read", file="run.csv.gz"),
        error("gzip-bomb", gzip.compress(whole + b"0,0,1,0,0\n" * 3_000_000), "unpacks to more than", file="run.csv.gz"),
        error("no-gzip", b"no gzip", "cannot be read", file="run.csv.gz"),
        error("thousands-of-columns", text([["1"] * 5000], ",".join(f"c{i}" for i in range(5000))), "c59 and 4940 more"),
        error("parquet-damaged", b"PAR1" + whole, "not a readable Parquet", file="run.parquet"),
        error("unknown-kind", whole, "files of kind '.doc'", file="run.doc"),
        error("sheet-of-a-text", whole, r"sheet is for \.xlsx files", data='sheet = "log"'),
    ]  # fmt: skip


def signals() -> list[Case]:
    def fold(bits: int, start: int = 0) -> Callable[[list[list[str]]], object]:
        return lambda b: [r.__setitem__(1, str((int(r[1]) + start) % 2**bits)) for r in b]

    def reset(body: list[list[str]]) -> None:
        for i, row in enumerate(body[20:]):
            row[1] = str(count(i / 20.0))

    def swap(body: list[list[str]]) -> None:
        body[10:] = [[f"{float(r[0]) - 1.0:.4f}", *r[1:]] for r in body[10:]]

    def reset_at_gap(body: list[list[str]]) -> None:
        reset(body)
        del body[18:20]

    def numbered(body: list[list[str]]) -> None:
        for i, row in enumerate(body):
            row.append(str(i % 16))
        del body[20:23]

    seq = changed(numbered).replace(b"fz\n", b"fz,k\n", 1)
    sequence = "sequence = { column = 'k', wraps_at = 16 }"
    return [
        repair("gap", changed(lambda b: b.__delitem__(slice(10, 13))), {"gap": 1}, used=37),
        repair("repeated-row", changed(lambda b: b.insert(10, b[9])), {"repeated-row": 1}),
        mask("conflicting-row", changed(lambda b: b.insert(10, [b[9][0], "9", *b[9][2:]])), 39, {"conflicting-row": 1}),
        repair("clock-back", changed(swap), {"time-jump-back": 1}),
        repair("roll-over-16", changed(fold(16, 60000)), {"counter-roll-over": 1}, instrument="counter_bits = 16"),
        repair("roll-over-32", changed(fold(32, 2**32 - 3000)), {"counter-roll-over": 1}, instrument="counter_bits = 32"),
        error("roll-over-undeclared", changed(fold(16, 60000)), r"row \d+, column 'n': the output jumps", place=True),
        error("counter-too-wide", changed(fold(24)), "outside the range", place=True, instrument="counter_bits = 13"),
        error("counter-too-narrow", changed(fold(8)), "a roll-over cannot be recognised", instrument="counter_bits = 8"),
        error("reset", changed(reset), r"row 22, column 'n': the counter goes to 0.*reset", place=True),
        error("reset-declared-16", changed(reset), r"row 22, column 'n': the counter goes to 0", place=True,
              instrument="counter_bits = 16"),
        repair("reset-at-gap", changed(reset_at_gap), {"gap": 1, "counter-reset": 1, "phase-lost": 1},
               used=38),
        repair("sequence-gap", seq, {"sequence-gap": 1, "gap": 1}, used=37, data=sequence),
        error("one-row", text(rows(1)), "fewer than two usable rows"),
        error("time-stands", changed(lambda b: [r.__setitem__(0, "1.0") for r in b]), "column .t. repeats itself in most rows"),
        error("all-missing", changed(lambda b: [r.__setitem__(1, "nan") for r in b]), "no row is left.*missing-value: 40"),
        error("all-settling", text(rows()), "no row is left.*the first 60 s of each position.*settle", data="settle = '60 s'"),
    ]  # fmt: skip


CATALOGUE = [*encodings(), *numbers(), *shape(), *signals()]


def silently_wrong(run: piga.Run) -> int:
    """Used numbers that differ from the clean log; increments inside stretches tell the output."""
    wrong = int(np.count_nonzero(np.abs(run.f - G0 * np.array([1.0, 0.1, 0.0])) > 1e-12))
    step, h = np.diff(run.output) / run.resolution, np.diff(run.t)
    inside = ~run.begins[1:]
    wrong += int(np.count_nonzero(np.abs(step - 10179.0 * h)[inside] > 1.001))
    return wrong + int(np.count_nonzero(np.abs(run.t * 20.0 - np.round(run.t * 20.0)) > 1e-9))


@pytest.mark.parametrize("case", CATALOGUE, ids=lambda case: case.name)
def test_each_ends_as_the_catalogue_says(tmp_path: Path, case: Case) -> None:
    path = case.write(tmp_path)
    if case.outcome == "error":
        with pytest.raises(piga.DataError, match="(?s)" + case.message) as caught:
            piga.read_run(path)
        assert case.file in caught.value.message
        assert not case.place or re.search(r"row \d+", caught.value.message)
        assert caught.value.remedy
        return
    run = piga.read_run(path)
    result = events(run)
    assert {kind: result.get(kind, 0) for kind in case.events} == case.events
    assert set(result) - set(case.events) <= {"gap", "phase-lost", "encoding"}
    assert run.size == case.used
    assert silently_wrong(run) == 0


def test_a_growing_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, collect = Case("grows", text(rows()), "error").write(tmp_path), columns.collect

    def grow(path: Path, *more: object) -> columns.RawColumns:
        result = collect(path, *more)  # type: ignore[arg-type]
        with path.open("ab") as log:
            log.write(b"2.0,20358,1.0,0.1,0.0\n")
        return result

    monkeypatch.setattr(columns, "collect", grow)
    with pytest.raises(piga.DataError, match="changed while it was read"):
        piga.read_run(run)
