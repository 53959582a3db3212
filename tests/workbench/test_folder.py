"""The opened folder: which of its files the pages offer."""

from __future__ import annotations

from pathlib import Path

from piga.workbench.folder import Folder


def test_what_is_listed_can_be_opened(tmp_path: Path) -> None:
    """Not the certificate of a preview, which lies in the hidden folder of the workbench."""
    for name in (
        "b.xml",
        "a.xml",
        "kept/c.xml",
        ".piga-ui/trials/0/c.xml",
        ".h.xml",
        "-x.xml",
        "back\\slash.xml",
    ):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("<x/>", encoding="utf-8")
    (tmp_path / "link.xml").symlink_to(tmp_path / "a.xml")
    (tmp_path / "nowhere.xml").symlink_to(tmp_path / "none.xml")
    (tmp_path / "folder.xml").mkdir()
    folder = Folder(tmp_path)
    names = folder.listed("**/*.xml")
    assert names == ["a.xml", "b.xml", "kept/c.xml"]
    assert all(folder.file(name) for name in names)
    assert folder.listed("b*", "a*") == ["b.xml", "a.xml"]
