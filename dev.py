"""Set up and run: ``python3 dev.py demo``, ``ui`` or ``test``. Needs nothing but Python 3.11 or later.

Each task makes its own virtual environment, installs the pinned requirements with their hashes, and runs: the demo, the
workbench on the shipped record, or the tests. ``python3 dev.py nox -l`` lists the longer tasks of ``noxfile.py``.
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent
PIP_INSTALL = ["install", "-qq", "--disable-pip-version-check", "--no-compile", "--no-deps"]
"""Errors only: pip warns of other configurations on the machine. What is used compiles itself."""
PINNED = ["--require-hashes", "--only-binary", ":all:", "-r"]
BYTECODE = {"PYTHONDONTWRITEBYTECODE": ""}
"""Kept in any case: the tests start several hundred processes, which would compile the same modules again."""


def programs_of(folder: Path) -> Path:
    """Where a virtual environment keeps its programs."""
    return folder / ("Scripts" if os.name == "nt" else "bin")


def environment(name: str, requirements: str) -> Path:
    """A virtual environment ``name`` with the pinned requirements and piga itself; returns its programs.

    New requirements make it anew. Changed sources install piga again. Otherwise it stays as it is, with its compiled kernels.
    """
    folder = ROOT / name
    programs = programs_of(folder)
    python = programs / ("python.exe" if os.name == "nt" else "python")
    listed = ROOT / "requirements" / f"{requirements}.txt"
    pinned, sources = digest([listed], sys.version), digest(package_files())
    new = not python.exists() or kept(folder / "requirements.sha256") != pinned
    if new:
        print(f"setting up {folder.name}: about half a minute, and the download of the packages", flush=True)
        venv.create(folder, with_pip=True, clear=True)
        run([str(python), "-m", "pip", *PIP_INSTALL, *PINNED, str(ROOT / "requirements" / "installer.txt")])
        install(python, *PINNED, str(listed))
    if new or kept(folder / "piga.sha256") != sources:
        install(python, "--force-reinstall", str(ROOT))
        call([str(python), "-m", "pip", "check", "--disable-pip-version-check"])
        (folder / "requirements.sha256").write_text(pinned, "utf-8")
        (folder / "piga.sha256").write_text(sources, "utf-8")
    return programs


def install(python: Path, *what: str) -> None:
    """Install with uv, in a quarter of pip's time; with pip where uv is not to be had, or needs what pip is told elsewhere."""
    if run([str(python), "-m", "uv", "pip", "install", "--python", str(python), "--no-deps", *what]):
        call([str(python), "-m", "pip", *PIP_INSTALL, *what])


def package_files() -> list[Path]:
    """What the installed package is made of."""
    folders = [path for top in ("src", "examples") for path in sorted((ROOT / top).rglob("*"))]
    files = [path for path in folders if path.is_file() and path.parent.name != "__pycache__"]
    return [*files, *(ROOT / name for name in ("pyproject.toml", "README.md", "LICENSE", "NOTICE"))]


def digest(paths: list[Path], more: str = "") -> str:
    """SHA-256 of the names and contents of files."""
    result = hashlib.sha256(more.encode())
    for path in paths:
        result.update(f"{path.relative_to(ROOT)} {path.stat().st_size}\n".encode() + path.read_bytes())
    return result.hexdigest()


def kept(path: Path) -> str:
    """Text of a file; empty if there is none."""
    return path.read_text("utf-8") if path.exists() else ""


def call(command: list[str]) -> None:
    """Run a command in the project's folder; stop with its exit code when it fails."""
    together([command])


def run(command: list[str]) -> int:
    """Run a command that may fail, and show nothing of what it says; its exit code."""
    with start(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        return process.wait()


def together(commands: list[list[str]]) -> None:
    """Run commands at the same time; stop with the exit code of the first that fails."""
    processes = [start(command) for command in commands]
    try:
        codes = [process.wait() for process in processes]
    except KeyboardInterrupt:  # the commands have it, too
        codes = [process.wait() for process in processes] + [130]
    for code in codes:
        if code:
            sys.exit(code)


def start(command: list[str], **to: int) -> subprocess.Popen[bytes]:
    """Start a command in the project's folder, and show it; ``to``: where its output goes."""
    print(f"+ {' '.join(command).replace(str(ROOT) + os.sep, '')}", flush=True)
    return subprocess.Popen(command, cwd=ROOT, env=os.environ | BYTECODE, **to)


def demo(arguments: list[str]) -> None:
    """Calibrate the shipped record, compensate it and write the report."""
    programs = environment(".venv", "demo")
    call([str(programs / "piga"), "demo", *arguments])


def ui(arguments: list[str]) -> None:
    """Open the workbench on the shipped record, in a folder of its own."""
    programs = environment(".venv-ui", "ui")
    folder = ROOT / "piga-workbench"
    folder.mkdir(exist_ok=True)
    data = ROOT / "src" / "piga" / "data"
    if not (folder / "tumble-a.toml").exists():
        (folder / "tumble-a.csv").write_bytes(gzip.decompress((data / "tumble-a.csv.gz").read_bytes()))
        shutil.copy(data / "tumble-a.toml", folder)
    call([str(programs / "piga"), "ui", str(folder), *arguments])


def test(arguments: list[str]) -> None:
    """Lint, types, import contract, and all tests of some seconds; with arguments those tests, the long ones too."""
    programs = environment(".venv-test", "all")
    python = str(programs / "python")
    everything = [python, "-m", "pytest", "-n", "2", "--dist", "loadfile", "-m"]
    if arguments:
        call([*everything, "not slow", *arguments])
        return
    print("lint, import contract, types and all tests (about four minutes on two cores)", flush=True)
    with start([python, "-m", "mypy"]) as types:
        checks = [[python, "-m", "ruff", "check"], [python, "-m", "ruff", "format", "--check"]]
        together([*checks, [str(programs / "lint-imports")]])
        call([*everything, "not slow and not long"])
    if types.returncode:
        print("the types are wrong: see above, or run .venv-test/bin/mypy", flush=True)
        sys.exit(types.returncode)


def nox(arguments: list[str]) -> None:
    """Run longer tasks in the environment of the tests."""
    call([str(environment(".venv-test", "all") / "nox"), *arguments])


def main() -> None:
    """Pick the task."""
    tasks = {"demo": demo, "ui": ui, "test": test, "nox": nox}
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("task", choices=tasks)
    task, rest = parser.parse_known_args()
    tasks[task.task](rest)


if __name__ == "__main__":
    main()
