"""Pages, pictures and proofs that the documentation names exist."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from .pages import DOCS, ROOT, name_of, pages

_TEST = re.compile(r"`(tests/[\w/]+\.py)(?:::(\w+))?[^`]*`|`(test_\w+)`")


def functions(path: Path) -> set[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


@pytest.fixture(scope="module")
def all_tests() -> set[str]:
    return {name for path in (ROOT / "tests").rglob("test_*.py") for name in functions(path)}


@pytest.mark.parametrize("page", pages(), ids=name_of)
def test_every_named_test_exists(page: Path, all_tests: set[str]) -> None:
    for path, name, bare in _TEST.findall(page.read_text(encoding="utf-8")):
        if bare:
            assert bare in all_tests, bare
            continue
        assert (ROOT / path).is_file(), path
        assert not name or name in functions(ROOT / path), f"{path}::{name}"


def accuracy_rows() -> list[list[str]]:
    """Cells of the first table: model, valid for, error at most, proved by."""
    text = (DOCS / "validation.md").read_text(encoding="utf-8").split("\n## ")[0]
    rows = re.findall(r"^\| (?!model|---)(.*) \|$", text, re.MULTILINE)
    return [[cell.strip() for cell in row.split(" | ")] for row in rows]


def test_accuracy_names_a_test_for_every_model() -> None:
    rows = accuracy_rows()
    assert len(rows) >= 10
    assert all("tests/" in row[-1] and "::" in row[-1] for row in rows)


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
