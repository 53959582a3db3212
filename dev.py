"""Set up and run: ``python3 dev.py demo`` or ``python3 dev.py test``. Needs nothing but Python 3.11 or later.

Each task makes its own virtual environment, installs the pinned requirements with their hashes, and runs. Further tasks:
ui (the workbench on the shipped record), compiled (all tests of compiled kernels), slow (long statistical tests), docs (the
site, in site/), coverage (JIT off), package (wheel and sdist, installed and run on
every Python there is).
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent
PIP_INSTALL = [
    "install",
    "--quiet",
    "--disable-pip-version-check",
    "--no-compile",
]  # what is used compiles itself
INSTALLERS = 3
"""Number of pip processes that set up an environment."""
BYTECODE = {"PYTHONDONTWRITEBYTECODE": ""}
"""Kept in any case: the tests start several hundred processes, which would compile the same modules again."""
PYTHONS = ("python3.11", "python3.12", "python3.13", "python3.14")


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
    pip = [str(python), "-m", "pip", *PIP_INSTALL, "--no-deps"]
    pinned, sources = digest([ROOT / requirements], sys.version), digest(package_files())
    commands: list[list[str]] = []
    if not python.exists() or kept(folder / "requirements.sha256") != pinned:
        print(f"setting up {folder.name}: about half a minute, and the download of the packages", flush=True)
        venv.create(folder, with_pip=True, clear=True)
        for k, part in enumerate(parts_of(ROOT / requirements)):
            listed = folder / f"requirements-{k}.txt"
            listed.write_text(part, "utf-8")
            commands.append([*pip, "--require-hashes", "--only-binary", ":all:", "-r", str(listed)])
    if commands or kept(folder / "piga.sha256") != sources:
        together([*commands, [*pip, "--force-reinstall", str(ROOT)]])
        call([str(python), "-m", "pip", "check", "--disable-pip-version-check"])
        (folder / "requirements.sha256").write_text(pinned, "utf-8")
        (folder / "piga.sha256").write_text(sources, "utf-8")
    return programs


def parts_of(requirements: Path) -> list[str]:
    """A file of pinned requirements in parts that are installed at the same time: pip uses one core only."""
    lines = [line for line in requirements.read_text("utf-8").splitlines() if not line.startswith("#")]
    starts = [k for k, line in enumerate(lines) if line[:1].strip()]
    blocks = ["\n".join(lines[i:j]) for i, j in zip(starts, [*starts[1:], len(lines)], strict=True)]
    return ["\n".join(blocks[k::INSTALLERS]) + "\n" for k in range(INSTALLERS)]


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


def call(command: list[str], **variables: str) -> None:
    """Run a command in the project's folder; stop with its exit code when it fails."""
    together([command], **variables)


def together(commands: list[list[str]], **variables: str) -> None:
    """Run commands at the same time; stop with the exit code of the first that fails."""
    processes = [start(command, **variables) for command in commands]
    for code in [process.wait() for process in processes]:
        if code:
            sys.exit(code)


def start(command: list[str], **variables: str) -> subprocess.Popen[bytes]:
    """Start a command in the project's folder."""
    shown = " ".join([f"{name}={value}" for name, value in variables.items()] + command)
    print(f"+ {shown.replace(str(ROOT) + os.sep, '')}", flush=True)
    return subprocess.Popen(command, cwd=ROOT, env=os.environ | BYTECODE | variables)


def demo(arguments: list[str]) -> None:
    """Calibrate the shipped record, compensate it and write the report."""
    programs = environment(".venv", "requirements.txt")
    call([str(programs / "piga"), "demo", *arguments])


def ui(arguments: list[str]) -> None:
    """Open the workbench on the shipped record, in a folder of its own."""
    programs = environment(".venv-ui", "requirements-ui.txt")
    folder = ROOT / "piga-workbench"
    folder.mkdir(exist_ok=True)
    data = ROOT / "src" / "piga" / "data"
    if not (folder / "tumble-a.toml").exists():
        (folder / "tumble-a.csv").write_bytes(gzip.decompress((data / "tumble-a.csv.gz").read_bytes()))
        shutil.copy(data / "tumble-a.toml", folder)
    call([str(programs / "piga"), "ui", str(folder), *arguments])


