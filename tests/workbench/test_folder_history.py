"""Undo, and two tabs that change one file."""

from __future__ import annotations

from pathlib import Path

import pytest

from piga.errors import ArgumentError, PigaError
from piga.workbench.folder import ChangedError, Folder, History
from tests.workbench.conftest import shipped_record


@pytest.fixture
def history(tmp_path: Path) -> History:
    shipped_record(tmp_path)
    return History(Folder(tmp_path))


def test_changes_are_taken_back_one_after_the_other(history: History, tmp_path: Path) -> None:
    path = tmp_path / "tumble-a.toml"
    first = path.read_text(encoding="utf-8")
    second, third = first.replace('"tumble-a"', '"G-7"', 1), first.replace('"tumble-a"', '"G-8"', 1)
    history.write("tumble-a.toml", history.seen(first), second, "one")
    history.write("tumble-a.toml", history.seen(second), third, "two")
    assert path.read_text(encoding="utf-8") == third
    assert (history.last, history.undo()) == ("two", "two")
    assert path.read_text(encoding="utf-8") == second
    history.undo()
    assert path.read_text(encoding="utf-8") == first
    with pytest.raises(ArgumentError, match="nothing to undo"):
        history.undo()


def test_a_folder_that_was_removed_comes_back_and_a_new_one_goes(history: History, tmp_path: Path) -> None:
    kept, new = tmp_path / "kept", tmp_path / "new"
    kept.mkdir()
    (kept / "a").write_text("1", encoding="utf-8")
    history.note("discard", kept, history.put_away(kept))
    new.mkdir()
    history.note("keep", new, None)
    assert not kept.exists()
    history.undo()
    assert not new.exists()
    history.undo()
    assert (kept / "a").read_text(encoding="utf-8") == "1"


def test_the_second_tab_is_told_what_the_first_changed(history: History, tmp_path: Path) -> None:
    path = tmp_path / "tumble-a.toml"
    first = path.read_text(encoding="utf-8")
    seen = history.seen(first)
    history.write("tumble-a.toml", seen, first.replace('"tumble-a"', '"G-7"', 1), "one")
    with pytest.raises(ChangedError) as error:
        history.write("tumble-a.toml", seen, first.replace("72000", "36000"), "two")
    assert error.value.lines == ['-serial = "tumble-a"', '+serial = "G-7"']
    assert "36000" not in path.read_text(encoding="utf-8")


def test_a_text_that_is_no_run_file_changes_nothing(history: History, tmp_path: Path) -> None:
    path = tmp_path / "tumble-a.toml"
    first = path.read_bytes()
    for text in ("[data", "[data]\nfile = 3\n"):
        with pytest.raises(PigaError):
            history.write("tumble-a.toml", history.seen(first.decode()), text, "wrong")
    assert path.read_bytes() == first
    assert history.last == ""
