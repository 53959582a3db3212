"""Write the schemas of the JSON documents that commands print: ``python -m builders.json_schemas``.

Runs the tests that print documents, collects the documents, and writes a schema for each command into ``docs/reference/json``.
A key that not every document has is optional. The keys of some objects are data, such as names of coefficients: :data:`MAPS`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from tests.json_documents import FOLDER

COEFFICIENTS = ("share", "shift", "contributions", "effects", "effects.*")
MAPS = {
    "calibrate": ("input_sha256", "leverage", "options", *COEFFICIENTS),
    "calibrate-set": ("terms", "input_sha256"),
    "campaign-collect": ("set", "failed", "seen"),
    "check": ("input_sha256",),
    "compensate": ("flags", "repairs"),
    "init": ("comments",),
    "noise": ("input_sha256",),
    "plan": ("standard_uncertainty", "wanted"),
    "platform-compare": ("models", "theory"),
    "records-add": ("request", "software"),
    "records-diff": ("facts",),
    "records-list": ("request", "software"),
    "records-reproduce": ("changed",),
    "records-show": ("request", "software"),
    "records-verify": ("known",),
}
"""Objects of each command whose keys are data; ``.*`` for their values."""
ELSEWHERE = {
    "init": {"document": "the draft, as a run file has it"},
    "records-show": {"calibration": "calibration.json, as piga calibrate prints it"},
}
"""Objects that have a schema of their own."""
TESTS = [
    "tests/cli",
    "tests/planning",
    "tests/ledger",
    "tests/reports",
    "tests/test_gravity_norm.py",
    "tests/campaign",
    "tests/reading",
]
"""Tests that print documents in their own process."""
TYPES = {bool: "boolean", str: "string", int: "number", float: "number", type(None): "null"}


def schema_of(values: list[Any], command: str, name: str = "") -> dict[str, Any]:
    """The schema that all values have; ``name`` is the key that holds them in the documents of a command."""
    maps = MAPS.get(command, ())
    kinds = {TYPES.get(type(value), "object" if isinstance(value, dict) else "array") for value in values}
    schema: dict[str, Any] = {"type": kinds.pop() if len(kinds) == 1 else sorted(kinds)}
    if schema["type"] == "null":
        return {"description": "null in the examples"}
    objects = [value for value in values if isinstance(value, dict)]
    if name in ELSEWHERE.get(command, {}):
        return schema | {"description": ELSEWHERE[command][name]}
    if objects and name in maps:
        inner = [item for value in objects for item in value.values()]
        schema["additionalProperties"] = schema_of(inner, command, f"{name}.*") if inner else True
    elif objects:
        keys = list(dict.fromkeys(key for value in objects for key in value))
        schema["properties"] = {
            key: schema_of([value[key] for value in objects if key in value], command, key) for key in keys
        }
        schema["required"] = [key for key in keys if all(key in value for value in objects)]
        schema["additionalProperties"] = False
    items = [item for value in values if isinstance(value, list) for item in value]
    if items:
        schema["items"] = schema_of(items, command, name)
    return schema


def collect(folder: Path) -> None:
    """Run the tests that print documents, interpreted and compiled, and keep the documents in a folder."""
    for off, tests in (("1", TESTS), ("0", ["tests/docs/test_json_documents.py"])):
        environment = os.environ | {"PIGA_COLLECT_JSON": str(folder), "NUMBA_DISABLE_JIT": off}
        subprocess.run([sys.executable, "-m", "pytest", "-q", *tests], env=environment, check=False)


def main() -> None:
    """Write all schemas."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(place)
        if len(sys.argv) < 2:
            collect(folder)
        FOLDER.mkdir(exist_ok=True)
        for path in sorted(folder.glob("*.jsonl")):
            documents = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
            schema = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
            schema |= schema_of(documents, path.stem)
            (FOLDER / f"{path.stem}.json").write_text(json.dumps(schema, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