def test(arguments: list[str]) -> None:
    """Lint, types, import contract; smoke tests of the compiled kernels; all tests with the JIT off."""
    programs = environment(".venv-test", "requirements-dev.txt")
    python = str(programs / "python")
    everything = [python, "-m", "pytest", "-n", "2", "--dist", "worksteal", "-m", "not slow", *arguments]
    if arguments:
        call(everything, NUMBA_DISABLE_JIT="1")
        return
    print("lint, import contract, types and smoke tests of the compiled kernels (under one minute)", flush=True)
    smoke = [
        path for path in sorted((ROOT / "tests").rglob("test_*.py")) if "mark.smoke" in path.read_text("utf-8")
    ]
    with start([python, "-m", "mypy"]) as types:  # uses one core only; its result is looked at last
        checks = [[python, "-m", "ruff", "check"], [python, "-m", "ruff", "format", "--check"]]
        together([*checks, [str(programs / "lint-imports")]])
        call([python, "-m", "pytest", "-n", "2", "-m", "smoke", *map(str, smoke)])
        print("all tests with the JIT off (about three minutes on two cores)", flush=True)
        call(everything, NUMBA_DISABLE_JIT="1")
    if types.returncode:
        print("the types are wrong: see above, or run .venv-test/bin/mypy", flush=True)
        sys.exit(types.returncode)


def compiled(arguments: list[str]) -> None:
    """All tests of the compiled kernels, and those that are too long for interpreted ones."""
    programs = environment(".venv-test", "requirements-dev.txt")
    selected = "(compiled or only_compiled) and not slow"
    call(
        [str(programs / "python"), "-m", "pytest", "-n", "2", "--dist", "worksteal", "-m", selected, *arguments]
    )


def slow(arguments: list[str]) -> None:
    """Run the long statistical tests, compiled."""
    programs = environment(".venv-test", "requirements-dev.txt")
    call([str(programs / "python"), "-m", "pytest", "-m", "slow", *arguments])


def docs(arguments: list[str]) -> None:
    """Build the documentation into site/; a warning is an error, and so is a picture with other numbers."""
    programs = environment(".venv-docs", "requirements-docs.txt")
    call([str(programs / "python"), "-m", "builders.build_report_image"])
    call(
        [
            str(programs / "python"),
            "-m",
            "sphinx",
            "-q",
            "-W",
            "--keep-going",
            "-b",
            "html",
            *arguments,
            "docs",
            "site",
        ]
    )
    print("open site/index.html")


def coverage(arguments: list[str]) -> None:
    """Branch coverage: all tests with the JIT off, then those that only run compiled."""
    programs = environment(".venv-test", "requirements-dev.txt")
    measured = [str(programs / "python"), "-m", "coverage", "run", "-m", "pytest", "-n", "2", *arguments]
    call([str(programs / "coverage"), "erase"])
    source = str(ROOT / "src")  # the tests of the checkout, not of what is installed
    call([*measured, "-m", "not slow"], NUMBA_DISABLE_JIT="1", PYTHONPATH=source)
    call([*measured, "-m", "only_compiled and not slow"], PYTHONPATH=source)
    call([str(programs / "coverage"), "combine", "--quiet"])
    call([str(programs / "coverage"), "report", "--fail-under", "95"])


def package(arguments: list[str]) -> None:
    """Build wheel and sdist; install and run each on every Python that is found (or named), or on this one."""
    programs = environment(".venv-test", "requirements-dev.txt")
    shutil.rmtree(ROOT / "dist", ignore_errors=True)
    call([str(programs / "python"), "-m", "hatchling", "build", "--directory", "dist"])
    result = [python for python in arguments or PYTHONS if runs(python)] or [sys.executable]
    for python in result:
        for built in sorted((ROOT / "dist").iterdir()):
            with tempfile.TemporaryDirectory() as folder:
                call([python, "-m", "venv", f"{folder}/venv"])
                try_package(built, Path(folder))
    print(f"wheel and sdist install and run on: {', '.join(result)}")


def runs(python: str) -> bool:
    """True when there is such a Python and it starts."""
    path = shutil.which(python)
    return (
        path is not None
        and subprocess.run([path, "--version"], capture_output=True, check=False).returncode == 0
    )


def try_package(built: Path, folder: Path) -> None:
    """Install a built file with its pinned requirements into ``folder/venv``; run what a user runs first."""
    programs = programs_of(folder / "venv")
    pip = [str(programs / "python"), "-m", "pip", *PIP_INSTALL]
    call([*pip, "--require-hashes", "--only-binary", ":all:", "-r", "requirements.txt"])
    call([*pip, "--no-deps", str(built)])
    call([str(programs / "python"), "-P", "-c", "import piga; print(piga.__version__, piga.__file__)"])
    call([str(programs / "piga"), "--version"])
    call([str(programs / "piga"), "demo", "--out", str(folder / "demo")])


def main() -> None:
    """Pick the task."""
    tasks = {
        "demo": demo,
        "ui": ui,
        "test": test,
        "compiled": compiled,
        "slow": slow,
        "docs": docs,
        "coverage": coverage,
        "package": package,
    }
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("task", choices=tasks)
    task, rest = parser.parse_known_args()
    tasks[task.task](rest)


if __name__ == "__main__":
    main()
