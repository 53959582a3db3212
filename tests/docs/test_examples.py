"""Every public name is used by an example that runs (:mod:`tests.docs.test_snippets` runs the pages)."""

from __future__ import annotations

import ast
from importlib import import_module
from pathlib import Path

import pytest

import piga

from .pages import DOCS, blocks

EXAMPLES = DOCS / "reference" / "examples"
ROOMS = (*piga.ROOMS, "describe")


def names_used(page: Path) -> set[str]:
    """Names that the code of a page uses. An import alone does not count."""
    trees = [ast.parse(block.text) for block in blocks(page) if block.kind == "python"]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    plain = {node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)}
    return plain | {node.attr for node in nodes if isinstance(node, ast.Attribute)}


@pytest.mark.parametrize("room", ROOMS)
def test_every_public_name_of_a_room_has_an_example(room: str) -> None:
    missing = set(import_module(f"piga.{room}").__all__) - names_used(EXAMPLES / f"{room}.md")
    assert not missing


def test_every_name_of_the_flat_namespace_has_an_example() -> None:
    pages = [DOCS / "reference" / "api.md", *EXAMPLES.glob("*.md")]
    missing = set(piga.__all__) - set().union(*map(names_used, pages))
    assert missing <= {"__version__"}


def test_an_import_is_no_example(tmp_path: Path) -> None:
    page = tmp_path / "index.md"
    page.write_text("```python\nfrom piga import Run, calibrate\nx: Run\ncalibrate\n```\n", encoding="utf-8")
    assert {"Run", "calibrate"} <= names_used(page)
    page.write_text("```python\nfrom piga import Run\n```\n", encoding="utf-8")
    assert "Run" not in names_used(page)


def test_every_page_of_examples_belongs_to_a_room() -> None:
    assert {page.stem for page in EXAMPLES.glob("*.md")} == {*ROOMS, "errors"}
