"""The commands as a user runs them: exit codes, JSON, results by rename, one clear message."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from typer.main import get_command

from piga.cli.main import app
from piga.errors import PigaError
from piga.progress import FIRST_USE
from piga.records import Calibration
from tests.cli.runner import exit_code, outcome
from tests.records.files import write_log, write_run


def piga(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", "from piga.cli.main import main; main()", *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, check=False, cwd=cwd, env=os.environ | {"COLUMNS": "100"}
    )


def small_run(folder: Path) -> Path:
    """Two positions, each visited twice: enough for scale_factor and k0."""
    visits = [(10179.0, "1.0,0.1,0.0"), (5089.5, "0.5,0.3,0.0")] * 2
    rows = [
        f"{i / 20.0 + 10.0 * k:.4f},{20000 * k + round(rate * i / 20.0)},{force},{k}"
        for k, (rate, force) in enumerate(visits)
        for i in range(30)
    ]
    write_log(folder, rows, header="t,n,fx,fy,fz,seg")
    return write_run(folder, data='segment = "seg"')


@pytest.mark.long
def test_the_main_job(tmp_path: Path) -> None:
    done = piga("demo", "--out", tmp_path / "out")
    assert ".piga-" not in (tmp_path / "out" / "calibration.json").read_text(encoding="utf-8")
    assert done.returncode == 0, done.stderr
    assert "scale_factor" in done.stdout
    names = {path.name for path in (tmp_path / "out").glob("[!.]*")}
    assert names == {
        "tumble-a.toml", "tumble-a.csv", "calibration.json", "residuals.parquet", "report.html", "compensated.parquet",
    }  # fmt: skip
    residuals = pq.read_table(tmp_path / "out" / "residuals.parquet")
    assert residuals.num_rows == 28824
    assert residuals.schema.field("after").metadata == {b"unit": b"rad"}
    compensated = pq.read_table(tmp_path / "out" / "compensated.parquet")
    assert compensated.column_names == ["t", "ax", "dv", "u_ax", "flags"]


def test_calibrate_json_and_files(tmp_path: Path) -> None:
    done = piga("calibrate", small_run(tmp_path), "--out", tmp_path / "out", "--no-report", "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["schema"] == "piga.calibration/1"
    assert json.loads((tmp_path / "out" / "calibration.json").read_text()) == document
    assert {path.name for path in (tmp_path / "out").glob("[!.]*")} == {"calibration.json", "residuals.parquet"}
    assert [line for line in done.stderr.splitlines() if FIRST_USE not in line] == []


def test_results_with_other_terms_go_beside_and_a_sentence_says_why(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("calibrate", small_run(tmp_path), "--out", tmp_path / "out", "--no-report")
    assert outcome(capsys, *words)[0] == outcome(capsys, *words)[0] == 0
    code, _, text = outcome(capsys, *words, "--terms", "scale_factor")
    assert code == 0
    assert (
        f"out holds results of other options or inputs: the new ones are in {tmp_path / 'out' / '2'}; --force"
        in text
    )
    first, second = (
        Calibration.from_json(tmp_path / "out" / place / "calibration.json") for place in ("", "2")
    )
    assert ("k0" in first, "k0" in second) == (True, False)
    assert outcome(capsys, *words, "--terms", "scale_factor", "--force")[0] == 0
    assert "k0" not in Calibration.from_json(tmp_path / "out" / "calibration.json")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["calibrate", "none.toml"], "none.toml: cannot be read"),
        (["calibrate", "run.toml", "--terms", "kO"], "unknown term 'kO'"),
        (["calibrate", "run.toml", "--phases", "loose"], "phases: 'loose' is not known"),
        (["calibrate", "run.toml", "--terms", "scale_factor,k0,k2,k3,k2o"], "this record"),
        (["calibrate", "run.toml", "--out", "run.csv"], "run.csv: is a file"),
        (["calibrate", "run.toml", "--per-run", "k0"], "--per-run is not for one run"),
        (["check", "/dev/null/run.toml"], "run.toml: cannot be read"),
        (["check", "empty.toml"], "empty.toml: the file is empty"),
        (["init", "run.csv", "--column", "n"], "--column n: is not name=kind"),
        (["compensate", "run.toml", "--out", "o.csv"], "--calibration is missing"),
        (
            ["compensate", "run.toml", "b.toml", "--out", "o.csv"],
            "piga cannot know how the instruments are mounted",
        ),
        (["compensate", "run.toml", "--out", "o.csv", "--rate", "0 Hz"], "--rate 0 Hz: must be positive"),
        (["compensate", "run.toml", "--identify-phase", "-1 s"], "--identify-phase -1 s: must be positive"),
        (["compensate", "run.toml", "--max-age", "-1"], "Invalid value for '--max-age'"),
        (["campaign", "status", "run.csv"], "run.csv: holds no campaign"),
        (["calibrate"], "Missing argument"),
        (["nonsense"], "No such command"),
        (["check", "run.csv"], "not valid TOML"),
        (
            ["check", "run.csv"],
            "remedy: give a TOML file; for the log of a test 'piga init' drafts the run file",
        ),
    ],
)
def test_wrong_use_is_exit_2_with_one_message(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    small_run(tmp_path)
    (tmp_path / "empty.toml").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    assert exit_code(*arguments) == 2
    said = capsys.readouterr()
    assert message in said.err
    assert "remedy: " in said.err or "Usage: piga" in said.err
    assert said.out == ""


@pytest.mark.long
def test_joint_calibration_of_the_shipped_examples(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two simulated stands, calibrated together and again from a summary of one of them; compensated as one run sees it."""

    def done(*words: object, code: int = 0) -> str:
        ended, out, err = outcome(capsys, *words)
        assert ended == code, err
        return out if code == 0 else err

    examples = Path(__file__).parents[2] / "examples"
    for name in ("dividing-head", "centrifuge"):
        done("simulate", examples / f"joint-{name}.toml", "--out", tmp_path / name)
    head, spun, joint = (tmp_path / name for name in ("dividing-head/run.toml", "centrifuge/run.toml", "joint"))
    assert "cannot separate k0, k2, k_YY" in done("calibrate", head, "--out", tmp_path / "alone", code=2)
    done("calibrate", head, spun, "--summary", "--out", joint)
    first = json.loads((joint / "calibration.json").read_text())
    values = {c["name"]: c for c in first["coefficients"] if c["name"] != "phi"}
    assert abs(values["k_YY"]["value"] + 5e-6) < 4.0 * values["k_YY"]["std"]
    assert values["m_Y"]["run"] == "dividing-head"
    compensate = (
        "compensate",
        spun,
        "--calibration",
        joint / "calibration.json",
        "--out",
        tmp_path / "out.csv",
    )
    assert "--as-run dividing-head" in done(*compensate, code=2)
    done(*compensate, "--as-run", "centrifuge")
    both = [joint / f"summary-{name}.json" for name in ("dividing-head", "centrifuge")]
    again = done("calibrate", both[0], spun, "--json", "--no-report", "--out", tmp_path / "again")
    assert {c["name"]: c["value"] for c in json.loads(again)["coefficients"]}["k_YY"] == pytest.approx(
        values["k_YY"]["value"], rel=1e-6
    )
    done("calibrate", *both, "--no-report", "--out", tmp_path / "merged")
    assert [path.name for path in (tmp_path / "merged").glob("[!.]*")] == ["calibration.json"]


@pytest.mark.parametrize(
    ("run", "option", "words"),
    [
        ("-", ("--rate", "10 Hz"), "--rate is not for a live stream"),
        ("-", ("--identify-phase", "60 s"), "--identify-phase is not for a live stream"),
        ("triad.toml", ("--phase", "0.4 rad"), "--phase is not for several instruments"),
        ("triad.toml", ("--identify-phase", "60 s"), "--identify-phase is not for several instruments"),
    ],
)
def test_an_option_that_would_have_no_effect_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: str, option: tuple[str, ...], words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "triad.toml").write_text("[[triad.instrument]]\n", encoding="utf-8")
    with pytest.raises(PigaError, match=words):
        get_command(app).main(["compensate", run, "--out", "o.csv", *option], standalone_mode=False)
