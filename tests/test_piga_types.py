"""The documented examples hold as a user's script under mypy --strict and pyright, and no signature says Any."""

from __future__ import annotations

import inspect
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import piga

ROOT = Path(__file__).parents[1]
PAGES = ("README.md", "docs/reference/api.md")
STRICTER = "disallow-any-generics, warn-return-any"
"""What ``--strict`` asks of a user's script, and not of piga."""
WRONG = "run.segment(3)\ncal['k0'].nothing\npiga.calibrate(run, progres=None)\n"
"""Mistakes of a user that the types must show."""


def script_of(page: str) -> str:
    """Name of the script of a page; those of the examples do not bear the names of packages."""
    stem = Path(page).stem
    return f"examples_of_{stem}" if "examples" in page else stem


@pytest.fixture(scope="module")
def scripts(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("scripts")
    examples = sorted(
        page.relative_to(ROOT).as_posix() for page in (ROOT / "docs/reference/examples").glob("*.md")
    )
    for page in (*PAGES, *examples):
        text = (ROOT / page).read_text(encoding="utf-8")
        code = "\n".join(re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL))
        assert code
        code = f"# mypy: {STRICTER}\n{code}"
        (folder / f"{script_of(page)}.py").write_text(code, encoding="utf-8")
    wrong = (folder / "api.py").read_text(encoding="utf-8") + WRONG
    (folder / "wrong.py").write_text(wrong, encoding="utf-8")
    return folder


def mypy(*scripts: Path) -> subprocess.CompletedProcess[str]:
    """With the settings and the cache of ``dev.py test``: piga itself is not checked again."""
    command = [sys.executable, "-m", "mypy", *map(str, scripts)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.mark.long
def test_mypy_takes_the_documented_examples_and_sees_mistakes(scripts):
    done = mypy(*sorted(scripts.glob("*.py")))
    seen = [Path(line.partition(":")[0]).name for line in done.stdout.splitlines() if ": error: " in line]
    assert seen == ["wrong.py"] * 3, done.stdout + done.stderr


@pytest.mark.long
@pytest.mark.skipif(shutil.which("node") is None, reason="pyright needs Node")
def test_pyright_takes_the_documented_examples(scripts):
    """Strict, but for what pandas and pyarrow leave untyped."""
    untyped = dict.fromkeys(
        ("reportUnknownArgumentType", "reportUnknownVariableType", "reportUnknownMemberType"), False
    )
    settings = {
        "extraPaths": [str(ROOT / "src")],
        "typeCheckingMode": "strict",
        "include": ["README.py", "api.py"],
    }
    settings |= {"reportMissingTypeStubs": False} | untyped
    (scripts / "pyrightconfig.json").write_text(json.dumps(settings))
    command = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable]
    done = subprocess.run(command, cwd=scripts, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_no_public_signature_says_any():
    said = []
    for name in piga.__all__:
        value = getattr(piga, name)
        if inspect.isclass(value):
            members = [m for m in vars(value).values() if inspect.isfunction(m) and m.__name__[0] != "_"]
        else:
            members = [value] if inspect.isfunction(value) else []
        said += [f"{name}.{m.__name__}" for m in members if re.search(r"\bAny\b", str(inspect.signature(m)))]
    assert said == []
