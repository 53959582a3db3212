"""The opened folder: which of its files the pages offer; Undo, and two tabs that change one file."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from piga.errors import ArgumentError, PigaError
from piga.workbench.folder import Folder, History, OutsideError
from tests.workbench.conftest import shipped_record


def test_what_is_listed_can_be_opened(tmp_path: Path) -> None:
    """Not the certificate of a preview, which lies in the hidden folder of the workbench."""
    hidden = (".piga-ui/trials/0/c.xml", ".h.xml", "-x.xml", "back\\slash.xml")
    for name in ("b.xml", "a.xml", "kept/c.xml", *hidden):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("<x/>", encoding="utf-8")
    (tmp_path / "link.xml").symlink_to(tmp_path / "a.xml")
    (tmp_path / "nowhere.xml").symlink_to(tmp_path / "none.xml")
    (tmp_path / "folder.xml").mkdir()
    folder = Folder(tmp_path)
    names = [folder.name(path) for path in folder.files()]
    assert names == ["a.xml", "b.xml", "kept/c.xml"]
    assert all(folder.read(folder.file(name)) == b"<x/>" for name in names)


@pytest.mark.skipif(os.name == "nt", reason="links and pipes of POSIX")
def test_no_file_is_read_through_a_link_or_pipe(tmp_path: Path) -> None:
    """Nor if it became one after it was looked at."""
    lab = tmp_path / "lab"
    (lab / "kept").mkdir(parents=True)
    (tmp_path / "secret").write_text("k7Qz", encoding="utf-8")
    (lab / "link.toml").symlink_to(tmp_path / "secret")
    (lab / "out").symlink_to(tmp_path)
    os.mkfifo(lab / "pipe.toml")
    (lab / "large.toml").write_bytes(b"x" * 2000)
    folder = Folder(lab)
    for name in ("link.toml", "out/secret", "pipe.toml", "kept", "../secret"):
        with pytest.raises((OutsideError, ValueError)):
            folder.read(lab / name)
    with pytest.raises(OutsideError):
        folder.read(lab / "large.toml", 1999)
    for name in ("link.toml", "out/secret", "pipe.toml", "out"):
        with pytest.raises(OutsideError):
            folder.path(name)
    run = shipped_record(lab).read_text(encoding="utf-8")
    for named in ("../secret", "/dev/zero", "link.toml"):
        (lab / "names.toml").write_text(run.replace('"tumble-a.csv"', f'"{named}"'), encoding="utf-8")
        with pytest.raises(OutsideError, match="names"):
            folder.toml("names.toml")


def test_the_hidden_folder_of_another_user_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = Folder(tmp_path)
    assert folder.state_room("trials").is_dir()
    me = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: me + 1)
    with pytest.raises(OutsideError, match="another user"):
        folder.state_room("trials")


def test_versions_of_a_result_are_in_order(tmp_path: Path) -> None:
    run = shipped_record(tmp_path)
    from tests.reports.example import calibration

    for name in ("-v1", "-v10", "-v2", ""):
        place = tmp_path / f"tumble-a-calibration{name}"
        place.mkdir()
        calibration(serial="tumble-a", with_residuals=False).to_json(place / "calibration.json")
    (entry,) = Folder(tmp_path).entries()
    assert entry.state == "ready"
    assert [one.version for one in entry.kept] == [0, -10, -2, -1]
    run.unlink()
    assert Folder(tmp_path).entries()[0].state == "log"


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
    assert history.last == "two"
    history.undo()
    assert path.read_text(encoding="utf-8") == second
    history.undo()
    assert path.read_text(encoding="utf-8") == first
    with pytest.raises(ArgumentError, match="nothing to undo"):
        history.undo()


def test_a_folder_that_was_removed_comes_back_and_a_new_one_goes(history: History, tmp_path: Path) -> None:
    kept, new = tmp_path / "kept", tmp_path / "new"
    kept.mkdir()
    (kept / "a").write_text("1", encoding="utf-8")
    history.put(kept, None, "discard")
    (tmp_path / "part").mkdir()
    history.put(new, tmp_path / "part", "keep")
    assert not kept.exists()
    history.undo()
    assert not new.exists()
    history.undo()
    assert (kept / "a").read_text(encoding="utf-8") == "1"


def test_a_text_that_is_no_run_file_changes_nothing(history: History, tmp_path: Path) -> None:
    path = tmp_path / "tumble-a.toml"
    first = path.read_bytes()
    for text in ("[data", "[data]\nfile = 3\n"):
        with pytest.raises(PigaError):
            history.write("tumble-a.toml", history.seen(first.decode()), text, "wrong")
    assert path.read_bytes() == first
    assert history.last == ""
