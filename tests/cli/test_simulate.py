"""``piga simulate`` as a user runs it: all files, and what was simulated."""

from __future__ import annotations

import json

import pytest

from piga.calibration.calibrate import calibrate
from piga.stand import (
    read_run,
)
from tests.cli.runner import invoked
from tests.stand.simulated import written

pytestmark = pytest.mark.interpreted


@pytest.mark.long
def test_command_writes_all_files_and_json(tmp_path):
    path = written(tmp_path)
    result = invoked("simulate", path, "--out", tmp_path / "out", "--json")
    assert result.exit_code == 0
    assert json.loads(result.stdout)["schema"] == "piga.truth/1"
    names = {p.name for p in (tmp_path / "out").glob("[!.]*")}
    assert names == {"run.toml", "run.parquet", "truth.json", "report.html"}
    assert calibrate(read_run(tmp_path / "out" / "run.toml"))["k0"].value == pytest.approx(3e-4, abs=1e-5)
