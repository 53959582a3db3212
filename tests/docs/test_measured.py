"""Tables of figures on the pages are those of ``docs/measured``, and every figure says how it was measured."""

from __future__ import annotations

import json
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


def test_a_limit_that_is_not_kept_is_said() -> None:
    figure = {"name": "x", "unit": "s", "value": [2.0, 3.5], "at_most": 3}
    assert measured.measured(figure) == "**not met**: 2 to 3.5 s"
    assert measured.bar(figure) == "at most 3 s"
    assert measured.measured(figure | {"at_most": 3.5}) == "2 to 3.5 s"
    assert measured.measured(figure | {"at_most": 4, "at_least": 2.5}).startswith("**not met**")
    assert (
        measured.measured({"name": "x", "unit": "1", "value": 0.9, "decimals": 2, "least": 1e-9})
        == "0.90 (least 1e-9)"
    )


def written(folder: Path) -> None:
    shared = dict.fromkeys(("commit", "command", "conditions"), "x") | {
        "version": "0.1.0",
        "date": "2026-01-01",
    }
    figures = [
        {"name": f"{row}{column}", "unit": "s", "value": 1.5, "row": row, "column": column}
        for row, column in (("a", "p"), ("a", "q"), ("b", "p"))
    ]
    table = shared | {"rows": "what", "columns": ["p", "q"], "figures": figures}
    (folder / "small.json").write_text(json.dumps(table), encoding="utf-8")


def test_what_is_recorded_is_shown(tmp_path: Path) -> None:
    written(tmp_path)
    page = "before\n<!-- measured: small -->\nold\n<!-- end -->\nbehind\n"
    assert "| a | 1.5 s | 1.5 s |\n| b | 1.5 s |  |\n" in measured.filled(page, tmp_path)
    measured.record(
        "small", {"ap": (2.0, 2.5), "bp": {"value": 4.0, "least": 3.0}}, tmp_path, conditions="idle"
    )
    shown = measured.filled(page, tmp_path)
    now = measured.version()
    assert f"| a | 2 to 2.5 s | 1.5 s | {now}, " in shown
    assert "| b | 4 s (least 3) |  |" in shown
    assert shown.startswith("before\n<!-- measured: small -->\n| what |")
    assert "X. Idle" in shown or "Idle. X" in shown
    assert measured.filled(shown, tmp_path) == shown
    figures = measured.load("small", tmp_path)[1]
    assert [figure["conditions"] for figure in figures] == ["idle", "x", "idle"]
    assert figures[0]["commit"].startswith(measured.commit()[:7])
    assert figures[1]["version"] == "0.1.0"
    measured.record("small", {"aq": {"value": 9.0, "at_most": 5}, "bp": 2.0}, tmp_path)
    assert "| b | 2 s |" in measured.filled(page, tmp_path), "the least of another run is gone"
    assert "| **not met**: 9 s (at most 5 s) |" in measured.filled(page, tmp_path)
