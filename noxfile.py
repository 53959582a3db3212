"""The longer tasks: ``python3 dev.py nox -s docs`` makes the environment of the tests and runs one in it; ``-l`` lists them.

What follows ``--`` goes to the program that the task runs: ``python3 dev.py nox -s slow -- tests/planning``.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import nox

ROOT = Path(__file__).parent
nox.needs_version = ">=2025.2.9"
nox.options.default_venv_backend = "none"  # that in which nox runs
PYTHONS = ("python3.11", "python3.12", "python3.13", "python3.14")
TESTS = ("pytest", "-n", "2", "--dist", "loadfile", "-m")
EXPORTED = {"demo": ["--extra", "report"], "ui": ["--extra", "report", "--extra", "ui"]}
"""Exported files, beside the lock, and the extras in them."""


def run(session: nox.Session, *words: str, **variables: str) -> None:
    """Run a module in the environment of nox."""
    session.run(sys.executable, "-m", *words, env=variables)


@nox.session
def long(session: nox.Session) -> None:
    """Tests that take more than some seconds."""
    run(session, *TESTS, "long and not slow", *session.posargs)


@nox.session
def interpreted(session: nox.Session) -> None:
    """Tests of the kernels again, with the JIT off."""
    run(session, *TESTS, "interpreted and not long and not slow", *session.posargs, NUMBA_DISABLE_JIT="1")


@nox.session(default=False)
def slow(session: nox.Session) -> None:
    """The long statistical tests, compiled: hours."""
    run(session, "pytest", "-m", "slow", *session.posargs)


@nox.session
def docs(session: nox.Session) -> None:
    """The site, in site/. A warning is an error, and so is a picture with other numbers."""
    run(session, "builders.pictures", "report")
    run(session, "sphinx", "-q", "-W", "--keep-going", "-b", "html", *session.posargs, "docs", "site")
    session.log("open site/index.html")


@nox.session(default=False)
def coverage(session: nox.Session) -> None:
    """Branch coverage: all tests with the JIT off, then the long ones compiled."""
    measured = ["coverage", "run", "-m", "pytest", "-n", "2", *session.posargs]
    source = str(ROOT / "src")  # the tests of the checkout, not of what is installed
    run(session, "coverage", "erase")
    run(session, *measured, "-m", "not slow", NUMBA_DISABLE_JIT="1", PYTHONPATH=source)
    run(session, *measured, "-m", "long and not slow", PYTHONPATH=source)
    run(session, "coverage", "combine", "--quiet")
    run(session, "coverage", "report", "--fail-under", "95")


@nox.session(default=False)
def package(session: nox.Session) -> None:
    """Wheel and sdist, installed and run on every Python that is found (or named), or on this one."""
    shutil.rmtree(ROOT / "dist", ignore_errors=True)
    run(session, "hatchling", "build", "--directory", "dist")
    pythons = [python for python in session.posargs or PYTHONS if starts(python)] or [sys.executable]
    for python in pythons:
        for built in sorted((ROOT / "dist").iterdir()):
            with tempfile.TemporaryDirectory() as folder:
                session.run(python, "-m", "venv", f"{folder}/venv")
                try_package(session, built, Path(folder))
    session.log(f"wheel and sdist install and run on: {', '.join(pythons)}")


def starts(python: str) -> bool:
    """True when there is such a Python and it starts."""
    path = shutil.which(python)
    return (
        path is not None
        and subprocess.run([path, "--version"], capture_output=True, check=False).returncode == 0
    )


def try_package(session: nox.Session, built: Path, folder: Path) -> None:
    """Install a built file with its pinned requirements into ``folder/venv``; run what a user runs first."""
    programs = folder / "venv" / ("Scripts" if os.name == "nt" else "bin")
    pip = [str(programs / "python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    session.run(*pip, "--require-hashes", "--only-binary", ":all:", "-r", "requirements/demo.txt")
    session.run(*pip, "--no-deps", str(built))
    session.run(str(programs / "python"), "-P", "-c", "import piga; print(piga.__version__, piga.__file__)")
    session.run(str(programs / "piga"), "--version")
    session.run(str(programs / "piga"), "demo", "--out", str(folder / "demo"))


@nox.session(venv_backend="venv", default=False)
def lock(session: nox.Session) -> None:
    """Resolve all requirements into requirements/all.txt, and export the others from it: ``-- --upgrade-package NAME``."""
    session.install("uv")
    resolve = [
        "uv",
        "pip",
        "compile",
        "--quiet",
        "--universal",
        "--python-version",
        "3.11",
        "--generate-hashes",
    ]
    resolve += ["--no-emit-index-url", "--no-annotate", "--no-header"]
    session.run(*resolve, "--group", "installer", "-o", "requirements/installer.txt", *session.posargs)
    resolve.append("pyproject.toml")
    every = ["--all-extras", "--group", "dev", "--group", "docs"]
    session.run(*resolve, *every, "-o", "requirements/all.txt", *session.posargs)
    for name, extras in EXPORTED.items():
        file = f"requirements/{name}.txt"
        session.run(*resolve, *extras, "--constraint", "requirements/all.txt", "-o", file, "--upgrade")
