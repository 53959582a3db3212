"""Output of commands: terminals that lack characters, closed and full ends, results by rename."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from piga.cli import common
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of
from tests.records.files import lines, write_log, write_run


def command(
    arguments: list[object], encoding: str = "utf-8", shell: str = "", **environment: str
) -> subprocess.CompletedProcess[bytes]:
    words = [sys.executable, "-m", "piga", *map(str, arguments)]
    return subprocess.run(
        ["sh", "-c", f'"$@" {shell}', "sh", *words],
        capture_output=True,
        check=False,
        env=os.environ | {"PYTHONIOENCODING": encoding, "NUMBA_DISABLE_JIT": "1"} | environment,
    )


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run whose serial no Western code page has."""
    write_log(tmp_path, lines())
    path = write_run(tmp_path)
    path.write_text(path.read_text(encoding="utf-8").replace('"T-1"', '"陀螺-\u03b2\u2714"'), encoding="utf-8")
    return path


@pytest.mark.long
@pytest.mark.parametrize("encoding", ["gbk", "ascii"])
def test_characters_that_the_terminal_lacks(run: Path, encoding: str) -> None:
    done = command(["check", run], encoding)
    assert (done.returncode, b"Traceback" in done.stderr) == (0, False)
    assert "Rows" in done.stdout.decode(encoding)
    document = json.loads(command(["check", run, "--json"], encoding).stdout.decode(encoding))
    assert document["serial"] == "陀螺-\u03b2\u2714"  # escaped, not replaced


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="redirections of a POSIX shell")
@pytest.mark.parametrize(
    ("shell", "text", "json_code"),
    [
        ("> /dev/full", 0, 1),
        ("| true", 0, 0),
        (">&- 2>&-", 0, 0),
        ("2> /dev/full", 0, 0),
    ],
)
def test_an_output_that_takes_nothing(run: Path, shell: str, text: int, json_code: int) -> None:
    """What was done is never reported as failed; a JSON document that is lost on a full disk is."""
    done = command(["check", run], shell=shell)
    assert done.returncode == text, done.stderr
    assert b"Traceback" not in done.stderr
    assert command(["check", run, "--json"], shell=shell).returncode == json_code


@pytest.mark.skipif(sys.platform == "win32", reason="redirections of a POSIX shell")
@pytest.mark.parametrize(("shell", "closed"), [(">&-", "output"), ("<&-", "input")])
@pytest.mark.parametrize("arrow", [False, True])
def test_a_live_stream_with_a_closed_end(tmp_path: Path, shell: str, closed: str, arrow: bool) -> None:
    """The rows are the result: they are not computed to be dropped."""
    calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.3}).to_json(tmp_path / "c.json")
    words = ["compensate", "-", "--calibration", tmp_path / "c.json", *(["--arrow"] if arrow else [])]
    done = command(words, shell=shell)
    assert done.returncode == 2
    assert f"standard {closed} is closed".encode() in done.stderr
    assert b"Traceback" not in done.stderr


def test_control_sequences_do_not_reach_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    common.say("a\x1b[31mb")
    common.note("c\x07d")
    captured = capsys.readouterr()
    assert captured.out == "a?[31mb\n"
    assert captured.err == "c?d\n"
