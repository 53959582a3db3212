"""Set up and run: ``python3 dev.py demo`` or ``python3 dev.py test``. Needs nothing but Python 3.11 or later.

Each task makes its own virtual environment, installs the pinned requirements with their hashes, and runs.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent


def environment(name: str, requirements: str) -> Path:
    """A virtual environment ``name`` with the pinned requirements and piga itself; returns its programs."""
    folder = ROOT / name
    programs = folder / ("Scripts" if os.name == "nt" else "bin")
    python = programs / ("python.exe" if os.name == "nt" else "python")
    if not python.exists():
        print(f"setting up {folder.name} ...", flush=True)
        venv.create(folder, with_pip=True, clear=True)
    pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    call([*pip, "--require-hashes", "--only-binary", ":all:", "-r", str(ROOT / requirements)])
    call([*pip, "--no-deps", "--force-reinstall", str(ROOT)])
    return programs


def call(command: list[str], **variables: str) -> None:
    """Run a command in the project's folder; stop with its exit code when it fails."""
    shown = " ".join([f"{name}={value}" for name, value in variables.items()] + command)
    print(f"+ {shown.replace(str(ROOT) + os.sep, '')}", flush=True)
    code = subprocess.run(command, cwd=ROOT, env=os.environ | variables, check=False).returncode
    if code:
        sys.exit(code)


def demo(arguments: list[str]) -> None:
    """Calibrate the shipped record, compensate it and write the report."""
    programs = environment(".venv", "requirements.txt")
    call([str(programs / "piga"), "demo", *arguments])


def test(arguments: list[str]) -> None:
    """Lint, types, import contract; all tests with the JIT off, then those of the kernels compiled."""
    programs = environment(".venv-test", "requirements-dev.txt")
    python = str(programs / "python")
    if not arguments:
        call([python, "-m", "ruff", "check"])
        call([python, "-m", "ruff", "format", "--check"])
        call([python, "-m", "mypy"])
        call([str(programs / "lint-imports")])
    call([python, "-m", "pytest", "-n", "2", "-m", "not slow", *arguments], NUMBA_DISABLE_JIT="1")
    call([python, "-m", "pytest", "-m", "(compiled or only_compiled) and not slow", *arguments])


def slow(arguments: list[str]) -> None:
    """Run the long statistical tests, compiled."""
    programs = environment(".venv-test", "requirements-dev.txt")
    call([str(programs / "python"), "-m", "pytest", "-m", "slow", *arguments])


def main() -> None:
    """Pick the task."""
    tasks = {"demo": demo, "test": test, "slow": slow}
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("task", choices=tasks)
    task, rest = parser.parse_known_args()
    tasks[task.task](rest)


if __name__ == "__main__":
    main()
