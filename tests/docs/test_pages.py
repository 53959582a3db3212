"""Every file, module, command, test, picture and page that a page names is there."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from pkgutil import resolve_name

import pytest
from builders import pictures

from .pages import DOCS, ROOT, commands, name_of, pages

_TEST = re.compile(r"`(tests/[\w/]+\.py)(?:::(\w+))?[^`]*`")


def functions(path: Path) -> set[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


@pytest.mark.parametrize("page", pages(), ids=name_of)
def test_every_named_test_exists(page: Path) -> None:
    for path, name in _TEST.findall(page.read_text(encoding="utf-8")):
        assert (ROOT / path).is_file(), path
        assert not name or name in functions(ROOT / path), f"{path}::{name}"


def test_accuracy_names_a_test_for_every_model() -> None:
    """The first table: model, valid for, error at most, proved by."""
    text = (DOCS / "validation.md").read_text(encoding="utf-8").split("\n## ")[0]
    rows = re.findall(r"^\| (?!model|---)(.*) \|$", text, re.MULTILINE)
    assert len(rows) >= 10
    assert all(re.search(r"tests/.*::[^|]*$", row) for row in rows)


@pytest.mark.parametrize("page", pages(), ids=name_of)
def test_links_and_pictures_lead_somewhere(page: Path) -> None:
    text = re.sub(r"`[^`\n]*`", "", page.read_text(encoding="utf-8"))
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        path = target.partition("#")[0]
        if not path or "://" in target or "reference/generated" in target or path.startswith("generated/"):
            continue
        result = (page.parent / path).resolve()
        assert result.exists(), f"{name_of(page)}: {target}"


def test_every_page_of_the_contents_exists() -> None:
    entries = re.findall(
        r"^((?!reference/generated)[\w/-]+)$", (DOCS / "index.md").read_text(encoding="utf-8"), re.M
    )
    missing = {entry for entry in entries if not (DOCS / f"{entry}.md").exists()}
    assert not missing


def test_no_remote_assets() -> None:
    """Nothing that the pages or the theme's settings name is fetched from elsewhere."""
    for path in [*pages(), DOCS / "conf.py", DOCS / "_static" / "piga.css"]:
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"(!\[[^\]]*\]\(|src=|url\(|@import\s+)['\"]?https?:", text), path


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


def test_the_shipped_picture_of_the_report_is_the_one_whose_numbers_stand_beside_it() -> None:
    assert set(pictures.kept()) == {"verdict", "tiles", "coefficients"}
