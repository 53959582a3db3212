"""Tables of figures on the pages are those of ``docs/measured``, and every figure says how it was measured."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from benchmarks import measured

from .pages import ROOT, name_of


@pytest.mark.parametrize("page", measured.pages(), ids=name_of)
def test_tables_are_those_of_the_figures(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert measured.filled(text) == text, "run: python benchmarks/measured.py"


def test_every_table_is_shown_once() -> None:
    shown = [name for page in measured.pages() for name in measured.shown(page.read_text(encoding="utf-8"))]
    assert sorted(shown) == measured.names()
    marks = [page.read_text(encoding="utf-8").count("<!-- measured:") for page in measured.pages()]
    assert sum(marks) == len(shown), "a mark without its end"


@pytest.mark.parametrize("name", measured.names())
def test_every_figure_says_how_it_was_measured(name: str) -> None:
    table, figures = measured.load(name)
    assert len({figure["name"] for figure in figures}) == len(figures), "one name, two figures"
    for figure in figures:
        missing = [key for key in measured.NEEDED if figure.get(key) in (None, "")]
        assert not missing, f"{figure['name']}: {missing}"
        values = figure["value"] if isinstance(figure["value"], list) else [figure["value"]]
        assert all(isinstance(value, int | float) for value in values), figure["name"]
        assert values == sorted(values), f"{figure['name']}: lowest value first"
        assert re.fullmatch(r"\d{4}-\d\d-\d\d", figure["date"])
        assert re.fullmatch(r"\d+\.\d+\.\d+(\.dev\d+)?", figure["version"])
        assert figure.get("column", "") in table.get("columns", [""])


@pytest.mark.parametrize("name", measured.names())
def test_commands_name_what_is_there(name: str) -> None:
    for figure in measured.load(name)[1]:
        words = figure["command"].split()
        paths = [word for word in words if "/" in word]
        paths += [word.replace(".", "/") + ".py" for word in words if word.startswith("tests.")]
        assert all((ROOT / path).exists() for path in paths), figure["command"]
