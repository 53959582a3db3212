"""Output of commands: terminals that lack characters, closed and full ends; progress and stops; help without heavy imports."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numba
import pytest
from typer.core import TyperGroup
from typer.main import get_command

import piga._kernels.jit  # noqa: F401
from piga.cli import common
from piga.cli.common import progress
from piga.cli.main import app
from piga.data import copy_example
from piga.progress import FIRST_USE
from tests.cli.runner import on_terminal
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
        ("> /dev/full", 2, 2),
        ("| true", 0, 0),
        (">&- 2>&-", 0, 0),
        ("2> /dev/full", 0, 0),
    ],
)
def test_an_output_that_takes_nothing(run: Path, shell: str, text: int, json_code: int) -> None:
    """Output that nobody wants is no error; output that is lost on a full disk is."""
    done = command(["check", run], shell=shell)
    assert done.returncode == text, done.stderr
    assert b"Traceback" not in done.stderr
    assert command(["check", run, "--json"], shell=shell).returncode == json_code


@pytest.mark.skipif(sys.platform == "win32", reason="redirections of a POSIX shell")
@pytest.mark.parametrize(("shell", "closed"), [(">&-", "output"), ("<&-", "input")])
def test_a_live_stream_with_a_closed_end(tmp_path: Path, shell: str, closed: str) -> None:
    """The rows are the result: they are not computed to be dropped."""
    calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.3}).to_json(tmp_path / "c.json")
    words = ["compensate", "-", "--calibration", tmp_path / "c.json"]
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


STOPPED = (130, -signal.SIGINT)
"""Exit by a stop. Python ends itself with the signal if the stop came while it made a class; shells show 130 for both."""


@pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo-terminal")
def test_calibrate_shows_what_it_does_and_what_a_stop_left(tmp_path: Path) -> None:
    run = copy_example(tmp_path)
    text, code = on_terminal(["calibrate", run], "calibrating")
    assert "reading" in text
    assert code in STOPPED, text
    assert "piga: stopped while calibrating" in text
    assert "on disk: nothing was written" in text
    assert "Traceback" not in text or "Exception ignored in" in text  # Ctrl-C within a callback of an import
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tumble-a.csv", "tumble-a.toml"]


@pytest.mark.long
def test_first_use_is_said_once_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with progress("calibrating"):
        for more in (1, 2):
            numba.njit(lambda x, more=more: x + more)(1)
    assert capsys.readouterr().err.splitlines() == [f"calibrating; {FIRST_USE}"]


HEAVY = {
    "numpy",
    "numba",
    "scipy",
    "pyarrow",
    "matplotlib",
    "jinja2",
    "sqlalchemy",
    "sqlite3",
    "lxml",
    "pydantic",
    "rich",
}
EACH = f"""
import sys
from piga.cli.main import main
for words in {{commands}}:
    sys.argv = ["piga", *words, "--help"]
    try:
        main()
    except SystemExit as done:
        assert done.code == 0, words
    loaded = {HEAVY} & set(sys.modules)
    assert not loaded, (words, loaded)
"""


def commands(group: TyperGroup, before: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """Words of the group and of every command in it."""
    result = [before]
    for name, command in group.commands.items():
        words = (*before, name)
        result += commands(command, words) if isinstance(command, TyperGroup) else [words]
    return result


def test_help_of_every_command_loads_nothing_heavy() -> None:
    """One process, which fails if a command loads something heavy."""
    group = get_command(app)
    assert isinstance(group, TyperGroup)
    every = commands(group)
    assert {("calibrate",), ("records", "trend"), ("certificate", "issue")} <= set(every)
    plain = {name: value for name, value in os.environ.items() if not name.startswith("COVERAGE_")}
    code = [sys.executable, "-c", EACH.replace("{commands}", repr(every))]
    said = subprocess.run(code, capture_output=True, text=True, check=False, env=plain)
    assert said.returncode == 0, said.stderr
    assert said.stdout.count("Usage: ") == len(every)
