"""Runs the blocks of a page in order, in one directory and one namespace, and compares what they print."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

from piga.cli.main import app
from piga.errors import PigaError

from .pages import ROOT, Block


class Runner:
    """State of one page: directory, Python namespace, output of the last block."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.names: dict[str, Any] = {"__name__": "__page__"}
        self.output = ""
        (folder / "examples").symlink_to(ROOT / "examples", target_is_directory=True)

    def run(self, block: Block) -> None:
        """Run one block; blocks of other kinds are checked as what they are."""
        if block.not_run:
            return
        action = {
            "python": self.python,
            "sh": self.shell,
            "text": self.compare,
            "toml": tomllib.loads,
            "json": json.loads,
        }
        if block.kind in action:
            action[block.kind](block.text)

    def python(self, text: str) -> None:
        """Execute; names stay for the blocks that follow."""
        with contextlib.redirect_stdout(io.StringIO()) as out:
            exec(compile(text, str(self.folder), "exec"), self.names)  # noqa: S102 - our own pages
        self.output = out.getvalue()

    def shell(self, text: str) -> None:
        """Run command lines: ``piga`` within this process, anything else by the shell."""
        self.output = ""
        for line in text.replace("\\\n", " ").splitlines():
            if not line.strip() or line.startswith("#"):
                continue
            if re.match(r"(\.venv/bin/)?piga ", line) and not set("|>") & set(line):
                self.output += command(shlex.split(line, comments=True)[1:])
            else:
                self.output += self.by_shell(line)

    def by_shell(self, line: str) -> str:
        """Run a line with pipes or another program; ``piga``, ``logger`` and ``consumer`` are on the path."""
        programs = self.folder / "bin"
        programs.mkdir(exist_ok=True)
        for name, words in (("piga", "-m piga "), ("python", "")):
            program = programs / name
            program.write_text(f'#!/bin/sh\nexec {sys.executable} {words}"$@"\n')
            program.chmod(0o755)
        path = f"{programs}{os.pathsep}{os.environ['PATH']}"
        done = subprocess.run(
            ["bash", "-ec", f"set -o pipefail; {line}"],
            cwd=self.folder, env=os.environ | {"PATH": path}, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
        return done.stdout

    def compare(self, text: str) -> None:
        """Every line shown stands in what the last block printed, in order; ``...`` is anything."""
        at = 0
        printed = self.output.splitlines()
        for line in text.splitlines():
            pattern = r"\s+".join(".*".join(map(re.escape, word.split("..."))) for word in line.split())
            while at < len(printed) and not re.fullmatch(pattern, printed[at].strip()):
                at += 1
            assert at < len(printed), f"not printed: {line}\nprinted:\n{self.output}"


def command(arguments: list[str]) -> str:
    """Run one ``piga`` command in this process; returns what it prints."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        try:
            app(arguments, standalone_mode=False)
        except PigaError as error:
            raise AssertionError(f"piga {shlex.join(arguments)}: {error}") from error
    return out.getvalue()
