"""The pages Plan, Twin and Platform: the files that they offer."""

from __future__ import annotations

from pathlib import Path

from piga.workbench.folder import Folder
from piga.workbench.pages.scenario import KINDS, _files


def test_only_files_that_can_be_opened_are_offered(tmp_path: Path) -> None:
    """The page opens the first of them, and would be refused with it."""
    for name in ("-option.toml", ".hidden.toml", ".piga-ui/x.toml", "-sub/x.toml", "good.toml", "sub/too.toml"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text("[plan]\n", encoding="utf-8")
    (tmp_path / "link.toml").symlink_to(tmp_path / "good.toml")
    (tmp_path / "nowhere.toml").symlink_to(tmp_path / "none.toml")
    (tmp_path / "folder.toml").mkdir()
    folder = Folder(tmp_path)
    names = _files(folder, KINDS["plan"])
    assert names == ["good.toml", "sub/too.toml"]
    assert all(folder.file(name) for name in names)
