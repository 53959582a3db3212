"""``piga simulate``, ``reproduce`` and ``platform`` as a user runs them."""

from __future__ import annotations

import json

import pytest

from piga.calibration.calibrate import calibrate
from piga.stand import read_run
from piga.studies import reproduction
from piga.studies.case import Case, Chapter
from tests.cli.runner import exit_code, invoked
from tests.platform.conftest import INTERPRETED
from tests.stand.simulated import written


@pytest.mark.interpreted
@pytest.mark.long
def test_command_writes_all_files_and_json(tmp_path):
    path = written(tmp_path)
    result = invoked("simulate", path, "--out", tmp_path / "out", "--json")
    assert result.exit_code == 0
    assert json.loads(result.stdout)["schema"] == "piga.truth/1"
    names = {p.name for p in (tmp_path / "out").glob("[!.]*")}
    assert names == {"run.toml", "run.parquet", "truth.json", "report.html"}
    assert calibrate(read_run(tmp_path / "out" / "run.toml"))["k0"].value == pytest.approx(3e-4, abs=1e-5)


def test_json_is_one_document_of_the_interface(capsys):
    assert exit_code("reproduce", "--only", "redundancy-angle", "--json") == 0
    cases = json.loads(capsys.readouterr().out)["cases"]
    assert len(cases) == 7
    for case in cases:
        assert case["verdict"] in ("pass", "fail", "info")
        assert case["difference"] == case["computed"] - case["published"]
        assert abs(case["difference"]) <= case["tolerance"]


def test_unknown_id_names_the_known_ones(capsys):
    assert exit_code("reproduce", "--only", "nothing") == 2
    assert "one of: constant-input, period" in capsys.readouterr().err


@pytest.mark.long
def test_out_writes_the_page(tmp_path):
    assert exit_code("reproduce", "--only", "constant-input", "--out", tmp_path / "new") == 0
    page = (tmp_path / "new" / "reproduction.html").read_text(encoding="utf-8")
    assert "constant-input-rates" in page
    assert "rate by form 1 where it is farthest from the integration" in page


def test_disagreement_ends_with_exit_code_1(monkeypatch):
    wrong = Case(
        id="mounting.moves", source="[Wei2024]", quantity="skew", unit="arcsec", published=1000.0, computed=900.0,
        tolerance=0.1, note="a wrong number",
    )  # fmt: skip
    monkeypatch.setitem(
        reproduction.CHAPTERS, "mounting", lambda: Chapter("Mounting", "", "", {"wrong": wrong}, "mounting")
    )
    done = invoked("reproduce", "--only", "mounting")
    assert done.exit_code == 1
    assert "1 cases: 0 agree, 1 do not" in done.stdout


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
        ("compare", {"comparison.json", *(f"navigation-{m}.parquet" for m in ("none", "A", "B", "C"))}),
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
        (("identify", ".", "--out", "x"), "but a folder"),
        (("align", "sway.toml", "--out", "x"), "needs a base at rest"),
        (("identify", "short.toml", "--out", "x"), "two turns of the cases"),
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
