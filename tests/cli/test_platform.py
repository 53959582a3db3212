"""``piga platform``: files, every N-th row, JSON and exit codes."""

from __future__ import annotations

import json

import pytest

from tests.cli.runner import exit_code
from tests.platform.conftest import INTERPRETED

STEP = "8 s" if INTERPRETED else "2 s"


SHORT = f"""
[site]
latitude = "40 deg"
[run]
duration = "1 h"
step = "{STEP}"
[polar]
misalignment = "4 arcmin"
phase = "20 deg"
[equatorial]
misalignment = "4 arcmin"
phase = "75 deg"
drift = ["0.01 deg/h", "0 deg/h"]
[sensors]
gimbal_noise = "1 arcsec"
pickoff_noise = "1 arcsec"
velocity_random_walk = "1e-5 m/s/sqrt(s)"
"""


@pytest.fixture
def scenario(tmp_path):
    path = tmp_path / "scenario.toml"
    path.write_text(SHORT)
    return path


def _run(capsys, *arguments):
    return exit_code("platform", *arguments), capsys.readouterr()


@pytest.mark.parametrize(
    ("command", "files"),
    [
        ("simulate", {"readouts.parquet", "truth.parquet", "simulated.toml"}),
        ("align", {"alignment.json"}),
        ("identify", {"identification.json"}),
        ("navigate", {f"navigation-{m}.parquet" for m in ("none", "A", "B", "C")}),
        ("compare", {"comparison.json"}),
    ],
)
def test_a_command_leaves_its_files_and_a_page(capsys, scenario, tmp_path, command, files):
    code, streams = _run(capsys, command, scenario, "--out", tmp_path / "out", "--json")
    assert code == 0
    assert isinstance(json.loads(streams.out), dict)
    assert {p.name for p in (tmp_path / "out").glob("[!.]*")} == {*files, "report.html"}
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "<h1>" in page


def test_budget_is_added_on_request(capsys, scenario, tmp_path):
    code, streams = _run(capsys, "compare", scenario, "--out", tmp_path, "--json", "--budget")
    document = json.loads(streams.out)
    assert code == 0
    assert document["budget"][-1]["source"] == "all together"


@pytest.mark.long
def test_gyro_accelerometers_get_their_own_page(capsys, scenario, tmp_path):
    step = "1 s"
    text = SHORT.replace(STEP, step).replace("1 h", "20 min")
    text = text.replace("[sensors]", '[sensors]\naccelerometers = "piga"')
    models = '[compensation]\nmodels = ["B"]\nmisalignment = "true"\nattitude = "true"\n'
    scenario.write_text(text + models)
    code, _ = _run(capsys, "compare", scenario, "--out", tmp_path / "out")
    assert code == 0
    assert "Gyro accelerometers" in (tmp_path / "out" / "capstone.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("compare", "absent.toml"), "absent.toml: cannot be read"),
        (("identify", ".", "--out", "x"), "is a folder"),
        (("align", "sway.toml", "--out", "x"), "needs a base at rest"),
        (("identify", "short.toml", "--out", "x"), "two turns of the cases"),
        (("simulate", "short.toml", "--out", "x", "--every", "2"), "--every is gone"),
    ],
)
def test_wrong_use_ends_with_two_and_one_message(capsys, monkeypatch, tmp_path, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sway.toml").write_text(SHORT + '[motion]\nkind = "sway"\n')
    (tmp_path / "short.toml").write_text(SHORT.replace("1 h", "800 s"))
    code, streams = _run(capsys, *arguments)
    assert code == 2
    assert message in streams.err
    assert "Traceback" not in streams.err
