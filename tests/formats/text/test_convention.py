"""Header, units row and skipped rows as the run file names them; encodings judged by the wanted column names."""

from __future__ import annotations

from pathlib import Path

import pytest

import piga
from piga.formats.text.convention import is_units_row
from tests.records.files import events, lines, write_run

PREAMBLE = "Test 12;A. B.\nn;t\n1;2\n"
HEADER = "t;n;fx;fy;fz"


def body() -> list[str]:
    return [line.replace(",", ";") for line in lines()]


def read(folder: Path, text: str, data: str = "", encoding: str = "utf-8") -> piga.Run:
    (folder / "run.csv").write_bytes(text.encode(encoding))
    return piga.read_run(write_run(folder, data=data))


@pytest.mark.parametrize("data", ["", "header_row = 4", "skip_rows = 3", "header_row = 4\nskip_rows = 1"])
def test_rows_before_the_header(tmp_path: Path, data: str) -> None:
    run = read(tmp_path, PREAMBLE + "\n".join([HEADER, *body(), ""]), data)
    assert run.size == 40
    assert run.row[0] == 5


def test_a_comment_that_repeats_the_names_is_no_header(tmp_path: Path) -> None:
    run = read(tmp_path, "\n".join([f"# {HEADER}", HEADER, *body(), ""]))
    assert (run.size, run.row[0]) == (40, 3)


@pytest.mark.parametrize(
    "units", ["s;-;g;g;g", "[s];[-];[g];[g];[g]", "s;;g;g;g", "s;1;g;g;g", '"s";"-";"g";"g";"g"']
)
def test_a_units_row(tmp_path: Path, units: str) -> None:
    run = read(tmp_path, "\n".join([HEADER, units, *body(), ""]))
    assert run.size == 40
    with pytest.raises(piga.DataError, match="has the unit 'mg' in the file, but 'g'"):
        read(tmp_path, "\n".join([HEADER, units.replace("g", "mg"), *body(), ""]))


def test_a_units_row_that_is_named(tmp_path: Path) -> None:
    text = "\n".join([HEADER, "Ueberschrift;;;;", "sec;Imp.;;;", *body(), ""])
    with pytest.raises(piga.DataError):
        read(tmp_path, text)
    assert read(tmp_path, text.replace("Ueberschrift;;;;\n", ""), "units_row = 2").size == 40
    assert read(tmp_path, text, "units_row = 3").size == 40
    with pytest.raises(piga.DataError, match="units_row 900 is not a row below"):
        read(tmp_path, text, "units_row = 900")


def test_no_units_row() -> None:
    """A label that is a unit, and missing values, do not make a units row."""
    assert not is_units_row(["-", "-", "g"], ["1.0", "2", "g"])
    assert is_units_row(["-", "-", "g"], ["1.0", "2", "3.5"])
    assert not is_units_row(["1.0", "s"])
    assert not is_units_row(["NaN", "s"])
    assert not is_units_row(["-", "-"])


def test_a_first_row_that_only_looks_like_units(tmp_path: Path) -> None:
    text = "\n".join(["t;n;fx;fy;fz;seg", *(f"{row};m" for row in body()), ""])
    assert read(tmp_path, text, 'segment = "seg"\nunits_row = false').size == 40


@pytest.mark.parametrize(
    ("name", "encoding"),
    [("Zählerstand", "cp1252"), ("Größe", "cp1252"), ("脉冲数", "gb18030"), ("Compteur d'été", "cp1252")],
)
def test_encodings_by_the_wanted_names(tmp_path: Path, name: str, encoding: str) -> None:
    text = "\n".join([HEADER.replace("n", name), *body(), ""])
    (tmp_path / "run.csv").write_bytes(text.encode(encoding))
    path = write_run(tmp_path)
    path.write_text(path.read_text().replace('"n"', f'"{name}"'), encoding="utf-8")
    run = piga.read_run(path)
    assert run.size == 40
    assert events(run) == {"encoding": 1}
    assert run.quality.events[0].detail == f"read as {encoding}"
