"""What all pages share: where the results of a job lie."""

from __future__ import annotations

from pathlib import Path

import pytest

from piga.workbench.folder import Folder, OutsideError
from piga.workbench.jobs import Jobs
from piga.workbench.pages.common import Workbench
from piga.workbench.security import Door

KEY = "0123456789abcdef01234567"


@pytest.mark.parametrize("room", ["signals", "check", "terms", "lab"])
def test_results_in_a_folder_of_any_name_have_their_place(tmp_path: Path, room: str) -> None:
    """The marks of jobs that write no files begin with such names."""
    folder = Folder(tmp_path)
    bench = Workbench(folder, Jobs(folder.state_room("jobs"), folder.root), None, Door(1))
    for mark in ("", f"signals/{KEY[:12]}-{KEY}", f"check/{KEY}", f"terms/{KEY}"):
        assert bench.place_of(mark) is None
    (tmp_path / room).mkdir()
    assert bench.place_of(f"{room}/run-compensated.parquet") == tmp_path / room / "run-compensated.parquet"
    (tmp_path / room / "p-plan").symlink_to(tmp_path.parent)
    with pytest.raises(OutsideError):
        bench.start(("plan", f"{room}/p.toml"), "Plan", f"{room}/p.toml", f"{room}/p-plan")
    assert bench.jobs.all() == []
