"""Help of every command: it comes without anything heavy being loaded; ``python -m piga`` is the same program."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest
from typer.core import TyperGroup
from typer.main import get_command

from piga.cli.common import note
from piga.cli.main import app

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


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    plain = {name: value for name, value in os.environ.items() if not name.startswith("COVERAGE_")}
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=False, env=plain)


@pytest.fixture(scope="module")
def every() -> list[tuple[str, ...]]:
    group = get_command(app)
    assert isinstance(group, TyperGroup)
    return commands(group)


@pytest.fixture(scope="module")
def said(every: list[tuple[str, ...]]) -> subprocess.CompletedProcess[str]:
    """The help of every command, from one process that fails if a command loads something heavy."""
    return run("-c", EACH.replace("{commands}", repr(every)))


def test_help_of_every_command_loads_nothing_heavy(
    every: list[tuple[str, ...]], said: subprocess.CompletedProcess[str]
) -> None:
    assert {("calibrate",), ("records", "trend"), ("certificate", "issue")} <= set(every)
    assert said.returncode == 0, said.stderr
    assert said.stdout.count("Usage: ") == len(every)


def test_help_names_values_as_users_do(said: subprocess.CompletedProcess[str]) -> None:
    """No type of Python, no value without a name, no bracket twice."""
    assert not re.findall(r".*(?:list\[|\bPath\b|\[\[|\.\.\.[\]}]).*", said.stdout)
    assert "--reason WORDS" in said.stdout
    assert re.search(r"--out DIR +Folder for run\.toml", said.stdout)


def test_no_name_is_broken_on_a_narrow_terminal(
    every: list[tuple[str, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    text = run("-c", EACH.replace("{commands}", repr(every))).stdout
    assert "piga-demo" in text
    assert not re.findall(r".*\w-$", text, re.MULTILINE)
    assert max(map(len, text.splitlines())) <= 60


def test_lines_are_as_wide_as_the_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = "piga: run.toml: no such file or folder: look-at-this"
    note(words)
    monkeypatch.setenv("COLUMNS", "30")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    note(words)
    assert capsys.readouterr().err == f"{words}\npiga: run.toml: no such file\n    or folder: look-at-this\n"


@pytest.mark.parametrize(("arguments", "code", "words"), [(["--version"], 0, "piga "), (["chekc"], 2, "chekc")])
def test_the_module_runs_as_the_program_does(arguments: list[str], code: int, words: str) -> None:
    as_module = run("-m", "piga", *arguments)
    as_program = run("-c", "from piga.cli.main import main; main()", *arguments)
    assert as_module.returncode == as_program.returncode == code
    assert words in as_module.stdout + as_module.stderr
    assert as_module.stdout == as_program.stdout
