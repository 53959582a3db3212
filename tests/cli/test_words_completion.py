"""Completion with Tab in three shells, and help without Python types."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys

import pytest
from typer.core import TyperGroup
from typer.main import get_command
from typer.testing import CliRunner

from piga.cli.main import app
from tests.cli.test_cli_help import commands


def asked(**environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "piga"],
        capture_output=True,
        text=True,
        env=os.environ | environment,
        check=False,
    )
    return done.stdout + done.stderr


def test_each_shell_gets_commands_and_options() -> None:
    assert asked(_PIGA_COMPLETE="complete_bash", COMP_WORDS="piga cal", COMP_CWORD="1").split() == ["calibrate"]
    assert '"add"' in asked(_PIGA_COMPLETE="complete_zsh", _TYPER_COMPLETE_ARGS="piga records ")
    fish = asked(
        _PIGA_COMPLETE="complete_fish",
        _TYPER_COMPLETE_FISH_ACTION="get-args",
        _TYPER_COMPLETE_ARGS="piga calibrate --ph",
    )
    assert "--phases" in fish
    assert "--phase-source" in fish


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_is_one_of_the_shell(shell: str) -> None:
    done = CliRunner().invoke(app, ["completion", shell])
    assert done.exit_code == 0
    assert "_PIGA_COMPLETE=complete_" + shell in done.stdout
    if shell == "zsh":
        assert done.stdout.startswith("#compdef piga\n")
    program = shutil.which(shell)
    if program is not None:
        subprocess.run([program, "-n"], input=done.stdout, text=True, check=True)


def test_bash_completes_with_the_script() -> None:
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("no bash here")
    script = (
        CliRunner()
        .invoke(app, ["completion", "bash"])
        .stdout.replace("complete_bash $1", f"complete_bash {sys.executable} -m piga")
    )
    code = script + '\nCOMP_WORDS=(piga rec); COMP_CWORD=1; _piga_completion piga; echo "${COMPREPLY[@]}"\n'
    done = subprocess.run([bash, "--norc"], input=code, text=True, capture_output=True, check=True)
    assert done.stdout.split() == ["records"]


def test_another_shell_is_refused() -> None:
    assert CliRunner().invoke(app, ["completion", "tcsh"]).exit_code == 2


def test_help_names_no_python_type() -> None:
    group = get_command(app)
    assert isinstance(group, TyperGroup)
    for words in commands(group):
        text = CliRunner().invoke(app, [*words, "--help"]).stdout
        wrong = re.findall(r"<(?:path|str|int|float|list)[^>]*>|\b(?:TEXT|PATH|INTEGER|FLOAT)\b", text)
        assert not wrong, (words, wrong)
