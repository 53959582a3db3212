"""The JSON documents of the commands: their schemas in ``docs/reference/json``, one file a command.

Every document that a command prints in a test is compared with the schema of its command (``tests/conftest.py``). A key that the
schema does not have fails the test, as does a key that is gone. After a change that is meant:
``python -m builders.json_schemas``, and a line in CHANGELOG.
"""

from __future__ import annotations

import json
import os
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator
from typer._click.core import Context
from typer._click.globals import get_current_context

FOLDER = Path(__file__).parents[1] / "docs" / "reference" / "json"
COLLECTED = os.environ.get("PIGA_COLLECT_JSON")
"""Folder for the documents themselves, from which the builder makes the schemas."""


def command(document: Any) -> str:
    """The command that runs, e.g. ``records-show``; ``calibrate-set`` and ``check-explain`` print other documents."""
    context: Context | None = get_current_context()
    names = []
    while context is not None and context.parent is not None:
        names.append(context.info_name or "")
        context = context.parent
    if names == ["calibrate"] and document.get("schema", "").startswith("piga.set"):
        names.insert(0, "set")
    if names == ["check"] and isinstance(document, list):
        names.insert(0, "explain")
    return "-".join(reversed(names))


@cache
def validator(name: str) -> Draft202012Validator:
    """The schema of a command."""
    path = FOLDER / f"{name}.json"
    if not path.is_file():
        pytest.fail(f"{name} has no schema: python -m builders.json_schemas")
    return Draft202012Validator(json.loads(path.read_text(encoding="utf-8")))


def check(document: Any) -> None:
    """Compare a document with the schema of the command that prints it."""
    plain = json.loads(json.dumps(document))
    name = command(plain)
    if COLLECTED:
        with (Path(COLLECTED) / f"{name}.jsonl").open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(plain) + "\n")
        return
    wrong = [f"{error.json_path}: {error.message[:300]}" for error in validator(name).iter_errors(plain)]
    if wrong:
        pytest.fail(f"piga {name} --json: {wrong[:5]}; if that is meant: python -m builders.json_schemas")
