"""Certificate: whose entries they are, numbers that are used once."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from piga.workbench.folder import Folder, History
from piga.workbench.jobs import Jobs
from piga.workbench.pages.common import Bench
from piga.workbench.pages.later import _items, _own
from piga.workbench.security import Door


@pytest.fixture
def bench(tmp_path: Path) -> object:
    folder = Folder(tmp_path)
    jobs = Jobs(tmp_path)
    yield Bench(folder, jobs, History(folder), Door(1))
    jobs.stop_all()


def test_entries_of_the_example_are_nobodys_own(bench: Bench, tmp_path: Path) -> None:
    empty = {key: value for key, value in _own(bench, None).items() if value}
    shutil.copy(Path("examples/certificate.toml"), tmp_path)
    assert {key: value for key, value in _own(bench, None).items() if value} == empty
    assert "laboratory.name" not in empty
    text = (tmp_path / "certificate.toml").read_text(encoding="utf-8").replace("12 Meridian Road", "3 Pier")
    (tmp_path / "certificate.toml").write_text(text, encoding="utf-8")
    assert _own(bench, None)["laboratory.street"] == "3 Pier"


def test_a_number_is_used_once(bench: Bench, tmp_path: Path) -> None:
    first = _own(bench, None)["certificate.number"]
    (tmp_path / f"certificate-{first}").mkdir()
    assert _own(bench, None)["certificate.number"] != first
    (item,) = [one for one in _items(bench, {"certificate.number": first}) if one.key == "certificate.number"]
    assert "was used" in item.refusal
