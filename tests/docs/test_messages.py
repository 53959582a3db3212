"""The messages that the page of messages explains are those of the program."""

from __future__ import annotations

import ast
import re
from dataclasses import replace
from functools import cache

import pytest

import piga

from .pages import DOCS, ROOT

_ROW = re.compile(r"^\| `([^`]+)` \| [^|]+ \| [^|]+ \|$", re.MULTILINE)


def messages() -> list[str]:
    return _ROW.findall((DOCS / "reference" / "messages.md").read_text(encoding="utf-8"))


def words(node: ast.expr) -> str:
    """Text of an expression; ``\\0`` stands for what is computed."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(words(part) for part in node.values)
    if isinstance(node, ast.BinOp):
        return words(node.left) + words(node.right)
    return "\0"


@cache
def texts() -> tuple[str, ...]:
    """Every text in the package; text that is put together counts as one."""
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in (ROOT / "src").rglob("*.py")]
    kinds = (ast.Constant, ast.JoinedStr, ast.BinOp)
    return tuple(words(node) for tree in trees for node in ast.walk(tree) if isinstance(node, kinds))


def held(message: str, text: str) -> bool:
    """True if a text holds the message; ``...`` is what differs."""
    pattern = ".*".join(map(re.escape, message.split("...")))
    return re.search(pattern, text, re.DOTALL | re.IGNORECASE) is not None


@pytest.mark.parametrize("message", messages())
def test_a_message_is_one_of_the_program(message: str) -> None:
    assert any(held(message, text) for text in texts())


def test_the_refusals_that_users_meet_are_explained() -> None:
    run = piga.example_run()
    with pytest.raises(piga.PigaError) as confounded:
        piga.calibrate(run, ["scale_factor", "tan_beta", "k0", "k2", "k_YY"])
    calibration = piga.calibrate(run, ["scale_factor", "tan_beta", "k0"], phases="per-segment")
    with pytest.raises(piga.PigaError) as phaseless:
        piga.compensate(replace(run, labels=tuple(f"part {label}" for label in run.labels)), calibration)
    for refusal in (confounded, phaseless):
        assert any(held(message, str(refusal.value)) for message in messages()), str(refusal.value)
