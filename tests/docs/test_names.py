"""Every file, module, test and command that pages, docstrings and builders name is there."""

from __future__ import annotations

import importlib
import re
from functools import cache
from pathlib import Path

import pytest

from .pages import DOCS, ROOT, pages

PLACES = ("src", "tests", "docs", "builders", "benchmarks", "examples")
_PATH = re.compile(rf"(?<![\w./-])((?:{'|'.join(PLACES)})/[\w./*-]*\w)")
_PAGE = re.compile(r"(?<![\w./*-])([\w-]+(?:/[\w-]+)*\.md)\b")
_DOTTED = re.compile(r"(?:`|:\w+:`~?)(piga(?:\.\w+)+)(?![\w/-])")
_COMMAND = re.compile(r"`piga ([a-z]+(?: [a-z]+)?)(?=[ `])")
_KEYS = {"piga.flags", "piga.inputs", "piga.notes"}
"""Names of metadata in files, which look like modules."""


def sources() -> list[Path]:
    """Everything whose words a reader follows; the changelog tells of what is gone, too."""
    code = [
        path for place in ("src", "builders", "benchmarks", "tests") for path in (ROOT / place).rglob("*.py")
    ]
    return [*pages(), ROOT / "dev.py", ROOT / "NOTICE", *sorted(code)]


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@cache
def commands() -> frozenset[tuple[str, ...]]:
    """Every command and group of the command line."""
    import typer.main

    from piga.cli.main import app

    result: set[tuple[str, ...]] = set()

    def walk(command: object, words: tuple[str, ...]) -> None:
        result.add(words)
        for name, inner in getattr(command, "commands", {}).items():
            walk(inner, (*words, name))

    walk(typer.main.get_command(app), ())
    return frozenset(result)


def resolves(dotted: str) -> bool:
    """True for a module of piga or something in one."""
    parts = dotted.split(".")
    for count in range(len(parts), 0, -1):
        try:
            result: object = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for name in parts[count:]:
            fields = getattr(result, "__dataclass_fields__", {})
            if (
                not hasattr(result, name)
                and name not in fields
                and name not in getattr(result, "__annotations__", {})
            ):
                return False
            result = getattr(result, name, None)
        return True
    return False


@pytest.mark.parametrize("path", sources(), ids=relative)
def test_what_is_named_is_there(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    missing = [
        name
        for name in set(_PATH.findall(text))
        if not list(ROOT.glob(name)) and not (ROOT / f"{name}.md").exists()
    ]
    for name in set(_PAGE.findall(text)):
        made = "generated/" in name
        if not made and not any(
            (folder / name).is_file() for folder in (path.parent, DOCS, ROOT, *DOCS.iterdir())
        ):
            missing.append(name)
    missing += [name for name in set(_DOTTED.findall(text)) - _KEYS if not resolves(name)]
    for one in _COMMAND.findall(text):
        words = tuple(one.split())
        inner = len(words) > 1 and words[:1] in groups()
        if words[: 1 + inner] not in commands():
            missing.append(f"piga {one}")
    assert not missing, f"{relative(path)} names what is not there: {sorted(missing)}"


@cache
def groups() -> frozenset[tuple[str, ...]]:
    """Commands that have commands."""
    return frozenset(words[:-1] for words in commands() if len(words) > 1)


def test_the_files_that_ci_names_are_there() -> None:
    script = (Path(__file__).parents[2] / ".ci" / "run").read_text(encoding="utf-8")
    named = re.findall(r"\b(?:tests|builders|benchmarks)/[\w/]+\.py", script)
    assert named
    assert [name for name in named if not (Path(__file__).parents[2] / name).is_file()] == []
