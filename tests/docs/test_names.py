"""Every file, module, test and command that a page names is there."""

from __future__ import annotations

import re
from pathlib import Path
from pkgutil import resolve_name

import pytest

from .pages import DOCS, ROOT, commands, name_of, pages

PLACES = ("src", "tests", "docs", "builders", "benchmarks", "examples")
_PATH = re.compile(rf"(?<![\w./-])((?:{'|'.join(PLACES)})/[\w./*-]*\w)")
_PAGE = re.compile(r"(?<![\w./*-])([\w-]+(?:/[\w-]+)*\.md)\b")
_DOTTED = re.compile(r"(?:`|:\w+:`~?)(piga(?:\.\w+)+)(?![\w/-])")
_COMMAND = re.compile(r"`piga ([a-z]+(?: [a-z]+)?)(?=[ `])")
_KEYS = {"piga.flags", "piga.inputs", "piga.notes"}
"""Names of metadata in files, which look like modules."""


def resolves(dotted: str) -> bool:
    """True for a module of piga or something in one."""
    try:
        resolve_name(dotted)
    except (ImportError, AttributeError):
        owner, _, name = dotted.rpartition(".")
        return owner != "piga" and name in getattr(resolve_name(owner), "__annotations__", {})
    return True


def missing_commands(text: str) -> list[str]:
    missing = []
    for words in _COMMAND.findall(text):
        first = f"piga {words.split()[0]}"
        name = f"piga {words}" if commands().get(first) else first
        missing += [] if name in commands() else [name]
    return missing


@pytest.mark.parametrize("page", pages(), ids=name_of)
def test_what_is_named_is_there(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    files = {name for name in _PATH.findall(text) if not (ROOT / f"{name}.md").exists()}
    missing = [name for name in files if not list(ROOT.glob(name))]
    for name in set(_PAGE.findall(text)):
        places = (page.parent, DOCS, ROOT, *DOCS.iterdir())
        if "generated/" not in name and not any((place / name).is_file() for place in places):
            missing.append(name)
    missing += [name for name in set(_DOTTED.findall(text)) - _KEYS if not resolves(name)]
    missing += missing_commands(text)
    assert not missing, f"{name_of(page)} names what is not there: {sorted(missing)}"


def test_the_files_that_ci_names_are_there() -> None:
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    named = re.findall(r"\b(?:tests|builders|benchmarks)/[\w/]+\.py", script)
    assert named
    assert [name for name in named if not (ROOT / name).is_file()] == []
