"""The pages of the documentation and the blocks of code in them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from typer.main import get_command

from piga.cli.main import app

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"

_FENCE = re.compile(r"^(?P<indent> *)(?P<mark>```+|:::+)\s*(?P<kind>[\w{}-]*)")
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
    lines = page.read_text(encoding="utf-8").splitlines()
    collected: list[Block] = []
    at, slow, reason = 0, False, ""
    while at < len(lines):
        fence = _FENCE.match(lines[at])
        if lines[at].strip() == "<!-- slow -->":
            slow = True
        if marked := _NOT_RUN.fullmatch(lines[at].strip()):
            reason = marked[1]
        if fence:
            end = at + 1
            while end < len(lines) and lines[end].strip() != fence["mark"]:
                end += 1
            text = "\n".join(line[len(fence["indent"]) :] for line in lines[at + 1 : end])
            kind = "python" if fence["kind"].startswith("{code-cell}") else fence["kind"]
            collected.append(Block(kind, text, at + 1, slow, reason))
            at, slow, reason = end, False, ""
        elif (
            lines[at].startswith("    ")
            and lines[at].strip().startswith(COMMANDS)
            and not lines[at - 1].strip()
        ):
            end = at
            while end < len(lines) and lines[end].startswith("    "):
                end += 1
            text = "\n".join(line[4:] for line in lines[at:end])
            collected.append(Block("sh", text, at + 1, not_run=reason))
            at, reason = end, ""
        at += 1
    return collected
