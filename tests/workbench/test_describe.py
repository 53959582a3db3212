"""Form and text of a run file: either side edits the other, and nothing else changes."""

from __future__ import annotations

from importlib.resources import files

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import piga
from piga.describe.toml_writer import toml_value
from piga.records.text_files import toml_document
from piga.workbench.pages.describe import form_fields, text_with

TEXT = files("piga.data").joinpath("tumble-a.toml").read_text(encoding="utf-8")
ALL = [field.path for fields in form_fields(TEXT).values() for field in fields]


def values(text: str) -> dict[str, str]:
    return {field.path: field.value for fields in form_fields(text).values() for field in fields}


def test_the_form_shows_the_text_and_an_unchanged_form_changes_nothing() -> None:
    assert text_with(TEXT, values(TEXT)) == TEXT
    shown = values(TEXT)
    assert shown["instrument.scale_factor"] == '"0.8884 rad/s/g"'
    assert shown["data.segment"] == '"position"'
    assert shown["estimation.method"] == ""
    assert all(field.sentence for fields in form_fields(TEXT).values() for field in fields)


def test_a_value_is_changed_added_and_removed() -> None:
    changed = text_with(
        TEXT,
        {
            "instrument.serial": '"G-7"',
            "estimation.method": '"rate"',
            "uncertainty.timing": "",
            "nonsense.key": "1",
        },
    )
    document = toml_document(__import__("pathlib").Path("run.toml"), changed.encode())
    assert document["instrument"]["serial"] == "G-7"
    assert document["estimation"] == {"method": "rate"}
    assert "timing" not in document["uncertainty"]
    assert "nonsense" not in document
    kept = [line for line in TEXT.splitlines() if "serial" not in line and "timing" not in line]
    assert all(line in changed.splitlines() for line in kept)


def test_plain_words_are_text() -> None:
    assert values(text_with(TEXT, {"data.segment": "Lage 3"}))["data.segment"] == '"Lage 3"'


@pytest.mark.parametrize("text", ["[instrument", "a = 1\na = 2", "x = \x00"])
def test_text_that_is_no_toml_is_refused(text: str) -> None:
    with pytest.raises(piga.PigaError):
        form_fields(text)
    with pytest.raises(piga.PigaError):
        text_with(text, {"instrument.serial": "1"})


@settings(max_examples=100, deadline=None)
@given(path=st.sampled_from(ALL), value=st.text(max_size=40))
def test_any_value_gives_toml_that_shows_it(path: str, value: str) -> None:
    try:
        changed = text_with(TEXT, {path: value})
    except piga.PigaError:
        return
    document = toml_document(__import__("pathlib").Path("run.toml"), changed.encode())
    table, _, key = path.partition(".")
    if value.strip():
        assert values(changed)[path] == toml_value(document[table][key])
    else:
        assert key not in document.get(table, {})
