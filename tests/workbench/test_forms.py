"""Form and text of a run file: either side edits the other, and nothing else changes."""

from __future__ import annotations

import pathlib
import tomllib
from importlib.resources import files

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import piga
from piga.records.text_files import toml_document, toml_value
from piga.workbench.forms import digest, form_fields, form_of_text, sent_text, text_with
from tests.workbench.conftest import Client, Server

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


def test_a_field_that_was_typed_is_not_lost_when_a_button_follows_at_once():
    typed = {"text": [TEXT.replace("\n", "\r\n")], "drawn": [digest(TEXT)], "key:instrument.serial": ['"G-9"']}
    assert 'serial = "G-9"' in sent_text(typed, "run")
    edited = typed | {"text": [TEXT.replace('tumble-a"', 'G-10"', 1)]}
    assert 'serial = "G-10"' in sent_text(
        edited, "run"
    )  # the text was changed after the form was drawn: it holds


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("scenario", "twin.toml"),
        ("platform", "platform-published.toml"),
        ("plan", "plan-dividing-head.toml"),
        ("certificate", "certificate.toml"),
    ],
)
def test_every_kind_of_file_has_its_form(file: str, name: str) -> None:
    text = (pathlib.Path("examples") / name).read_text(encoding="utf-8")
    tables = form_fields(text, file)
    shown = {field.path: field.value for fields in tables.values() for field in fields}
    assert text_with(text, shown, file) == text
    assert all(field.sentence for fields in tables.values() for field in fields)
    document = tomllib.loads(text)
    for table, held in document.items():
        if isinstance(held, dict):
            assert {f"{table}.{key}" for key in held} <= set(shown)


def test_a_value_never_moves_another_key() -> None:
    text = "[site]\nlatitude = '40 deg'\n[[environment]]\nname = 'T'\nvalue = '20 degC'\n"
    assert "environment" not in form_fields(text, "certificate")
    nested = "[sensors.piga]\nbeta = '74 arcsec'\n"
    try:
        changed = text_with(
            nested, {"sensors.gimbal_noise": "1 arcsec", "sensors.piga": "{ beta = '75 arcsec' }"}, "platform"
        )
    except piga.PigaError:
        return
    assert tomllib.loads(changed) == {"sensors": {"piga": {"beta": "75 arcsec"}, "gimbal_noise": "1 arcsec"}}


def test_text_without_form_keeps_its_message() -> None:
    form = form_of_text("[instrument", "run")
    assert form.tables == {}
    assert "not valid TOML" in form.message


def test_a_question_keeps_its_capital_letters(client: Client, server: Server) -> None:
    (server.folder / "open.csv").write_text("t,counts\n" + "".join(f"{t},{7 * t}\n" for t in range(40)))
    page = client.page("/describe/open.csv")
    (server.folder / "open.csv").unlink()
    assert ">Columns of the specific force along X0, Y0 and Z0</label>" in page
