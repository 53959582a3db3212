"""What a user calls is in an example that runs (:mod:`tests.docs.test_snippets` runs the pages)."""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from inspect import isfunction
from pathlib import Path

import pytest
import typer

import piga
from piga.cli.main import app

from .pages import DOCS, ROOT, blocks

EXAMPLES = DOCS / "reference" / "examples"
ROOMS = (*piga.ROOMS, "describe")


def names_used(page: Path) -> set[str]:
    """Names that the code of a page uses. An import alone does not count."""
    trees = [ast.parse(block.text) for block in blocks(page) if block.kind == "python"]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    plain = {node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)}
    return plain | {node.attr for node in nodes if isinstance(node, ast.Attribute)}


def types_of(annotations: Mapping[str, object]) -> set[str]:
    return set(re.findall(r"\w+", " ".join(map(str, annotations.values()))))


def given(thing: object) -> set[str]:
    """Types of what a function returns, or of the members of a class."""
    if not isinstance(thing, type):
        back = getattr(thing, "__annotations__", {}).get("return")
        return types_of({"return": back})
    members = (getattr(m, "fget", None) or getattr(m, "func", None) or m for m in vars(thing).values())
    returned = (given(member) for member in members if not isinstance(member, type))
    return types_of(vars(thing).get("__annotations__", {})).union(*returned)


@pytest.mark.parametrize("room", ROOMS)
def test_what_a_user_calls_has_an_example(room: str) -> None:
    """Every public name, but for the types of results: they come from a function that has one."""
    module = import_module(f"piga.{room}")
    public = {name: getattr(module, name) for name in module.__all__}
    results = {name for name, thing in public.items() if not isfunction(thing)}
    results &= set().union(*map(given, public.values()))
    assert not set(public) - results - names_used(EXAMPLES / f"{room}.md")


def test_every_function_of_the_flat_namespace_has_an_example() -> None:
    pages = [DOCS / "reference" / "api.md", *EXAMPLES.glob("*.md")]
    functions = {name for name in piga.__all__ if isfunction(getattr(piga, name))}
    assert "calibrate" in functions
    assert functions <= set().union(*map(names_used, pages))


def commands(path: str, command: object) -> list[str]:
    below = getattr(command, "commands", None)
    return (
        [path]
        if below is None
        else [one for name, child in below.items() for one in commands(f"{path} {name}", child)]
    )


def test_every_command_has_its_python_beside_it() -> None:
    """A section of its own, or that of its group; but for commands that have no meaning in Python."""
    text = (EXAMPLES / "commands").with_suffix(".md").read_text(encoding="utf-8")
    sections = {line.removeprefix("## ") for line in text.splitlines() if line.startswith("## ")}
    names = commands("piga", typer.main.get_command(app))
    missing = {name for name in names if not {name, name.rpartition(" ")[0]} & sections}
    assert missing == {"piga ui", "piga completion", "piga examples"}
    assert sections <= {*names, *(name.rpartition(" ")[0] for name in names)}


def test_files_are_read_from_their_text() -> None:
    text = (ROOT / "examples" / "plan-dividing-head.toml").read_text(encoding="utf-8")
    assert (
        piga.read_plan("no/plan.toml", content=text).table
        == piga.read_plan(ROOT / "examples/plan-dividing-head.toml").table
    )
    text = (ROOT / "examples" / "twin.toml").read_text(encoding="utf-8")
    assert (
        piga.read_scenario("twin.toml", content=text).table
        == piga.read_scenario(ROOT / "examples/twin.toml").table
    )
    text = (ROOT / "examples" / "platform-piga.toml").read_text(encoding="utf-8")
    read = piga.platform.load_scenario("p.toml", content=text)
    assert replace(read, source=None) == replace(
        piga.platform.load_scenario(ROOT / "examples/platform-piga.toml"), source=None
    )
    text = (ROOT / "examples" / "certificate.toml").read_text(encoding="utf-8")
    assert piga.certificate.read_certificate_file("c.toml", content=text).item.description
    with pytest.raises(piga.RunFileError, match=r"nothing\.toml: not valid TOML"):
        piga.read_plan("nothing.toml", content="[")
