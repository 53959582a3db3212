"""The pages of the documentation and the blocks of code in them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from markdown_it import MarkdownIt
from typer.main import get_command

from piga.cli.main import app

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"

_NOT_RUN = re.compile(r"<!-- not run: (.+) -->")
COMMANDS = ("piga ", "logger ")
"""First words of an indented block that is a command line."""


@dataclass(frozen=True)
class Block:
    """A block of code: ``kind`` as behind the fence, ``line`` of its start; ``slow`` when marked so.

    ``not_run``: why the block is not run, from the comment ``<!-- not run: REASON -->`` above it.
    """

    kind: str
    text: str
    line: int
    slow: bool = False
    not_run: str = ""


def pages() -> list[Path]:
    """README, CONTRIBUTING and every page that is written by hand."""
    seen = [path for path in DOCS.rglob("*.md") if "generated" not in path.parts]
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(seen)]


def name_of(page: Path) -> str:
    """The page as the tests name it."""
    return page.relative_to(ROOT).as_posix()


@cache
def commands() -> dict[str, bool]:
    """Every command of the command line, e.g. ``piga records trend``, and whether it is a group of commands."""
    seen = {}

    def walk(name: str, command: object) -> None:
        below = getattr(command, "commands", {})
        seen[name] = bool(below)
        for word, child in below.items():
            walk(f"{name} {word}", child)

    walk("piga", get_command(app))
    return seen


def blocks(page: Path) -> list[Block]:
    """Fenced blocks, and indented blocks that are command lines, in order."""
    collected: list[Block] = []
    slow, reason = False, ""
    for token in MarkdownIt().parse(page.read_text(encoding="utf-8")):
        if token.type == "html_block":
            slow = slow or "<!-- slow -->" in token.content
            marked = _NOT_RUN.search(token.content)
            reason = marked[1] if marked else reason
        elif token.type == "fence" or (token.type == "code_block" and token.content.startswith(COMMANDS)):
            kind = "sh" if token.type == "code_block" else token.info.partition(" ")[0]
            kind = "python" if kind == "{code-cell}" else kind
            collected.append(Block(kind, token.content, (token.map or [0])[0] + 1, slow, reason))
            slow, reason = False, ""
    return collected
