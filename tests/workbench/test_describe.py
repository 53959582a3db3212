"""A log that nothing describes: corrected columns, answers, refusals."""

from __future__ import annotations

from pathlib import Path

import pytest

from piga.records.run_file import read_run_file
from piga.workbench.describe import sheet
from piga.workbench.folder import Folder
from tests.workbench.logs import german

KEY = "instrument.scale_factor"


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    (tmp_path / "log.csv").write_bytes(german())
    return Folder(tmp_path)


@pytest.mark.parametrize(
    ("typed", "words"), [("0,8884", "unit is missing"), ("0.8884 rad/s", "rad/s"), ("0,8884.1 rad/s/g", "comma in the number")]
)  # fmt: skip
def test_a_wrong_number_is_refused_at_its_field_and_kept(folder: Folder, typed: str, words: str) -> None:
    made = sheet(folder, "log.csv", {f"q:{KEY}": typed, f"u:{KEY}": ""})
    (field,) = [one for one in made.fields if one.key == KEY]
    assert (field.typed, made.complete) == (typed, False)
    assert words in field.refusal


def test_the_run_file_is_complete_once_the_questions_are_answered(folder: Folder) -> None:
    made = sheet(folder, "log.csv", {f"q:{KEY}": "0,8884", f"u:{KEY}": "rad/s/g"})
    assert made.complete, made
    run_file = read_run_file(folder.root / "log.toml", made.draft.text().encode())
    assert run_file.instrument.scale_factor == "0.8884 rad/s/g"
    assert run_file.data.output.column == "Z\u00e4hlerstand"


def test_a_column_is_corrected_at_the_column(folder: Folder) -> None:
    plain = sheet(folder, "log.csv", {})
    names = [column.name for column in plain.described.columns]
    at = names.index("fz")
    made = sheet(folder, "log.csv", {f"role:{at}": "temperature", f"unit:{at}": "degC"})
    assert made.draft.document["data"]["temperature"]["column"] == "fz"
    assert made.described.columns[at].reason == "as you said"
    assert "fz" not in str(made.draft.document["data"].get("reference", ""))
    unknown = sheet(folder, "log.csv", {f"role:{at}": "<script>"})
    assert "is not what a column can hold" in unknown.message
    assert unknown.described.columns[at].kind == "force"


def test_a_direct_instrument_is_asked_for_its_own_unit(tmp_path: Path) -> None:
    rows = "".join(
        f"{0.05 * k:.2f},{1.3 * (1 - 2 * (k // 50 % 2)):.5f},{1 - 2 * (k // 50 % 2)},0,0\n" for k in range(200)
    )
    (tmp_path / "direct.csv").write_text("time [s],output [V],fx [g],fy [g],fz [g]\n" + rows, encoding="utf-8")
    made = sheet(Folder(tmp_path), "direct.csv", {"role:1": "direct", f"q:{KEY}": "1,3 V/g"})
    assert made.draft.document["instrument"]["scale_factor"] == "1.3 V/g", made
