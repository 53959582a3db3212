"""Help of every command: it comes without anything heavy being loaded."""

from __future__ import annotations

import os
import subprocess
import sys

from typer.core import TyperGroup
from typer.main import get_command

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


def test_help_of_every_command_loads_nothing_heavy() -> None:
    """One process, which fails if a command loads something heavy."""
    group = get_command(app)
    assert isinstance(group, TyperGroup)
    every = commands(group)
    assert {("calibrate",), ("records", "trend"), ("certificate", "issue")} <= set(every)
    said = run("-c", EACH.replace("{commands}", repr(every)))
    assert said.returncode == 0, said.stderr
    assert said.stdout.count("Usage: ") == len(every)
